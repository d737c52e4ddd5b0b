"""The default recipe on generic shapes, for `experiments.public_vs_virtual`."""

from experiments.configs import vane
from experiments.runner.experiment import Experiment


def get_config() -> Experiment:
    """RPM-Net's protocol: crops of 70 %, noise 0.01, 45 deg; tested on scans of the part."""
    config = vane.get_config()
    config.name = "public"
    config.data.shapes = "solids"
    config.training.steps = 1200  # what it learns from the part's scans, it has learned by then
    config.training.quick_compilation = False
    config.training.evaluate_every = 100
    return config
