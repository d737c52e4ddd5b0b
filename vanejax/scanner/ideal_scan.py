"""What rays meet, and what one view measures ideally: plain records."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from vanejax.rigid import RigidTransform


@dataclasses.dataclass(frozen=True, eq=False)
class Hits:
    """Where N rays first meet the part, in the part's frame.

    Attributes:
      distance_mm: [N] f64, mm from the origin along the unit ray; inf at a miss.
      face: [N] i32, index of the triangle; -1 at a miss.
      normals: [N, 3] f64, unit, outward, so facing the ray's origin; zero at a miss.
    """

    distance_mm: np.ndarray
    face: np.ndarray
    normals: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Scan:
    """What one view measures, ideally: one point per pixel that sees the part, in pixel order.

    Attributes:
      points: [N, 3] f32, mm, camera frame.
      normals: [N, 3] f32, unit, camera frame, of the triangle hit, facing the camera.
      face: [N] i32, index into the part's triangles.
      pixel: [N] i32, ``row * camera.width + column``, ascending.
      camera_from_part: the pose label; numpy f64 [3, 3] and [3], mm.
      hidden: [H, 3] f32, mm, camera frame: those of the area-uniform surface samples that the view
        does not see (the red cloud of the paper's Fig. 5); None unless asked for.
    """

    points: np.ndarray
    normals: np.ndarray
    face: np.ndarray
    pixel: np.ndarray
    camera_from_part: RigidTransform
    hidden: np.ndarray | None = None

    @functools.cached_property
    def range_mm(self) -> np.ndarray:
        """[N] f32, mm along the ray from the camera: the length of ``points``."""
        return np.linalg.norm(self.points.astype(np.float64), axis=-1).astype(np.float32)

    @functools.cached_property
    def incidence_deg(self) -> np.ndarray:
        """[N] f32, angle between the normal and the way back to the camera, 0 to 90."""
        points, normals = self.points.astype(np.float64), self.normals.astype(np.float64)
        # not by acos, which turns float32's rounding of a normal into 0.02 deg at 0 deg
        sine = np.linalg.norm(np.cross(normals, points), axis=-1)
        cosine = -np.einsum("ni,ni->n", normals, points)
        return np.degrees(np.arctan2(sine, cosine)).astype(np.float32)
