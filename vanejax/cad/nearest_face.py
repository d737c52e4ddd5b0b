"""The nearest point of a part's surface, exactly, whatever the size and shape of its faces.

`Surface.exact` looks at the faces of a few samples near by: quick, and right to a face's size,
which on the long thin faces of a flat side can be a millimetre.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point

from vanejax.cad.part import Part
from vanejax.cad.surface import ClosestPoints

PAIRS_AT_ONCE = 1 << 17  # of a point and a face
FIRST_FACES = 8  # of each size, looked at for each point
TIE_MM = 1e-9  # points as near as this are one: rounding at 1 m is 1e-13


class NearestFace:
    """Nearest points on a part's surface, to rounding.

    Faces are sorted by size, a search tree over the middles of each size. A face of radius r about
    its middle can be no nearer than the middle less r, so that the search ends when the next middle
    is farther than the best foot and r together.

    Args:
      part: whose surface.
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
        columns = zip(*((b.points, b.normals, b.face) for b in blocks), strict=True)
        return ClosestPoints(*map(np.concatenate, columns))

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
