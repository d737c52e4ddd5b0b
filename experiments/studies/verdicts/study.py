"""How well the verdict tells right poses from wrong ones, over parts and sensors.

python -m experiments.verdicts [--quick] [--scans 1] [--parts NAME,...] [--sensors NAME,...]

Each part is scanned by each sensor from random rotations. The true pose and wrong ones (one pitch
off, upside down, nearly symmetric, turned by 10 to 180 deg) are refined, and the part is sought in
the scan of another one. Every pose is judged by the function of `vanejax.register`, `assess`, with
the others as competing hypotheses. Then `vanejax.register` itself is run from no guess. Results:
tables, verdicts.json, verdicts.png and judged.json (every pose) in ``--out``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments.runner import study_command as study
from experiments.studies.verdicts.challenge_parts import VANE, challenge_parts, names_of_parts
from experiments.studies.verdicts.report import OTHER_PART, RIGHT, picture, summarize, table
from experiments.studies.verdicts.wrong_poses import SENSORS, PosedScan, posed_scan, wrong_poses
from vanejax.errors import InputError
from vanejax.localization import MeasurementModel, judge, measurement_model, refine, register
from vanejax.localization.assessment import (
    MOST_HYPOTHESES,
    Assessment,
    assess,
    compared_points,
    converge_fully,
)
from vanejax.localization.pose_batch import concatenate, distinct, select, stack
from vanejax.localization.pose_result import Refinement
from vanejax.localization.pose_search import add_symmetry_hypotheses, search
from vanejax.plotting import save_figure
from vanejax.scans.measured_scan import MIN_POINTS, MeasuredScan

QUICK_PARTS = (VANE, "vane_4", "flange_odd_hole", "box", "wedge")
OTHER_PART_ROTATIONS = 150


def judged_poses(scan: PosedScan, model: MeasurementModel, seed: int) -> Iterator[dict[str, Any]]:
    """A row for the true pose and for each distinct wrong pose that refinement ends at."""
    rng = np.random.default_rng([seed, *scan.name.encode()])
    kinds, guesses = zip((RIGHT, scan.truth), *wrong_poses(scan, rng), strict=True)
    refined = [refine(model, scan.points, guess, seed=seed) for guess in guesses]
    # the true pose stays in, whether it was kept or lost; what came back to it says nothing new
    kept = [k for k, r in enumerate(refined) if k == 0 or not scan.is_right(r.part_from_camera)]
    poses = stack(*(refined[k].part_from_camera for k in kept))
    kept = np.array(kept)[distinct(poses, model.part, len(kept))]
    poses = stack(*(refined[k].part_from_camera for k in kept))
    poses = converge_fully(model, poses, compared_points(scan.points, seed))
    for k in kept:
        assessment = assess(model, scan.points, refined[k], poses, seed=seed)
        yield _row(scan, kinds[k], refined[k], assessment, model.part.radius)


def other_part(scan: PosedScan, name: str, model: MeasurementModel, seed: int) -> dict[str, Any]:
    """A row for the best pose of the part of that name in the scan of another one."""
    candidates = search(model, scan.points, count=OTHER_PART_ROTATIONS, seed=seed)
    candidates = add_symmetry_hypotheses(model, scan.points, candidates, seed=seed)
    refinement = refine(model, scan.points, candidates.pose(0), seed=seed)
    others = select(candidates.part_from_camera, slice(1, 1 + MOST_HYPOTHESES))
    poses = concatenate(stack(refinement.part_from_camera), others)
    poses = converge_fully(model, poses, compared_points(scan.points, seed))
    assessment = assess(model, scan.points, refinement, poses, seed=seed)
    row = _row(scan, OTHER_PART, refinement, assessment, model.part.radius)
    return row | {"sought": name}


def registered(scan: PosedScan, seed: int) -> dict[str, Any]:
    """A row for the result of `vanejax.register` from no guess."""
    began = time.perf_counter()
    measured = MeasuredScan(scan.points, None, np.zeros(3), scan.name)
    result = register(measured, scan.challenge.part, seed=seed)
    seconds = time.perf_counter() - began
    angle, shift = scan.error(result.part_from_camera)
    return {
        "part": scan.name,
        "sensor": scan.sensor,
        "right": scan.is_right(result.part_from_camera),
        "right_listed": any(scan.is_right(a.part_from_camera) for a in result.alternatives),
        "rotation_deg": angle,
        "translation_mm": shift,
        "verdict": result.verdict.status,
        "reason": result.verdict.reason,
        "seconds": seconds,
    }


def _row(
    scan: PosedScan, kind: str, refinement: Refinement, assessment: Assessment, radius_mm: float
) -> dict[str, Any]:
    """Of a pose of the part that was scanned, or (`OTHER_PART`) of one that is not there at all."""
    right, (angle, shift) = False, (np.nan, np.nan)
    if kind != OTHER_PART:
        right = scan.is_right(refinement.part_from_camera)
        angle, shift = scan.error(refinement.part_from_camera)
    verification = assessment.verification
    alone = judge(verification, assessment.uncertainty, (), radius_mm=radius_mm)
    return {
        "part": scan.name,
        "sensor": scan.sensor,
        "kind": kind,
        "right": right,
        "rotation_deg": angle,
        "translation_mm": shift,
        "score": verification.score,
        "inlier_share": verification.inlier_share,
        "violation_share": verification.violation_share,
        "unmeasured_share": verification.unmeasured_share,
        "preference": min((other.preference for other in assessment.competing), default=np.inf),
        "tolerance_mm": verification.tolerance_mm,
        "verdict": assessment.verdict.status,
        "verdict_alone": alone.status,
        "reason": assessment.verdict.reason,
    }


def measure(settings: argparse.Namespace) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """All poses judged, and all registrations.

    Raises:
      InputError: a part or a sensor that is none.
    """
    unknown = sorted(set(settings.sensors) - set(SENSORS))
    if unknown:
        raise InputError(f"no sensor {', '.join(unknown)}; there are {', '.join(SENSORS)}")
    names = settings.parts or (QUICK_PARTS if settings.quick else (VANE, *names_of_parts()))
    parts = challenge_parts(names)
    models = {name: measurement_model(p.part, np.zeros(3)) for name, p in parts.items()}
    scans = [
        posed_scan(name, part, models[name].scanner, sensor, settings.seed + number)
        for name, part in parts.items()
        for sensor in settings.sensors
        for number in range(settings.scans)
    ]
    judged, runs = [], []
    for scan in tqdm(scans, "judging", unit="scan"):
        if len(scan.points) < 2 * MIN_POINTS:
            continue
        judged += judged_poses(scan, models[scan.name], settings.seed)
        runs.append(registered(scan, settings.seed))
        for name in other_parts(list(parts).index(scan.name), list(parts)):
            judged.append(other_part(scan, name, models[name], settings.seed))
    return judged, runs


def other_parts(place: int, names: Sequence[str]) -> list[str]:
    """Those sought in the scans of the part at a place of the list: never its near relatives.

    Near relatives, such as a gear with and without keyway, stand beside each other.
    """
    count = len(names)
    steps = {count // 2, count // 3} - {0}
    return [names[(place + step) % count] for step in sorted(steps)]


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """The study."""
    judged, runs = measure(settings)
    head = study.header("poses judged by ray casting", settings)
    # a thousand poses beside the figures that sum them up
    study.save(settings.out, "judged", head | {"judged": judged})
    report = study.save(settings.out, "verdicts", head | summarize(judged, runs))
    save_figure(picture(report), settings.out / "verdicts.png")
    print(table(report))
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("verdicts", __doc__)
    parser.add_argument("--quick", action="store_true", help=f"of {', '.join(QUICK_PARTS)} only")
    parser.add_argument("--scans", type=study.count, default=1, help="per part and sensor (1)")
    parser.add_argument("--parts", type=_names, default=None, help="instead of all")
    parser.add_argument("--sensors", type=_names, default=list(SENSORS), help="instead of all")
    return parser


def _names(text: str) -> list[str]:
    return text.split(",")
