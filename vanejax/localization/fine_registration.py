"""Fine registration: Gauss-Newton on what the CAD model predicts for every measured point.

Two stages. `robust_gauss_newton` takes a few thousand points, many poses at once, and a kernel that
narrows with the residuals; it has a wide basin. `refine` then takes every point and weighs it by
the noise that the residuals themselves show (`noise`), down to the limit that this noise sets.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vanejax.localization.covariance import PATCHES, inflation
from vanejax.localization.noise import LEAST_COSINE, fit_noise, weights
from vanejax.localization.pose_batch import select, stack
from vanejax.localization.pose_result import Refinement
from vanejax.localization.residuals import MeasurementModel, Precision, RayCasting, moved
from vanejax.localization.scan_patches import patch_labels
from vanejax.rigid import RigidTransform
from vanejax.scans.robust_statistics import robust_sigma

COARSE_POINTS = 4_000
MEDIUM_POINTS = 20_000
MOST_POINTS = 400_000  # more of them improve the pose by less than the casting's own tolerance
# of the part's radius: no sensor worth the name is noisier, and no kernel starts narrower
SCALE_FLOOR = 0.01
NOISE_FITS = 4  # of the last stage's iterations
CONVERGED = 0.1  # of a standard deviation of the pose: a smaller step says nothing new


def subset(points: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Indices of at most ``count`` points, drawn without replacement, ascending."""
    if len(points) <= count:
        return np.arange(len(points))
    return np.sort(np.random.default_rng(seed).choice(len(points), count, replace=False))


def robust_gauss_newton(
    model: MeasurementModel,
    part_from_camera: RigidTransform,
    points: np.ndarray,
    *,
    iterations: int,
    precision: Precision = "grid",
    floor_mm: float | None = None,
    ceiling_mm: float | None = None,
    min_step_deg: float = 0.0,
) -> tuple[RigidTransform, int]:
    """Robust Gauss-Newton from a batch of poses, on the same points for all of them.

    Deviations are taken along the surface normal (bounded at grazing incidence, where those along
    the ray are not), with a Geman-McClure kernel as wide as two robust standard deviations. Points
    whose ray misses pull towards the nearest surface. Steps are limited to 20 deg and a fifth of
    the part's radius.

    Args:
      model: predicts points.
      part_from_camera: H poses, [H, 3, 3] and [H, 3].
      points: [n, 3] mm, camera frame.
      iterations: at most.
      precision: as in `MeasurementModel.residuals`.
      floor_mm, ceiling_mm: the kernel's scale is no smaller, default 1 % of the part's radius, and
        no larger, default 30 %.
      min_step_deg: a pose that turns by less, and moves by less of the part's radius, is left.

    Returns:
      H poses, and the number of iterations done.
    """
    radius = model.part.radius
    floor = SCALE_FLOOR * radius if floor_mm is None else floor_mm
    damping = 1e-3 * np.diag([radius**2] * 3 + [1.0] * 3)
    rotation, translation = part_from_camera.rotation.copy(), part_from_camera.translation.copy()
    moving = np.arange(len(rotation))
    done = 0
    while done < iterations and len(moving):
        done += 1
        poses = RigidTransform(rotation[moving], translation[moving])
        residuals = model.residuals(poses, points, precision=precision)
        deviation = residuals.deviation_mm
        scale = robust_sigma(deviation, axis=1)
        scale = 2 * np.clip(scale, floor, ceiling_mm or 0.3 * radius)[:, None]
        weight = 1 / (1 + (deviation / scale) ** 2) ** 2
        weighted = residuals.jacobian * weight[..., None]
        information = weighted.swapaxes(-1, -2) @ residuals.jacobian
        gradient = np.einsum("hnk,hn->hk", weighted, deviation)
        information += damping * weight.sum(axis=1)[:, None, None]
        delta = -np.linalg.solve(information, gradient[..., None])[..., 0]
        turn = np.linalg.norm(delta[:, :3], axis=1)
        shift = np.linalg.norm(delta[:, 3:], axis=1) / radius
        delta /= np.maximum(1, np.maximum(turn / np.radians(20), shift / 0.2))[:, None]
        poses = moved(model.part, poses, delta)
        rotation[moving], translation[moving] = poses.rotation, poses.translation
        moving = moving[np.degrees(np.maximum(turn, shift)) >= min_step_deg]
    return RigidTransform(rotation, translation), done


def refine(
    model: MeasurementModel,
    points: np.ndarray,
    init: RigidTransform,
    *,
    max_iterations: int = 12,
    seed: int = 0,
) -> Refinement:
    """One pose of a part that is its CAD model, to the limit that the scan's noise sets.

    `form_deviation` goes on from there for a part that is not.

    Args:
      model: predicts points.
      points: [N, 3] f64, mm, camera frame.
      init: rough part_from_camera, [3, 3] and [3]; 5 deg and 5 mm off are no trouble.
      max_iterations: of the last stage.
      seed: of the random subsets of points in the first stages.
    """
    batch = stack(init)
    coarse = points[subset(points, COARSE_POINTS, seed)]
    batch, iterations = robust_gauss_newton(model, batch, coarse, iterations=25, min_step_deg=0.02)
    # what a narrow-band sensor needs and a noisy one does not mind: the kernel at the noise itself
    batch, more = robust_gauss_newton(
        model,
        batch,
        coarse,
        iterations=10,
        precision="samples",
        floor_mm=1e-4 * model.part.radius,
        min_step_deg=0.002,
    )
    iterations += more
    for size in (MEDIUM_POINTS, MOST_POINTS)[len(points) <= 2 * MEDIUM_POINTS :]:
        chosen = points[subset(points, size, seed)]
        refinement = _least_squares(model, chosen, batch, max_iterations=max_iterations)
        batch = stack(refinement.part_from_camera)
        iterations += refinement.iterations
    return dataclasses.replace(refinement, iterations=iterations)


def _least_squares(
    model: MeasurementModel,
    points: np.ndarray,
    batch: RigidTransform,
    *,
    max_iterations: int,
) -> Refinement:
    """Gauss-Newton along the rays from one pose [1], weighted by the noise fitted on the way."""
    patches = [patch_labels(model, points, across) for across in PATCHES]
    converged = False
    weight = np.full(len(points), np.inf)
    for step in range(max_iterations):
        residuals = model.residuals(batch, points)
        columns = residuals.jacobian[0]
        cosine = np.maximum(residuals.cosine[0], LEAST_COSINE)
        along = residuals.deviation_mm[0] / cosine
        if step < NOISE_FITS:  # then fixed: pose and noise would follow each other round
            noise = fit_noise(residuals)
        fresh = weights(along, cosine, noise)
        # a ray that was off once stays out: else those at edges would come and go for ever
        weight = fresh if step < NOISE_FITS else np.minimum(weight, fresh)
        weighted = columns * (weight / cosine)[:, None]
        scores = weighted * along[:, None]
        information = weighted.T @ (columns / cosine[:, None])
        gradient = scores.sum(axis=0)
        delta, known = _solve(information, gradient, model.part.radius)
        information /= inflation(information, scores - scores.mean(axis=0), patches)
        batch = moved(model.part, batch, -delta[None])
        if delta @ information @ delta < CONVERGED**2 * len(delta):
            converged = bool(known)
            break
    return Refinement(
        part_from_camera=select(batch, 0),
        converged=converged,
        iterations=step + 1,
        method="ray casting" if isinstance(model, RayCasting) else "point to plane",
        noise_mm=float(noise.range_mm),
        num_points=len(points),
        num_inliers=int(np.count_nonzero(weight)),
        information=information,
    )


def _solve(information: np.ndarray, gradient: np.ndarray, radius: float) -> tuple[np.ndarray, bool]:
    """The Gauss-Newton step, and whether all its directions are known.

    Directions in which the scan knows a million times less than in the best one stay as they are.
    """
    unit = np.array([1 / radius] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    known = values > 1e-8 * max(values[-1], 1e-30)
    along = vectors.T @ (gradient * unit)
    step = vectors @ np.where(known, along / np.where(known, values, 1.0), 0.0)
    return step * unit, bool(known.all())
