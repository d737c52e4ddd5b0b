"""Experiments with vanejax: train, evaluate, and the settings of both."""
