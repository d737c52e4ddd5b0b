"""Learned registration networks."""
