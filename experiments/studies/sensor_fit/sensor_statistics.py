"""What the errors of scans are like, in a few figures: of real and virtual scans alike.

A scan is compared with what the CAD model predicts for each pixel of its camera, at the pose that
the fine registration finds from the true one. The residual of a pixel is its measured depth less
the predicted one.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import ndimage, stats

from vanejax.errors import InputError
from vanejax.localization import RayCasting, refine
from vanejax.rigid import RigidTransform
from vanejax.scans.robust_statistics import robust_sigma

FOCAL_PX = (150.0, 300.0)  # between which that of the real camera is sought
EDGE_PX = 2.0
EDGE_JUMP_MM = 4.0
MARGIN_PX = 4  # around the points: what lies off the outline is seen there
INCIDENCES_DEG = (0.0, 40.0, 60.0, 75.0, 90.0)
LAGS_PX = (1, 3, 8, 20)
CREASE_PX = 2.0
MOST_MM = 20.0  # a point farther off is none of the part
# below these a figure is as good as none: they keep the logarithm of a ratio finite
LEAST = {"mm": 0.05, "share": 0.01, "ratio": 0.05}


@dataclasses.dataclass(frozen=True)
class Grid:
    """Where the pixels' rays run: slopes ``(column + column_phase) / focal_px``, rows downwards.

    The number of the first column is unknown and of no matter.
    """

    focal_px: float
    column_phase: float
    row_phase: float

    def place(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column [N] of points [N, 3], camera frame; not yet whole numbers."""
        depth = -points[:, 2]
        column = self.focal_px * points[:, 0] / depth - self.column_phase
        row = -self.focal_px * points[:, 1] / depth - self.row_phase
        return row, column

    def rays(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """[..., 3], of length 1 in depth."""
        x = (column + self.column_phase) / self.focal_px
        y = -(row + self.row_phase) / self.focal_px
        return np.stack(np.broadcast_arrays(x, y, -1.0), axis=-1)


def find_grid(scans: Sequence[np.ndarray]) -> Grid:
    """The grid of square pixels that all scans [N, 3] of one camera lie on.

    Slopes times the right focal length are whole numbers plus a phase: the one for which the mean
    of ``exp(2 pi i f x / z)`` is longest.

    Raises:
      InputError: no focal length between `FOCAL_PX` puts the points on a grid.
    """
    slopes = np.concatenate([points[:, :2] / -points[:, 2:] for points in scans])
    slopes[:, 1] *= -1

    def phases(focal: float, some: np.ndarray) -> np.ndarray:
        return np.exp(2j * np.pi * focal * some).mean(axis=0)

    few = slopes[:: max(1, len(slopes) // 5000)]
    # a focal length wrong by 0.1 px shifts a slope of 0.5 by a twentieth of a pixel
    coarse = np.arange(*FOCAL_PX, 0.1)
    best = coarse[np.argmax([np.abs(phases(f, few)).sum() for f in coarse])]
    fine = best + np.arange(-0.2, 0.2, 0.005)
    focal = float(fine[np.argmax([np.abs(phases(f, slopes)).sum() for f in fine])])
    found = phases(focal, slopes)
    if np.abs(found).min() < 0.8:
        raise InputError(
            f"the scans do not lie on a grid of pixels with a focal length of {FOCAL_PX[0]:g} to "
            f"{FOCAL_PX[1]:g} pixels; the best is {focal:.2f}"
        )
    column, row = np.angle(found) / (2 * np.pi)
    return Grid(focal, float(column), float(row))


@dataclasses.dataclass(frozen=True, eq=False)
class Compared:
    """A scan beside its prediction, in the image around it: arrays [H, W], NaN where nothing is."""

    measured: np.ndarray  # depth, mm
    predicted: np.ndarray  # depth, mm
    incidence_deg: np.ndarray  # of the predicted surface
    # distance from the nearest jump of the predicted depth, or from the outline; on either side
    edge_px: np.ndarray
    # mean predicted depth around a pixel less its own: what a matching window would add
    crease_mm: np.ndarray

    @property
    def residual_mm(self) -> np.ndarray:
        """Measured less predicted depth."""
        return self.measured - self.predicted


def compared(
    model: RayCasting, points: np.ndarray, camera_from_part: RigidTransform, grid: Grid
) -> Compared:
    """A scan beside the prediction at its refined pose.

    Args:
      model: of the part; its sensor stands at the origin.
      points: [N, 3] f64 mm, camera frame.
      camera_from_part: about right.
      grid: of the camera.
    """
    pose = refine(model, points, camera_from_part.inverse()).part_from_camera
    row, column = (np.rint(place).astype(np.int64) for place in grid.place(points))
    first = row.min() - MARGIN_PX, column.min() - MARGIN_PX
    shape = row.max() + MARGIN_PX + 1 - first[0], column.max() + MARGIN_PX + 1 - first[1]
    measured = np.full(shape, np.nan)
    measured[row - first[0], column - first[1]] = -points[:, 2]
    rays = grid.rays(first[0] + np.arange(shape[0])[:, None], first[1] + np.arange(shape[1]))
    length = np.linalg.norm(rays, axis=-1)
    towards = pose.rotate(rays.reshape(-1, 3)) / length.reshape(-1, 1)
    hits = model.scanner.cast(np.broadcast_to(pose.translation, towards.shape), towards)
    predicted = np.where(hits.face >= 0, hits.distance_mm, np.nan).reshape(shape) / length
    cosine = -np.einsum("ni,ni->n", hits.normals, towards).reshape(shape)
    incidence = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    seen = np.isfinite(predicted)
    filled = np.where(seen, predicted, 1e4)
    reach = ndimage.maximum_filter(filled, 3) - ndimage.minimum_filter(filled, 3)
    # of a plane seen flat, neighbours differ much and yet there is no edge
    slope = np.where(
        seen, filled / grid.focal_px * np.tan(np.radians(np.minimum(incidence, 85))), 0
    )
    edge = reach > np.maximum(EDGE_JUMP_MM, 4 * slope)
    edge_px = ndimage.distance_transform_edt(~edge)
    weight = ndimage.gaussian_filter(seen.astype(np.float64), CREASE_PX)
    mean = ndimage.gaussian_filter(np.where(seen, predicted, 0.0), CREASE_PX)
    crease = np.where(seen, mean / np.maximum(weight, 1e-9) - predicted, np.nan)
    incidence = np.where(seen, incidence, np.nan)
    return Compared(measured, predicted, incidence, edge_px, crease)


def statistics(scans: Sequence[Compared]) -> dict[str, float]:
    """The figures of some scans together; each name ends with its unit: mm, share or ratio."""

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(scan, name).ravel() for scan in scans])

    residual, predicted, incidence, edge, crease = map(
        joined, ("residual_mm", "predicted", "incidence_deg", "edge_px", "crease_mm")
    )
    measured = np.isfinite(joined("measured"))
    seen = np.isfinite(predicted)
    both = measured & seen & (np.abs(residual) < MOST_MM)
    inner = both & (edge > EDGE_PX)
    spread = _spread(residual[inner])
    tail = 3 * max(spread, 1e-3)
    result = {
        "inside: spread (mm)": spread,
        "inside, incidence below 40 deg: spread (mm)": _spread(residual[inner & (incidence < 40)]),
        "inside, incidence above 60 deg: spread (mm)": _spread(residual[inner & (incidence > 60)]),
        "inside, nearer than 220 mm: spread (mm)": _spread(residual[inner & (predicted < 220)]),
        "inside, beyond 260 mm: spread (mm)": _spread(residual[inner & (predicted > 260)]),
        "inside: beyond 3 spreads (share)": _share(np.abs(residual[inner]) > tail),
        "rounding of edges (ratio)": _slope(crease[inner], residual[inner]),
    }
    for lag in LAGS_PX:
        differences = np.concatenate([_differences(scan, lag) for scan in scans])
        result[f"residuals {lag} px apart: difference (mm)"] = _spread(differences)
    steps = np.concatenate([np.diff(scan.measured, axis=1).ravel() for scan in scans])
    result["neighbours of the same depth (share)"] = _share(np.abs(steps[np.isfinite(steps)]) < 0.1)
    for low, high in itertools.pairwise(INCIDENCES_DEG):
        some = seen & (edge > EDGE_PX) & (incidence >= low) & (incidence < high)
        result[f"inside, {low:g} to {high:g} deg: not measured (share)"] = _share(~measured[some])
    rim = seen & (edge <= EDGE_PX)
    result["at edges: not measured (share)"] = _share(~measured[rim])
    result["at edges: beyond 3 spreads (share)"] = _share(np.abs(residual[rim & both]) > tail)
    result["points off the outline (share)"] = _share(~seen[measured])
    return result


def unlikeness(one: Mapping[str, float], other: Mapping[str, float]) -> dict[str, float]:
    """``|log(a / b)|`` of each figure, with `LEAST` added to both; their mean is the distance."""
    parts = {}
    for name, value in one.items():
        least = LEAST[name[name.rindex("(") + 1 : -1]]
        if math.isfinite(value) and math.isfinite(other[name]):
            # a regression's slope may be negative, which is as little as none
            ratio = (max(value, 0) + least) / (max(other[name], 0) + least)
            parts[name] = abs(math.log(ratio))
    return parts


def distance(one: Mapping[str, float], other: Mapping[str, float]) -> float:
    """The mean of `unlikeness`: 0 for the same figures, 0.69 where they differ by a factor of 2."""
    return float(np.mean(list(unlikeness(one, other).values())))


def residual_gap(one: Sequence[Compared], other: Sequence[Compared]) -> float:
    """Two-sample Kolmogorov-Smirnov statistic of the residuals away from edges: 0 to 1."""

    def inner(scans: Sequence[Compared]) -> np.ndarray:
        joined = np.concatenate([scan.residual_mm[scan.edge_px > EDGE_PX] for scan in scans])
        return joined[np.isfinite(joined)]

    return float(stats.ks_2samp(inner(one), inner(other)).statistic)


def _spread(values: np.ndarray) -> float:
    """Robust standard deviation about the median; NaN of fewer than 30."""
    if len(values) < 30:
        return math.nan
    return float(robust_sigma(values - np.median(values)))


def _share(which: np.ndarray) -> float:
    return float(np.mean(which)) if len(which) >= 30 else math.nan


def _slope(x: np.ndarray, y: np.ndarray) -> float:
    """Of the line through the origin, by least squares with all y limited to 3 spreads."""
    limit = 3 * max(_spread(y), 1e-6)
    return float(np.sum(x * np.clip(y, -limit, limit)) / max(np.sum(x * x), 1e-12))


def _differences(scan: Compared, lag: int) -> np.ndarray:
    """Of residuals away from edges that lie ``lag`` columns or rows apart."""
    inner = np.where(scan.edge_px > EDGE_PX, scan.residual_mm, np.nan)
    down, across = inner[lag:] - inner[:-lag], inner[:, lag:] - inner[:, :-lag]
    joined = np.concatenate([down.ravel(), across.ravel()])
    return joined[np.isfinite(joined) & (np.abs(joined) < MOST_MM)]
