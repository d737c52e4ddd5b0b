"""The smallest experiment that trains, tests and draws: the network that compiles soonest."""

from __future__ import annotations

from experiments.configs.smoke import get_config
from experiments.runner.experiment import Experiment


def tiny_experiment() -> Experiment:
    """Two training views and two test views, twelve steps; its figures mean nothing."""
    config = get_config()
    config.name = "tiny"
    config.views.elevations_deg, config.views.azimuths_deg = (60.0,), (0.0, 20.0, 40.0, 60.0)
    config.data.num_reference = 64
    config.model.name = "pcrnet"
    config.pcrnet.head, config.pcrnet.test_iterations, config.pcrnet.loss.iterations = (16,), 1, 1
    training = config.training
    training.steps, training.validation_pairs = 12, 2
    training.log_every, training.evaluate_every, training.save_every = 2, 6, 4
    return config
