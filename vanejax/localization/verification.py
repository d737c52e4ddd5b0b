"""Whether a pose explains a scan: points off the part, rays through it, surface never measured.

Nearest-neighbour fitness cannot tell a right pose from a wrong one: where a part looks much the
same turned round, 99.8 % of the points lie near its surface at 31 deg of error. The rays know more.
A point behind the surface means that light went through material; a part of the surface that the
sensor should have seen and did not measure is missing; and of two poses each patch of the scan can
say which one it prefers. That last test is paired: both poses are judged by the same patches, so
that noise, holes and clutter cancel, and what remains is what tells the two apart.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vanejax.localization.pose_result import PointStatus, Verification
from vanejax.localization.residuals import MeasurementModel, RayCasting, Residuals
from vanejax.rigid import RigidTransform

MOST_CELLS = 64  # along the longer side of the scan's view
POINTS_PER_CELL = 3.0
PATCH_CELLS = 2  # cells along the side of a patch, where there are 64; in proportion elsewhere
# surface seen flatter than 75 deg may well go unmeasured
FLATTEST_COSINE = float(np.cos(np.radians(75)))
UNMEASURED_PENALTY = 0.5
VIOLATION_PENALTY = 0.5


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
        image = self._project(rays)
        self.low = image.min(axis=0)
        side = int(np.clip(np.sqrt(len(points) / POINTS_PER_CELL), 8, MOST_CELLS))
        self.size = max(float(np.ptp(image, axis=0).max()), 1e-6) / side
        self.patch_cells = max(1, round(PATCH_CELLS * side / MOST_CELLS))
        cells = self._cells(image)
        shape = cells.max(axis=0) + 1
        occupied = np.zeros(shape + 2, bool)
        occupied[cells[:, 0] + 1, cells[:, 1] + 1] = True
        self.points_per_cell = len(points) / occupied.sum()
        # a hole as wide as a cell is the sampling's, not the sensor's
        grown = occupied.copy()
        for shift in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
            grown |= np.roll(occupied, shift, (0, 1))
        self._near_measured = grown
        self.patch = self._patch(cells)

    def _project(self, rays: np.ndarray) -> np.ndarray:
        """[n, 2] coordinates in the plane at unit distance."""
        turned = rays @ self.axes.T
        return turned[:, :2] / np.maximum(turned[:, 2:], 1e-3)

    def _cells(self, image: np.ndarray) -> np.ndarray:
        return np.floor((image - self.low) / self.size).astype(np.int64)

    def _patch(self, cells: np.ndarray) -> np.ndarray:
        """One number per patch of cells, the same for points and empty cells."""
        patch = np.floor_divide(cells, self.patch_cells)
        return patch[:, 0] * 100_003 + patch[:, 1]

    def empty_cells(self, center: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Rays [m, 3], unit, through cells without measurement where a sphere would be seen.

        Args:
          center: [3] mm, camera frame, of the sphere around the part.
          radius: mm.

        Returns:
          the rays and their patches [m].
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
        known = np.all(cells + 1 == inside, axis=1)
        known &= self._near_measured[inside[:, 0], inside[:, 1]]
        cells = cells[~known]
        image = (cells + 0.5) * self.size + self.low
        rays = np.concatenate([image, np.ones((len(image), 1))], axis=1) @ self.axes
        return rays / np.linalg.norm(rays, axis=1, keepdims=True), self._patch(cells)


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """What patches of a scan say for H poses: the larger the better.

    Attributes:
      patch: [P] number of points in each patch.
      score: [H, P] sums over points and empty cells.
      total: [H] sum of all, per point.
    """

    patch: np.ndarray
    score: np.ndarray
    total: np.ndarray

    def preference(self, first: int, second: int) -> float:
        """How many standard errors the patches prefer the first pose to the second.

        A paired t statistic over patches. Patches that see no difference say nothing and do not
        count, so that a small feature which all of its patches agree on is not drowned.
        """
        difference = self.score[first] - self.score[second]
        spread = np.sqrt(np.sum(difference**2))
        return float(difference.sum() / spread) if spread > 0 else 0.0


def evidence(
    model: MeasurementModel,
    poses: RigidTransform,
    points: np.ndarray,
    *,
    tolerance_mm: float,
    view: View | None,
) -> Evidence:
    """Judges H poses [H, 3, 3] by the same points [n, 3] mm.

    A point scores ``1 - (deviation / tolerance)^2`` within the tolerance, 0 beyond it and -0.5
    behind the surface; an empty cell where the part should have been measured -0.5 for each point
    that it should hold. ``view`` must be of these very points, or None where no ray is known.
    """
    now = model.residuals(poses, points, precision="samples")
    score = _point_scores(now, tolerance_mm, view)
    label = _cubes(points) if view is None else view.patch
    labels = [label]
    missing = []
    for h in range(len(poses.rotation)):
        if view is None:
            break
        pose = RigidTransform(poses.rotation[h], poses.translation[h])
        _, empty, seen = predicted_unmeasured(model, pose, view)
        missing.append(empty[seen])
        labels.append(missing[-1])
    names, where = np.unique(np.concatenate(labels), return_inverse=True)
    rows = [np.bincount(where[: len(label)], weights=s, minlength=len(names)) for s in score]
    start = len(label)
    for row, empty in zip(rows, missing, strict=False):
        mine = where[start : start + len(empty)]
        row -= UNMEASURED_PENALTY * view.points_per_cell * np.bincount(mine, minlength=len(names))
        start += len(empty)
    rows = np.stack(rows)
    count = np.bincount(where[: len(label)], minlength=len(names))
    return Evidence(patch=count, score=rows, total=rows.sum(axis=1) / len(points))


def predicted_unmeasured(
    model: RayCasting, pose: RigidTransform, view: View
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays through empty cells [m, 3], their patches [m], and whether they should have measured."""
    center = pose.inverse().apply(model.part.center[None])[0]
    rays, patch = view.empty_cells(center, model.part.radius)
    if not len(rays):
        return rays, patch, np.zeros(0, bool)
    sensor = pose.apply(view.sensor_origin[None])
    directions = pose.rotate(rays)
    hits = model.scanner.cast(np.broadcast_to(sensor, rays.shape), directions)
    cosine = -np.sum(hits.normals * directions, axis=1)
    return rays, patch, (hits.face >= 0) & (cosine > FLATTEST_COSINE)


def verify(
    model: MeasurementModel,
    part_from_camera: RigidTransform,
    points: np.ndarray,
    checked: np.ndarray,
    *,
    tolerance_mm: float,
    view: View | None,
) -> Verification:
    """What each of the points ``points[checked]`` says about one pose; ``view`` is of them."""
    batch = RigidTransform(part_from_camera.rotation[None], part_from_camera.translation[None])
    now = model.residuals(batch, points[checked])
    hit, deviation = now.hit[0], now.deviation_mm[0]
    status = np.full(len(checked), PointStatus.BESIDE, np.uint8)
    status[hit & (deviation > tolerance_mm)] = PointStatus.BEFORE
    status[hit & (deviation < -tolerance_mm)] = PointStatus.BEHIND
    # a ray that just misses an edge belongs to it
    status[np.abs(deviation) <= tolerance_mm] = PointStatus.INLIER
    inlier = status == PointStatus.INLIER
    unmeasured = violation = np.nan
    score = _point_scores(now, tolerance_mm, view).sum()
    if view is not None:
        violation = float(np.mean(status == PointStatus.BEHIND))
        _, _, seen = predicted_unmeasured(model, part_from_camera, view)
        measured = inlier.sum() / view.points_per_cell
        unmeasured = float(seen.sum() / max(seen.sum() + measured, 1.0))
        score -= UNMEASURED_PENALTY * view.points_per_cell * seen.sum()
    return Verification(
        inlier_share=float(inlier.mean()),
        violation_share=violation,
        unmeasured_share=unmeasured,
        tolerance_mm=tolerance_mm,
        checked=checked,
        status=status,
        deviation_mm=np.where(hit | inlier, deviation, np.nan),
        score=float(score / len(checked)),
    )


def _point_scores(now: Residuals, tolerance_mm: float, view: View | None) -> np.ndarray:
    """[H, n], as `evidence` says; nothing is behind where no ray is known."""
    score = np.clip(1 - (now.deviation_mm / tolerance_mm) ** 2, 0, None)
    if view is not None:
        score[now.hit & (now.deviation_mm < -tolerance_mm)] = -VIOLATION_PENALTY
    return score


def _cubes(points: np.ndarray) -> np.ndarray:
    """[n] patches of points without a sensor: cubes, about 300 of them on a surface."""
    size = max(float(np.ptp(points, axis=0).max()), 1e-9) / 16
    cell = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    return cell @ np.array([1, 1 << 10, 1 << 20])
