"""What the noise of a scan is like, from the residuals that a pose leaves.

* Its standard deviation along the ray grows with the angle of incidence,
  ``sigma_range^2 + (sigma_lateral tan(angle))^2``, both fitted;
* its tails are Student's t with the degrees of freedom that fit best. White noise gives a normal
  distribution: then the estimate is least squares and reaches the Cramer-Rao bound. A real depth
  camera gives heavy tails, and far points count for little (Kerl et al., ICRA 2013, take this
  distribution with five degrees of freedom).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import gammaln

from vanejax.localization.residuals import Residuals
from vanejax.scans.robust_statistics import robust_sigma

DEGREES_OF_FREEDOM = (1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0, np.inf)
CUTOFF = 5.0  # standard deviations; a normal distribution has 6e-7 beyond
# rays flatter than 88.9 deg count as if they were not: one of them would outweigh 1e6 others, and a
# pose wrong by less than its noise would already make it jump off the face
LEAST_COSINE = 0.02
LEAST_MM = 1e-5  # what single precision leaves of 100 mm


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
    return Noise(max(range_mm * scale, LEAST_MM), lateral_mm * scale, freedom)


def weights(along: np.ndarray, cosine: np.ndarray, noise: Noise) -> np.ndarray:
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
    variance = np.array([robust_sigma(magnitude[b]) ** 2 for b in bins]) + LEAST_MM**2
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
    step = max(1, len(standard) // 5000)
    squared = standard[::step] ** 2 + 1e-12  # a scan without noise has no logarithm
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
