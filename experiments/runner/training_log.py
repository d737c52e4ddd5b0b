"""The progress bar of a training, its log on disk, its validation, and the watch for divergence."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments.runner.experiment import Experiment
from experiments.runner.run_folder import RunFolder
from experiments.runner.stopping import TrainingDiverged
from vanejax.matching import pose_metrics
from vanejax.rigid import RigidTransform
from vanejax.training import PairSampling
from vanejax.training.checkpoint import all_finite
from vanejax.training.train_step import Bank, Metrics, TrainState, Variables

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
        """Logs the mean metrics since the last row; TrainingDiverged where they are of no use."""
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
        """Logs validation errors, which must be finite; the score of the best checkpoint."""
        if not all(np.isfinite(value) for value in values.values()):
            raise TrainingDiverged(f"the validation at step {step} is not finite")
        self._folder.log(step, values)
        return values["validation_rotation_error_deg"]

    def check_weights(self, step: int, state: TrainState) -> None:
        """Raises TrainingDiverged where a weight is not finite: such a state is never saved."""
        if not all_finite((state.variables, state.average)):
            raise TrainingDiverged(f"weights not finite at step {step}")


def make_validation(
    config: Experiment, bank: Bank, sampling: PairSampling, radius_mm: float
) -> Callable[[TrainState], dict[str, float]]:
    """Mean errors on training entries, drawn with a key of their own: test views stay unseen."""
    network, count = config.make_network(), config.training.validation_pairs
    key = jax.random.fold_in(jax.random.key(config.seed), 0x7A11DA7E)
    entries = jnp.linspace(0, bank.size - 1, count).astype(int)

    @jax.jit
    def errors(variables: Variables, bank: Bank) -> Metrics:
        register = network.factory(network.model, variables, iterations=network.iterations)

        def errors_of(number: jax.Array) -> Metrics:
            draw_key, register_key = jax.random.split(jax.random.fold_in(key, number))
            pairs = bank.draw(draw_key, entries[number][None], sampling)
            source, truth = jax.tree.map(
                lambda leaf: leaf[0], (pairs.source, pairs.target_from_source)
            )
            init = jax.tree.map(jnp.asarray, RigidTransform.identity())
            result = register(source, pairs.target, init, register_key)
            return pose_metrics(result.target_from_source, truth)

        return jax.lax.map(errors_of, jnp.arange(count))

    def validate(state: TrainState) -> dict[str, float]:
        means = jax.tree.map(np.mean, jax.device_get(errors(state.average, bank)))
        return {
            "validation_rotation_error_deg": float(means["rotation_error_deg"]),
            "validation_translation_error_mm": float(means["translation_error"]) * radius_mm,
        }

    return validate
