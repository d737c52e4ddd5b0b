"""What `experiments.benchmark` times, one subject a module."""
