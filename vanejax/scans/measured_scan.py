"""A scan as it was measured: points of unknown quality, and what is known of the sensor."""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal

import numpy as np

from vanejax.errors import InputError
from vanejax.scans.viewpoint import why_not_from

MIN_POINTS = 50
"""Distinct points that a pose is asked of at least."""

# no scanner measures 100 km: writers put 1e10 or the largest float where there is no measurement
_NOWHERE_MM = 1e8
# of its length: what a scan is wide at least; single precision and three decimals stay below it
_LINE = 1e-4
_BAD_NORMALS = 0.01
_HASH_FACTOR = np.uint64(0x9E3779B97F4A7C15)  # 2^64 / golden ratio: odd, so nothing is lost


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredScan:
    """Points of one real or virtual scan, cleaned, in the scan's own frame.

    Attributes:
      points: [N, 3] f64, mm, finite, no two alike.
      normals: [N, 3] f32, unit; towards the sensor where its origin is known; None if not given.
      sensor_origin: [3] f64, mm, where the rays start; None if unknown (merged clouds, exports).
      name: for reports; the file's stem.
      notes: what was dropped or assumed, a sentence each.
      origin_is_assumed: whether nobody said where the sensor stands, it only looks like it.
    """

    points: np.ndarray
    normals: np.ndarray | None
    sensor_origin: np.ndarray | None
    name: str = "scan"
    notes: tuple[str, ...] = ()
    origin_is_assumed: bool = False

    @functools.cached_property
    def looks_along(self) -> Literal["+z", "-z"] | None:
        """The half of the z axis, scan frame, on which the sensor sees the points.

        None where the sensor's origin is unknown, or its line of sight is nearer to the xy plane
        than to the z axis.
        """
        if self.sensor_origin is None:
            return None
        sight = np.mean(self.points, axis=0) - self.sensor_origin
        if abs(sight[2]) <= np.linalg.norm(sight[:2]):
            return None
        return "+z" if sight[2] > 0 else "-z"


def clean_scan(
    points: np.ndarray,
    normals: np.ndarray | None = None,
    *,
    name: str = "scan",
    sensor_origin: str | np.ndarray = "auto",
    stated_origin: np.ndarray | None = None,
) -> MeasuredScan:
    """A scan from raw points, without what is no measurement.

    Dropped, with a note: points that are not finite or farther away than 100 km; points exactly at
    the sensor's place, and points at (0, 0, 0) where there are several (organised clouds mark
    missing pixels so); all but the first of equal points; points with a normal that is zero or not
    finite, or all normals where more than 1 % are.

    Arrays of other shapes, fewer than 50 distinct points, and points on one line raise InputError.

    Args:
      points: [N, 3] float or integer, mm; not changed.
      normals: [N, 3], any length; None if there are none.
      name: for messages and reports.
      sensor_origin: [3] mm, scan frame; ``"unknown"`` for merged or moved clouds; ``"auto"`` for
        ``stated_origin``, if the cloud looks like a single view from there: see `why_not_from`.
      stated_origin: [3] mm; None for (0, 0, 0).
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise InputError(
            f"{name}: points have shape {list(points.shape)} and type {points.dtype}, not [N, 3] "
            "numbers in mm"
        )
    points = points.astype(np.float64, copy=False)
    if normals is not None:
        normals = np.asarray(normals)
        if normals.shape != points.shape or normals.dtype.kind not in "fiu":
            raise InputError(
                f"{name}: normals have shape {list(normals.shape)} and type {normals.dtype}, the "
                f"points {list(points.shape)}"
            )
    given = len(points)
    notes: list[str] = []
    points, normals = _without(
        points, normals, ~measured(points), "without a measurement (not finite)", notes
    )
    zero = at_place(points, np.zeros(3))
    if np.count_nonzero(zero) > 1:
        points, normals = _without(points, normals, zero, "without a measurement (0, 0, 0)", notes)
    normals, bad = _unit_normals(normals, notes)
    points, normals = _without(points, normals, bad, "whose normal is zero or not finite", notes)
    double = repeats(points)
    points, normals = _without(points, normals, double, "that repeat another exactly", notes)
    if len(points) < MIN_POINTS:
        dropped = f" ({'; '.join(notes)})" if notes else ""
        raise InputError(
            f"{name}: {len(points)} distinct points are left of {given:,}{dropped}; "
            f"a pose needs at least {MIN_POINTS}"
        )
    _refuse_line(points, name)
    origin, reason = _sensor(points, sensor_origin, stated_origin, name)
    if origin is not None:  # a ray to the sensor itself has no direction
        points, normals = _without(
            points, normals, at_place(points, origin), "at the sensor's place", notes
        )
    notes.append(reason)
    if normals is not None and origin is not None:
        normals = _towards(points, normals, origin, notes)
    scan = MeasuredScan(points, normals, origin, name)
    if origin is not None and scan.looks_along:
        notes[notes.index(reason)] += f", looking along {scan.looks_along}"
    assumed = origin is not None and isinstance(sensor_origin, str)
    return dataclasses.replace(scan, notes=tuple(notes), origin_is_assumed=assumed)


def measured(points: np.ndarray) -> np.ndarray:
    """[N] bool, which of the points [N, 3], in any unit, are finite and not absurdly far away."""
    # column by column, which is faster; False for NaN
    return np.logical_and.reduce([np.abs(points[:, axis]) < _NOWHERE_MM for axis in range(3)])


def at_place(points: np.ndarray, place: np.ndarray) -> np.ndarray:
    """[N] bool, which of the points [N, 3] are exactly there."""
    x, y, z = place
    return (points[:, 2] == z) & (points[:, 0] == x) & (points[:, 1] == y)


def _without(
    points: np.ndarray,
    normals: np.ndarray | None,
    bad: np.ndarray | None,
    why: str,
    notes: list[str],
) -> tuple[np.ndarray, np.ndarray | None]:
    """Points and normals without the ``bad`` [N] bool (None: none), and a note that says so."""
    count = 0 if bad is None else int(np.count_nonzero(bad))
    if not count:
        return points, normals
    notes.append(f"dropped {count:,} points {why}")
    return points[~bad], None if normals is None else normals[~bad]


def _unit_normals(
    normals: np.ndarray | None, notes: list[str]
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Unit normals [N, 3] f32, and which rows [N] bool are none, or None where all are."""
    if normals is None or not len(normals):
        return None, None
    with np.errstate(over="ignore", invalid="ignore"):
        normals = normals.astype(np.float32, copy=False)
        squared = np.einsum("ni,ni->n", normals, normals)
        # a tenth of a unit: shorter is rounding noise, longer overflowed
        bad = ~((squared > 1e-12) & (squared < 1e12))
        count = int(np.count_nonzero(bad))
        if count > _BAD_NORMALS * len(normals):
            notes.append(
                f"dropped all normals: {count:,} of {len(normals):,} are zero or not finite"
            )
            return None, None
        normals = normals / np.sqrt(squared)[:, None]
    return normals, bad if count else None


def _sensor(
    points: np.ndarray, wanted: str | np.ndarray, stated: np.ndarray | None, name: str
) -> tuple[np.ndarray | None, str]:
    """Where the sensor stands, and the sentence that says so."""
    if isinstance(wanted, str) and wanted == "unknown":
        return None, "the sensor's place is taken as unknown, as asked"
    if isinstance(wanted, str) and wanted == "auto":
        origin = np.zeros(3) if stated is None else np.asarray(stated, np.float64)
        place = "the scan's origin" if stated is None else f"the file's viewpoint {origin} mm"
        if reason := why_not_from(points, origin):
            return None, f"{place} {reason}; the sensor's place is taken as unknown"
        return origin, f"the sensor is taken to stand at {place}"
    try:
        origin = np.asarray(wanted, np.float64)
    except (TypeError, ValueError):
        origin = np.full(3, np.nan)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        raise InputError(
            f"{name}: sensor_origin must be 'auto', 'unknown' or three numbers in mm, "
            f"got {wanted!r}"
        )
    return origin, f"the sensor stands at {origin} mm, as given"


def _towards(
    points: np.ndarray, normals: np.ndarray, origin: np.ndarray, notes: list[str]
) -> np.ndarray:
    """Normals [N, 3], each with the sign that faces ``origin``."""
    away = sum((points[:, axis] - origin[axis]) * normals[:, axis] for axis in range(3)) > 0
    share = float(np.mean(away))
    if share > 0.99:
        notes.append("the normals pointed away from the sensor and were turned round")
    elif share > 0.001:
        notes.append(f"turned {100 * share:.1f} % of the normals, which faced away from the sensor")
    return np.where(away[:, None], -normals, normals)


def repeats(points: np.ndarray) -> np.ndarray | None:
    """[N] bool, which points [N, 3] equal an earlier one; None if none does.

    Equal points have equal hashes, and sorting one hash per point is ten times faster than sorting
    points: only those that share a hash are compared.
    """
    bits = (np.ascontiguousarray(points) + 0.0).view(np.uint64)  # -0.0 becomes 0.0
    code = np.zeros(len(points), np.uint64)
    for axis in range(3):
        code ^= bits[:, axis]
        code *= _HASH_FACTOR
        code ^= code >> np.uint64(32)
    ranked = np.sort(code)
    shared = ranked[1:][ranked[1:] == ranked[:-1]]
    if not len(shared):
        return None
    shared = np.unique(shared)
    place = np.minimum(np.searchsorted(shared, code), len(shared) - 1)
    rows = np.flatnonzero(shared[place] == code)
    order = rows[np.lexsort((rows, *points[rows].T))]  # equal points in the order of the file
    repeated = np.zeros(len(points), bool)
    repeated[order[1:]] = np.all(points[order[1:]] == points[order[:-1]], axis=1)
    return repeated if repeated.any() else None


def _refuse_line(points: np.ndarray, name: str) -> None:
    """Raises InputError for points on one line."""
    centered = points - points.mean(axis=0)
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(centered.T @ centered / len(points)), 0))
    if spread[1] <= _LINE * spread[2]:
        raise InputError(
            f"{name}: its {len(points):,} points lie on one line (to {spread[1]:.2g} mm in "
            f"{2 * spread[2]:.3g} mm): the part could turn about it and fit as well, so no pose "
            "follows; scan an area of the part"
        )
