"""The paper's letter: published RPM-Net loss, batches of one, no averaging of weights."""

from experiments.runner.experiment import Experiment, TrainingSettings


def get_config() -> Experiment:
    """The optimizer is RPM-Net's Adam at 1e-4, constant; the paper names none of its own."""
    return Experiment(
        name="paper",
        training=TrainingSettings(
            batch_size=1,
            learning_rate=1e-4,
            warmup_steps=0,
            final_fraction=1.0,
            clip_norm=1e9,
            average_decay=0.0,
            steps=20_000,
        ),
    )
