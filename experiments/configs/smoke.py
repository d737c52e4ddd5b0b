"""The same pipeline in a minute: few pixels, few views, few points, a narrow network."""

from experiments.runner.experiment import (
    DataSettings,
    Experiment,
    ModelSettings,
    TrainingSettings,
    ViewSettings,
)
from vanejax.training import RpmNetLoss


def get_config() -> Experiment:
    """Under 60 s on two cores, compilation included; its figures mean nothing."""
    return Experiment(
        name="smoke",
        views=ViewSettings(
            elevations_deg=(60.0, 85.0),
            azimuths_deg=tuple(float(angle) for angle in range(0, 360, 20)),
            resolution=0.25,
        ),
        data=DataSettings(voxel_mm=4.0, num_reference=256),
        model=ModelSettings(num_neighbors=8, feature_width=32, test_iterations=2),
        loss=RpmNetLoss(matching=0.02, matching_sigma=0.08),
        training=TrainingSettings(
            steps=40,
            batch_size=2,
            warmup_steps=5,
            log_every=5,
            evaluate_every=20,
            save_every=10,
            validation_pairs=4,
        ),
    )
