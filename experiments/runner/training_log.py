"""The progress bar of a training, its log on disk, and the watch for divergence."""

from __future__ import annotations

import jax
import numpy as np
from tqdm import tqdm

from experiments.runner.run_folder import RunFolder
from experiments.runner.stopping import TrainingDiverged
from vanejax.training.checkpoint import all_finite
from vanejax.training.train_step import Metrics, TrainState

DIVERGED = 20.0  # times the loss of the first rows: no run of use comes back from there


class TrainingLog:
    """A context manager that takes the metrics of every step."""

    def __init__(self, folder: RunFolder, step: int, steps: int, radius_mm: float) -> None:
        self._folder = folder
        self._radius_mm = radius_mm
        self._recent: list[Metrics] = []
        self._first_loss: float | None = None
        folder.open_log(step)
        self._bar = tqdm(total=steps, initial=step, unit="step", desc="training")

    def __enter__(self) -> TrainingLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def add(self, metrics: Metrics) -> None:
        """Takes the metrics of one more step, without waiting for the device."""
        self._recent.append(metrics)
        self._bar.update()

    def write(self, step: int) -> None:
        """Logs the mean metrics of the steps since the last row.

        Raises:
          TrainingDiverged: a mean is not finite, or the loss has exploded.
        """
        rows = jax.device_get(self._recent)
        self._recent = []
        values = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
        values["translation_error_mm"] = values.pop("translation_error") * self._radius_mm
        bad = [name for name, value in values.items() if not np.isfinite(value)]
        if bad:
            raise TrainingDiverged(f"{', '.join(bad)} not finite at step {step}")
        loss = values["loss"]
        self._first_loss = self._first_loss or loss
        if loss > DIVERGED * self._first_loss:
            times = loss / self._first_loss
            raise TrainingDiverged(
                f"the loss at step {step}, {loss:.3g}, is {times:.0f} times the first"
            )
        self._folder.log(step, values)
        self._bar.set_postfix_str(
            f"loss {loss:.4f}, {values['rotation_error_deg']:.2f} deg, "
            f"{values['translation_error_mm']:.2f} mm"
        )

    def write_validation(self, step: int, values: dict[str, float]) -> float:
        """Logs validation errors; the score that the best checkpoint is chosen by.

        Raises:
          TrainingDiverged: an error is not finite.
        """
        if not all(np.isfinite(value) for value in values.values()):
            raise TrainingDiverged(f"the validation at step {step} is not finite")
        self._folder.log(step, values)
        return values["validation_rotation_error_deg"]

    def check_weights(self, step: int, state: TrainState) -> None:
        """Raises TrainingDiverged where a weight is not finite: such a state is never saved."""
        if not all_finite((state.variables, state.average)):
            raise TrainingDiverged(f"weights not finite at step {step}")
