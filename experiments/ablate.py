"""Ablations: trains a network for every cell of a grid of settings, and compares their errors.

python -m experiments.ablate --config vane.py --sweep model.num_neighbors=8,16,32,64
    [--sweep data.noise=0,0.01] [--seeds 0,1,2] [--cell_minutes=10] [--workdir runs/ablation]
    [--config.FIELD=VALUE ...] [--cells]

Any field of the config can be swept; several sweeps make a grid; tuples stand in brackets. Every
cell registers the test views twice: under its own settings, and under the data, views, part and
seed of the config, the same test for all. Kill it and give the command again: finished cells are
kept, the one that was interrupted goes on. Results: a table, cells.jsonl (a line for each cell),
ablation.json and ablation.png in the work folder.

VANEJAX_CACHE_DIR is where compiled programs are kept (~/.cache/vanejax); off keeps none.
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from absl import flags

from experiments.evaluate import registered, report_of
from experiments.runner import command_line
from experiments.runner import study_command as study
from experiments.runner.evaluation_report import plain
from experiments.runner.experiment import Experiment
from experiments.runner.machine import report_head
from experiments.runner.run_folder import RunFolder, training_record
from experiments.runner.stopping import TrainingDiverged
from experiments.runner.sweep import Cell, Sweep, check_used, grid, parse_seeds, parse_sweeps
from experiments.runner.trained import trained
from experiments.studies.ablation import picture as ablation_picture
from experiments.studies.ablation.table import CELL_TESTS, over_seeds, table
from experiments.train import load_or_scan
from vanejax.cad import Part
from vanejax.errors import InputError
from vanejax.files import write_text
from vanejax.plotting import save_figure
from vanejax.training.dataset import ScanSet, describe_source
from vanejax.training.train_step import Variables

MEASURES = (
    "rotation_error_deg",
    "translation_error_mm",
    "rmse_mm",
    "ffmde_signed_mm",
    "ffmde_abs_mm",
)


class SharedScans:
    """Parts and their scans: made once for all the cells that need the same."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._parts: dict[tuple[str, str, float], Part] = {}

    def part(self, config: Experiment) -> Part:
        """The part of a cell."""
        made_from = (config.part.path, config.part.units, config.views.resolution)
        if made_from not in self._parts:
            self._parts[made_from] = config.make_part()
        return self._parts[made_from]

    def path(self, config: Experiment) -> Path:
        """Where the scans of a cell are: the same file where they are the same scans.

        Raises InputError where viewpoints to train on or to test are lacking.
        """
        part = self.part(config)
        viewpoints = config.make_viewpoints(part)
        trained_on = config.data.shapes or not viewpoints.is_test.all()
        if not (trained_on and viewpoints.is_test.any()):
            raise InputError(
                f"config.views.azimuths_deg={config.views.azimuths_deg}: multiples of 40 deg are "
                "tested, all others are trained on; both kinds are needed"
            )
        source = describe_source(part, config.make_camera(), viewpoints, config.data.voxel_mm)
        digest = hashlib.sha256(json.dumps(source, sort_keys=True).encode()).hexdigest()
        return self._folder / f"scans-{digest[:12]}.npz"

    def scans(self, config: Experiment) -> ScanSet:
        """The scans of a cell, from the file if another cell has made them."""
        return load_or_scan(config, self.part(config), self.path(config))


def ablate(
    config: Experiment, sweeps: Sequence[Sweep], seeds: Sequence[int], workdir: Path
) -> dict[str, Any]:
    """Trains and tests every cell that is not finished yet; returns what ablation.json holds.

    The test that is the same for all cells is drawn as ``config`` says; the first of the ``sweeps``
    is the axis of the picture. Raises InputError before anything is trained, and Interrupted after
    the state of a cell was saved.
    """
    cells = grid(sweeps, seeds)
    check_used(cells, config)
    shared = SharedScans(workdir)
    for cell in cells:
        settings = cell.config(config)
        settings.check()
        shared.path(settings)
    config.check()
    shared.path(config)
    part = shared.part(config)
    rows = []
    with RunFolder(workdir) as folder:
        folder.claim(config, part)
        done = read_cells(workdir)
        for number, cell in enumerate(cells, 1):
            row = finished(cell, shared.part(cell.config(config)), done)
            print(
                f"cell {number} of {len(cells)}, {cell.name}: {'finished' if row else 'training'}"
            )
            if row is None:
                row = run_cell(cell, config, shared, workdir)
                done.append(row)
                write_text(workdir / "cells.jsonl", "".join(json.dumps(r) + "\n" for r in done))
            rows.append(row)
    head = report_head(part, seed=config.seed, config=dataclasses.asdict(config))
    report = {
        "name": config.name,
        **head,
        "sweeps": [dataclasses.asdict(sweep) for sweep in sweeps],
        "seeds": list(seeds),
        "points": over_seeds(rows),
        "cells": [{name: row[name] for name in row if name != "config"} for row in rows],
    }
    report = study.save(workdir, "ablation", report)
    save_figure(ablation_picture.picture(report), workdir / "ablation.png")
    print(table(report))
    return report


def run_cell(cell: Cell, base: Experiment, shared: SharedScans, workdir: Path) -> dict[str, Any]:
    """Trains a cell, or goes on from its checkpoint, and tests it; its line of cells.jsonl.

    A training that diverges is a result, too: a line whose tests are None.
    """
    config, folder = cell.config(base), workdir / "cells" / cell.name
    part, scans = shared.part(config), shared.scans(config)
    tests: dict[str, Any] = dict.fromkeys(CELL_TESTS)
    try:
        network = trained(config, part, scans, folder)
    except TrainingDiverged as trouble:
        print(f"{cell.name}: training diverged: {trouble}")
        training = training_record(folder).summary(config.training.steps)
        training["ended_by"] = "divergence"
    else:
        training = network.record.summary(config.training.steps)
        tests["own"] = tests["same"] = errors_under(config, scans, network.variables)
        same = same_test(config, base)
        if same != config:
            tests["same"] = errors_under(same, shared.scans(same), network.variables)
    row = {
        "cell": cell.name,
        "overrides": dict(cell.overrides),
        **report_head(part, seed=cell.seed, config=dataclasses.asdict(config)),
        "device": str(jax.devices()[0].device_kind),
        "training": training,
        "tests": tests,
    }
    return plain(row)


def same_test(config: Experiment, base: Experiment) -> Experiment:
    """The cell's network under the base's data, views, part and seed."""
    same = copy.deepcopy(config)
    same.seed, same.part, same.views = base.seed, base.part, base.views
    # shapes are what it was trained on, no matter of the test
    same.data = dataclasses.replace(base.data, shapes=config.data.shapes)
    return same


def errors_under(config: Experiment, scans: ScanSet, variables: Variables) -> dict[str, Any]:
    """Summaries of the errors over the test views."""
    report = report_of(config, scans, registered(config, scans, variables))
    counts = {name: report[name] for name in ("views", "non_finite_views")}
    return counts | {name: report["summary"][name] for name in MEASURES}


def read_cells(workdir: Path) -> list[dict[str, Any]]:
    """The lines of cells.jsonl, none where there is no such file; InputError for broken ones."""
    path = workdir / "cells.jsonl"
    if not path.exists():
        return []
    try:
        return [json.loads(line) for line in path.read_text().splitlines()]
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as lines of JSON ({error})") from error


def finished(cell: Cell, part: Part, rows: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """The line of this very cell on this very part; a work folder belongs to one config."""
    wanted = cell.name, part.sha256
    return next((row for row in rows if (row["cell"], row["part"]["sha256"]) == wanted), None)


def list_cells(cells: Sequence[Cell], config: Experiment, workdir: Path) -> None:
    """Prints what would be trained, and how long at most."""
    check_used(cells, config)
    names = {row["cell"] for row in read_cells(workdir)}
    for cell in cells:
        settings = cell.config(config).training
        most = f", {settings.budget_minutes:g} min at most" if settings.budget_minutes else ""
        status = "finished" if cell.name in names else f"{settings.steps} steps{most}"
        print(f"{cell.name}: {status}")


if __name__ == "__main__":
    SWEEPS = flags.DEFINE_multi_string(
        "sweep", [], "FIELD=VALUE,VALUE,... of the config; give it again for a grid"
    )
    SEEDS = flags.DEFINE_list("seeds", [], "every cell is trained with each; the config's if none")
    MINUTES = flags.DEFINE_float(
        "cell_minutes",
        None,
        "most minutes of training a cell, 0 for no limit; the config's budget_minutes if not given",
        lower_bound=0.0,
    )
    CELLS = flags.DEFINE_bool("cells", False, "list the cells and train none")

    def run(config: Experiment, workdir: Path) -> None:
        """The command."""
        sweeps, seeds = parse_sweeps(SWEEPS.value, config), parse_seeds(SEEDS.value, config.seed)
        if MINUTES.value is not None:
            if any(sweep.field == "training.budget_minutes" for sweep in sweeps):
                raise InputError("--cell_minutes: training.budget_minutes is swept; give one")
            config.training.budget_minutes = MINUTES.value
        if CELLS.value:
            list_cells(grid(sweeps, seeds), config, workdir)
        else:
            ablate(config, sweeps, seeds, workdir)

    command_line.run(
        run,
        workdir="folder of the cells; runs/NAME-ablation with the config's name if none",
        default=lambda config: f"runs/{config.name}-ablation",
    )
