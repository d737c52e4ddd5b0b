"""The default recipe: the paper's data and network, with what was measured to train better."""

from experiments.runner.experiment import Experiment, TrainingSettings
from vanejax.training import RpmNetLoss


def get_config() -> Experiment:
    """Half an hour on two cores."""
    return Experiment(
        name="vane",
        loss=RpmNetLoss(matching=0.02, matching_sigma=0.02),
        training=TrainingSettings(steps=4000, learning_rate=2e-3),
    )
