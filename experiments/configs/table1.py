"""The paper's Table 1 on the guide vane: every method, with settings tuned on training views."""

import dataclasses

from experiments.comparison import Comparison, TrainingOfNetworks
from experiments.configs import vane


def get_config() -> Comparison:
    """RPM-Net as in `vane.py`."""
    experiment = vane.get_config()
    recipe = experiment.training
    return Comparison(
        experiment=experiment,
        training=TrainingOfNetworks(
            dcp=dataclasses.replace(recipe, steps=1500, learning_rate=1e-3),
            pointnetlk=dataclasses.replace(recipe, steps=4000, learning_rate=1e-3),
            pcrnet=dataclasses.replace(recipe, steps=8000, learning_rate=1e-3),
            rpmnet=recipe,
        ),
    )
