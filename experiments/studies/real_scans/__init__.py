"""Registers real scans without guess or training, against ground truth."""
