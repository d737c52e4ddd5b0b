"""The CAD surface as a target for points: nearest point, quickly for many, exactly for few."""

from __future__ import annotations

import functools
from typing import NamedTuple

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
PAIRS_AT_ONCE = 1 << 17  # of a point and a face
FIRST_FACES = 8  # of each size, looked at for each point
TIE_MM = 1e-9  # points as near as this are one: rounding at 1 m is 1e-13


class ClosestPoints(NamedTuple):
    """The nearest surface points of n points.

    Attributes:
      points: [n, 3] f64, mm, part frame, on the surface.
      normals: [n, 3] f64, unit, outward, of the face.
      face: [n] i64.
    """

    points: np.ndarray
    normals: np.ndarray
    face: np.ndarray

    def at(self, index: np.ndarray) -> ClosestPoints:
        """Those of an index [m]."""
        return ClosestPoints(*(column[index] for column in self))

    def put(self, which: np.ndarray, better: ClosestPoints) -> None:
        """Takes those of the indices ``which`` from ``better``."""
        for column, values in zip(self, better, strict=True):
            column[which] = values


class Surface:
    """Nearest points on a part's surface, from samples. Safe to share between threads."""

    def __init__(self, part: Part) -> None:
        self.part = part
        self._samples = ClosestPoints(*part.sample(SAMPLES, seed=0))
        self.points, self.normals, self.face = self._samples
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
        return self._samples.at(nearest[tuple(cell.T)])

    def nearest(self, points: np.ndarray) -> ClosestPoints:
        """The sample nearest to each point [n, 3]: right to about the samples' spacing."""
        return self._samples.at(self._tree.query(points)[1])

    def is_smooth(self, points: np.ndarray, reach_mm: float, least_cosine: float) -> np.ndarray:
        """[n] bool: no sample within reach of points [n, 3] faces another way than the nearest."""
        _, index = self._tree.query(points, k=CANDIDATES * 2)
        normals = self.normals[index]
        aside = np.linalg.norm(self.points[index] - self.points[index[:, :1]], axis=-1)
        same = np.einsum("nki,ni->nk", normals, normals[:, 0]) > least_cosine
        return np.all(same | (aside > reach_mm), axis=1)

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
        return self._samples.at(index[rows, best])._replace(points=closest[rows, best])


class NearestFace:
    """Nearest points on a part's surface, to rounding, whatever the size and shape of its faces.

    `Surface.exact` is quicker, and right to a face's size: a millimetre on long thin faces.

    Faces are sorted by size, a search tree over the middles of each size. A face of radius r about
    its middle can be no nearer than the middle less r, so that the search ends when the next middle
    is farther than the best foot and r together.
    """

    def __init__(self, part: Part) -> None:
        self._corners = np.asarray(part.mesh.triangles, np.float64)
        sides = self._corners[:, 1:] - self._corners[:, :1]
        cross = np.cross(sides[:, 0], sides[:, 1])
        double_area = np.linalg.norm(cross, axis=1)
        self._normals = cross / np.where(double_area > 0, double_area, 1.0)[:, None]
        middles = self._corners.mean(axis=1)
        self._radii = np.linalg.norm(self._corners - middles[:, None], axis=2).max(axis=1)
        size = np.ceil(np.log2(np.maximum(self._radii, 1e-6)))
        # a face without area is the edge of its neighbours
        has_area = double_area > 0
        self._sizes = [np.flatnonzero(has_area & (size == v)) for v in np.unique(size[has_area])]
        self._trees = [cKDTree(middles[faces]) for faces in self._sizes]

    def closest_points(self, points: np.ndarray) -> ClosestPoints:
        """The nearest surface points of points [N, 3] f64, mm, part frame.

        Where several faces share one, at an edge or a corner, that which faces the point or turns
        from it most: the side of that face is the side of the solid.
        """
        size = PAIRS_AT_ONCE // FIRST_FACES
        blocks = [self._nearest_of(points[i : i + size]) for i in range(0, len(points), size)]
        return ClosestPoints(*map(np.concatenate, zip(*blocks, strict=True)))

    def _nearest_of(self, points: np.ndarray) -> ClosestPoints:
        best = np.full(len(points), np.inf)
        blank = np.zeros((2, len(points), 3))
        closest = ClosestPoints(*blank, np.zeros(len(points), np.int64))
        for faces, tree in zip(self._sizes, self._trees, strict=True):
            largest = self._radii[faces].max()
            rows, first, last = np.arange(len(points)), 0, min(FIRST_FACES, len(faces))
            while len(rows):
                ended = []
                for block in np.array_split(rows, 1 + len(rows) * last // PAIRS_AT_ONCE):
                    middle, order = tree.query(points[block], k=range(first + 1, last + 1))
                    tried = faces[order]
                    near = middle - self._radii[tried] <= best[block, None] + TIE_MM
                    row, column = np.nonzero(near)
                    self._try_faces(points, block[row], tried[row, column], best, closest)
                    ended.append(middle[:, -1] - largest > best[block] + TIE_MM)
                rows = rows[~np.concatenate(ended)] if last < len(faces) else rows[:0]
                first, last = last, min(2 * last, len(faces))
        return closest

    def _try_faces(
        self,
        points: np.ndarray,
        point: np.ndarray,
        face: np.ndarray,
        best: np.ndarray,
        closest: ClosestPoints,
    ) -> None:
        """Takes a face [n] for a point [n] where it is nearer than the best, which changes too."""
        # the foot that was the best so far stays in the choice
        known = np.unique(point)
        known = known[np.isfinite(best[known])]
        foot = closest_point(self._corners[face], points[point]) if len(face) else np.zeros((0, 3))
        foot = np.concatenate([foot, closest.points[known]])
        point, face = np.concatenate([point, known]), np.concatenate([face, closest.face[known]])
        off = points[point] - foot
        distance = np.linalg.norm(off, axis=1)
        facing = np.abs(np.einsum("ni,ni->n", off, self._normals[face]))
        np.minimum.at(best, point, distance)
        tied = np.flatnonzero(distance <= best[point] + TIE_MM)
        tied = tied[np.argsort(facing[tied], kind="stable")]  # the last one written stays
        closest.put(point[tied], ClosestPoints(foot[tied], self._normals[face[tied]], face[tied]))
