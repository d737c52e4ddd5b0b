"""The default recipe on scans without end: any view, another structured-light camera each time."""

from experiments.runner.experiment import DataSettings, Experiment, TrainingSettings
from vanejax.training import RpmNetLoss
from vanejax.training.online_scans import OnlineScans


def get_config() -> Experiment:
    """Half an hour on two cores; less noise is added, since the scans have their sensor's."""
    return Experiment(
        name="vane_robust",
        data=DataSettings(noise=0.005, noise_clip=0.025),
        online=OnlineScans(sensor="paper_camera", casting_mm=0.5),
        loss=RpmNetLoss(matching=0.02, matching_sigma=0.02),
        training=TrainingSettings(steps=2500, learning_rate=2e-3, quick_compilation=False),
    )
