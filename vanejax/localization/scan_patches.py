"""Patches of a scan: neighbouring points, whose errors go together, and cells of the sensor's view.

Both the evidence for a pose (`verification`) and its covariance are sums over patches.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import ConvexHull, QhullError

from vanejax.localization.residuals import MeasurementModel, RayCasting

MOST_CELLS = 64  # along the longer side of the scan's view
POINTS_PER_CELL = 3.0
PATCH_CELLS = 2  # cells along the side of a patch, where there are 64; in proportion elsewhere


def cell_labels(cells: np.ndarray) -> np.ndarray:
    """[n] i64: one number per integer cell [n, k], k at most 3, ordered by the last axis first."""
    return cells @ (1 << 20 * np.arange(cells.shape[1]))


def cube_labels(points: np.ndarray, across: int) -> np.ndarray:
    """[n] i64, 0, 1, ...: which cube a point [n, 3] is in, ``across`` of them along the cloud."""
    size = max(float(np.ptp(points, axis=0).max()), 1e-9) / across
    cells = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    return np.unique(cell_labels(cells), return_inverse=True)[1]


def patch_labels(model: MeasurementModel, points: np.ndarray, across: int) -> np.ndarray:
    """[n] i64: patches of points [n, 3] mm: squares of the sensor's view, or cubes without one."""
    if isinstance(model, RayCasting):
        rays = points - model.sensor_origin
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        forward = rays.mean(axis=0)
        points = rays - np.outer(rays @ forward, forward) / (forward @ forward)
    return cube_labels(points, across)


def view_of(model: MeasurementModel, points: np.ndarray) -> View | None:
    """The sensor's view of points [n, 3] mm, camera frame; None where its place is not known."""
    return View(points, model.sensor_origin) if isinstance(model, RayCasting) else None


class View:
    """The scan as the sensor saw it: cells of its image that hold a measurement.

    Args:
      points: [n, 3] mm, camera frame.
      sensor_origin: [3] mm, camera frame.
    """

    def __init__(self, points: np.ndarray, sensor_origin: np.ndarray) -> None:
        rays = points - sensor_origin
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        forward = rays.mean(axis=0)
        forward /= np.linalg.norm(forward)
        across = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
        across /= np.linalg.norm(across)
        self.axes = np.stack([across, np.cross(forward, across), forward])
        self.sensor_origin = sensor_origin
        turned = rays @ self.axes.T
        image = turned[:, :2] / np.maximum(turned[:, 2:], 1e-3)  # in the plane at unit distance
        self.low = image.min(axis=0)
        side = int(np.clip(np.sqrt(len(points) / POINTS_PER_CELL), 8, MOST_CELLS))
        self.size = max(float(np.ptp(image, axis=0).max()), 1e-6) / side
        self.patch_cells = max(1, round(PATCH_CELLS * side / MOST_CELLS))
        cells = np.floor((image - self.low) / self.size).astype(np.int64)
        occupied = np.zeros(cells.max(axis=0) + 3, bool)
        occupied[cells[:, 0] + 1, cells[:, 1] + 1] = True
        self.points_per_cell = len(points) / occupied.sum()
        # a hole as wide as a cell is the sampling's, not the sensor's
        self._near_measured = binary_dilation(occupied, np.ones((3, 3), bool))
        self.patch = self._patch(cells)
        self._hull = _hull(cells + 0.5)

    def _patch(self, cells: np.ndarray) -> np.ndarray:
        """One number per patch of cells, the same for points and empty cells."""
        return cell_labels(np.floor_divide(cells, self.patch_cells)[:, ::-1])

    def empty_cells(
        self, center: np.ndarray, radius: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays [m, 3], unit, through cells without measurement where a sphere would be seen.

        Args:
          center: [3] mm, camera frame, of the sphere around the part.
          radius: mm.

        Returns:
          the rays, their patches [m], and whether they are among the measured ones [m] bool: within
          the convex hull of all that was measured. What is outside of it may have been cut off.
        """
        offset = self.axes @ (center - self.sensor_origin)
        depth = max(offset[2], 1.05 * radius)
        middle, reach = offset[:2] / depth, radius / max(depth - radius, 0.05 * radius)
        reach = min(reach, 200 * self.size)
        low = np.floor((middle - reach - self.low) / self.size).astype(np.int64)
        high = np.ceil((middle + reach - self.low) / self.size).astype(np.int64)
        cells = np.stack(
            np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij"), -1
        ).reshape(-1, 2)
        inside = np.clip(cells + 1, 0, np.array(self._near_measured.shape) - 1)
        measured = np.all(cells + 1 == inside, axis=1)
        measured &= self._near_measured[inside[:, 0], inside[:, 1]]
        cells = cells[~measured]
        image = (cells + 0.5) * self.size + self.low
        rays = np.concatenate([image, np.ones((len(image), 1))], axis=1) @ self.axes
        among = np.all((cells + 0.5) @ self._hull[:, :2].T + self._hull[:, 2] < 0, axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True), self._patch(cells), among


def _hull(cells: np.ndarray) -> np.ndarray:
    """[k, 3] (a, b, c): (x, y) is within the convex hull where all ``a x + b y + c < 0``."""
    try:
        return ConvexHull(np.unique(cells, axis=0)).equations
    except QhullError:  # all in one line
        return np.array([[0.0, 0.0, 1.0]])
