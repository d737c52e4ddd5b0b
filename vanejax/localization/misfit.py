"""Why a scan does not fit: it shows the mirror image of the CAD model, or a part of another size.

A scan times -1 is one of the mirror image, turned half round, and a scan times 1.05 is one of a
part that is 5 % larger. Both are registered to the same model, so that no part is built anew.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import numpy as np

from vanejax.cad.cad_file import MM_PER_UNIT
from vanejax.cad.part import Part
from vanejax.cad.surface import Surface
from vanejax.localization.fine_registration import robust_gauss_newton, subset
from vanejax.localization.pose_batch import select, stack
from vanejax.localization.pose_result import PoseResult
from vanejax.localization.pose_search import (
    Candidates,
    converge,
    initial_poses,
    search,
    uniform_rotations,
)
from vanejax.localization.residuals import MeasurementModel, RayCasting, SurfaceMatching
from vanejax.localization.scan_patches import view_of
from vanejax.localization.verdict import Limits, size_in_words
from vanejax.localization.verification import verify
from vanejax.rigid import RigidTransform
from vanejax.scans.measured_scan import MeasuredScan

MIRRORED = -1.0
# sizes of the part in the scan, and of units: how large the scan may be against the part's diameter
STEP, LARGEST_STEP = 1.08, 9
LENGTHS = (0.3, 1.05)
ROTATIONS, POINTS, ITERATIONS = 120, 250, 10
CONVERGED_POINTS = 1500
FITTING, KEPT = 3, 6  # poses of each size, and of all sizes, that are looked at more closely
SIZE_STEPS = (0.04, 0.02, 0.01, 0.005, 0.0025)
TOLERANCE, NEAR = 0.01, 0.05  # of the part's radius; the second while sizes are apart by a step
SAME_SIZE = 0.03  # what is less is a term of the part's form
ON_THE_PART = 0.9  # of the points: then no other shape is sought
UNIT = 0.01  # a size this near to a unit's is that unit
CLEARLY = 0.5  # of what a pose leaves open another shape leaves no more
OWN_MIRROR_IMAGE = 0.98  # of the surface that lies on the mirror image


def times(scan: MeasuredScan, factor: float) -> MeasuredScan:
    """The scan as of a part ``factor`` times as large; below 0 of its mirror image."""
    origin = scan.sensor_origin
    return dataclasses.replace(
        scan,
        points=factor * scan.points,
        normals=None,
        sensor_origin=None if origin is None else factor * origin,
        origin_is_assumed=False,
    )


def fits_badly(result: PoseResult, part: Part, limits: Limits) -> bool:
    """Whether the scan leaves so much open that it may be of another shape than the part.

    A crop that lies on the part does not, nor does a part whose other size is known already.
    """
    checks, form = result.verification, result.refinement.form
    if result.verdict.status != "ambiguous":
        return result.verdict.status == "rejected" and not has_other_size(result, limits)
    return (
        (checks.support < limits.least_support and checks.inlier_share < ON_THE_PART)
        or checks.tolerance_mm / 3 > limits.doubtful_noise * part.radius
        or (form is not None and form.unexplained_share > limits.most_unexplained_share)
        or (form is not None and not form.converged)
    )


def has_other_size(result: PoseResult, limits: Limits) -> bool:
    """Whether a result is of a part that fits well, but for a size that is not its own."""
    form = result.refinement.form
    return (
        form is not None
        and abs(form.scale_error) > limits.most_scale_error
        and result.verification.support >= limits.least_support
    )


def mirror_image(
    model: MeasurementModel, scan: MeasuredScan, own_support: float, *, seed: int = 0
) -> Candidates | None:
    """Poses of the mirror image, where that fits clearly better than the part itself.

    Args:
      model: predicts points of the scan.
      scan: as measured.
      own_support: of the part itself, from `support`.
      seed: of the subsets of points.

    Returns:
      Poses of the scan times `MIRRORED`; None where it fits no better, or the part is its own
      mirror image.
    """
    mirrored = _seen(model, MIRRORED)
    candidates = search(mirrored, MIRRORED * scan.points, seed=seed)
    found = support(mirrored, candidates.pose(0), MIRRORED * scan.points, seed=seed)
    if not is_clear(found, own_support) or is_own_mirror_image(model.part):
        return None
    return candidates


def other_size(
    model: MeasurementModel, scan: MeasuredScan, own_support: float, *, seed: int = 0
) -> tuple[float, Candidates] | None:
    """A factor of the scan, and poses, where it fits clearly better than the part as it is.

    Args and conditions as in `mirror_image`. A part that is larger or smaller by less than
    `SAME_SIZE` is none of another size.
    """
    sample = scan.points[subset(scan.points, CONVERGED_POINTS, seed + 7)]
    best = max(_fitted_sizes(model, sample), key=lambda size: size.support, default=None)
    if best is None or abs(best.factor - 1) < SAME_SIZE or not is_clear(best.support, own_support):
        return None
    scaled = _seen(model, best.factor)
    points = best.factor * scan.points
    return best.factor, converge(scaled, points, stack(best.pose), seed=seed)


def support(
    model: MeasurementModel, pose: RigidTransform, points: np.ndarray, *, seed: int = 0
) -> float:
    """`Verification.support` of one pose, at a tolerance that is the same for all shapes.

    Args:
      model: predicts points.
      pose: part_from_camera.
      points: [N, 3] mm, camera frame.
      seed: of the subset of points.
    """
    points = points[subset(points, CONVERGED_POINTS, seed + 7)]
    checked, tolerance_mm = np.arange(len(points)), TOLERANCE * model.part.radius
    view = view_of(model, points)
    return verify(model, pose, points, checked, tolerance_mm=tolerance_mm, view=view).support


def in_words(factor: float, other: PoseResult, result: PoseResult) -> str:
    """What the scan shows instead of the part.

    Args:
      factor: of the scan.
      other: of the scan times the factor.
      result: of the scan as measured.
    """
    checks = other.verification
    within = f"within {checks.tolerance_mm:.3g} mm"
    itself = (
        f"{result.verification.inlier_share:.0%} on the part itself (within "
        f"{result.verification.tolerance_mm:.3g} mm)"
    )
    if factor == MIRRORED:
        return (
            f"the scan fits the mirror image of the CAD model: {checks.inlier_share:.0%} of the "
            f"points lie on that ({within}), {itself}: it is the opposite hand, or the CAD file or "
            "the scan is mirrored (left-handed axes)"
        )
    form = other.refinement.form
    size = (1 + (form.scale_error if form else 0.0)) / factor
    figures = f"{checks.inlier_share:.0%} of the points lie on a part of that size ({within}), "
    for ratio in unit_ratios():
        if abs(size / ratio - 1) < UNIT:
            times = f"{ratio:.4g}" if ratio > 1 else f"1/{1 / ratio:.4g}"
            return (
                f"the scan is {times} times as large as the CAD model: {figures}{itself}: one of "
                "the two is in another unit (--units-scan, --units-cad)"
            )
    return (
        f"{size_in_words(size - 1)}: {figures}{itself}: it is a part of another size, or the scale "
        "of the scan or of the CAD file is wrong"
    )


def is_clear(support: float, own_support: float) -> bool:
    """Whether another shape is supported clearly better than the part itself."""
    return 1 - support < CLEARLY * (1 - own_support)


def _seen(model: MeasurementModel, factor: float) -> MeasurementModel:
    """The model for the scan times a factor."""
    if isinstance(model, RayCasting):
        return dataclasses.replace(model, sensor_origin=factor * model.sensor_origin)
    return model


class _Size(NamedTuple):
    """A factor of the scan, the pose at which it then fits best, and its support."""

    factor: float
    pose: RigidTransform
    support: float


def _fitted_sizes(model: MeasurementModel, points: np.ndarray) -> list[_Size]:
    """The sizes and poses at which points [n, 3] mm fit best, not sorted."""
    few = points[subset(points, POINTS, 8)]
    found = []
    for factor in _factors(model.part, points):
        scaled, scaled_few = _seen(model, factor), factor * few
        poses, _ = robust_gauss_newton(
            scaled,
            initial_poses(scaled, scaled_few, uniform_rotations(ROTATIONS)),
            scaled_few,
            iterations=ITERATIONS,
            min_step_deg=0.5,
        )
        deviation_mm = np.abs(scaled.residuals(poses, scaled_few, precision="grid").deviation_mm)
        score = np.clip(1 - deviation_mm / (NEAR * model.part.radius), 0, None).mean(axis=1)
        found += [(score[k], factor, select(poses, k)) for k in np.argsort(-score)[:FITTING]]
    found.sort(key=lambda entry: -entry[0])
    return [_fitted_size(model, factor, pose, points) for _, factor, pose in found[:KEPT]]


def _fitted_size(
    model: MeasurementModel, factor: float, pose: RigidTransform, points: np.ndarray
) -> _Size:
    """From a factor and a pose to those nearby that fit best."""

    def fitted(factor: float, pose: RigidTransform) -> _Size:
        scaled, scaled_points = _seen(model, factor), factor * points
        poses, _ = robust_gauss_newton(
            scaled, stack(pose), scaled_points, iterations=8, min_step_deg=0.02
        )
        pose = select(poses, 0)
        return _Size(factor, pose, support(scaled, pose, scaled_points))

    best = fitted(factor, pose)
    for step in SIZE_STEPS:
        for change in (1 + step, 1 / (1 + step)):
            pose = _rescaled(best.pose, change, model.part)
            best = max(best, fitted(change * best.factor, pose), key=lambda size: size.support)
    return best


def _rescaled(pose: RigidTransform, factor: float, part: Part) -> RigidTransform:
    """A pose of the scan times a factor, about the same place of the part."""
    return RigidTransform(pose.rotation, factor * (pose.translation - part.center) + part.center)


def _factors(part: Part, points: np.ndarray) -> list[float]:
    """Factors of sizes and units at which the scan is about as large as a view of the part."""
    centered = points - np.median(points, axis=0)
    axis = np.linalg.svd(centered, full_matrices=False)[2][0]
    length = np.ptp(np.quantile(centered @ axis, [0.005, 0.995])) / (2 * part.radius)
    sizes = [STEP**k for k in range(-LARGEST_STEP, LARGEST_STEP + 1)] + unit_ratios()
    return [size for size in sizes if LENGTHS[0] <= size * length <= LENGTHS[1]]


@functools.cache
def unit_ratios() -> list[float]:
    """Of one unit to another, each once, without 1 and what sizes near 1 are."""
    ratios = {a / b for a in MM_PER_UNIT.values() for b in MM_PER_UNIT.values()}
    largest = STEP ** (LARGEST_STEP + 0.5)
    return sorted({round(r, 9) for r in ratios if not 1 / largest < r < largest})


@functools.lru_cache(maxsize=16)
def is_own_mirror_image(part: Part) -> bool:
    """Whether a part and its mirror image are alike."""
    surface = Surface(part)
    model = SurfaceMatching(surface, reach_mm=0.3 * part.radius)
    mirrored = -surface.points[:CONVERGED_POINTS]
    pose = search(model, mirrored).pose(0)
    return support(model, pose, mirrored) > OWN_MIRROR_IMAGE
