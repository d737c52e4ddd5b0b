"""Points in cubes: one of each, what hangs together, and where a surface folds inwards."""

from __future__ import annotations

import functools
import itertools

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from vanejax.cad.solid_bodies import connected

CREASE = 0.15  # rad by which the normals of neighbouring voxels turn towards each other


class Voxels:
    """The cubes of a grid that hold at least one of N points; V of them.

    The points are [N, 3] f64, mm, at least one; their extent is at most 2^20 cubes.

    Attributes:
      size_mm: side of a cube.
      cell: [V, 3] i64, in ascending order.
      of_point: [N] i64, index of each point's voxel.
      middle: [V, 3] f64, mm, mean of the points in it.
    """

    def __init__(self, points: np.ndarray, size_mm: float) -> None:
        self.size_mm = size_mm
        # column by column: numpy reduces over rows of three at a tenth of the speed
        columns = [np.floor(points[:, k] / size_mm).astype(np.int64) for k in range(3)]
        low = np.array([column.min() for column in columns])
        span = np.array([column.max() for column in columns]) - low + 1
        x, y, z = (column - start for column, start in zip(columns, low, strict=True))
        code = (x * span[1] + y) * span[2] + z
        names, self.of_point, count = np.unique(code, return_inverse=True, return_counts=True)
        self.cell = np.stack(np.unravel_index(names, tuple(span)), axis=1) + low
        total = [np.bincount(self.of_point, weights=points[:, k]) for k in range(3)]
        self.middle = np.stack(total, axis=1) / count[:, None]

    def __len__(self) -> int:
        return len(self.cell)

    @functools.cached_property
    def neighbors(self) -> np.ndarray:
        """[2, E] i64: pairs of voxels that share a face, an edge or a corner, each pair once."""
        low = self.cell.min(axis=0) - 1
        span = np.ptp(self.cell, axis=0) + 3
        code = ((self.cell - low) * (span[1] * span[2], span[2], 1)).sum(axis=1)  # ascending
        pairs = []
        for step in itertools.product((-1, 0, 1), repeat=3):
            if step <= (0, 0, 0):
                continue
            neighbor_code = code + np.dot(step, (span[1] * span[2], span[2], 1))
            place = np.minimum(np.searchsorted(code, neighbor_code), len(code) - 1)
            has_neighbor = np.flatnonzero(code[place] == neighbor_code)
            pairs.append(np.stack([has_neighbor, place[has_neighbor]]))
        return np.concatenate(pairs, axis=1)

    def clusters(self) -> np.ndarray:
        """[V] i32: voxels that hang together have the same number, from 0."""
        return connected(self.neighbors.T, len(self))

    def pieces(self, sensor_origin: np.ndarray, *, least: int) -> np.ndarray:
        """[V] i32: clusters parted where the surface folds inwards, as between part and clamp.

        What lies between two surfaces, and patches of fewer than ``least`` voxels, go with the next
        piece. The outside of the surface is where the sensor is, [3] mm.
        """
        first, second = self.neighbors
        normals = self._normals(sensor_origin)
        away = self.middle[first] - self.middle[second]
        # as normals turn towards each other the difference points against the way between them
        fold = np.einsum("ei,ei->e", normals[first] - normals[second], away)
        fold /= np.linalg.norm(away, axis=1)
        smooth = np.ones(len(self), bool)
        folded = fold < -CREASE
        smooth[first[folded]] = smooth[second[folded]] = False
        inside = smooth[first] & smooth[second]
        piece = connected(self.neighbors[:, inside].T, len(self))
        count = np.bincount(piece)
        core = smooth & (count[piece] >= least)
        if not core.any():
            return np.zeros(len(self), np.int32)
        nearest = cKDTree(self.middle[core]).query(self.middle[~core])[1]
        piece[~core] = piece[core][nearest]
        return np.unique(piece, return_inverse=True)[1].astype(np.int32)

    def _normals(self, sensor_origin: np.ndarray) -> np.ndarray:
        """[V, 3] f64 unit, of the plane through a voxel and its neighbours, to the sensor."""
        first, second = self.neighbors
        pairs = np.ones(len(first)), (first, second)
        near = sparse.csr_matrix(pairs, shape=(len(self), len(self)))
        about = self.middle - self.middle.mean(axis=0)
        products = about[:, :, None] * about[:, None]
        sums = np.column_stack([np.ones(len(self)), about, products.reshape(-1, 9)])
        sums = near @ sums + near.T @ sums + sums
        mean = sums[:, 1:4] / sums[:, :1]
        spread = sums[:, 4:].reshape(-1, 3, 3) / sums[:, :1, None]
        spread -= mean[:, :, None] * mean[:, None]
        normals = np.linalg.eigh(spread)[1][:, :, 0]
        side = np.einsum("vi,vi->v", normals, sensor_origin - self.middle)
        return np.where(side[:, None] < 0, -normals, normals)


def voxel_thin(points: np.ndarray, *, voxel_mm: float) -> np.ndarray:
    """Indices of one point per occupied voxel: the one nearest to the voxel's mean point.

    Args:
      points: [N, 3], mm, on the host.
      voxel_mm: edge length of the cubic grid, anchored at the origin of the points' frame.

    Returns:
      indices [n] i64, ascending; real points are kept, so normals and face ids still belong.
    """
    points = np.asarray(points, np.float64)
    if len(points) == 0:
        return np.zeros(0, np.int64)
    voxels = Voxels(points, voxel_mm)
    squared = np.sum((points - voxels.middle[voxels.of_point]) ** 2, axis=1)
    order = np.lexsort((squared, voxels.of_point))
    first = np.unique(voxels.of_point[order], return_index=True)[1]
    return np.sort(order[first])
