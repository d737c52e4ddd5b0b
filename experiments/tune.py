"""Tunes the classical methods of a comparison on training views; the test views stay unseen.

python -m experiments.tune --config table1.py [--methods icp,fgr] [--views 18]
    [--workdir runs/table1]

Every method of the library and of Open3D runs over its grid, on pairs drawn from training views
alone. The settings with the smallest mean rotation error, each view's capped at 20 deg so that a
part turned over counts once and not ninefold, win; they are printed as options of
`experiments.compare`, and every cell is kept in tuning.json.

VANEJAX_CACHE_DIR is where compiled programs are kept (~/.cache/vanejax); off keeps none.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags
from tqdm import tqdm

from experiments.runner import command_line
from experiments.runner import study_command as study
from experiments.runner.machine import PACKAGES, PEERS, report_head, versions
from experiments.runner.registrations import Results, register_views
from experiments.runner.sweep import with_values
from experiments.studies.comparison.methods import TITLES, make_method
from experiments.studies.comparison.settings import CLASSICAL, OPEN3D, Comparison
from experiments.train import load_or_scan
from vanejax.errors import InputError, MissingExtra
from vanejax.training import make_bank

CAP_DEG = 20.0
_FEATURES = (0.25, 0.3, 0.5)
_DISTANCES = (0.05, 0.1)
GRIDS: dict[str, dict[str, Sequence[Any]]] = {
    "icp": {
        "icp.metric": ("point_to_point", "point_to_plane"),
        "icp.max_distance": (0.2, 0.4, 0.8, 1.6),
        "icp.kernel": ("none", "huber"),
        "icp.trim": (1.0, 0.8),
    },
    "sac_ia": {"sac_ia.feature_radius": _FEATURES, "sac_ia.max_distance": _DISTANCES},
    "sac_ia_icp": {
        "sac_ia.max_distance": _DISTANCES,
        "fine_icp.metric": ("point_to_point", "point_to_plane"),
        "fine_icp.max_distance": (0.02, *_DISTANCES),
    },
    "fgr": {"fgr.feature_radius": _FEATURES, "fgr.max_distance": (0.025, *_DISTANCES)},
    "open3d_icp": {
        "open3d_icp.metric": ("point_to_point", "point_to_plane"),
        "open3d_icp.max_distance": (0.2, 0.4, 0.8, 1.6),
    },
    "open3d_ransac_icp": {
        "open3d_ransac.feature_radius": _FEATURES,
        "open3d_ransac.max_distance": _DISTANCES,
        "open3d_fine_icp.max_distance": _DISTANCES,
    },
    "open3d_fgr": {
        "open3d_fgr.feature_radius": _FEATURES,
        "open3d_fgr.max_distance": (0.025, *_DISTANCES),
        "open3d_fgr.tuple_similarity": (0.9, 0.95),
    },
}


def cells(grid: Mapping[str, Sequence[Any]]) -> Iterator[dict[str, Any]]:
    """Every combination of a grid, as values by field."""
    for values in itertools.product(*grid.values()):
        yield dict(zip(grid, values, strict=True))


def score_deg(results: Results) -> float:
    """Mean rotation error with each view's capped; what is not finite counts as the cap."""
    errors = np.nan_to_num(results.errors.rotation_deg, nan=CAP_DEG, posinf=CAP_DEG)
    return float(np.mean(np.minimum(errors, CAP_DEG)))


def tune(config: Comparison, workdir: Path, methods: Sequence[str], views: int) -> dict[str, Any]:
    """The grids on ``views`` training views, spread over all; gives what tuning.json holds."""
    unknown = [name for name in methods if name not in GRIDS]
    if unknown or not methods:
        raise InputError(f"methods {', '.join(unknown)}: only {', '.join(GRIDS)} are tuned")
    experiment = config.experiment
    part = experiment.make_part()
    scans = load_or_scan(experiment, part, workdir / "scans.npz")
    if not len(scans.train):
        raise InputError("there are no training views to tune on")
    chosen = np.unique(np.linspace(0, len(scans.train) - 1, views).round().astype(int))
    bank = make_bank(scans.train.select(chosen), num_reference=experiment.data.num_reference)
    report: dict[str, Any] = {
        "name": config.name,
        **report_head(part, seed=experiment.seed, config=dataclasses.asdict(config)),
        "versions": versions((*PACKAGES, *PEERS)),
        "training_views": chosen,
        "score": f"mean rotation error, capped at {CAP_DEG:g} deg",
        "methods": {},
    }
    for name in methods:
        rows = []
        grid = list(cells(GRIDS[name]))
        for values in tqdm(grid, TITLES[name], unit="cell"):
            try:
                register = make_method(name, with_values(config, values))
            except MissingExtra as missing:
                report["methods"][name] = {"skipped": str(missing)}
                break
            results = register_views(
                register,
                bank,
                experiment.pair_sampling(scans),
                seed=experiment.seed,
                unit_mm=scans.radius_mm,
                progress=False,
            )
            rows.append(
                {
                    "values": values,
                    "score_deg": score_deg(results),
                    "median_rotation_deg": np.median(results.errors.rotation_deg),
                    "median_translation_mm": np.median(results.errors.translation_mm),
                    "time_s": np.median(results.time_s),
                }
            )
        else:
            best = min(rows, key=lambda row: row["score_deg"])
            report["methods"][name] = {"best": best, "cells": rows}
        saved = study.save(workdir, "tuning", report)  # what is found outlives a kill
    print(table(saved))
    return saved


def table(report: Mapping[str, Any]) -> str:
    """The best settings of each method, as options of the comparison."""
    lines = [f"{len(report['training_views'])} training views; {report['score']}"]
    for name, outcome in report["methods"].items():
        if "skipped" in outcome:
            lines.append(f"{TITLES[name]}: {outcome['skipped']}")
            continue
        best = outcome["best"]
        lines += [
            f"{TITLES[name]}: {best['score_deg']:.3g} deg, median "
            f"{best['median_rotation_deg']:.3g} deg and {best['median_translation_mm']:.3g} mm, "
            f"{best['time_s']:.2g} s; best of {len(outcome['cells'])}",
            "  " + " ".join(f"--config.{path}={value}" for path, value in best["values"].items()),
        ]
    return "\n".join(lines)


if __name__ == "__main__":
    CHOICE = flags.DEFINE_list("methods", list(CLASSICAL + OPEN3D), "which methods to tune")
    VIEWS = flags.DEFINE_integer("views", 18, "training views to tune on", lower_bound=1)
    command_line.run(
        lambda config, workdir: tune(config, workdir, CHOICE.value, VIEWS.value), tree=Comparison
    )
