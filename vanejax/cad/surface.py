"""The CAD surface as a target for points: nearest point, quickly for many, exactly for few."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point

from vanejax.cad.part import Part
from vanejax.cad.triangles import areas

SAMPLES = 40_000  # mean spacing on a part of radius 70 mm: about 1 mm
CELLS = 48  # of the lookup grid, along the longest side
MARGIN = 0.3  # of the part's radius: how far the grid reaches beyond its bounding box
CANDIDATES = 6  # faces tried for an exact foot point


@dataclasses.dataclass(frozen=True, eq=False)
class ClosestPoints:
    """The nearest surface points of n points.

    Attributes:
      points: [n, 3] f64, mm, part frame, on the surface.
      normals: [n, 3] f64, unit, outward, of the face.
      face: [n] i64.
    """

    points: np.ndarray
    normals: np.ndarray
    face: np.ndarray

    def put(self, which: np.ndarray, better: ClosestPoints) -> None:
        """Takes those of the indices ``which`` from ``better``."""
        self.points[which], self.normals[which] = better.points, better.normals
        self.face[which] = better.face


class Surface:
    """Nearest points on a part's surface. Safe to share between threads.

    Args:
      part: whose surface.
      seed: of the area-uniform samples that the search starts from.
    """

    def __init__(self, part: Part, *, seed: int = 0) -> None:
        self.part = part
        self.points, self.normals, self.face = part.sample(SAMPLES, seed)
        self._tree = cKDTree(self.points)

    @functools.cached_property
    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """The surface's middle [3], mm, and its principal axes [3, 3], unit, one in each row.

        Exact integrals: over a triangle of area A with corners v and centroid m, that of x x^T is
        ``A / 12 (sum v v^T + 9 m m^T)``.
        """
        total, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
        for corners in self.part.triangles.blocks():
            corners -= self.part.center
            area, centroid = areas(corners), corners.mean(axis=1)
            total += area.sum()
            first += area @ centroid
            flat = corners.reshape(-1, 3)
            second += (np.repeat(area, 3)[:, None] * flat).T @ flat
            second += 9 * (area[:, None] * centroid).T @ centroid
        middle = first / total
        second -= 12 * total * np.outer(middle, middle)  # about the middle, not the centre
        return middle + self.part.center, np.linalg.eigh(second)[1].T

    @functools.cached_property
    def _grid(self) -> tuple[np.ndarray, float, np.ndarray]:
        """Lower corner, cell size, and a sample [x, y, z] in the occupied cell nearest to each."""
        low, high = np.asarray(self.part.mesh.bounds, np.float64)
        reach = MARGIN * self.part.radius
        low = low - reach
        size = float((high + reach - low).max()) / CELLS
        shape = np.ceil((high + reach - low) / size).astype(np.int64) + 1
        sample = np.full(shape, -1, np.int64)
        cells = np.floor((self.points - low) / size).astype(np.int64)
        sample[tuple(cells.T)] = np.arange(len(cells))
        occupied = distance_transform_edt(sample < 0, return_distances=False, return_indices=True)
        return low, size, sample[tuple(occupied)]

    def coarse(self, points: np.ndarray) -> ClosestPoints:
        """The sample nearest to the grid cell of each point [n, 3]: right to about a cell."""
        low, size, nearest = self._grid
        cell = ((points - low) / size).astype(np.int64)
        np.clip(cell, 0, np.array(nearest.shape) - 1, out=cell)
        index = nearest[cell[:, 0], cell[:, 1], cell[:, 2]]
        return ClosestPoints(self.points[index], self.normals[index], self.face[index])

    def nearest(self, points: np.ndarray) -> ClosestPoints:
        """The sample nearest to each point [n, 3]: right to about the samples' spacing."""
        _, index = self._tree.query(points)
        return ClosestPoints(self.points[index], self.normals[index], self.face[index])

    def exact(self, points: np.ndarray) -> ClosestPoints:
        """The foot points on the faces of the nearest few samples, to rounding.

        A nearer face smaller than the samples' spacing can be missed: off by less than that face.
        """
        _, index = self._tree.query(points, k=CANDIDATES)
        faces = self.face[index].reshape(-1)
        triangles = self.part.mesh.vertices[self.part.mesh.faces[faces]]
        closest = closest_point(np.asarray(triangles), np.repeat(points, CANDIDATES, axis=0))
        closest = closest.reshape(-1, CANDIDATES, 3)
        best = np.argmin(np.sum((closest - points[:, None]) ** 2, axis=-1), axis=1)
        rows = np.arange(len(points))
        chosen = index[rows, best]
        return ClosestPoints(closest[rows, best], self.normals[chosen], self.face[chosen])
