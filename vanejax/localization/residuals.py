"""What a pose predicts for every measured point, and how that changes with the pose.

Two measurement models with one interface. `RayCasting`: a point is a ray of known direction and
range, and the ray cast at the CAD model in the assumed pose gives the predicted range: exact
correspondence, self-occlusion included, no search. `SurfaceMatching`: the closest point of the CAD
surface, where the sensor's place is not known.

Coordinates of a small motion ``delta`` [6], everywhere in the fine registration: (rotation vector
in rad, translation in mm) in the part's frame about the part's centre c, applied after
``part_from_camera``: ``x -> c + exp(delta[:3]) (x - c) + delta[3:]``.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, Protocol, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.cad.part import Part
from vanejax.cad.surface import ClosestPoints, Surface
from vanejax.rigid import RigidTransform
from vanejax.scanner.virtual_scanner import Scanner

T = TypeVar("T")

# How precisely the closest point on the surface is found: to a cell of a grid, to the spacing of
# surface samples, or on the faces themselves; each is some ten times slower than the one before.
Precision = Literal["grid", "samples", "faces"]
FAR = 0.15  # of the part's radius
REACH = 0.3  # of the part's radius: how far a surface partner is sought where no ray is known
BLOCK = 1 << 14  # rays at a time: their arrays stay in the cache


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
        self,
        part_from_camera: RigidTransform,
        points: np.ndarray,
        *,
        precision: Precision = "faces",
    ) -> Residuals:
        """Deviations under a batch of poses; ``precision`` says how well misses are measured."""
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
        self,
        part_from_camera: RigidTransform,
        points: np.ndarray,
        *,
        precision: Precision = "faces",
    ) -> Residuals:
        """See `MeasurementModel`.

        With the predicted point x, its face's outward normal n, the ray's unit direction d and
        range r: ``dr = ((x - c) x n . omega + n . v) / |n . d|``; the deviation is that times
        ``|n . d|``.
        """
        rays = points - self.sensor_origin
        range_mm = np.linalg.norm(rays, axis=-1)
        rays /= range_mm[:, None]
        sensor = part_from_camera.rotation @ self.sensor_origin + part_from_camera.translation
        sensor -= self.part.center
        shape = (len(sensor), len(points))
        out = Residuals(
            np.empty(shape), np.empty((*shape, 6)), np.empty(shape), np.empty(shape, bool)
        )

        def fill(block: tuple[slice, slice]) -> None:
            poses, chosen = block
            turned = rays[chosen] @ part_from_camera.rotation[poses].swapaxes(-1, -2)
            origins = sensor[poses, None]
            hits = self.scanner.cast_unit(origins, turned)
            hit, normals = hits.face >= 0, hits.normals
            predicted = np.where(hit, hits.distance_mm, range_mm[chosen])
            cosine = np.where(hit, -np.einsum("hni,hni->hn", normals, turned), 1.0)
            deviation = (predicted - range_mm[chosen]) * cosine
            turned *= predicted[..., None]
            turned += origins  # now the predicted points, about the part's centre
            missed = ~hit
            if missed.any():
                deviation[missed], normals[missed] = _to_surface(
                    self.surface, turned[missed] + self.part.center, precision
                )
            out.deviation_mm[block], out.cosine[block], out.hit[block] = deviation, cosine, hit
            _jacobian(turned, normals, out.jacobian[block])

        _in_parallel(fill, _blocks(*shape))
        return out


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
        self,
        part_from_camera: RigidTransform,
        points: np.ndarray,
        *,
        precision: Precision = "faces",
    ) -> Residuals:
        """See `MeasurementModel`: point to plane, with the plane of the nearest face."""
        batch = part_from_camera.rotation.shape[:-2]
        moved = part_from_camera.apply(np.broadcast_to(points, (*batch, *points.shape)))
        flat = moved.reshape(-1, 3)
        closest = _closest_points(self.surface, flat, "grid" if precision == "grid" else "samples")
        offset = flat - closest.points
        deviation = np.einsum("ni,ni->n", offset, closest.normals)
        distance = np.linalg.norm(offset, axis=-1)
        hit = distance < self.reach_mm
        direction = offset / np.maximum(distance, 1e-12)[:, None]
        normals = np.where(hit[:, None], closest.normals, direction).reshape(moved.shape)
        return Residuals(
            deviation_mm=np.where(hit, deviation, distance).reshape(moved.shape[:2]),
            jacobian=_jacobian(moved - self.part.center, normals, np.empty((*moved.shape[:2], 6))),
            cosine=np.ones(moved.shape[:2]),
            hit=hit.reshape(moved.shape[:2]),
        )


def measurement_model(part: Part, sensor_origin: np.ndarray | None) -> MeasurementModel:
    """Rays from ``sensor_origin`` [3] mm, camera frame; the surface alone where it is None."""
    surface = Surface(part)
    if sensor_origin is None:
        return SurfaceMatching(surface, reach_mm=REACH * part.radius)
    return RayCasting(Scanner(part), surface, sensor_origin)


def moved(part: Part, part_from_camera: RigidTransform, delta: np.ndarray) -> RigidTransform:
    """Applies the small motions delta [H, 6] about the part's centre to H poses."""
    turn = Rotation.from_rotvec(delta[:, :3]).as_matrix()
    arm = part_from_camera.translation - part.center
    return RigidTransform(
        rotation=turn @ part_from_camera.rotation,
        translation=np.einsum("hij,hj->hi", turn, arm) + part.center + delta[:, 3:],
    )


def _jacobian(x: np.ndarray, normals: np.ndarray, out: np.ndarray) -> np.ndarray:
    """[H, n, 6] of ``normals . (omega x x + v)`` for points x about the part's centre."""
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        out[..., k] = x[..., i] * normals[..., j] - x[..., j] * normals[..., i]
    out[..., 3:] = normals
    return out


def _blocks(poses: int, points: int) -> list[tuple[slice, slice]]:
    """Blocks of poses and points with about `BLOCK` rays each."""
    if points >= BLOCK:
        starts = range(0, points, BLOCK)
        return [(slice(h, h + 1), slice(n, n + BLOCK)) for h in range(poses) for n in starts]
    step = max(1, BLOCK // max(points, 1))
    return [(slice(h, h + step), slice(None)) for h in range(0, poses, step)]


def _in_parallel(work: Callable[[T], None], items: Sequence[T]) -> None:
    """Calls ``work`` on each item; numpy, Embree and the k-d tree release the GIL."""
    workers = min(len(items), os.cpu_count() or 1)
    if workers < 2:
        for item in items:
            work(item)
        return
    with ThreadPoolExecutor(workers) as pool:
        for _ in pool.map(work, items):
            pass


def _to_surface(
    surface: Surface, points: np.ndarray, precision: Precision
) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m] to the surface and the unit direction [m, 3] away from it."""
    closest = _closest_points(surface, points, precision)
    offset = points - closest.points
    distance = np.linalg.norm(offset, axis=-1)
    return distance, offset / np.maximum(distance, 1e-12)[:, None]


def _closest_points(surface: Surface, points: np.ndarray, precision: Precision) -> ClosestPoints:
    """Closest points of points [m, 3] to a precision; of far ones a grid cell's: they weigh little.

    A search among all samples takes a hundred times longer for a point that is far from them all.
    """
    closest = surface.coarse(points)
    if precision != "grid":
        squared = np.sum((points - closest.points) ** 2, axis=1)
        near = np.flatnonzero(squared < (FAR * surface.part.radius) ** 2)
        search = surface.nearest if precision == "samples" else surface.exact
        if len(near):
            closest.put(near, search(points[near]))
    return closest
