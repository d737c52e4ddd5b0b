"""Fine registration: Gauss-Newton on what the CAD model predicts for every measured point.

Two stages. `descend` is robust and cheap: a few thousand points, many poses at once, a kernel that
narrows with the residuals; it has a wide basin. `refine` then takes every point and weighs it by
the noise that the residuals themselves show:

* its standard deviation along the ray grows with the angle of incidence,
  ``sigma_range^2 + (sigma_lateral tan(angle))^2``, both fitted;
* its tails are Student's t with the degrees of freedom that fit best. White noise gives a normal
  distribution, so the estimate is least squares and reaches the Cramer-Rao bound; a real depth
  camera gives heavy tails, and then far points count for little (Kerl et al., ICRA 2013, take this
  distribution with five degrees of freedom);
* errors of neighbouring points that go together (calibration, quantisation, a casting that is not
  its CAD model) carry less information than their number says: the scores of patches of the scan
  tell by how much (the cluster-robust sandwich), and the information matrix is divided by it.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vanejax.pose_result import Refinement, Uncertainty
from vanejax.residuals import MeasurementModel, Precision, RayCasting, Residuals, moved
from vanejax.rigid import RigidTransform

COARSE_POINTS = 4_000
MOST_POINTS = 400_000  # more of them improve the pose by less than the casting's own tolerance
# of the part's radius: no sensor worth the name is noisier, and no kernel starts narrower
SCALE_FLOOR = 0.01
DEGREES_OF_FREEDOM = (1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0, np.inf)
CUTOFF = 5.0  # standard deviations; a normal distribution has 6e-7 beyond
# of the scan, along the longer side of its view, and how many times the variance of independent
# points their scores must show: white noise stays below
PATCHES = {16: 1.4, 8: 1.8}
# rays flatter than 88.9 deg count as if they were not: one of them would outweigh 1e6 others, and a
# pose wrong by less than its noise would already make it jump off the face
LEAST_COSINE = 0.02
NOISE_FITS = 4  # of the last stage's iterations
SETTLED = 0.02  # of a standard deviation of the pose: a smaller step says nothing new


@dataclasses.dataclass(frozen=True)
class Noise:
    """What the residuals along the ray are distributed like.

    Attributes:
      range_mm: standard deviation (of the t's core) at normal incidence.
      lateral_mm: what it grows by with the tangent of the angle of incidence.
      degrees_of_freedom: of Student's t; inf is a normal distribution.
    """

    range_mm: float
    lateral_mm: float
    degrees_of_freedom: float

    def sigma_mm(self, cosine: np.ndarray) -> np.ndarray:
        """Standard deviation along rays that meet the surface at this cosine of incidence."""
        tangent_squared = 1 / cosine**2 - 1
        return np.sqrt(self.range_mm**2 + self.lateral_mm**2 * tangent_squared)


def subset(points: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Indices of at most ``count`` points, drawn without replacement, ascending."""
    if len(points) <= count:
        return np.arange(len(points))
    return np.sort(np.random.default_rng(seed).choice(len(points), count, replace=False))


def descend(
    model: MeasurementModel,
    part_from_camera: RigidTransform,
    points: np.ndarray,
    *,
    iterations: int,
    feet: Precision = "grid",
    floor_mm: float | None = None,
    settled_deg: float = 0.0,
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
      feet: as in `MeasurementModel.residuals`.
      floor_mm: the kernel's scale is no smaller; default 1 % of the part's radius.
      settled_deg: a pose that turns by less, and moves by less of the part's radius, is left.

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
        now = model.residuals(poses, points, feet=feet)
        deviation = now.deviation_mm
        scale = 1.4826 * np.median(np.abs(deviation), axis=1)
        scale = 2 * np.clip(scale, floor, 0.3 * radius)[:, None]
        weight = 1 / (1 + (deviation / scale) ** 2) ** 2
        weighted = now.jacobian * weight[..., None]
        information = weighted.swapaxes(-1, -2) @ now.jacobian
        gradient = np.einsum("hnk,hn->hk", weighted, deviation)
        information += damping * weight.sum(axis=1)[:, None, None]
        delta = -np.linalg.solve(information, gradient[..., None])[..., 0]
        turn = np.linalg.norm(delta[:, :3], axis=1)
        shift = np.linalg.norm(delta[:, 3:], axis=1) / radius
        delta /= np.maximum(1, np.maximum(turn / np.radians(20), shift / 0.2))[:, None]
        poses = moved(model.part, poses, delta)
        rotation[moving], translation[moving] = poses.rotation, poses.translation
        moving = moving[np.degrees(np.maximum(turn, shift)) >= settled_deg]
    return RigidTransform(rotation, translation), done


def refine(
    model: MeasurementModel,
    points: np.ndarray,
    init: RigidTransform,
    *,
    max_iterations: int = 12,
    seed: int = 0,
) -> Refinement:
    """One pose to the limit of what the scan's noise lets one know.

    Args:
      model: predicts points.
      points: [N, 3] f64, mm, camera frame.
      init: rough part_from_camera, [3, 3] and [3]; 5 deg and 5 mm off are no trouble.
      max_iterations: of the last stage.
      seed: of the random subset of points in the first stage.
    """
    batch = RigidTransform(init.rotation[None], init.translation[None])
    coarse = points[subset(points, COARSE_POINTS, seed)]
    batch, iterations = descend(model, batch, coarse, iterations=25, settled_deg=0.02)
    points = points[subset(points, MOST_POINTS, seed)]
    # what a narrow-band sensor needs and a noisy one does not mind: the kernel at the noise itself
    batch, more = descend(
        model,
        batch,
        coarse,
        iterations=10,
        feet="samples",
        floor_mm=1e-4 * model.part.radius,
        settled_deg=0.002,
    )
    iterations += more
    patches = [_patches(model, points, across) for across in PATCHES]
    converged = False
    for step in range(max_iterations):
        iterations += 1
        now = model.residuals(batch, points)
        cosine = np.maximum(now.cosine[0], LEAST_COSINE)
        along = now.deviation_mm[0] / cosine
        if step < NOISE_FITS:  # then fixed: pose and noise would follow each other round
            noise = fit_noise(now)
            weight = _weights(along, cosine, noise)
        weighted = now.jacobian[0] * (weight / cosine)[:, None]
        scores = weighted * along[:, None]
        information = weighted.T @ (now.jacobian[0] / cosine[:, None])
        delta, known = _solve(information, scores.sum(axis=0), model.part.radius)
        information /= _inflation(information, scores - scores.mean(axis=0), patches)
        batch = moved(model.part, batch, -delta[None])
        if delta @ information @ delta < SETTLED**2 * 6:
            converged = bool(known)
            break
    inliers = weight > 0
    return Refinement(
        part_from_camera=RigidTransform(batch.rotation[0], batch.translation[0]),
        converged=converged,
        iterations=iterations,
        method="ray casting" if isinstance(model, RayCasting) else "point to plane",
        noise_mm=float(noise.range_mm),
        num_points=len(points),
        num_inliers=int(inliers.sum()),
        information=information,
    )


def fit_noise(residuals: Residuals) -> Noise:
    """The noise model of one pose's residuals [1, n], from those within its own cut-off.

    ``lateral_mm`` is 0 where there are no rays (every cosine is 1).
    """
    used = residuals.hit[0]
    if used.sum() < 30:  # nearly nothing is predicted: take all for the same kind of noise
        used = np.ones_like(used)
    cosine = np.maximum(residuals.cosine[0][used], LEAST_COSINE)
    along = residuals.deviation_mm[0][used] / cosine
    tangent_squared = 1 / cosine**2 - 1
    range_mm, lateral_mm = _spread(np.abs(along), tangent_squared)
    core = Noise(range_mm, lateral_mm, np.inf)
    standard = along / core.sigma_mm(cosine)
    freedom, scale = _student(standard[np.abs(standard) < 2 * CUTOFF])
    return Noise(range_mm * scale, lateral_mm * scale, freedom)


def uncertainty(refinement: Refinement, center: np.ndarray) -> Uncertainty:
    """Covariance and its weakest directions from the information of a refinement."""
    values, vectors = np.linalg.eigh(_scaled(refinement.information, 100.0))
    # nothing is known worse than by half a turn, or by that much at 100 mm
    values = np.maximum(values, 1 / (100.0 * np.pi) ** 2)
    covariance = _scaled(vectors / values @ vectors.T, 100.0)
    turn, shift = covariance[:3, :3], covariance[3:, 3:]
    turn_values, turn_axes = np.linalg.eigh(turn)
    shift_values, shift_axes = np.linalg.eigh(shift)
    return Uncertainty(
        covariance=covariance,
        center=np.asarray(center, np.float64),
        rotation_sigma_deg=np.degrees(np.sqrt(np.diag(turn))),
        translation_sigma_mm=np.sqrt(np.diag(shift)),
        weakest_rotation_axis=_pointing_up(turn_axes[:, -1]),
        weakest_rotation_sigma_deg=float(np.degrees(np.sqrt(turn_values[-1]))),
        weakest_translation_axis=_pointing_up(shift_axes[:, -1]),
        weakest_translation_sigma_mm=float(np.sqrt(shift_values[-1])),
    )


def _scaled(matrix: np.ndarray, length: float) -> np.ndarray:
    """With rotations counted as the way they move a point at ``length`` mm, or the reverse."""
    unit = np.array([1 / length] * 3 + [1.0] * 3)
    return matrix * np.outer(unit, unit)


def _pointing_up(axis: np.ndarray) -> np.ndarray:
    """Of the two signs of an axis, that with its largest component positive."""
    return axis * np.sign(axis[np.argmax(np.abs(axis))])


def _weights(along: np.ndarray, cosine: np.ndarray, noise: Noise) -> np.ndarray:
    """Weight, 1 / mm^2, of residuals along the ray [n]; 0 beyond the cut-off."""
    sigma = noise.sigma_mm(cosine)
    standard = np.abs(along) / sigma
    freedom = noise.degrees_of_freedom
    if np.isinf(freedom):
        weight = np.ones_like(standard)
    else:
        # the square of the t's own weight, so that what is far off loses its pull altogether
        weight = ((freedom + 1) / (freedom + standard**2)) ** 2
    reach = CUTOFF if np.isinf(freedom) else 2 * CUTOFF
    return np.where(standard < reach, weight / sigma**2, 0.0)


def _spread(magnitude: np.ndarray, tangent_squared: np.ndarray) -> tuple[float, float]:
    """range_mm and lateral_mm from robust spreads in bins of equal size over the tangent."""
    order = np.argsort(tangent_squared)
    bins = [b for b in np.array_split(order, 12) if len(b)]
    variance = np.array([(1.4826 * np.median(magnitude[b])) ** 2 for b in bins]) + 1e-12
    steep = np.array([np.median(tangent_squared[b]) for b in bins])
    if np.ptp(steep) < 1e-6:
        return float(np.sqrt(np.median(variance))), 0.0
    # relative least squares: a variance's own error is in proportion to it
    design = np.stack([np.ones_like(steep), steep], axis=1) / variance[:, None]
    slope = np.linalg.lstsq(design, np.ones_like(steep), rcond=None)[0]
    flat = float(np.sqrt(np.median(variance)))
    if slope[1] <= 0:
        return flat, 0.0
    floor = 0.1 * variance.min()
    return float(np.sqrt(max(slope[0], floor))), float(np.sqrt(slope[1]))


def _student(standard: np.ndarray) -> tuple[float, float]:
    """Degrees of freedom and scale of the t distribution that is likeliest for these [n].

    Only as many of them as needed: 5,000. A normal distribution is preferred unless a t is better
    by more than chance (a log likelihood of 5).
    """
    from scipy.special import gammaln

    step = max(1, len(standard) // 5000)
    squared = standard[::step] ** 2
    if len(squared) < 30:
        return np.inf, 1.0
    best, best_likelihood = (np.inf, 1.0), -np.inf
    for freedom in DEGREES_OF_FREEDOM[::-1]:
        variance = 1.0
        if np.isinf(freedom):
            core = squared < CUTOFF**2
            variance = float(squared[core].mean())
            density = -0.5 * np.log(2 * np.pi * variance) - 0.5 * squared / variance
            margin = 5.0
        else:
            for _ in range(20):
                weight = (freedom + 1) / (freedom + squared / variance)
                variance = float((weight * squared).mean())
            density = (
                gammaln((freedom + 1) / 2)
                - gammaln(freedom / 2)
                - 0.5 * np.log(freedom * np.pi * variance)
                - (freedom + 1) / 2 * np.log1p(squared / (freedom * variance))
            )
            margin = 0.0
        likelihood = float(density.sum()) + margin
        if likelihood > best_likelihood:
            best, best_likelihood = (freedom, float(np.sqrt(variance))), likelihood
    return best


def _solve(information: np.ndarray, gradient: np.ndarray, radius: float) -> tuple[np.ndarray, bool]:
    """The Gauss-Newton step, and whether all six directions are known.

    Directions in which the scan knows a million times less than in the best one stay as they are.
    """
    unit = np.array([1 / radius] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    known = values > 1e-8 * max(values[-1], 1e-30)
    along = vectors.T @ (gradient * unit)
    step = vectors @ np.where(known, along / np.where(known, values, 1.0), 0.0)
    return step * unit, bool(known.all())


def _patches(model: MeasurementModel, points: np.ndarray, across: int) -> np.ndarray:
    """[n] i64: which patch of the scan a point is in; squares of the sensor's view, or cubes."""
    if isinstance(model, RayCasting):
        rays = points - model.sensor_origin
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        forward = rays.mean(axis=0)
        points = rays - np.outer(rays @ forward, forward) / (forward @ forward)
    size = max(float(np.ptp(points, axis=0).max()), 1e-9) / across
    cell = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    _, patch = np.unique(cell @ np.array([1, 1 << 10, 1 << 20]), return_inverse=True)
    return patch


def _inflation(information: np.ndarray, scores: np.ndarray, patches: list[np.ndarray]) -> float:
    """How much more the patches' scores vary than independent points would; at least 1.

    The median over the six directions of the sandwich's ratio, at each size of patches; the
    largest that is more than chance.
    """
    largest = 1.0
    for patch, chance in zip(patches, PATCHES.values(), strict=True):
        totals = np.stack([np.bincount(patch, weights=column) for column in scores.T], axis=1)
        count = len(totals)
        if count < 20:
            continue
        between = totals.T @ totals * count / (count - 6)
        try:
            ratio = np.linalg.eigvals(np.linalg.solve(information, between)).real
        except np.linalg.LinAlgError:
            continue
        if np.median(ratio) > chance:
            largest = max(largest, float(np.median(ratio)))
    return largest
