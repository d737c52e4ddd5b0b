"""The guide vane from uniformly random rotations, without an initial guess.

python -m experiments.any_pose [--weights FILE] [--count 200] [--noise-mm 0.1]

The test views in turn, each with white noise along the rays and turned about the sensor by a random
rotation, so that its rays stay rays and every rotation of the part before the sensor is equally
likely. A pose is right within 0.1 deg and 0.1 mm at the part's centre. Results: a table and
any_pose.json in ``--out``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from experiments.runner import study_command as study
from experiments.runner.vane_views import VaneViews, error_row, pose_error, with_noise
from experiments.studies.verdicts.report import verdict_counts
from vanejax.localization.registration import register
from vanejax.rigid import RigidTransform
from vanejax.scans.measured_scan import MeasuredScan
from vanejax.training.weight_file import TrainedMatcher, find_weights

RIGHT_DEG, RIGHT_MM = 0.1, 0.1
LEAST_RIGHT, MOST_SECONDS = 0.98, 10.0


def turned_scan(
    views: VaneViews, view: int, turn: np.ndarray, *, noise_mm: float, rng: np.random.Generator
) -> tuple[MeasuredScan, RigidTransform]:
    """A noisy view turned about the sensor by ``turn`` [3, 3], and its true part_from_camera."""
    points = with_noise(views.points(view), noise_mm, rng) @ turn.T
    truth = views.truth(view) @ RigidTransform(turn.T, np.zeros(3))
    return MeasuredScan(points, None, np.zeros(3), f"view {view}"), truth


def attempt(
    views: VaneViews, number: int, weights: TrainedMatcher | None, *, noise_mm: float, seed: int
) -> dict[str, Any]:
    """One random rotation: what was found, how far off, how long it took."""
    rng = np.random.default_rng([seed, number])
    test = views.select("test")
    view = test[number % len(test)]
    turn = Rotation.random(rng=rng).as_matrix()
    scan, truth = turned_scan(views, view, turn, noise_mm=noise_mm, rng=rng)
    began = time.perf_counter()
    result = register(scan, views.part, weights=weights, seed=seed)
    seconds = time.perf_counter() - began
    off = error_row(pose_error(result.part_from_camera, truth, views.part.center))
    return {
        "number": number,
        "view": view,
        **off,
        "right": off["rotation_deg"] < RIGHT_DEG and off["translation_mm"] < RIGHT_MM,
        "verdict": result.verdict.status,
        "reason": result.verdict.reason,
        "score": result.verification.score,
        "points": len(scan.points),
        "seconds": seconds,
        "stages": dict(result.seconds),
    }


def summarize(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Shares, counts and times of all attempts; wrong poses are listed one by one."""
    stages = dict.fromkeys(stage for row in rows for stage in row["stages"])
    right = [row for row in rows if row["right"]]
    return {
        "attempts": len(rows),
        "right": len(right) / len(rows),
        **verdict_counts(rows),
        "median_of_right": {
            name: float(np.median([row[name] for row in right])) if right else None
            for name in ("rotation_deg", "translation_mm")
        },
        "seconds": study.spread([row["seconds"] for row in rows]),
        "stages": {
            stage: study.spread([row["stages"].get(stage, 0.0) for row in rows]) for stage in stages
        },
        "wrong": [row["number"] for row in rows if not row["right"]],
        "rows": list(rows),
    }


def table(report: dict[str, Any]) -> str:
    """The report as aligned text."""
    lines = [
        f"{report['attempts']} random rotations: {report['right']:.1%} right "
        f"(within {RIGHT_DEG} deg and {RIGHT_MM} mm), {report['accepted_wrong']} wrong accepted",
        "",
        f"{'verdict':<12}{'right':>8}{'wrong':>8}",
    ]
    for status, count in report["verdicts"].items():
        lines.append(f"  {status:<10}{count['right']:>8}{count['wrong']:>8}")
    lines += ["", f"{'time (s)':<12}{'median':>8}{'max':>8}"]
    for stage, spread in {**report["stages"], "all": report["seconds"]}.items():
        lines.append(f"  {stage:<10}{spread['median']:>8.2f}{spread['max']:>8.2f}")
    lines.append("")
    for row in (row for row in report["rows"] if not row["right"]):
        lines.append(
            f"wrong: number {row['number']}, view {row['view']}: {row['rotation_deg']:.3f} deg, "
            f"{row['translation_mm']:.3f} mm, {row['verdict']}: {row['reason']}"
        )
    met = (
        report["right"] >= LEAST_RIGHT
        and not report["accepted_wrong"]
        and report["seconds"]["median"] <= MOST_SECONDS
    )
    lines.append(
        f"{'met' if met else 'MISSED'}: goals are {LEAST_RIGHT:.0%} right, none accepted and "
        f"wrong, {MOST_SECONDS:g} s"
    )
    return "\n".join(lines)


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """All attempts, one after the other."""
    views = VaneViews()
    named = settings.weights
    weights = None if named == "none" else find_weights(named, views.part)
    given = {"noise_mm": settings.noise_mm, "seed": settings.seed}
    if weights is not None:  # compiles
        attempt(views, 0, weights, **given)
    rows = [
        attempt(views, number, weights, **given)
        for number in tqdm(range(settings.count), "registering", unit="scan")
    ]
    method = "register, no guess, " + ("no training" if weights is None else "RPM-Net")
    report = study.header(method, settings, views.part) | summarize(rows)
    report = study.save(settings.out, "any_pose", report)
    print(table(report))
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("any_pose", __doc__)
    parser.add_argument(
        "--weights",
        default="none",
        help="from `vanejax export`, for the guide vane; pretrained; none (default)",
    )
    parser.add_argument("--count", type=study.count, default=200, help="random rotations (200)")
    parser.add_argument("--noise-mm", type=float, default=0.1, help="along the rays (0.1)")
    return parser
