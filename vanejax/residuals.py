"""What a pose predicts for every measured point, and how that changes with the pose.

Two measurement models with one face. `RayCasting`: a point is a ray of known direction and range,
and the ray cast at the CAD in the assumed pose gives the predicted range: exact correspondence,
self-occlusion included, no search. `SurfaceMatching`: the point's foot on the CAD surface, where
nobody knows from where the point was seen.

Coordinates of a small motion ``delta`` [6], everywhere in the fine registration: (rotation vector
in rad, translation in mm) in the part's frame about the part's centre c, applied after
``part_from_camera``: ``x -> c + exp(delta[:3]) (x - c) + delta[3:]``.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.part import Part
from vanejax.rigid import RigidTransform
from vanejax.scanner import Scanner
from vanejax.surface import Feet, Surface

# How near the foot of a point on the surface is found: to a cell of a grid, to the spacing of
# surface samples, or on the faces themselves; each is some ten times slower than the one before.
Precision = Literal["grid", "samples", "faces"]
MOST_EXACT = 20_000  # points; of more of them the samples will do


@dataclasses.dataclass(frozen=True, eq=False)
class Residuals:
    """Deviations of n points under H poses, to first order ``deviation + jacobian @ delta``.

    Attributes:
      deviation_mm: [H, n], signed distance to the plane of the predicted face, positive outside
        the material; for points without prediction the distance to the nearest surface point.
      jacobian: [H, n, 6], mm per rad and per mm.
      cosine: [H, n], of the incidence angle: ``deviation_mm / cosine`` is along the ray; 1 where
        there is no ray.
      hit: [H, n] bool, whether the model predicts a measurement of this point at all.
    """

    deviation_mm: np.ndarray
    jacobian: np.ndarray
    cosine: np.ndarray
    hit: np.ndarray


class MeasurementModel(Protocol):
    """Predicts measured points ``points`` [n, 3], mm, camera frame, under poses [H]."""

    part: Part

    def residuals(
        self, part_from_camera: RigidTransform, points: np.ndarray, *, feet: Precision = "faces"
    ) -> Residuals:
        """Deviations under a batch of poses; ``feet`` says how well misses are measured."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class RayCasting:
    """The scanner as the measurement model.

    Attributes:
      scanner: of the part.
      surface: of the same part, for rays that miss it.
      sensor_origin: [3] mm, camera frame.
    """

    scanner: Scanner
    surface: Surface
    sensor_origin: np.ndarray

    @property
    def part(self) -> Part:
        """What is looked for."""
        return self.scanner.part

    def residuals(
        self, part_from_camera: RigidTransform, points: np.ndarray, *, feet: Precision = "faces"
    ) -> Residuals:
        """See `MeasurementModel`.

        With the predicted point x, its face's outward normal n, the ray's unit direction d and
        range r: ``dr = ((x - c) x n . omega + n . v) / |n . d|``; the deviation is that times
        ``|n . d|``.
        """
        rays = points - self.sensor_origin
        range_mm = np.linalg.norm(rays, axis=-1)
        turned = rays / range_mm[:, None] @ part_from_camera.rotation.swapaxes(-1, -2)
        sensor = part_from_camera.rotation @ self.sensor_origin + part_from_camera.translation
        origins = np.broadcast_to(sensor[:, None], turned.shape)
        hits = self.scanner.cast(origins.reshape(-1, 3), turned.reshape(-1, 3))
        shape = turned.shape[:2]
        hit = hits.face.reshape(shape) >= 0
        normals = hits.normals.reshape(turned.shape)
        predicted = np.where(hit, hits.distance_mm.reshape(shape), range_mm)
        cosine = np.where(hit, -np.einsum("hni,hni->hn", normals, turned), 1.0)
        deviation = (predicted - range_mm) * cosine
        x = turned
        x *= predicted[..., None]
        x += (sensor - self.part.center)[:, None]
        if not hit.all():
            missed = ~hit
            # about the centre, as everything here
            distance, direction = _to_surface(self.surface, x[missed] + self.part.center, feet)
            deviation[missed], normals[missed] = distance, direction
        return Residuals(deviation, _jacobian(x, normals), cosine, hit)


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceMatching:
    """The nearest surface point as the measurement model: for clouds without a known sensor.

    Attributes:
      surface: of the part.
      reach_mm: points farther away count as not predicted.
    """

    surface: Surface
    reach_mm: float

    @property
    def part(self) -> Part:
        """What is looked for."""
        return self.surface.part

    def residuals(
        self, part_from_camera: RigidTransform, points: np.ndarray, *, feet: Precision = "faces"
    ) -> Residuals:
        """See `MeasurementModel`: point to plane, with the plane of the nearest face."""
        moved = part_from_camera.apply(
            np.broadcast_to(points, (*_batch(part_from_camera), *points.shape))
        )
        flat = moved.reshape(-1, 3)
        found = _feet(self.surface, flat, "grid" if feet == "grid" else "samples")
        offset = flat - found.points
        deviation = np.einsum("ni,ni->n", offset, found.normals)
        distance = np.linalg.norm(offset, axis=-1)
        hit = distance < self.reach_mm
        direction = offset / np.maximum(distance, 1e-12)[:, None]
        normals = np.where(hit[:, None], found.normals, direction).reshape(moved.shape)
        return Residuals(
            deviation_mm=np.where(hit, deviation, distance).reshape(moved.shape[:2]),
            jacobian=_jacobian(moved - self.part.center, normals),
            cosine=np.ones(moved.shape[:2]),
            hit=hit.reshape(moved.shape[:2]),
        )


def moved(part: Part, part_from_camera: RigidTransform, delta: np.ndarray) -> RigidTransform:
    """Applies the small motions delta [H, 6] about the part's centre to H poses."""
    turn = Rotation.from_rotvec(delta[:, :3]).as_matrix()
    arm = part_from_camera.translation - part.center
    return RigidTransform(
        rotation=turn @ part_from_camera.rotation,
        translation=np.einsum("hij,hj->hi", turn, arm) + part.center + delta[:, 3:],
    )


def _batch(poses: RigidTransform) -> tuple[int, ...]:
    return poses.rotation.shape[:-2]


def _jacobian(x: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[H, n, 6] of ``normals . (omega x x + v)`` for points about the part's centre."""
    out = np.empty((*x.shape[:-1], 6))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        out[..., k] = x[..., i] * normals[..., j] - x[..., j] * normals[..., i]
    out[..., 3:] = normals
    return out


def _to_surface(
    surface: Surface, points: np.ndarray, precision: Precision
) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m] to the surface and the unit direction [m, 3] away from it."""
    feet = _feet(surface, points, precision)
    offset = points - feet.points
    distance = np.linalg.norm(offset, axis=-1)
    return distance, offset / np.maximum(distance, 1e-12)[:, None]


def _feet(surface: Surface, points: np.ndarray, precision: Precision) -> Feet:
    """Feet of points [m, 3] as near as wanted."""
    if precision == "grid":
        return surface.coarse(points)
    if precision == "samples" or len(points) > MOST_EXACT:
        return surface.nearest(points)
    return surface.exact(points)
