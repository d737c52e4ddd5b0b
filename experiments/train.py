"""Trains a registration network on virtual scans of a part, then evaluates it.

python -m experiments.train --config vane.py [--workdir runs/vane] [--config.FIELD=VALUE ...]

Makes the part, scans it from every viewpoint, trains, and registers the test views. Kill it and
start it again: it goes on where its last checkpoint stands and ends bit-equal.

VANEJAX_CACHE_DIR is where compiled programs are kept (~/.cache/vanejax); off keeps none.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments.evaluate import evaluate
from experiments.runner import command_line
from experiments.runner.experiment import Experiment, TrainingSettings
from experiments.runner.run_folder import RunFolder, training_record
from experiments.runner.training_banks import training_banks
from vanejax.cad.part import Part
from vanejax.matching.metrics import pose_metrics
from vanejax.rigid import RigidTransform
from vanejax.training.checkpoint import Checkpoints, all_finite, restore_or
from vanejax.training.dataset import ScanSet, describe_source, load_scan_set, make_scan_set
from vanejax.training.pairs import Bank, PairSampling
from vanejax.training.train_step import Metrics, TrainState, Variables, init_state, make_train_step

DIVERGED = 20.0  # times the loss of the first rows: no run of use comes back from there


class TrainingDiverged(RuntimeError):
    """The loss is not finite or has exploded; the last good checkpoint stands."""


class Interrupted(RuntimeError):
    """SIGINT or SIGTERM; the state is saved.

    Attributes:
      signal: its number.
    """

    def __init__(self, number: int, step: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name} after step {step}")
        self.signal = number


def train(config: Experiment, workdir: Path) -> None:
    """Trains to the end, resuming what ``workdir`` holds, and evaluates on the test views.

    Raises:
      InputError: settings, part or folder that cannot be used.
      TrainingDiverged: NaN or an exploding loss.
      Interrupted: SIGINT or SIGTERM, after the state was saved.
    """
    config.check()
    with RunFolder(workdir) as folder:
        part = config.make_part()
        for note in part.notes:
            print(f"{part.name}: {note}")
        folder.claim(config, part)
        scans = load_or_scan(config, part, folder.path / "scans.npz")
        state = fit(config, part, scans, folder)
        evaluate(
            config, scans, state.average, workdir, part=part, training=training_record(workdir)
        )


def load_or_scan(config: Experiment, part: Part, path: Path) -> ScanSet:
    """The scans of the part: from the file if there is one, else scanned and saved there."""
    camera, viewpoints = config.make_camera(), config.make_viewpoints(part)
    voxel_mm = config.data.voxel_mm
    if path.exists():
        expected = describe_source(part, camera, viewpoints, voxel_mm)
        return load_scan_set(path, expected=expected)
    scans = make_scan_set(part, camera, viewpoints, voxel_mm=voxel_mm)
    scans.save(path)
    return scans


def fit(config: Experiment, part: Part, scans: ScanSet, folder: RunFolder) -> TrainState:
    """Trains; of ``scans``, only the training views are looked at."""
    settings = config.training
    network, optimizer = config.make_network(), config.make_optimizer()
    sampling, banks = config.pair_sampling(scans), training_banks(config, part, scans, folder)
    step = make_train_step(
        network.model,
        optimizer,
        network.loss,
        sampling,
        batch_size=settings.batch_size,
        seed=config.seed,
        average_decay=settings.average_decay,
        quick_compilation=settings.quick_compilation,
    )
    validate = make_validation(config, banks.validation, sampling, scans.radius_mm)
    state = init_state(network.model, optimizer, banks.validation, sampling, seed=config.seed)
    state = restore_or(folder.checkpoints, state, keep=settings.keep)

    with (
        Checkpoints(folder.checkpoints, keep=settings.keep) as checkpoints,
        Log(folder, int(state.step), settings.steps, scans.radius_mm) as log,
        banks.steps(int(state.step), settings.steps) as bank_of_step,
        stop_signal() as stop,
    ):
        began = time.monotonic() - folder.seconds
        over = over_budget(settings, folder.seconds)
        for done in range(int(state.step) + 1, settings.steps + 1):
            if over:
                break
            asked = time.perf_counter()
            bank = next(bank_of_step)
            waited = time.perf_counter() - asked
            state, metrics = step(state, bank)
            log.add(metrics | {"scan_wait_s": waited})
            leave = bool(stop)  # once: a signal may come between two looks
            over = over_budget(settings, time.monotonic() - began)
            last = over or done == settings.steps
            score = None
            if done % settings.log_every == 0 or last or leave:
                log.write(done)
            if done % settings.evaluate_every == 0 or last:
                score = log.write_validation(done, validate(state))
            if done % settings.save_every == 0 or score is not None or leave:
                log.check_weights(done, state)
                checkpoints.save(state, score=score)
                folder.seconds = time.monotonic() - began
            if leave and not last:
                raise Interrupted(stop[0], done)
    return state


def over_budget(settings: TrainingSettings, seconds: float) -> bool:
    """Whether training has used up its budget."""
    return 0 < 60 * settings.budget_minutes <= seconds


class Log:
    """The progress bar, the log on disk, and the watch for divergence; a context manager."""

    def __init__(self, folder: RunFolder, step: int, steps: int, radius_mm: float) -> None:
        self._folder = folder
        self._radius_mm = radius_mm
        self._recent: list[Metrics] = []
        self._first_loss: float | None = None
        folder.open_log(step)
        self._bar = tqdm(total=steps, initial=step, unit="step", desc="training")

    def __enter__(self) -> Log:
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


def make_validation(
    config: Experiment, bank: Bank, sampling: PairSampling, radius_mm: float
) -> Callable[[TrainState], dict[str, float]]:
    """Pose errors of the averaged weights on training entries, drawn with a key of their own.

    They choose the best checkpoint, so that the test views stay unseen until the end.
    """
    network, count = config.make_network(), config.training.validation_pairs
    key = jax.random.fold_in(jax.random.key(config.seed), 0x7A11DA7E)
    entries = jnp.linspace(0, bank.size - 1, count).astype(int)

    @jax.jit
    def errors(variables: Variables, bank: Bank) -> Metrics:
        register = network.factory(network.model, variables, iterations=network.iterations)

        def one(number: jax.Array) -> Metrics:
            draw_key, register_key = jax.random.split(jax.random.fold_in(key, number))
            pairs = bank.draw(draw_key, entries[number][None], sampling)
            source, truth = jax.tree.map(
                lambda leaf: leaf[0], (pairs.source, pairs.target_from_source)
            )
            init = jax.tree.map(jnp.asarray, RigidTransform.identity())
            found = register(source, pairs.target, init, register_key)
            return pose_metrics(found.target_from_source, truth)

        return jax.lax.map(one, jnp.arange(count))

    def validate(state: TrainState) -> dict[str, float]:
        found = jax.device_get(errors(state.average, bank))
        return {
            "validation_rotation_error_deg": float(np.mean(found["rotation_error_deg"])),
            "validation_translation_error_mm": float(np.mean(found["translation_error"]))
            * radius_mm,
        }

    return validate


@contextmanager
def stop_signal() -> Iterator[list[int]]:
    """A list that receives SIGINT or SIGTERM; a second one acts as it always does."""
    caught: list[int] = []
    before = {}

    def catch(number: int, _: object) -> None:
        caught.append(number)
        signal.signal(number, before[number])

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, catch)
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def exit_code(work: Callable[[], object], workdir: Path) -> int:
    """Does work that trains in ``workdir``; 0, or what its early end means, said in one line."""
    try:
        work()
    except Interrupted as stop:
        print(f"{stop}; saved in {workdir}. Run the same command to go on.", file=sys.stderr)
        return 128 + stop.signal
    except TrainingDiverged as trouble:
        print(
            f"error: training stopped: {trouble}. The last good checkpoint is kept in {workdir}. "
            "Try a lower learning_rate in config.training, with another --workdir.",
            file=sys.stderr,
        )
        return 1
    return 0


def main(config: Experiment, workdir: Path) -> int:
    """Trains, evaluates and reports; the exit code."""
    return exit_code(lambda: train(config, workdir), workdir)


if __name__ == "__main__":
    CONFIG = command_line.define_config()
    WORKDIR = command_line.define_workdir()
    command_line.run(lambda: main(CONFIG.value, command_line.workdir(WORKDIR, CONFIG)))
