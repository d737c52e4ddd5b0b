"""How well the verdict tells right poses from wrong ones, over parts and sensors.

python -m experiments.verdicts [--quick] [--scans 1] [--parts NAME,...] [--sensors NAME,...]

Each part is scanned by each sensor from random rotations. The true pose and wrong ones (one pitch
off, upside down, nearly symmetric, turned by 10 to 180 deg) are refined, and the part is sought in
the scan of another one; every pose that results is verified and judged as `vanejax.register` does,
against the others as rivals. Then `vanejax.register` itself is run from no guess. Results: tables,
verdicts.json, verdicts.png and judged.json (every pose) in ``--out``.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments.runner import study_command as study
from experiments.studies.verdicts.challenge_parts import names_of_parts
from experiments.studies.verdicts.report import OTHER_PART, RIGHT, picture, summarize, table
from experiments.studies.verdicts.wrong_poses import (
    SENSORS,
    VANE,
    PosedScan,
    parts_to_pose,
    posed_scan,
    wrong_starts,
)
from vanejax.cad.part import Part
from vanejax.cad.surface import Surface
from vanejax.errors import InputError
from vanejax.localization import registration as locate
from vanejax.localization.covariance import uncertainty
from vanejax.localization.fine_registration import refine, subset
from vanejax.localization.pose_result import Refinement, Verdict, Verification
from vanejax.localization.pose_search import (
    challenge,
    concatenate,
    distances,
    distinct,
    is_same,
    search,
    select,
)
from vanejax.localization.residuals import RayCasting
from vanejax.localization.verdict import Rival, judge
from vanejax.localization.verification import View, evidence, verify
from vanejax.plotting.canvas import save_figure
from vanejax.rigid import RigidTransform
from vanejax.scanner.virtual_scanner import Scanner
from vanejax.scans.measured_scan import MIN_POINTS, MeasuredScan

QUICK_PARTS = (VANE, "vane_4", "flange_odd_hole", "box", "wedge")
OTHER_PART_STARTS = 150


@dataclasses.dataclass(frozen=True, eq=False)
class Assessed:
    """What is said of one refined pose of a scan.

    Attributes:
      part_from_camera: the pose.
      verification: of it.
      preference: standard errors by which the scan prefers it to its best rival; inf without one.
      verdict: with the rivals.
      alone: the verdict as if no other pose were known.
    """

    part_from_camera: RigidTransform
    verification: Verification
    preference: float
    verdict: Verdict
    alone: Verdict


def make_model(part: Part) -> RayCasting:
    """Rays from the origin of the scan's frame."""
    return RayCasting(Scanner(part), Surface(part), np.zeros(3))


def assess(
    model: RayCasting,
    points: np.ndarray,
    refined: Sequence[Refinement],
    *,
    rivals: Sequence[RigidTransform] = (),
) -> list[Assessed]:
    """Verifies refined poses and judges each with the others, and ``rivals``, as its rivals.

    The steps, and the numbers of points, are those of `vanejax.localization.registration`.
    """
    part = model.part
    some = points[subset(points, locate.RIVAL_POINTS, 2)]
    # a refined pose may have slid where the scan hardly holds it: no fair rival
    poses = _batch([*(found.part_from_camera for found in refined), *rivals])
    poses = locate.followed(model, poses, some)
    checked = subset(points, locate.VERIFIED_POINTS, 3)
    few, all_checked = View(some, model.sensor_origin), View(points[checked], model.sensor_origin)
    result = []
    for found in refined:
        pose = found.part_from_camera
        tolerance = float(locate.inlier_tolerance_mm(model, _batch([pose]), some)[0])
        turn, shift = distances(poses, pose, part)
        others = np.flatnonzero(~is_same(turn, shift, part))
        compared = concatenate(_batch([pose]), select(poses, others))
        said = evidence(model, compared, some, tolerance_mm=tolerance, view=few)
        known = [
            Rival(said.preference(0, 1 + n), float(turn[o]), float(shift[o]), select(poses, o))
            for n, o in enumerate(others)
        ]
        seen = verify(model, pose, points, checked, tolerance_mm=tolerance, view=all_checked)
        sure = uncertainty(found, part.center)
        with_rivals, alone = (
            judge(found, seen, sure, told, radius_mm=part.radius) for told in (known, ())
        )
        best = min((rival.preference for rival in known), default=np.inf)
        result.append(Assessed(pose, seen, best, with_rivals, alone))
    return result


def judged_poses(scan: PosedScan, model: RayCasting, seed: int) -> Iterator[dict[str, Any]]:
    """A row for the true pose and for each distinct wrong pose to which a start led."""
    rng = np.random.default_rng([seed, *scan.name.encode()])
    kinds, starts = zip((RIGHT, scan.truth), *wrong_starts(scan, rng), strict=True)
    refined = [refine(model, scan.points, start, seed=seed) for start in starts]
    # the true pose stays in, whether it was kept or lost; what came back to it says nothing new
    kept = np.array(
        [k for k, one in enumerate(refined) if k == 0 or not scan.is_right(one.part_from_camera)]
    )
    poses = _batch([refined[k].part_from_camera for k in kept])
    kept = kept[distinct(poses, model.part, len(kept))]
    for k, found in zip(kept, assess(model, scan.points, [refined[k] for k in kept]), strict=True):
        yield _row(scan, kinds[k], found, right=scan.is_right(found.part_from_camera))


def other_part(scan: PosedScan, name: str, model: RayCasting, seed: int) -> dict[str, Any]:
    """A row for the best pose that the part of that name finds in the scan of another one."""
    found = search(model, scan.points, count=OTHER_PART_STARTS, seed=seed)
    found = challenge(model, scan.points, found, seed=seed)
    best, *others = (found.pose(k) for k in range(min(len(found), 1 + locate.RIVALS)))
    refined = refine(model, scan.points, best, seed=seed)
    (assessed,) = assess(model, scan.points, [refined], rivals=others)
    return _row(scan, OTHER_PART, assessed, right=False) | {"sought": name}


def registered(scan: PosedScan, seed: int) -> dict[str, Any]:
    """A row for what `vanejax.register` says from no guess."""
    began = time.perf_counter()
    measured = MeasuredScan(scan.points, None, np.zeros(3), scan.name)
    result = locate.register(measured, scan.challenge.part, seed=seed)
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


def _row(scan: PosedScan, kind: str, found: Assessed, *, right: bool) -> dict[str, Any]:
    angle, shift = (np.nan, np.nan) if kind == OTHER_PART else scan.error(found.part_from_camera)
    seen = found.verification
    return {
        "part": scan.name,
        "sensor": scan.sensor,
        "kind": kind,
        "right": right,
        "rotation_deg": angle,
        "translation_mm": shift,
        "score": seen.score,
        "inlier_share": seen.inlier_share,
        "violation_share": seen.violation_share,
        "unmeasured_share": seen.unmeasured_share,
        "preference": found.preference,
        "tolerance_mm": seen.tolerance_mm,
        "verdict": found.verdict.status,
        "verdict_alone": found.alone.status,
        "reason": found.verdict.reason,
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
    parts = parts_to_pose(names)
    models = {name: make_model(challenge.part) for name, challenge in parts.items()}
    scans = {
        name: [
            posed_scan(name, challenge, models[name].scanner, sensor, settings.seed + number)
            for sensor in settings.sensors
            for number in range(settings.scans)
        ]
        for name, challenge in parts.items()
    }
    judged, runs = [], []
    every = [(place, scan) for place, name in enumerate(parts) for scan in scans[name]]
    for place, scan in tqdm(every, "judging", unit="scan"):
        if len(scan.points) < 2 * MIN_POINTS:
            continue
        judged += judged_poses(scan, models[scan.name], settings.seed)
        runs.append(registered(scan, settings.seed))
        for other in other_parts(place, list(parts)):
            judged.append(other_part(scan, other, models[other], settings.seed))
    return judged, runs


def other_parts(place: int, names: Sequence[str]) -> list[str]:
    """Those sought in the scans of the part at a place of the list: never its near relatives.

    Near relatives, such as a gear with and without keyway, stand beside each other.
    """
    count = len(names)
    steps = {count // 2, count // 3} - {0}
    return [names[(place + step) % count] for step in sorted(steps)]


def _batch(poses: Sequence[RigidTransform]) -> RigidTransform:
    return RigidTransform(
        np.stack([pose.rotation for pose in poses]), np.stack([pose.translation for pose in poses])
    )


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """The study."""
    judged, runs = measure(settings)
    method = "poses judged by ray casting"
    head = study.header(method, settings)
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
