"""Poses in files: the JSON that a registration writes, and the guess that one starts from.

Frames and units are stated in the file itself. Host numpy only.
"""

from __future__ import annotations

import dataclasses
import datetime
import importlib.metadata
import json
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.cad.declared_symmetry import PartSymmetry
from vanejax.errors import InputError
from vanejax.files import write_json
from vanejax.localization.pose_result import PointStatus, PoseResult, Verdict
from vanejax.localization.verdict import Limits
from vanejax.machine.placement import Placement
from vanejax.rigid import MATRIX_TOLERANCE, RigidTransform, rigid_from_matrix

FORMAT = "vanejax pose"
VERSION = 1
PACKAGES = ("vanejax", "jax", "jaxlib", "numpy", "embreex")

CONVENTIONS = {
    "camera": "frame of the scan file, mm",
    "part": "frame of the CAD model, mm",
    "part_from_camera": "4x4, row-major, on column vectors: [x_part, 1] = M [x_camera, 1]; mm",
    "camera_from_part": "its inverse: where the part is in the scan; 4x4, row-major, mm",
    "quaternion_wxyz": "unit, order w, x, y, z, with w >= 0",
    "euler_xyz_deg": "angles (a, b, c) about the fixed axes x, then y, then z: "
    "R = Rz(c) Ry(b) Rx(a); degrees",
    "kuka": "X, Y, Z in mm; A, B, C in degrees with R = Rz(A) Ry(B) Rx(C)",
    "symmetry": "motion @ part_from_camera is the same pose for each of the motions, 4x4, part "
    "frame, mm; so is every rotation about the free axis, about which sigma is null",
    "shares": "0 to 1",
    "null": "not known",
}
_UNCERTAINTY = (
    "one sigma of a small motion e = (rotation vector in rad, translation in mm) "
    "about the part's centre c, in the part's frame: x -> c + exp(e[:3]) (x - c) + e[3:]. "
    "It contains how the part differs from its CAD model as far as the scan shows it, and the "
    "sensor's calibration where that was given."
)
_PLACEMENT = (
    "the pose is that of the finished part as placed in the measured blank, not that of the CAD "
    "model that fits it best; stock is along the surface's normal, where a scan saw the blank, and "
    "margins are what it is beyond what is required; the sigma is of the scan's noise alone; the "
    "motion is from the registered pose, along and about the part's axes through its centre"
)

MAX_BYTES = 16 << 20


def pose_to_dict(part_from_camera: RigidTransform) -> dict[str, Any]:
    """A pose (mm) and its inverse as plain values; `CONVENTIONS` says what each is."""
    poses = {"part_from_camera": part_from_camera, "camera_from_part": part_from_camera.inverse()}
    values: dict[str, Any] = {name: pose.as_matrix() for name, pose in poses.items()}
    for name, pose in poses.items():
        quaternion = Rotation.from_matrix(pose.rotation).as_quat(canonical=True, scalar_first=True)
        a, b, c = angles = euler_deg(pose.rotation, "xyz")
        values[f"{name}_as"] = {
            "translation_mm": pose.translation,
            "quaternion_wxyz": quaternion,
            "euler_xyz_deg": angles,
            "kuka": dict(zip("XYZABC", [*pose.translation, c, b, a], strict=True)),
        }
    return _plain(values)


def euler_deg(rotation: np.ndarray, order: str) -> np.ndarray:
    """Angles [3] of a rotation [3, 3], degrees, in an order as scipy names it.

    Capitals are axes that turn along, small letters fixed ones. Where two axes fall together
    (gimbal lock) the third angle is 0.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Gimbal lock")
        return Rotation.from_matrix(rotation).as_euler(order, degrees=True)


def result_to_dict(
    result: PoseResult,
    *,
    scan_name: str,
    part_name: str,
    part_sha256: str,
    seed: int | None = None,
    weights_name: str | None = None,
    calibration_name: str | None = None,
    limits: Limits | None = None,
) -> dict[str, Any]:
    """A registration's result without its points, as values that JSON can hold.

    A number that is not finite becomes None.

    Args:
      result: of the registration.
      scan_name, part_name: of the files.
      part_sha256: `Part.sha256`.
      seed: that it was given.
      weights_name: the trained matcher's file.
      calibration_name: the sensor whose errors of calibration count in the covariance.
      limits: that the verdict used.
    """
    limits = limits or Limits()
    alternatives = [
        pose_to_dict(other.part_from_camera)
        | {
            "rotation_from_the_answer_deg": other.rotation_deg,
            "translation_from_the_answer_mm": other.translation_mm,
            "inlier_share": other.inlier_share,
        }
        for other in result.alternatives
    ]
    refinement, uncertainty, checks = result.refinement, result.uncertainty, result.verification
    statuses = np.bincount(np.asarray(checks.status, np.int64), minlength=len(PointStatus))
    return _plain(
        {
            **_heading(),
            "scan": {"name": scan_name, "sensor_origin_mm": result.sensor_origin},
            "part": {"name": part_name, "sha256": part_sha256},
            "seed": seed,
            "weights": weights_name,
            "calibration": calibration_name,
            "tolerance": {"mm": limits.tolerance_mm, "deg": limits.tolerance_deg},
            "verdict": {"status": result.verdict.status, "reason": result.verdict.reason},
            **pose_to_dict(result.part_from_camera),
            "uncertainty": {
                "meaning": _UNCERTAINTY,
                "center_mm": uncertainty.center,
                "rotation_sigma_deg": uncertainty.rotation_sigma_deg,
                "translation_sigma_mm": uncertainty.translation_sigma_mm,
                "weakest_rotation": {
                    "axis": uncertainty.weakest_rotation_axis,
                    "sigma_deg": uncertainty.weakest_rotation_sigma_deg,
                },
                "weakest_translation": {
                    "axis": uncertainty.weakest_translation_axis,
                    "sigma_mm": uncertainty.weakest_translation_sigma_mm,
                },
                "covariance": uncertainty.covariance,
            },
            "verification": {
                "inlier_share": checks.inlier_share,
                "violation_share": checks.violation_share,
                "unmeasured_share": checks.unmeasured_share,
                "tolerance_mm": checks.tolerance_mm,
                "points_checked": len(checks.checked),
                "points": {status.name.lower(): statuses[status] for status in PointStatus},
            },
            "refinement": {
                "method": refinement.method,
                "converged": refinement.converged,
                "iterations": refinement.iterations,
                "noise_mm": refinement.noise_mm,
                "points": refinement.num_points,
                "inliers": refinement.num_inliers,
                "information": refinement.information,
            },
            "form_deviation": refinement.form and dataclasses.asdict(refinement.form),
            "symmetry": _symmetry(result.symmetry),
            "alternatives": alternatives,
            "before_refinement": {"part_from_camera": result.before.as_matrix()},
            "notes": list(result.notes),
            "seconds": dict(result.seconds),
        }
    )


def _symmetry(symmetry: PartSymmetry | None) -> dict[str, Any] | None:
    """What makes poses one, as plain values."""
    if symmetry is None:
        return None
    axis = symmetry.free_axis
    return {
        "declared": str(symmetry.declared),
        "motions": symmetry.motions,
        "free_axis": axis and {"point_mm": axis[0], "direction": axis[1]},
        "largest_difference_mm": symmetry.difference_mm,
    }


def write_result(path: str | os.PathLike[str], result: PoseResult, **names: Any) -> None:
    """Writes `result_to_dict` (with the same arguments) as JSON, which `read_pose` reads again."""
    write_json(path, result_to_dict(result, **names), allow_nan=False)


def placement_to_dict(
    placement: Placement,
    verdict: Verdict,
    *,
    scan_name: str,
    part_name: str,
    part_sha256: str,
    even: bool,
    fixed: Sequence[str],
) -> dict[str, Any]:
    """A placement in one scan as values that JSON can hold: a pose file without a covariance.

    Relative to the measured points the place has no error: it is chosen.

    Args:
      placement: of the finished part.
      verdict: on it.
      scan_name, part_name: of the files.
      part_sha256: `Part.sha256`.
      even, fixed: as they were asked.
    """
    least = placement.least
    return _plain(
        {
            **_heading(),
            "scan": {"name": scan_name},
            "part": {"name": part_name, "sha256": part_sha256},
            "verdict": {"status": verdict.status, "reason": verdict.reason},
            **pose_to_dict(placement.part_from_camera[0]),
            "placement": {
                "meaning": _PLACEMENT,
                "even": even,
                "fixed": list(fixed),
                "least_stock_mm": placement.stock_mm[least],
                "required_mm": placement.required_mm[least],
                "margin_mm": placement.margin_mm,
                "margin_sigma_mm": placement.margin_sigma_mm,
                "least_at_mm": placement.points[least],
                "least_side": placement.least_side,
                "held_by": dict(placement.held_by),
                "seen_share": placement.seen_share,
                "unopposed_share": placement.unopposed_share,
                "rotation_vector_deg": np.degrees(placement.motion[:3]),
                "translation_mm": placement.motion[3:],
                "converged": placement.converged,
            },
        }
    )


def read_pose(path: str | os.PathLike[str]) -> RigidTransform:
    """Reads part_from_camera (f64), for example as a first guess.

    Args:
      path: JSON that `write_result` wrote, or ``{"part_from_camera": M}``,
        ``{"camera_from_part": M}``, or M alone, with M 4x4, row-major, mm (or ``{"matrix": M}``);
        or text with the 16 numbers of part_from_camera row by row, lines with # left out. The
        rotation becomes the nearest one.

    Raises:
      InputError: no such file, no pose in it, or no rigid motion; names the file and the value.
    """
    return parse_transform(read_text(Path(path)), where=str(path))


def parse_transform(
    text: str, *, where: str, target: str = "part", source: str = "camera"
) -> RigidTransform:
    """The motion target_from_source from text that `read_pose` takes.

    ``where`` begins the messages of its `InputError`. JSON may name the motion or its inverse;
    what stands without a name is target_from_source.
    """
    if text.lstrip()[:1] in ("{", "["):
        return _from_json(text, where, target, source)
    words = re.sub(r"#.*", "", text).replace(",", " ").replace(";", " ").split()
    try:
        numbers = [float(word) for word in words[:17]]
    except ValueError as error:
        raise InputError(f"{where}: neither JSON nor 16 numbers ({error})") from None
    if len(words) != 16:
        raise InputError(
            f"{where}: holds {len(words)} numbers; a pose is 16, the rows of a 4x4 matrix in mm"
        )
    return rigid_from_matrix(np.array(numbers).reshape(4, 4), where=where)


def read_text(path: Path) -> str:
    """The text of a pose file; `InputError` if it cannot be one."""
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is a folder or a device; a pose file is JSON or 16 numbers")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(f"{path}: {size / 2**20:.0f} MiB are too large for a pose file")
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        where = path.parent.absolute()
        raise InputError(
            f"{path}: no such file (looked in {where}); it should hold a pose"
        ) from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is no text; a pose file is JSON or 16 numbers") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def _from_json(text: str, where: str, target: str, source: str) -> RigidTransform:
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: is not valid JSON ({error})") from None
    if isinstance(values, list):
        return rigid_from_matrix(_matrix(values, where), where=where)
    forward, backward = f"{target}_from_{source}", f"{source}_from_{target}"
    poses = {
        name: rigid_from_matrix(_matrix(values[name], f"{where}, {name}"), where=f"{where}, {name}")
        for name in (forward, backward)
        if name in values
    }
    if not poses:
        names = ", ".join(map(repr, list(values)[:8])) or "nothing"
        raise InputError(
            f'{where}: has no "{forward}" and no "{backward}", each 4x4, row-major, mm; it has '
            f"{names}"
        )
    if len(poses) == 2:  # in a file that was edited, perhaps only one of the two was
        rest = poses[forward] @ poses[backward]
        # rounded entries of a rotation move a point that is far away
        limit = MATRIX_TOLERANCE * (1 + np.linalg.norm(poses[forward].translation))
        turned = np.abs(rest.rotation - np.eye(3)).max() > MATRIX_TOLERANCE
        if turned or np.abs(rest.translation).max() > limit:
            raise InputError(
                f'{where}: "{forward}" and "{backward}" are not inverse to each other; keep the '
                "one that is right"
            )
    return poses[forward] if forward in poses else poses[backward].inverse()


def _matrix(value: Any, where: str) -> np.ndarray:
    """[4, 4] f64 from nested or flat lists of numbers, or from ``{"matrix": ...}``."""
    if isinstance(value, dict):
        value = value.get("matrix")
    rows = value if isinstance(value, list) else []
    if len(rows) == 4 and all(isinstance(row, list) and len(row) == 4 for row in rows):
        rows = [number for row in rows for number in row]
    wrong = [v for v in rows if isinstance(v, bool) or not isinstance(v, int | float)]
    if len(rows) != 16 or wrong:
        raise InputError(f"{where}: holds no 4x4 matrix: four rows of four numbers, mm")
    try:
        return np.array(rows, np.float64).reshape(4, 4)
    except OverflowError:
        raise InputError(f"{where}: the matrix holds a value that is not finite") from None


def _heading() -> dict[str, Any]:
    """What every pose file begins with."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "conventions": CONVENTIONS,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": {name: _version(name) for name in PACKAGES},
    }


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _plain(value: Any) -> Any:
    """Lists, dicts and Python numbers; a number that is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, str | bool):
        return value
    array = np.asarray(value)
    if array.ndim:
        return _plain(array.tolist())
    number = array.item()
    return number if np.isfinite(number) else None
