"""Trains a registration network on virtual scans of a part, then evaluates it.

python -m experiments.train --config vane.py [--workdir runs/vane] [--config.FIELD=VALUE ...]

Makes the part, scans it from every viewpoint, trains, and registers the test views. Kill it and
start it again: it goes on where its last checkpoint stands and ends bit-equal.

VANEJAX_CACHE_DIR is where compiled programs are kept (~/.cache/vanejax); off keeps none.
"""

from __future__ import annotations

import time
from pathlib import Path

from experiments.evaluate import evaluate
from experiments.runner import command_line
from experiments.runner.experiment import Experiment
from experiments.runner.run_folder import RunFolder, training_record
from experiments.runner.stopping import Interrupted, stop_signal
from experiments.runner.training_banks import training_banks
from experiments.runner.training_log import TrainingLog, make_validation
from vanejax.cad import Part
from vanejax.training import Checkpoints, TrainState, restore_or
from vanejax.training.dataset import ScanSet, describe_source, load_scan_set, make_scan_set


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
        training = training_record(workdir)
        evaluate(config, scans, state.average, workdir, part=part, training=training)


def load_or_scan(config: Experiment, part: Part, path: Path) -> ScanSet:
    """The scans of the part: from the file if there is one, else scanned and saved there."""
    camera, viewpoints = config.make_camera(), config.make_viewpoints(part)
    voxel_mm = config.data.voxel_mm
    if path.exists():
        expected = describe_source(part, camera, viewpoints, voxel_mm)
        return load_scan_set(path, expected=expected)
    scans = make_scan_set(part, camera, viewpoints, voxel_mm=voxel_mm)
    path.parent.mkdir(parents=True, exist_ok=True)
    scans.save(path)
    return scans


def fit(config: Experiment, part: Part, scans: ScanSet, folder: RunFolder) -> TrainState:
    """Trains; of ``scans``, only the training views are looked at."""
    training, steps = config.training, config.training.steps
    sampling, banks = config.pair_sampling(scans), training_banks(config, part, scans, folder)
    state = config.initial_state(banks.validation, sampling)
    state = restore_or(folder.checkpoints, state, keep=training.keep)
    validate = make_validation(config, banks.validation, sampling, scans.radius_mm)
    step = config.train_step(sampling)
    first = int(state.step)
    began = time.monotonic() - folder.seconds  # of all that was trained before, too
    with (
        Checkpoints(folder.checkpoints, keep=training.keep) as checkpoints,
        TrainingLog(folder, first, steps, scans.radius_mm) as log,
        banks.steps(first, steps) as bank_of_step,
        stop_signal() as signals,
    ):
        last = over_budget(config, folder.seconds)
        for done in () if last else range(first + 1, steps + 1):
            asked = time.perf_counter()
            bank = next(bank_of_step)
            waited = time.perf_counter() - asked
            state, metrics = step(state, bank)
            log.add(metrics | {"scan_wait_s": waited})

            stop = bool(signals)  # once: a signal may come between two looks
            last = done == steps or over_budget(config, time.monotonic() - began)
            score = None
            if done % training.log_every == 0 or last or stop:
                log.write(done)
            if done % training.evaluate_every == 0 or last:
                score = log.write_validation(done, validate(state))
            if done % training.save_every == 0 or score is not None or stop:
                log.check_weights(done, state)
                checkpoints.save(state, score=score)
                folder.seconds = time.monotonic() - began
            if last:
                break
            if stop:
                raise Interrupted(signals[0], done, folder.path)
    return state


def over_budget(config: Experiment, seconds: float) -> bool:
    """Whether training has used up its budget of time."""
    return 0 < 60 * config.training.budget_minutes <= seconds


if __name__ == "__main__":
    command_line.run(train)
