"""What a pose file says beside the pose, read without trust: verdict, covariance, form deviation.

Frames and units are those of `vanejax.machine.pose_file`. Host numpy only.
"""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np

from vanejax.errors import InputError
from vanejax.localization.pose_result import FieldKind, FormDeviation, Status, Verdict
from vanejax.machine.motion_covariance import MotionCovariance
from vanejax.machine.pose_file import parse_transform, read_text
from vanejax.rigid import RigidTransform

MOST = 1e9  # mm, or mm^2 of a covariance: larger is no figure of a part
ROUNDED = 1e-6  # of a covariance's entries over the standard deviations


class PoseRecord(NamedTuple):
    """What a pose file (f64, mm) says; None is what it does not say.

    Attributes:
      part_from_camera: the pose.
      verdict: on it.
      part_sha256: `Part.sha256`.
      covariance: of an error applied after ``part_from_camera``, part frame.
      form: how the part as scanned differs from its CAD model.
      calibration: the name of the sensor whose errors of calibration count in the covariance.
      tolerance_mm: what the verdict asked of the pose.
      has_alternatives: whether it lists other poses that the scan allows.
    """

    part_from_camera: RigidTransform
    verdict: Verdict | None = None
    part_sha256: str | None = None
    covariance: MotionCovariance | None = None
    form: FormDeviation | None = None
    calibration: str | None = None
    tolerance_mm: float | None = None
    has_alternatives: bool = False


def read_record(path: str | os.PathLike[str]) -> PoseRecord:
    """`read_pose`, with what else the file says.

    Raises:
      InputError: as `read_pose`; an unknown verdict, a covariance that is none, a form deviation
        that is incomplete or has a value out of range.
    """
    path = Path(path)
    text = read_text(path)
    pose = parse_transform(text, where=str(path))
    values = json.loads(text) if text.lstrip()[:1] == "{" else {}
    try:
        return PoseRecord(
            pose,
            _verdict(values.get("verdict")),
            _text(_entry(values, "part", "sha256")),
            _covariance(values.get("uncertainty")),
            _form(values.get("form_deviation")),
            _text(values.get("calibration")),
            _tolerance_mm(_entry(values, "tolerance", "mm")),
            bool(values.get("alternatives")),
        )
    except InputError as error:
        raise InputError(
            f"{path}: {error}; write it again with `vanejax register --json`"
        ) from None


def _entry(values: dict[str, Any], name: str, key: str) -> Any:
    inner = values.get(name)
    return inner.get(key) if isinstance(inner, dict) else None


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None


def _verdict(value: Any) -> Verdict | None:
    if value is None:
        return None
    if not isinstance(value, dict) or value.get("status") not in get_args(Status):
        raise InputError(f"its verdict has no status {', '.join(get_args(Status))}")
    return Verdict(value["status"], str(value.get("reason") or "no reason is given"))


def _covariance(value: Any) -> MotionCovariance | None:
    if value is None:
        return None
    if not isinstance(value, dict):
        raise InputError("its uncertainty is no object with a covariance and a center_mm")
    center = _numbers(value.get("center_mm"), (3,), "center_mm")
    covariance = _numbers(value.get("covariance"), (6, 6), "covariance")
    variance = np.diag(covariance)
    sigma = np.sqrt(np.maximum(variance, 0))
    unit = np.outer(sigma, sigma)  # rad and mm in one matrix: only a correlation has no unit
    if (np.abs(covariance - covariance.T) > ROUNDED * unit).any():
        raise InputError("its covariance is not symmetric")
    correlation = covariance / np.where(unit > 0, unit, 1)
    too_large = variance.min() < 0 or (np.abs(covariance) > (1 + ROUNDED) * unit).any()
    if too_large or np.linalg.eigvalsh(correlation)[0] < -ROUNDED:
        raise InputError("its covariance has a negative variance in some direction")
    return MotionCovariance(covariance, center)


def _form(value: Any) -> FormDeviation | None:
    if value is None:
        return None
    if not isinstance(value, dict):
        raise InputError("its form_deviation is no object")
    fields = dataclasses.fields(FormDeviation)
    return FormDeviation(**{f.name: _form_field(f.name, f.default, value) for f in fields})


def _form_field(name: str, default: Any, values: dict[str, Any]) -> Any:
    value = values.get(name)
    if name == "field":
        if value not in get_args(FieldKind):
            raise InputError(
                f"its form_deviation.field is none of {', '.join(get_args(FieldKind))}"
            )
        return value
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise InputError(f"its form_deviation.{name} is neither true nor false")
        return value
    number = float(_numbers(value, (), f"form_deviation.{name}"))
    if number < 0 and name not in ("stock_mm", "scale_error", "focal_error"):
        raise InputError(f"its form_deviation.{name} is {number:g}, less than 0")
    return number


def _tolerance_mm(value: Any) -> float | None:
    if value is None:
        return None
    number = float(_numbers(value, (), "tolerance.mm"))
    if number <= 0:
        raise InputError(f"its tolerance.mm is {number:g}, not above 0")
    return number


def _numbers(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """[*shape] f64 from nested lists of numbers; `InputError` for anything else."""
    try:
        array = np.array(value, dtype=object)
    except ValueError:  # lists of lists of different lengths
        array = np.array(None)
    plain = all(isinstance(v, int | float) and not isinstance(v, bool) for v in array.ravel())
    if array.shape != shape or not plain:
        what = f"{' x '.join(map(str, shape))} numbers" if shape else "a number"
        raise InputError(f"its {name} is not {what}")
    if not all(abs(v) <= MOST for v in array.ravel()):
        raise InputError(f"its {name} holds a value that is not finite, or too large")
    return array.astype(np.float64)
