"""Whether a cloud can have been measured from one place: what a single view looks like."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

_CONE_DEG = 75.0
_NEAREST = 0.05  # of the cloud's extent
_STRAY = 0.001  # of the points: dust in the air may be nearer or farther out
_SAMPLE = 20_000

_NEIGHBORS = 8
_STEEPEST = 10.0  # 84 deg of incidence: steeper is no surface but the step from one to another
_STEP = 0.02  # of the cloud's extent: noise is less
_LAYERED = 0.06


def sampled_rows(count: int, wanted: int) -> np.ndarray:
    """Indices [n] i64, ascending, of about ``wanted`` of ``count`` rows; all if those are fewer.

    At random, the same every time: every k-th pixel of an organised scan would be a few columns.
    """
    if count <= wanted:
        return np.arange(count)
    return np.unique(np.random.default_rng(0).integers(count, size=wanted))


def why_not_from(points: np.ndarray, origin: np.ndarray) -> str:
    """Why a sensor at ``origin`` [3] cannot have measured points [N, 3], both in any one unit.

    From its sensor a single view lies in a cone, at a distance, and in one layer: neighbouring
    rays end at neighbouring points, but at the few outlines where one surface hides another.
    Clouds merged from several views, or moved into another frame, have rays that end at several
    depths. Of the neighbouring rays of a single view of a guide vane at most 4 % do, of two views
    40 deg apart 6 % and more, of a whole surface 24 % and more. Normals are not asked: programs
    that estimate them turn patches of them the wrong way (10 to 24 % in real depth-camera scans).

    Returns:
      The predicate of a sentence about the origin; empty if it can be the sensor's place.
    """
    if len(points) < 2:
        return "cannot be told to be the sensor's place from so few points"
    rays = points[sampled_rows(len(points), _SAMPLE)] - origin
    distance = np.linalg.norm(rays, axis=1)
    rays, distance = rays[distance > 0], distance[distance > 0]
    extent = float(np.linalg.norm(np.ptp(rays, axis=0))) if len(rays) else 0.0
    directions = rays / distance[:, None]
    mean = directions.sum(axis=0)
    length = float(np.linalg.norm(mean))
    # without a mean direction the points are all around
    cosine = directions @ (mean / length) if length > 0 else np.full(1, -1.0)
    if np.quantile(cosine, _STRAY) < np.cos(np.radians(_CONE_DEG)):
        return "lies inside the cloud: merged or centred"
    if np.quantile(distance, _STRAY) < _NEAREST * extent:
        return "lies at the edge of the cloud: cropped, or moved into another frame"
    if _layered_share(directions, distance, extent) > _LAYERED:
        return "would see surfaces behind each other: merged, or moved into another frame"
    return ""


def _layered_share(directions: np.ndarray, distance: np.ndarray, extent: float) -> float:
    """Of all pairs of neighbouring rays, those that end on different surfaces, 0 to 1."""
    count = min(_NEIGHBORS, len(directions) - 1)
    if count < 1:
        return 0.0
    angle, index = cKDTree(directions).query(directions, range(2, count + 2), workers=-1)
    step = np.abs(distance[index] - distance[:, None])
    allowed = np.maximum(_STEP * extent, _STEEPEST * angle * distance[:, None])
    return float(np.mean(step > allowed))
