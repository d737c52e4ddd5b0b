"""Where a scan shows material that the CAD model lacks, or that it lacks itself."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vanejax.cad.solid_bodies import connected
from vanejax.localization.fine_registration import subset
from vanejax.localization.pose_batch import stack
from vanejax.localization.pose_result import MaterialRegion, PointStatus
from vanejax.localization.residuals import MeasurementModel
from vanejax.rigid import RigidTransform

POINTS = 15_000
NEIGHBORS = 16  # of a point, by which areas are measured and what hangs together
MOSTLY = 0.8  # of them are of a region: not along an edge, where sensors err
SPARSE = 2.0  # times as far from each other as usual: dust, or flatter than 75 deg
LEAST_SHARE = 0.01  # of the points
# tolerances, and of the part's radius: what is less is a deviation of form
LEAST_DEPTH = 2.0, 0.025
NEAR = 0.05  # of the part's radius: what comes no nearer to it is not of it
MOST_REGIONS = 2
DEEPEST = 0.95  # quantile of the depths, so that no single point decides


def material_regions(
    model: MeasurementModel,
    part_from_camera: RigidTransform,
    points: np.ndarray,
    status: np.ndarray,
    *,
    tolerance_mm: float,
) -> tuple[MaterialRegion, ...]:
    """The largest regions in which a scan is not as the CAD model, largest first.

    Args:
      model: predicts points.
      part_from_camera: a pose that is right but for such regions.
      points: [n, 3] mm, camera frame.
      status: [n], their `PointStatus` under the pose.
      tolerance_mm: largest deviation of an inlier.
    """
    few = subset(points, POINTS, 9)
    points, status = points[few], status[few]
    behind = status == PointStatus.BEHIND
    outside = (status == PointStatus.BEFORE) | (status == PointStatus.BESIDE)
    if len(points) <= NEIGHBORS or max(behind.mean(), outside.mean()) < LEAST_SHARE:
        return ()
    distance, near = cKDTree(points).query(points, k=NEIGHBORS + 1)
    # the area of a disc that holds so many points
    area_mm2 = np.pi * distance[:, -1] ** 2 / NEIGHBORS
    least_mm = max(LEAST_DEPTH[0] * tolerance_mm, LEAST_DEPTH[1] * model.part.radius)
    dense = distance[:, -1] < SPARSE * np.median(distance[:, -1])
    regions = []
    for is_missing, of_kind in ((True, behind), (False, outside)):
        for chosen in _pieces(of_kind & dense, near):
            share = len(chosen) / len(points)
            place, depth_mm = _place_and_depth(model, part_from_camera, points[chosen], is_missing)
            attached = is_missing or depth_mm.min() < NEAR * model.part.radius
            deepest = float(np.quantile(depth_mm, DEEPEST))
            if share < LEAST_SHARE or not attached or deepest < least_mm:
                continue
            area = float(area_mm2[chosen].sum())
            regions.append(MaterialRegion(is_missing, share, area, place.mean(axis=0), deepest))
    return tuple(sorted(regions, key=lambda region: -region.share)[:MOST_REGIONS])


def _pieces(of_kind: np.ndarray, near: np.ndarray) -> list[np.ndarray]:
    """Indices of the points of a kind [n] bool that hang together, for each piece of them.

    Points with few neighbours ``near`` [n, k] of their kind hang together with nothing.
    """
    inner = np.flatnonzero(of_kind & (of_kind[near].mean(axis=1) >= MOSTLY))
    first = np.repeat(inner, near.shape[1])
    second = near[inner].reshape(-1)
    both = of_kind[second]
    label = connected(np.column_stack([first[both], second[both]]), len(of_kind))
    return [np.flatnonzero(of_kind & (label == piece)) for piece in np.unique(label[inner])]


def _place_and_depth(
    model: MeasurementModel, pose: RigidTransform, points: np.ndarray, is_missing: bool
) -> tuple[np.ndarray, np.ndarray]:
    """[m, 3] mm in the part's frame, and [m] mm from the CAD model's surface.

    Of missing material the place is where the CAD model has its surface, and the depth along the
    normal of that.
    """
    moved = pose.apply(points)
    if not is_missing:
        closest = model.surface.exact(moved).points
        return moved, np.linalg.norm(moved - closest, axis=1)
    residuals = model.residuals(stack(pose), points)
    deviation, normals = residuals.deviation_mm[0], residuals.jacobian[0][:, 3:]
    return moved - deviation[:, None] * normals, np.abs(deviation)
