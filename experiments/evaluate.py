"""Registers the test views with a trained network: errors, a table, JSON and pictures.

python -m experiments.evaluate --config vane.py [--workdir runs/vane] [--config.FIELD=VALUE ...]

Needs what ``experiments.train`` left in the work folder: the scans and a checkpoint. What limits
the network shows by changing what it is tested with, results kept apart by ``--out``:
``--config.data.noise=0``, ``--config.data.num_reference=2048``,
``--config.model.test_iterations=2``, and another ``--config.seed`` for other points, noise, poses.

VANEJAX_CACHE_DIR is where compiled programs are kept (~/.cache/vanejax); off keeps none.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
from absl import flags

from experiments.runner import command_line
from experiments.runner import evaluation_pictures as pictures
from experiments.runner.evaluation_report import plain, summarize, table
from experiments.runner.experiment import Experiment
from experiments.runner.machine import report_head
from experiments.runner.registrations import Results, register_views
from experiments.runner.run_folder import RunFolder, TrainingRecord, training_record
from vanejax.cad import Part
from vanejax.errors import InputError
from vanejax.files import write_json
from vanejax.training import Checkpoints, make_bank
from vanejax.training.dataset import ScanSet, describe_source, load_scan_set
from vanejax.training.train_step import Variables


def evaluate(
    config: Experiment,
    scans: ScanSet,
    variables: Variables,
    folder: Path,
    *,
    part: Part,
    training: TrainingRecord | None = None,
) -> dict[str, Any]:
    """Registers the test views from the identity; returns what evaluation.json holds.

    With the ``training``, the report says how long it took, and its curves are drawn. Raises
    InputError without test views.
    """
    results = registered(config, scans, variables)
    report = report_of(config, scans, results)
    if training is not None:
        summary = training.summary(config.training.steps)
        report["training"] = plain(summary | {"curve": training.curve})
    log = training.rows if training is not None else ()
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "evaluation.json", report)
    pictures.draw(results, scans.test, part, config.make_camera(), log, folder)
    print(table(report))
    return report


def registered(
    config: Experiment, scans: ScanSet, variables: Variables, *, progress: bool = True
) -> Results:
    """The registrations of the test views; InputError if there are none."""
    test = scans.test
    if not len(test):
        raise InputError("no test views: none of config.views.azimuths_deg is a multiple of 40 deg")
    return register_views(
        config.make_network().register(variables),
        make_bank(test, num_reference=config.data.num_reference),
        config.pair_sampling(scans),
        seed=config.seed,
        unit_mm=scans.radius_mm,
        progress=progress,
    )


def report_of(config: Experiment, scans: ScanSet, results: Results) -> dict[str, Any]:
    """What evaluation.json holds of the registrations of the test views."""
    network = config.make_network()
    times = "1 iteration" if network.iterations == 1 else f"{network.iterations} iterations"
    report = {"method": f"{network.title}, {times}, no initial guess"}
    report |= report_head(None, seed=config.seed, config=dataclasses.asdict(config))
    report |= {
        "device": str(jax.devices()[0].device_kind),
        "part": {"name": scans.source["part"], "sha256": scans.source["part_sha256"]},
    }
    return plain(report | summarize(results, scans.test))


def load_variables(
    config: Experiment, scans: ScanSet, folder: Path, *, which: str = "latest"
) -> Variables:
    """Averaged weights of a run's "latest" or "best" checkpoint; InputError if none is there."""
    bank = make_bank(scans, num_reference=config.data.num_reference)
    like = jax.eval_shape(lambda: config.initial_state(bank, config.pair_sampling(scans)))
    path = RunFolder(folder).checkpoints
    if not path.is_dir():
        raise InputError(f"{folder} holds no checkpoints; train first, or give its --workdir")
    with Checkpoints(path, keep=config.training.keep) as checkpoints:
        step = checkpoints.best_step if which == "best" else checkpoints.latest_step
        return checkpoints.restore(like, step=step).average


def main(config: Experiment, workdir: Path, out: Path, which: str) -> None:
    """Evaluates the trained network of a work folder; the results go to ``out``."""
    config.check()
    part = config.make_part()
    camera, viewpoints = config.make_camera(), config.make_viewpoints(part)
    expected = describe_source(part, camera, viewpoints, config.data.voxel_mm)
    scans = load_scan_set(workdir / "scans.npz", expected=expected)
    variables = load_variables(config, scans, workdir, which=which)
    evaluate(config, scans, variables, out, part=part, training=training_record(workdir))


if __name__ == "__main__":
    CHECKPOINT = flags.DEFINE_enum("checkpoint", "latest", ["latest", "best"], "which weights")
    OUT = flags.DEFINE_string("out", None, "folder for the results; the work folder if not given")
    command_line.run(
        lambda config, workdir: main(config, workdir, Path(OUT.value or workdir), CHECKPOINT.value)
    )
