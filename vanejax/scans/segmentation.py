"""What of a scan is the part, what the table, and what anything else.

Planes first: one is a table if the part has no face as large and the rest of the scan stands on
one side of it, the sensor's. What remains falls into clusters; the part is the one whose size is
likest to the part's, with all other pieces that do not make it larger than the part. What touches
the part, such as a clamp or a chip that lies on it, is one cluster with it and stays.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.scans.table_planes import Plane, find_tables, with_noise_thickness
from vanejax.scans.viewpoint import sampled_rows
from vanejax.scans.voxels import Voxels

VOXELS_PER_RADIUS = 60.0
POINTS_PER_VOXEL = 3.0  # fewer, and a surface falls apart into its points
MAX_VOXEL_STEPS = 12  # in which the voxels become larger
THICKNESS_POINTS = 50_000
LARGER_PART = 1.03  # how much wider than the part its pieces together may be
NOISE = 0.02  # and by how much of its radius
LEAST_PIECE = 0.02  # of the largest piece: smaller ones that stand on the table are chips on it
MOST_PIECES = 9  # of which all sets are tried
DIRECTIONS = 128  # in which widths are measured
PART_TURNS = 12  # of the part against those


class Segment(enum.IntEnum):
    """What a point was taken for."""

    PART = 0
    TABLE = 1
    OTHER = 2


@dataclasses.dataclass(frozen=True, eq=False)
class Segments:
    """A scan of N points, taken apart: a `Segment` each [N] u8, and the planes taken away."""

    label: np.ndarray
    tables: tuple[Plane, ...]

    @property
    def part(self) -> np.ndarray:
        """[N] bool: the part, and what touches it."""
        return self.label == Segment.PART

    def count(self, segment: Segment) -> int:
        """How many points were taken for that."""
        return int(np.count_nonzero(self.label == segment))


def is_larger(points: np.ndarray, part: Part) -> bool:
    """Whether points [N, 3] mm, but for 1 % at either end, are wider than the part can be.

    Then they are not of the part alone; where they are not, there may still be other things.
    """
    sample = points[sampled_rows(len(points), 2_000)]
    low, high = np.quantile(sample @ _directions().T, [0.01, 0.99], axis=0)
    return bool(np.any(np.sort(high - low) > _allowed_mm(_part_widths(part), part)))


def segment(
    points: np.ndarray, part: Part, *, sensor_origin: np.ndarray | None = None, seed: int = 0
) -> Segments:
    """Finds the part among other things; where there are none, everything is the part.

    Points are [N, 3] f64, mm, finite, in any frame (InputError for another shape); the sensor's
    origin is [3] mm in that frame, None if unknown: a table has the sensor above it. The part's
    size tells what may be it. The seed is that of the planes tried: same seed, same result.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise InputError(f"segmentation needs [N, 3] points in mm, got {list(points.shape)}")
    voxels = _voxels(points, part)
    tables = find_tables(voxels, part, sensor_origin, seed)
    label = np.full(len(points), Segment.PART, np.uint8)
    sample = points[sampled_rows(len(points), THICKNESS_POINTS)]
    tables = tuple(with_noise_thickness(table, sample, part) for table in tables)
    for table in tables:
        label[np.abs(table.height_mm(points)) <= table.thickness_mm] = Segment.TABLE
    rest = np.flatnonzero(label == Segment.PART)
    if len(rest):
        is_part = _part_of(points[rest], part, voxels.size_mm, tables, sensor_origin)
        label[rest[~is_part]] = Segment.OTHER
    return Segments(label, tables)


def _voxels(points: np.ndarray, part: Part) -> Voxels:
    """Fine beside the part, coarse beside the points' spacing."""
    # a stray far away would need a grid beyond 64 bits
    widest = max(float(np.ptp(points[:, k])) for k in range(3))
    size = max(part.radius / VOXELS_PER_RADIUS, widest / 2**20)
    for _ in range(MAX_VOXEL_STEPS):
        voxels = Voxels(points, size)
        if len(points) >= POINTS_PER_VOXEL * len(voxels):
            break
        size *= 1.3
    return voxels


def _part_of(
    points: np.ndarray,
    part: Part,
    size_mm: float,
    tables: tuple[Plane, ...],
    sensor_origin: np.ndarray | None,
) -> np.ndarray:
    """[N] bool: which of the points [N, 3] are the part, or cannot be told from it."""
    voxels = Voxels(points, size_mm)
    directions, wanted = _directions(), _part_widths(part)
    piece = voxels.clusters()
    supports = _Supports.of(voxels.middle, piece, directions)
    allowed = _allowed_mm(wanted, part)
    too_large = np.any(supports.widths() > allowed, axis=1)
    if sensor_origin is not None and too_large.any():
        # what is larger than the part is more than the part
        least = max(1, int(LEAST_PIECE * len(voxels)))
        folded = voxels.pieces(np.asarray(sensor_origin, np.float64), least=least)
        parted = too_large[piece]
        piece[parted] = piece.max() + 1 + folded[parted]
        piece = np.unique(piece, return_inverse=True)[1]
        supports = _Supports.of(voxels.middle, piece, directions)
    order = np.argsort(-supports.count, kind="stable")
    large = order[: np.count_nonzero(supports.count >= LEAST_PIECE * supports.count[order[0]])]
    chosen = _likeliest(supports, large[:MOST_PIECES], wanted, allowed)
    low, high = supports.low[chosen].min(axis=0), supports.high[chosen].max(axis=0)
    allowed = np.maximum(allowed, np.sort(high - low))
    small = np.setdiff1d(order, large)
    with_small = np.maximum(high, supports.high[small]) - np.minimum(low, supports.low[small])
    fits = np.all(np.sort(with_small, axis=1) <= allowed, axis=1)
    if tables:
        above = [table.height_mm(voxels.middle) - table.thickness_mm for table in tables]
        height = np.min(above, axis=0)
        lowest = np.full(len(order), np.inf)
        np.minimum.at(lowest, piece, height)
        fits &= lowest[small] > 2 * size_mm
    return np.isin(piece, np.concatenate([chosen, small[fits]]))[voxels.of_point]


@dataclasses.dataclass(frozen=True, eq=False)
class _Supports:
    """How far K pieces reach in D directions.

    Attributes:
      low, high: [K, D] f64, mm.
      count: [K] i64, voxels in each.
    """

    low: np.ndarray
    high: np.ndarray
    count: np.ndarray

    @classmethod
    def of(cls, middle: np.ndarray, piece: np.ndarray, directions: np.ndarray) -> _Supports:
        """Of voxels [V, 3] mm by the number [V] of their piece; no number is left out."""
        count = np.bincount(piece)
        along = (middle @ directions.T)[np.argsort(piece, kind="stable")]
        first = np.cumsum(count) - count
        return cls(np.minimum.reduceat(along, first), np.maximum.reduceat(along, first), count)

    def widths(self) -> np.ndarray:
        """[K, D] mm, ascending, of each piece.

        Whatever is a piece of the part is, in every order statistic, at most as wide as the part,
        however it is turned.
        """
        return np.sort(self.high - self.low, axis=1)


def _likeliest(
    supports: _Supports, large: np.ndarray, wanted: np.ndarray, allowed: np.ndarray
) -> np.ndarray:
    """Which of the large pieces together are most of the part, but no more than it.

    All sets of them are tried: the score is the number of voxels times how like the widths are to
    the part's. A single piece that is too large is better than nothing.
    """
    chosen = (np.arange(1, 1 << len(large))[:, None] >> np.arange(len(large))) & 1 == 1
    low = np.where(chosen[..., None], supports.low[large], np.inf).min(axis=1)
    high = np.where(chosen[..., None], supports.high[large], -np.inf).max(axis=1)
    widths = np.sort(high - low, axis=1)
    ratio = widths / wanted
    like = np.minimum(ratio, 1 / np.maximum(ratio, 1e-9)).mean(axis=1)
    score = like * (chosen @ supports.count[large])
    fits = np.all(widths <= allowed, axis=1)
    if not fits.any():
        fits = chosen.sum(axis=1) == 1
        score = like
    return large[chosen[np.argmax(np.where(fits, score, -1.0))]]


def _allowed_mm(widths: np.ndarray, part: Part) -> np.ndarray:
    """What a piece of the part may be wide: noise makes thin things thicker."""
    return LARGER_PART * widths + NOISE * part.radius


def _part_widths(part: Part) -> np.ndarray:
    """[D] f64, mm, ascending: the largest that order statistics of the part's widths can be.

    They depend a little on how it is turned against the directions.
    """
    vertices = np.asarray(part.mesh.vertices)
    with contextlib.suppress(QhullError):  # a flat part has no hull; only corners count anyway
        vertices = vertices[ConvexHull(vertices).vertices]
    turns = Rotation.random(PART_TURNS, rng=np.random.default_rng(0)).as_matrix()
    widths = [np.ptp(vertices @ turn @ _directions().T, axis=0) for turn in turns]
    return np.sort(widths, axis=1).max(axis=0)


def _directions() -> np.ndarray:
    """[D, 3] f64, unit, even over half the sphere: a spiral of equal areas."""
    k = np.arange(DIRECTIONS) + 0.5
    z = k / DIRECTIONS
    angle = np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
