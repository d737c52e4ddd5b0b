"""Registers real scans without guess or training, against ground truth.

python -m experiments.real_scans FOLDER [--sensor consumer_depth] [--out DIR]

FOLDER holds scans, CAD files and ground_truth.json: a list of entries with ``scan``, ``cad`` (file
names), ``scan_units``, ``cad_unit_mm`` and ``scan_from_cad_mm``, the right poses [S][4][4] (several
for a symmetric part). Errors are those of camera_from_part: the angle, and how far the part's
origin is off, to the nearest right pose. With ``--sensor``, what that camera's matching window
rounds off is taken out as well (`vanejax.localization.edge_rounding`). Results in ``--out``: a
table and real_scans.json.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.runner import markdown
from experiments.runner import study_command as study
from vanejax.cad import Part, load_part
from vanejax.cad.cad_file import MM_PER_UNIT
from vanejax.errors import InputError
from vanejax.files import read_json
from vanejax.localization.registration import register
from vanejax.rigid import RigidTransform, rigid_from_matrix
from vanejax.scans import load_scan

TRUTH = "ground_truth.json"
RIGHT_DEG, RIGHT_MM, MOST_SECONDS = 5.0, 5.0, 5.0
NEAR_DEG, NEAR_MM = 3.0, 3.0  # not much more than the truth itself may be off


@dataclasses.dataclass(frozen=True, eq=False)
class KnownScan:
    """One scan whose pose is known: files, the units of their numbers, and all right answers."""

    scan: Path
    cad: Path
    scan_units: str
    cad_units: str
    camera_from_part: np.ndarray  # [S, 4, 4] f64, mm

    def points(self, part: Part) -> np.ndarray:
        """[N, 3] f64 mm, camera frame: the scan of ``part``."""
        return load_scan(self.scan, units=self.scan_units, part_extent_mm=part.extent_mm).points

    def errors(self, part_from_camera: RigidTransform) -> dict[str, Any]:
        """`error` by name, and whether the pose is right."""
        angle, shift = self.error(part_from_camera)
        right = angle < RIGHT_DEG and shift < RIGHT_MM
        return {"rotation_deg": angle, "translation_mm": shift, "right": right}

    def error(self, part_from_camera: RigidTransform) -> tuple[float, float]:
        """Degrees and mm of a part_from_camera to the nearest right answer.

        That for which angle and distance, as shares of what is still right, are smallest together.
        """
        pose = part_from_camera.inverse().as_matrix()
        turn = pose[:3, :3].T @ self.camera_from_part[:, :3, :3]
        angle = np.degrees(Rotation.from_matrix(turn).magnitude())
        shift = np.linalg.norm(self.camera_from_part[:, :3, 3] - pose[:3, 3], axis=1)
        best = np.argmin(angle / RIGHT_DEG + shift / RIGHT_MM)
        return float(angle[best]), float(shift[best])


def load_truth(folder: Path) -> list[KnownScan]:
    """The scans of a folder.

    Raises:
      InputError: no ground_truth.json there, or an entry that lacks something or makes no sense.
    """
    path = folder / TRUTH
    entries = read_json(path)
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: should be a list of scans")
    return [_known(entry, folder, f"{path}: entry {n}") for n, entry in enumerate(entries)]


def _known(entry: Any, folder: Path, where: str) -> KnownScan:
    try:
        poses = np.asarray(entry["scan_from_cad_mm"], np.float64)
        unit_mm = float(entry["cad_unit_mm"])
        scan, cad = folder / entry["scan"], folder / entry["cad"]
        scan_units = str(entry.get("scan_units", "auto"))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{where}: {type(error).__name__}: {error}") from error
    units = [name for name, size in MM_PER_UNIT.items() if math.isclose(size, unit_mm)]
    if not units:
        raise InputError(f"{where}: cad_unit_mm is {unit_mm}, none of {list(MM_PER_UNIT.values())}")
    poses = poses[None] if poses.ndim == 2 else poses
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise InputError(f"{where}: scan_from_cad_mm has shape {list(poses.shape)}, not [S, 4, 4]")
    poses = np.stack([rigid_from_matrix(pose, where=where).as_matrix() for pose in poses])
    return KnownScan(scan, cad, scan_units, units[0], poses)


def measure(
    scans: Sequence[KnownScan], seed: int, sensor: str | None = None
) -> list[dict[str, Any]]:
    """Registers every scan; a row for each."""
    load = functools.cache(lambda cad, units: load_part(cad, units=units))
    return [_row(known, load(known.cad, known.cad_units), seed, sensor) for known in scans]


def _row(known: KnownScan, part: Part, seed: int, sensor: str | None) -> dict[str, Any]:
    began = time.perf_counter()
    result = register(known.scan, part, units_scan=known.scan_units, sensor=sensor, seed=seed)
    seconds = time.perf_counter() - began
    others = [known.errors(other.part_from_camera) for other in result.alternatives]
    shares = ("inlier_share", "violation_share", "unmeasured_share", "tolerance_mm")
    return {
        "scan": known.scan.name,
        "part": part.name,
        **known.errors(result.part_from_camera),
        "right_listed": any(other["right"] for other in others),
        "verdict": result.verdict.status,
        "reason": result.verdict.reason,
        "alternatives": len(others),
        **{name: getattr(result.verification, name) for name in shares},
        "seconds": seconds,
    }


def summarize(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Counts, mean errors of the right poses, and times."""
    right = [row for row in rows if row["right"]]
    return {
        "scans": len(rows),
        "right": len(right),
        "near": sum(
            row["rotation_deg"] < NEAR_DEG and row["translation_mm"] < NEAR_MM for row in rows
        ),
        "accepted": sum(row["verdict"] == "accepted" for row in rows),
        "accepted_wrong": sum(row["verdict"] == "accepted" and not row["right"] for row in rows),
        "mean_of_right": {
            name: float(np.mean([row[name] for row in right])) if right else None
            for name in ("rotation_deg", "translation_mm")
        },
        "seconds": study.spread([row["seconds"] for row in rows]),
        "rows": list(rows),
    }


def table(report: dict[str, Any]) -> str:
    """A line for each scan, and what they come to."""
    lines = [
        f"{'scan':<20}{'deg':>8}{'mm':>8}{'':>8}{'verdict':>12}{'others':>8}{'inliers':>9}"
        f"{'violate':>9}{'missing':>9}{'time (s)':>10}"
    ]
    for row in report["rows"]:
        shares = "".join(
            f"{'-' if row[name] is None else format(row[name], '.1%'):>9}"
            for name in ("inlier_share", "violation_share", "unmeasured_share")
        )
        lines.append(
            f"{row['scan']:<20}{row['rotation_deg']:>8.2f}{row['translation_mm']:>8.2f}"
            f"{'right' if row['right'] else 'WRONG':>8}{row['verdict']:>12}"
            f"{row['alternatives']:>8}{shares}{row['seconds']:>10.2f}"
        )
    mean, time_s = report["mean_of_right"], report["seconds"]
    lines += [
        "",
        f"{report['right']} of {report['scans']} right (within {RIGHT_DEG:g} deg and "
        f"{RIGHT_MM:g} mm), {report['near']} within {NEAR_DEG:g} deg and {NEAR_MM:g} mm, "
        f"{report['accepted']} accepted, {report['accepted_wrong']} of them "
        "wrong",
        f"time {time_s['median']:.2f} s (median), {time_s['max']:.2f} s (longest)",
    ]
    if report["right"]:
        errors = f"{mean['rotation_deg']:.2f} deg, {mean['translation_mm']:.2f} mm"
        lines.insert(-1, f"mean error {errors}")
    met = (
        report["right"] == report["scans"]
        and not report["accepted_wrong"]
        and time_s["max"] <= MOST_SECONDS
    )
    goal = f"all right, none accepted and wrong, {MOST_SECONDS:g} s each"
    return "\n".join([*lines, f"{'met' if met else 'MISSED'}: goals are {goal}"])


def sensor_table(report: dict[str, Any]) -> str:
    """Markdown: the scans as they are beside those without what the named sensor rounds off."""
    sensor, rows = report["sensor"], []
    for name, found in (("as they are", report), (f"`--sensor {sensor['name']}`", sensor)):
        mean = found["mean_of_right"]
        rows.append(
            [
                name,
                str(found["right"]),
                str(found["near"]),
                f"{found['accepted']} ({found['accepted_wrong']})",
                f"{mean['rotation_deg']:.2f}",
                f"{mean['translation_mm']:.2f}",
                f"{found['seconds']['median']:.2f}",
            ]
        )
    head = [f"of {report['scans']} scans", f"right: within {RIGHT_DEG:g} deg, {RIGHT_MM:g} mm"]
    head += [f"within {NEAR_DEG:g} deg, {NEAR_MM:g} mm", "accepted (wrong)"]
    return markdown.table([*head, "mean (deg)", "mean (mm)", "time (s)"], rows)


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """The scans of the folder, and again with the sensor known if it is named."""
    truth = load_truth(settings.folder)
    report = study.header("register, no guess, no training", settings)
    report |= summarize(measure(truth, settings.seed))
    if settings.sensor is not None:
        again = summarize(measure(truth, settings.seed, settings.sensor))
        report["sensor"] = {"name": settings.sensor} | again
    report = study.save(settings.out, "real_scans", report)
    print(table(report))
    if settings.sensor is not None:
        print(f"\nwithout what the window of {settings.sensor} rounds off:\n")
        print(table(report["sensor"]))
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("real_scans", __doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help=f"scans, CAD files, {TRUTH}")
    parser.add_argument(
        "--sensor", metavar="NAME", help="that took the scans: once more with its window undone"
    )
    return parser
