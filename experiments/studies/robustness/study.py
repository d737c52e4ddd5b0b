"""How registration stands what happens at a machine: distance, angle, light, clutter, casting.

python -m experiments.robustness --weights ideal=vane.npz --weights robust=vane_robust.npz
    [--views 6] [--random 1000] [--out runs/robustness]

Each network registers the same scans, from the same rough poses up to 45 deg and half a part radius
away, and fine registration goes on from there. ``--weights NAME=FILE`` is what `vanejax export`
wrote for the guide vane. ``--random N`` adds N scans from anywhere between 300 and 500 mm by N
cameras, registered by `vanejax.register` with the last of the networks, verdict and all. Results:
tables, robustness.json, and the paper's Fig. 11 drawn again in ``--out``.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from tqdm import tqdm

from experiments.runner import study_command as study
from experiments.runner.vane_views import magnitudes, perturb, pose_error
from experiments.studies.density.study import fit
from experiments.studies.robustness import report as robustness_report
from experiments.studies.robustness.disturbances import SENSOR, Disturbed, Series, Stand
from experiments.studies.verdicts.report import verdict_counts
from vanejax.cad import Part, guide_vane
from vanejax.errors import InputError
from vanejax.localization import measurement_model, refine, register
from vanejax.localization.form_deviation import with_form_deviation
from vanejax.localization.matched_poses import match_poses
from vanejax.localization.pose_batch import select, stack
from vanejax.plotting import save_figure
from vanejax.rigid import RigidTransform
from vanejax.scans import MeasuredScan
from vanejax.scans.voxels import voxel_thin
from vanejax.training import TrainedMatcher, find_weights
from vanejax.training.online_scans import RandomViews

START_DEG, START_SHARE = 45.0, 0.5  # of the part's radius
RIGHT_DEG, RIGHT_MM, LEAST_RIGHT = 0.1, 0.15, 0.99
_STARTS, _RANDOM = 0x57A7, 0x4A4D  # folded into the seed


class Trial:
    """Registers disturbed scans of one part with several networks."""

    def __init__(self, part: Part, networks: Mapping[str, TrainedMatcher]) -> None:
        self.part, self.networks = part, networks
        self._model = measurement_model(part, np.zeros(3))
        matcher = next(iter(networks.values()))
        self._tree = cKDTree(matcher.reference_points.astype(np.float64))
        self._normals = matcher.reference_normals
        self._voxel_mm = matcher.voxel_mm

    def row(
        self, scan: Disturbed, rng: np.random.Generator, *, max_allowance_mm: float = 0.0
    ) -> dict[str, Any]:
        """What every network finds in one scan, alone and refined, and the metrics at the truth."""
        truth = scan.part_from_camera
        init = _rough(truth, self.part, rng)
        row = {
            "points": len(scan.points),
            "hole_share": scan.measured.hole_share,
            "foreign_share": scan.clutter_share,
            "truth": self._fit(scan, truth),
        }
        cloud = MeasuredScan(scan.points, None, np.zeros(3))
        for name, matcher in self.networks.items():
            began = time.perf_counter()
            poses = match_poses(matcher, cloud, stack(init), iterations=matcher.iterations)
            matched = select(poses, 0)
            middle = time.perf_counter()
            fine = refine(self._model, scan.points, matched)
            if max_allowance_mm:
                fine = with_form_deviation(
                    self._model, scan.points, fine, max_allowance_mm=max_allowance_mm
                )
            end = time.perf_counter()
            row[name] = {
                "alone": self._errors(scan, matched) | {"time_s": middle - began},
                "refined": self._errors(scan, fine.part_from_camera) | {"time_s": end - middle},
            }
        return row

    def _errors(self, scan: Disturbed, pose: RigidTransform) -> dict[str, float]:
        return _pose_errors(pose, scan.part_from_camera, self.part) | self._fit(scan, pose)

    def _fit(self, scan: Disturbed, pose: RigidTransform) -> dict[str, float]:
        """RMSE and FFMDE (eqs 1, 2) of the thinned scan on the thinned surface of the part."""
        thinned = scan.points[voxel_thin(scan.points, voxel_mm=self._voxel_mm)]
        metrics = fit(pose.apply(thinned), self._tree, self._normals)
        return {name: metrics[name] for name in ("rmse_mm", "ffmde_abs_mm")}


def _pose_errors(pose: RigidTransform, truth: RigidTransform, part: Part) -> dict[str, float]:
    rotation_deg, translation_mm = magnitudes(pose_error(pose, truth, part.center))
    return {"rotation_deg": rotation_deg, "translation_mm": translation_mm}


def _rough(truth: RigidTransform, part: Part, rng: np.random.Generator) -> RigidTransform:
    """A pose up to 45 deg and half a radius away from the true one."""
    deg, mm = rng.uniform(0, START_DEG), rng.uniform(0, START_SHARE) * part.radius
    return perturb(truth, part, deg=deg, mm=mm, rng=rng)


def run_series(trial: Trial, series: Series, seed: int) -> dict[str, Any]:
    """All scans of a series."""
    todo = list(itertools.product(range(len(series.values)), range(series.views)))
    steps: list[dict[str, Any]] = [{"value": value, "rows": []} for value in series.values]
    for index, number in tqdm(todo, series.name, unit="scan"):
        rng = np.random.default_rng([seed, _STARTS, index, number])
        scan = series.take(series.values[index], number)
        row = trial.row(scan, rng, max_allowance_mm=series.max_allowance_mm)
        steps[index]["rows"].append(row)
    return {
        "name": series.name,
        "title": series.title,
        "unit": series.unit,
        "paper": series.paper,
        "steps": steps,
    }


def run_random(part: Part, matcher: TrainedMatcher, count: int, seed: int) -> dict[str, Any]:
    """Scans from anywhere by any camera of the kind, through the product's own path."""
    stand, views = Stand(part, seed), RandomViews()
    rows = []
    for number in tqdm(range(count), "random scans", unit="scan"):
        rng = np.random.default_rng([seed, _RANDOM, number])
        pose = views.draw(rng, part.center)
        distance = float(np.linalg.norm(pose.apply(part.center[None])))
        scan = stand.scan(rng, pose, distance_mm=distance)
        init = _rough(scan.part_from_camera, part, rng)
        cloud = MeasuredScan(scan.points, None, np.zeros(3))
        began = time.perf_counter()
        result = register(cloud, part, init=init, weights=matcher, seed=seed)
        seconds = time.perf_counter() - began
        errors = _pose_errors(result.part_from_camera, scan.part_from_camera, part)
        right = errors["rotation_deg"] < RIGHT_DEG and errors["translation_mm"] < RIGHT_MM
        rows.append(
            {
                "number": number,
                "distance_mm": distance,
                "hole_share": scan.measured.hole_share,
                "points": len(scan.points),
                **errors,
                "right": right,
                "verdict": result.verdict.status,
                "reason": result.verdict.reason,
                "sigma_mm": result.uncertainty.weakest_translation_sigma_mm,
                "seconds": seconds,
            }
        )
    return summarize_random(rows)


def summarize_random(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Shares and verdicts; only what is not right or not accepted is listed one by one."""
    errors = {
        name: np.array([row[name] for row in rows]) for name in ("rotation_deg", "translation_mm")
    }
    return {
        "scans": len(rows),
        "right": sum(row["right"] for row in rows) / len(rows),
        **verdict_counts(rows),
        **{
            name: {
                "mean": float(np.mean(error)),
                "median": float(np.median(error)),
                "p99": float(np.percentile(error, 99)),
                "max": float(np.max(error)),
            }
            for name, error in errors.items()
        },
        "seconds": study.spread([row["seconds"] for row in rows]),
        "listed": [row for row in rows if not row["right"] or row["verdict"] != "accepted"],
    }


def parse_weights(words: Sequence[str]) -> dict[str, Path]:
    """Files by the name of the network, in the order given.

    Raises:
      InputError: an argument of another form, a name twice, or none at all.
    """
    files: dict[str, Path] = {}
    for word in words:
        name, equals, path = word.partition("=")
        if not (name and equals and path) or name in files:
            raise InputError(f"--weights {word}: should be NAME=FILE, each name once")
        files[name] = Path(path)
    if not files:
        raise InputError("--weights NAME=FILE is missing: what `vanejax export` wrote for the vane")
    return files


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """All series, then the random scans."""
    files = parse_weights(settings.weights)
    part = guide_vane()
    networks = {name: find_weights(path, part) for name, path in files.items()}
    trial = Trial(part, networks)
    series = Stand(part, settings.seed).series(settings.views)
    report = study.header("RPM-Net, then ray casting", settings, part) | {
        "networks": {name: dict(matcher.trained) for name, matcher in networks.items()},
        "sensor": SENSOR,
        "series": [run_series(trial, each, settings.seed) for each in series],
        "random": None,
    }
    if settings.random:
        last = list(networks)[-1]
        report["random"] = {"network": last} | run_random(
            part, networks[last], settings.random, settings.seed
        )
    report = study.save(settings.out, "robustness", report)
    save_figure(robustness_report.picture(report), settings.out / "robustness.png")
    print(robustness_report.table(report))
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("robustness", __doc__)
    parser.add_argument(
        "--weights",
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="a network and its weights, from `vanejax export`; may be given several times",
    )
    parser.add_argument(
        "--views", type=study.count, default=6, help="scans at each strength of a disturbance (6)"
    )
    parser.add_argument(
        "--random", type=int, default=0, metavar="N", help="scans from anywhere, with verdicts (0)"
    )
    return parser
