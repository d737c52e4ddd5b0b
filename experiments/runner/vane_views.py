"""The guide vane's views at full resolution with white noise, and poses beside the true one."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.cad import Part, guide_vane
from vanejax.errors import InputError
from vanejax.localization.pose_batch import stack
from vanejax.localization.residuals import RayCasting, measurement_model, moved
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Viewpoints, hemisphere_viewpoints


@dataclasses.dataclass(frozen=True, eq=False)
class VaneViews:
    """216 virtual scans of the built-in guide vane by a camera, made when asked for."""

    camera: Camera = dataclasses.field(default_factory=Camera)

    @functools.cached_property
    def part(self) -> Part:
        """The guide vane."""
        return guide_vane()

    @functools.cached_property
    def viewpoints(self) -> Viewpoints:
        """The paper's."""
        return hemisphere_viewpoints(self.part.center)

    @functools.cached_property
    def model(self) -> RayCasting:
        """Predicts the scans, whose sensor is at their origin."""
        return measurement_model(self.part, np.zeros(3))

    def select(self, which: str) -> list[int]:
        """Indices of the views: "test" for the paper's 54, "all", or numbers such as 0,4,8."""
        count = len(self.viewpoints)
        if which in ("test", "all"):
            return [v for v in range(count) if which == "all" or self.viewpoints.is_test[v]]
        try:
            chosen = [int(word) for word in which.split(",")]
        except ValueError:
            chosen = [-1]
        if not all(0 <= view < count for view in chosen):
            raise InputError(f"views {which!r}: should be test, all, or numbers below {count}")
        return chosen

    def truth(self, view: int) -> RigidTransform:
        """part_from_camera."""
        return self.viewpoints.view(view).inverse()

    def points(self, view: int) -> np.ndarray:
        """[N, 3] f64, mm, camera frame, free of noise."""
        scan = self.model.scanner.scan(self.camera, self.viewpoints.view(view))
        return scan.points.astype(np.float64)


def with_noise(points: np.ndarray, noise_mm: float, rng: np.random.Generator) -> np.ndarray:
    """Points [N, 3] with white noise along the rays from the origin."""
    range_mm = np.linalg.norm(points, axis=1)
    return points * (1 + noise_mm * rng.standard_normal(len(points)) / range_mm)[:, None]


def perturb(
    pose: RigidTransform, part: Part, *, deg: float, mm: float, rng: np.random.Generator
) -> RigidTransform:
    """The pose turned by ``deg`` and moved by ``mm`` at the part's centre, in any direction."""
    axis, direction = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    delta = np.concatenate([np.radians(deg) * axis, mm * direction])
    batch = moved(part, stack(pose), delta[None])
    return RigidTransform(batch.rotation[0], batch.translation[0])


def pose_error(pose: RigidTransform, truth: RigidTransform, center: np.ndarray) -> np.ndarray:
    """[6] the error as `Uncertainty` defines it: rad, then mm at the centre."""
    error = truth @ pose.inverse()
    shift = error.rotation @ center + error.translation - center
    return np.concatenate([Rotation.from_matrix(error.rotation).as_rotvec(), shift])


def magnitudes(error: np.ndarray) -> tuple[float, float]:
    """Degrees and mm of an error [6]."""
    return float(np.degrees(np.linalg.norm(error[:3]))), float(np.linalg.norm(error[3:]))


def error_row(error: np.ndarray) -> dict[str, float]:
    """`magnitudes` by their names in records."""
    return dict(zip(("rotation_deg", "translation_mm"), magnitudes(error), strict=True))
