"""How much material a measured blank has above points of the finished part's surface.

The blank is what scans measured of it: small planes through neighbouring points. Where no plane
lies above a point of the finished part, its stock is not known. Host code, float64, mm.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.rigid import RigidTransform
from vanejax.scanner.virtual_scanner import Scanner
from vanejax.scans.measured_scan import MeasuredScan
from vanejax.scans.voxels import voxel_thin

POINTS, PLANES = 60_000, 15_000  # of the scans, about
NEIGHBORS = (24, 48)  # of a plane: fewest and most
OVERLAP = 12  # planes over every measured point
MOST_THICK = 1.6  # of the planes' typical thickness: more is an edge or clutter
MOST_BENT = 0.01  # of the planes' typical reach: a curvature of which the plane takes no notice
LEAST_SPREAD = 0.2  # of the reach: less is a row of points
REFITS, LEAST_PLANE = 4, 0.7  # and the share of the neighbours that lie on a plane
MOST_REACH = 3.0  # of the typical one: more is a lonely point
SAME_SIDE = 0.7  # cosine: a plane above a point of the part faces as its surface does, to 45 deg
MOST_STOCK = 0.15  # of the part's radius
COVERED = 0.6  # of a plane's reach: farther from its middle noise tilts it too much
AROUND, AGREED = 5, 0.04  # planes that must agree on a stock, and to how much of their reach
# of the distance between the part and the blank where a normal leaves and where it ends: so long a
# normal runs along the stock of another face, in a corner
MOST_ALONG = 2.5
CLEAR_MM = 0.01  # off a surface, where a ray starts that shall not meet it


@dataclasses.dataclass(frozen=True, eq=False)
class MeasuredSurface:
    """A measured surface as N planes, in one frame.

    Attributes:
      points: [N, 3], mm, the middle of each.
      normals: [N, 3], unit; away from the material where ``has_side``.
      has_side: [N] bool, whether the sensor's place says on which side the material is.
      reach_mm: [N], how far from its middle a plane was measured.
      noise_mm: [N], standard deviation of the points about it.
      spread_mm: [N], standard deviation of the points along its narrower direction.
      neighbors: how many points each has.
    """

    points: np.ndarray
    normals: np.ndarray
    has_side: np.ndarray
    reach_mm: np.ndarray
    noise_mm: np.ndarray
    spread_mm: np.ndarray
    neighbors: int


def measured_surface(scans: Sequence[tuple[MeasuredScan, RigidTransform]]) -> MeasuredSurface:
    """The planes of registered scans of one blank.

    Args:
      scans: each with its ``blank_from_camera``, of one blank's frame.

    Raises:
      InputError: no scan, or none with a smooth surface.
    """
    if not scans:
        raise InputError("no scan is given: the stock of a blank needs one at least")
    points = np.concatenate([pose.apply(scan.points) for scan, pose in scans])
    towards = np.concatenate([_towards_sensor(scan, pose) for scan, pose in scans])
    if len(points) > POINTS or len(scans) > 1:
        # where scans overlap or were taken from near by, planes would be small and far apart
        kept = voxel_thin(points, voxel_mm=_voxel_mm(points))
        points, towards = points[kept], towards[kept]
    chosen = np.arange(len(points))
    if len(points) > PLANES:
        chosen = np.random.default_rng(0).choice(len(points), PLANES, replace=False)
    count = min(int(np.clip(OVERLAP * len(points) / PLANES, *NEIGHBORS)), len(points))
    distance, index = cKDTree(points).query(points[chosen], k=count)
    reach = distance[:, -1]
    planes = _fit_planes(points[index], reach)
    normals, towards = planes.normals, towards[chosen]
    side = np.einsum("ni,ni->n", normals, towards)
    normals = np.where(side[:, None] < 0, -normals, normals)
    flat = (planes.share >= LEAST_PLANE) & (
        planes.noise_mm <= MOST_THICK * np.median(planes.noise_mm) + MOST_BENT * np.median(reach)
    )
    flat &= planes.spread_mm >= LEAST_SPREAD * reach
    good = flat & (reach <= MOST_REACH * np.median(reach))
    if not good.any():
        raise InputError("the scans show no smooth surface: the stock cannot be measured")
    return MeasuredSurface(
        planes.middle[good],
        normals[good],
        towards.any(axis=1)[good],
        reach[good],
        planes.noise_mm[good],
        planes.spread_mm[good],
        count,
    )


class _Planes(NamedTuple):
    """Of n planes their middle, normal, noise, spread, and the share of their points on them."""

    middle: np.ndarray
    normals: np.ndarray
    noise_mm: np.ndarray
    spread_mm: np.ndarray
    share: np.ndarray


def _fit_planes(near: np.ndarray, reach: np.ndarray) -> _Planes:
    """Planes through neighbourhoods [n, K, 3] mm by robust least squares (Geman and McClure).

    Near an edge of the blank some neighbours are on the next face; those lose their weight.
    """
    weight = np.ones(near.shape[:2])
    for _ in range(REFITS):
        total = weight.sum(axis=1)
        middle = np.einsum("nk,nki->ni", weight, near) / total[:, None]
        off = near - middle[:, None]
        moments = np.einsum("nk,nki,nkj->nij", weight, off, off, optimize=True)
        variance, axes = np.linalg.eigh(moments / total[:, None, None])
        variance = np.maximum(variance, 0)
        normals = axes[:, :, 0]
        noise = np.sqrt(variance[:, 0] * total / np.maximum(total - 3, 1))
        residual = np.einsum("nki,ni->nk", off, normals)
        scale = 2 * np.median(noise) + MOST_BENT * reach
        weight = (1 + (residual / scale[:, None]) ** 2) ** -2.0
    share = np.mean(np.abs(residual) < 2 * scale[:, None], axis=1)
    return _Planes(middle, normals, noise, np.sqrt(np.maximum(variance[:, 1], 1e-12)), share)


def _voxel_mm(points: np.ndarray) -> float:
    """The voxel with which about `POINTS` of the points [N, 3] are left, or half of fewer."""
    count = min(len(points), PLANES)
    some = points[np.random.default_rng(0).choice(len(points), count, replace=False)]
    distance = cKDTree(some).query(some, k=9)[0][:, -1]
    area = np.median(np.pi * distance**2 / 8)  # of the surface under each
    return float(np.sqrt(area * count / min(POINTS, len(points) / 2)))


def _towards_sensor(scan: MeasuredScan, pose: RigidTransform) -> np.ndarray:
    """[N, 3] from each point to the sensor, blank frame; zero where its place is unknown."""
    if scan.sensor_origin is None:
        return np.zeros_like(scan.points)
    return pose.rotate(scan.sensor_origin - scan.points)


@dataclasses.dataclass(frozen=True, eq=False)
class FinishedSurface:
    """Points of the finished part's surface, uniform over its area, part frame.

    Attributes:
      points: [n, 3], mm.
      normals: [n, 3], unit, outward.
      below_mm, above_mm: [n], how far below and above a point the blank's surface is sought: half
        way to the part's next surface, so that the other side of a wall or slot is not taken for
        this one.
    """

    points: np.ndarray
    normals: np.ndarray
    below_mm: np.ndarray
    above_mm: np.ndarray


def finished_surface(part: Part, count: int) -> FinishedSurface:
    """``count`` points of a part's surface; the same every time."""
    points, normals, _ = part.sample(count, seed=0)
    # from inside the material a face is met from behind, as those of an open surface may be
    scanner = Scanner(dataclasses.replace(part, closed=False))
    ways = {}
    for name, way in (("below_mm", -normals), ("above_mm", normals)):
        free = scanner.cast(points + CLEAR_MM * way, way).distance_mm
        ways[name] = np.minimum(free / 2, MOST_STOCK * part.radius)
    return FinishedSurface(points, normals, **ways)


class StockMeter:
    """The stock above a finished surface, in any place of the part in a measured blank.

    At first the part's frame is near the blank's: where no sensor's place says on which side of a
    plane the material is, the nearest surface of the part does.
    """

    def __init__(self, blank: MeasuredSurface, finished: FinishedSurface) -> None:
        self.finished = finished
        self._tree = cKDTree(blank.points)
        self._part_tree = cKDTree(finished.points)
        _, nearest = self._part_tree.query(blank.points)
        same = np.einsum("ni,ni->n", finished.normals[nearest], blank.normals)
        turned = ~blank.has_side & (same < 0)
        normals = np.where(turned[:, None], -blank.normals, blank.normals)
        self.blank = dataclasses.replace(blank, normals=normals)
        self._spacing_mm = float(np.median(self._part_tree.query(finished.points, k=2)[0][:, 1]))

    def planes_above(self, blank_from_part: RigidTransform, known: np.ndarray) -> np.ndarray:
        """[n] i64: which plane each point's normal meets; -1 where none does.

        ``known`` [n] i64 are those of a place near by: they stay where they still are met.
        """
        points = blank_from_part.apply(self.finished.points)
        normals = blank_from_part.rotate(self.finished.normals)
        planes = np.where(known >= 0, known, 0)
        rows = np.arange(len(points))
        kept = (known >= 0) & np.isfinite(self._beside_mm(rows, planes, points, normals))
        planes = np.where(kept, planes, -1)
        best = np.full(len(points), np.inf)
        low, high = -self.finished.below_mm, self.finished.above_mm
        step = float(np.median(self.blank.reach_mm))
        for height in np.arange(low.min(), high.max() + step, step):
            rows = np.flatnonzero(~kept & (height > low - step) & (height < high + step))
            if not len(rows):
                continue
            _, found = self._tree.query(points[rows] + height * normals[rows])
            beside = self._beside_mm(rows, found, points[rows], normals[rows])
            nearer = beside < best[rows]
            best[rows[nearer]] = beside[nearer]
            planes[rows[nearer]] = found[nearer]
        new = np.flatnonzero(~kept & (planes >= 0))
        if len(new):
            planes[new] = self._agreed(new, planes[new], points[new], normals[new], blank_from_part)
        return planes

    def _agreed(
        self,
        rows: np.ndarray,
        planes: np.ndarray,
        points: np.ndarray,
        normals: np.ndarray,
        blank_from_part: RigidTransform,
    ) -> np.ndarray:
        """Of the planes around those given [m], the middle one; -1 where they do not agree.

        They do not at an edge of the blank. -1 also where the normal runs along the stock of
        another face, in a corner, or meets that of another part of the part.
        """
        stock = self._along(planes, points, normals)
        met = points + stock[:, None] * normals
        _, around = self._tree.query(met, k=AROUND)
        around = np.column_stack([planes, around])
        every = [np.repeat(values, AROUND + 1, axis=0) for values in (rows, points, normals)]
        stocks = self._along(around.ravel(), *every[1:]).reshape(around.shape)
        beside = self._beside_mm(every[0], around.ravel(), *every[1:]).reshape(around.shape)
        away = np.abs(stocks - np.median(stocks, axis=1, keepdims=True))
        middle = np.argmin(np.where(np.isfinite(beside), away, np.inf), axis=1)[:, None]
        agree = np.maximum(np.median(away, axis=1), np.take_along_axis(away, middle, 1)[:, 0])
        middle = np.take_along_axis(around, middle, 1)[:, 0]
        near_part, _ = self._part_tree.query(blank_from_part.inverse().apply(met))
        near_blank, _ = self._tree.query(points)
        reach = self.blank.reach_mm[planes]
        nearest = np.minimum(near_part + 2 * self._spacing_mm, near_blank + COVERED * reach)
        by_noise = 2 * self.blank.noise_mm[planes] / np.sqrt(self.blank.neighbors)
        good = (agree < AGREED * reach + by_noise) & (np.abs(stock) < MOST_ALONG * nearest)
        return np.where(good, middle, -1)

    def _beside_mm(
        self, rows: np.ndarray, planes: np.ndarray, points: np.ndarray, normals: np.ndarray
    ) -> np.ndarray:
        """How far from a plane's middle a normal meets it [m]; inf where that is no stock."""
        blank, finished = self.blank, self.finished
        cosine = np.einsum("ni,ni->n", blank.normals[planes], normals)
        stock = self._along(planes, points, normals)
        beside = np.linalg.norm(points + stock[:, None] * normals - blank.points[planes], axis=1)
        met = (cosine > SAME_SIDE) & (beside <= COVERED * blank.reach_mm[planes])
        met &= (stock >= -finished.below_mm[rows]) & (stock <= finished.above_mm[rows])
        return np.where(met, beside, np.inf)

    def _along(self, planes: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Signed distances [m] from points along normals to planes; large where they run along."""
        plane_normals = self.blank.normals[planes]
        cosine = np.einsum("ni,ni->n", plane_normals, normals)
        cosine = np.where(np.abs(cosine) < 1e-6, 1e-6, cosine)
        return np.einsum("ni,ni->n", plane_normals, self.blank.points[planes] - points) / cosine

    def stock(
        self,
        rows: np.ndarray,
        planes: np.ndarray,
        blank_from_part: RigidTransform,
        center: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Stock over points of given planes, and how it changes with a small motion of the part.

        With the plane's normal m, the point's normal n and g = m / (m . n), a motion moves the
        point x where they meet, and ``ds = -g . (v + w x (x - c))``.

        Args:
          rows: [m] i64, which of the finished points.
          planes: [m] i64, of the blank.
          blank_from_part: the part's place.
          center: [3] mm, c, blank frame: what the motion is about.

        Returns:
          [m] mm; [m, 6], mm per rad and per mm.
        """
        points = blank_from_part.apply(self.finished.points[rows])
        normals = blank_from_part.rotate(self.finished.normals[rows])
        stock = self._along(planes, points, normals)
        met = points + stock[:, None] * normals - center
        across = self.blank.normals[planes]
        across = across / np.einsum("ni,ni->n", across, normals)[:, None]
        return stock, -np.concatenate([np.cross(met, across), across], axis=1)

    def sigma_mm(
        self, rows: np.ndarray, planes: np.ndarray, blank_from_part: RigidTransform
    ) -> np.ndarray:
        """[m]: standard deviation of the stock over points by the noise of their planes' points."""
        points = blank_from_part.apply(self.finished.points[rows])
        normals = blank_from_part.rotate(self.finished.normals[rows])
        beside = self._beside_mm(rows, planes, points, normals)
        beside = np.where(np.isfinite(beside), beside, self.blank.reach_mm[planes])
        lever = 1 + (beside / self.blank.spread_mm[planes]) ** 2
        return self.blank.noise_mm[planes] * np.sqrt(lever / self.blank.neighbors)
