"""Whether a pose explains a scan: points off the part, rays through it, surface never measured.

Nearest-neighbour fitness cannot tell a right pose from a wrong one: where a part looks much the
same turned round, 99.8 % of the points lie near its surface at 31 deg of error. Rays say more.
A point behind the surface means that light went through material; a part of the surface that the
sensor should have seen and did not measure is missing. Two poses are compared by the same patches
of the scan, so that noise, holes and clutter cancel, and what remains is what tells them apart.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vanejax.localization.pose_batch import select, stack
from vanejax.localization.pose_result import PointStatus, Verification
from vanejax.localization.residuals import MeasurementModel, RayCasting, Residuals
from vanejax.localization.scan_patches import View, cube_labels
from vanejax.rigid import RigidTransform

CUBES = 16  # along the scan, where there is no sensor's view to be cut into patches
# surface seen flatter than 75 deg may well go unmeasured
FLATTEST_COSINE = float(np.cos(np.radians(75)))
UNMEASURED_PENALTY = 0.5
VIOLATION_PENALTY = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """What patches of a scan say for H poses: the larger the better.

    Attributes:
      patch: [P] number of points in each patch.
      score: [H, P] sums over points and empty cells.
      cropped: [H, P] likewise, if what is outside the measured region was cut off: then it is not
        known, and does not count.
      total: [H] sum of the means of both, per point: to sort by.
    """

    patch: np.ndarray
    score: np.ndarray
    cropped: np.ndarray
    total: np.ndarray

    def preference(self, first: int, second: int) -> float:
        """How many standard errors the patches prefer the first pose to the second.

        A paired t statistic over patches. Patches that see no difference say nothing and do not
        count, so that a small feature which all of its patches agree on is not drowned. It holds
        whether the scan was cropped or not: the smaller of the two figures, 0 where they disagree.
        """
        whole, cropped = (_t_statistic(s[first] - s[second]) for s in (self.score, self.cropped))
        return min(whole, cropped, key=abs) if whole * cropped > 0 else 0.0


def _t_statistic(difference: np.ndarray) -> float:
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
    residuals = model.residuals(poses, points, precision="samples")
    point_score = _point_scores(residuals, tolerance_mm, view)
    point_patch = cube_labels(points, CUBES) if view is None else view.patch
    unmeasured = []  # of each pose, the patches of its empty cells, and whether they are inside
    if view is not None:
        for h in range(len(poses.rotation)):
            _, patch, seen, among = predicted_unmeasured(model, select(poses, h), view)
            unmeasured.append((patch[seen], among[seen]))
    patches = [patch for patch, _ in unmeasured]
    names, row = np.unique(np.concatenate([point_patch, *patches]), return_inverse=True)
    starts = np.cumsum([len(point_patch), *map(len, patches)])[:-1]
    row_of_point, *rows_of_empty = np.split(row, starts)
    score = np.stack([np.bincount(row_of_point, s, minlength=len(names)) for s in point_score])
    cropped = score.copy()
    for h, rows in enumerate(rows_of_empty):
        lost = UNMEASURED_PENALTY * view.points_per_cell
        score[h] -= lost * np.bincount(rows, minlength=len(names))
        cropped[h] -= lost * np.bincount(rows[unmeasured[h][1]], minlength=len(names))
    count = np.bincount(row_of_point, minlength=len(names))
    total = 0.5 * (score + cropped).sum(axis=1) / len(points)
    return Evidence(count, score, cropped, total)


def predicted_unmeasured(
    model: RayCasting, pose: RigidTransform, view: View
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rays through empty cells [m, 3], their patches [m], and two [m] bool.

    Whether they should have measured the part, and whether they are among those that measured.
    """
    center = pose.inverse().apply(model.part.center[None])[0]
    rays, patch, among = view.empty_cells(center, model.part.radius)
    if not len(rays):
        return rays, patch, np.zeros(0, bool), among
    sensor = pose.apply(view.sensor_origin[None])
    directions = pose.rotate(rays)
    hits = model.scanner.cast(np.broadcast_to(sensor, rays.shape), directions)
    cosine = -np.sum(hits.normals * directions, axis=1)
    return rays, patch, (hits.face >= 0) & (cosine > FLATTEST_COSINE), among


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
    residuals = model.residuals(stack(part_from_camera), points[checked])
    hit, deviation = residuals.hit[0], residuals.deviation_mm[0]
    status = np.full(len(checked), PointStatus.BESIDE, np.uint8)
    status[hit & (deviation > tolerance_mm)] = PointStatus.BEFORE
    status[hit & (deviation < -tolerance_mm)] = PointStatus.BEHIND
    # a ray that just misses an edge belongs to it
    status[np.abs(deviation) <= tolerance_mm] = PointStatus.INLIER
    inlier = status == PointStatus.INLIER
    unmeasured = missing = violation = np.nan
    score = _point_scores(residuals, tolerance_mm, view).sum()
    if view is not None:
        violation = float(np.mean(status == PointStatus.BEHIND))
        _, _, seen, among = predicted_unmeasured(model, part_from_camera, view)
        measured = inlier.sum() / view.points_per_cell
        unmeasured = float(seen.sum() / max(seen.sum() + measured, 1.0))
        inside = float((seen & among).sum())
        missing = inside / max(inside + measured, 1.0)
        score -= UNMEASURED_PENALTY * view.points_per_cell * seen.sum()
    return Verification(
        inlier_share=float(inlier.mean()),
        violation_share=violation,
        unmeasured_share=unmeasured,
        missing_share=missing,
        tolerance_mm=tolerance_mm,
        checked=checked,
        status=status,
        deviation_mm=np.where(hit | inlier, deviation, np.nan),
        score=float(score / len(checked)),
    )


def _point_scores(residuals: Residuals, tolerance_mm: float, view: View | None) -> np.ndarray:
    """[H, n], as `evidence` says; nothing is behind where no ray is known."""
    score = np.clip(1 - (residuals.deviation_mm / tolerance_mm) ** 2, 0, None)
    if view is not None:
        score[residuals.hit & (residuals.deviation_mm < -tolerance_mm)] = -VIOLATION_PENALTY
    return score
