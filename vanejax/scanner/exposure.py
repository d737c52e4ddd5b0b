"""How bright a surface looks to the camera, and where that is too bright or too dark to measure.

Brightness is a share of the pixel's full well. A structured-light camera projects fringes: the
bright ones give a pixel ``light + ambient``, the dark ones ``ambient``. What is measured is the
difference, the modulation; what saturates is the sum. A longer exposure raises both.

A surface reflects diffusely (Lambert) and, in part, specularly: facets tilted by a Beckmann
distribution (Cook and Torrance, 1982), without Fresnel's and the shadowing term. All brightness is
relative to a matte surface that faces the light, 400 mm away from it.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vanejax.settings import bounded, check_fields, magnitude, positive

REFERENCE_MM = 400.0
# flatter than 89.4 deg: brightness would grow without limit
_LEAST_COSINE = 0.01


@dataclasses.dataclass(frozen=True)
class Exposure:
    """Light, exposure time and finish of the surface.

    Attributes:
      exposure_ms: the camera's exposure time.
      projector_per_ms: brightness per ms that the bright fringe gives the reference surface.
      ambient_per_ms: the same for a lamp in the workshop, which shines all the time.
      ambient_towards: [3] camera frame, any length: from the part to that lamp, a parallel light.
      specular: share of the light that is reflected specularly, 0 to 1.
      roughness: root-mean-square slope of the facets; a blasted casting has about 0.3, a ground
        surface 0.1.
      least_modulation: share of the full well; pixels with less are too dark.
      reference_signal: brightness at which `Sensor.noise_px` holds; shot noise grows as the
        square root of all light, and what is measured is the modulation.

    A value that no light can have raises InputError.
    """

    exposure_ms: float = positive(10.0)
    projector_per_ms: float = positive(0.04)
    ambient_per_ms: float = magnitude(0.002)
    ambient_towards: tuple[float, float, float] = bounded(
        (-0.5, 0.5, 0.7),
        lambda way: len(way) == 3 and 0 < np.linalg.norm(way) < np.inf,
        "be a direction, three numbers in the camera's frame",
    )
    specular: float = bounded(0.25, lambda share: 0 <= share <= 1, "lie between 0 and 1")
    roughness: float = positive(0.3)
    least_modulation: float = magnitude(0.03)
    reference_signal: float = positive(0.4)

    def __post_init__(self) -> None:
        check_fields(self, "exposure")

    def reflected(
        self, normals: np.ndarray, to_camera: np.ndarray, to_light: np.ndarray
    ) -> np.ndarray:
        """[N] f32, brightness per unit of light from a direction, relative to the reference.

        ``(1 - specular) cos_l + specular exp(-(tan h / m)^2) / (4 m^2 cos(h)^4 cos_v)`` with the
        angle h between the normal and the middle of both ways, and m the roughness. All directions
        are [N, 3] f32, unit; the light's may be [3].
        """
        to_light = np.broadcast_to(to_light, normals.shape)
        cosine = np.maximum(_dot(normals, to_light), 0)
        value = np.float32(1 - self.specular) * cosine
        if not self.specular:
            return value
        middle = to_camera + to_light
        squared = _dot(normals, middle)
        squared *= squared
        squared /= np.maximum(_dot(middle, middle), np.float32(1e-12))
        np.clip(squared, 1e-4, 1, out=squared)  # cos(h)^2
        slope = np.float32(self.roughness**2)
        shine = np.exp((1 - 1 / squared) / slope)
        shine /= 4 * slope * squared * squared
        shine /= np.maximum(_dot(normals, to_camera), np.float32(_LEAST_COSINE))
        value += np.float32(self.specular) * np.where(cosine > 0, shine, 0)
        return value

    def modulation(self, reflected: np.ndarray, distance_mm: np.ndarray) -> np.ndarray:
        """[N] f32 brightness that the projector adds, from `reflected` and its distance [N] mm."""
        lit = np.float32(self.exposure_ms * self.projector_per_ms) * reflected
        return lit * (np.float32(REFERENCE_MM) / distance_mm) ** 2

    def ambient(self, reflected: np.ndarray) -> np.ndarray:
        """[N] f32 brightness that the lamp adds."""
        return np.float32(self.exposure_ms * self.ambient_per_ms) * reflected

    def noise_gain(self, modulation: np.ndarray, total: np.ndarray) -> np.ndarray:
        """[N] f32: by what the disparity's noise is larger than at the reference.

        The standard deviation of a fringe's phase is that of the brightness over the modulation,
        and shot noise is the square root of all light: ``sqrt(total r) / modulation``.
        """
        least = max(self.least_modulation, 1e-3)
        root = np.sqrt(np.minimum(total, 1) * np.float32(self.reference_signal))
        return root / np.maximum(modulation, np.float32(least))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", a, b)
