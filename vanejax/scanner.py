"""The virtual structured-light scanner: Embree rays against the part. Only this file knows embreex.

What embreex would otherwise do to its callers, and what is done about it here:

* everything is float32: the scene is centred on the part, rays start just in front of it instead
  of at the camera, and Embree's answer is used for one thing, *which* triangle is hit; the range
  is then the exact float64 intersection of the pixel's ray with that triangle's plane;
* a miss is triangle -1 at distance 1e37, normals are not unit vectors, distances are in lengths
  of the direction vector, and a ``dists`` array is overwritten in place: none of them is read,
  and the array given is always a fresh one;
* the scene is built on the first query, which is not safe from two threads: the constructor asks
  one. After that queries release the GIL, so threads share one scene.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from tqdm import tqdm

from vanejax.camera import Camera, Viewpoints
from vanejax.errors import InputError
from vanejax.part import Part
from vanejax.rigid import RigidTransform

T = TypeVar("T")

# Faces seen at more than 89.94 deg are not measured: a float32 ray may miss their edge by 1e-5 mm,
# which along the ray would be 0.01 mm and more. No sensor measures them either.
EDGE_ON_COSINE = 1e-3
RAYS_PER_STRIP = 1 << 16  # float64 set-up of this many rays stays in the cache


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
      range_mm: [N] f32, mm along the ray from the camera: the length of ``points``.
      face: [N] i32, index into the part's triangles.
      incidence_deg: [N] f32, angle between the normal and the way back to the camera, 0 to 90.
      pixel: [N] i32, ``row * camera.width + column``, ascending.
      camera_from_part: the pose label; numpy f64 [3, 3] and [3], mm.
      hidden: [H, 3] f32, mm, camera frame: those of the area-uniform surface samples that the view
        does not see (the red cloud of the paper's Fig. 5); None unless asked for.
    """

    points: np.ndarray
    normals: np.ndarray
    range_mm: np.ndarray
    face: np.ndarray
    incidence_deg: np.ndarray
    pixel: np.ndarray
    camera_from_part: RigidTransform
    hidden: np.ndarray | None = None


class Scanner:
    """Casts rays at one part. Safe to share between threads; the same call gives the same bits.

    Args:
      part: what to scan.
      surface_samples: number of surface points among which `scan` looks for hidden ones.
      seed: of those samples.
    """

    def __init__(self, part: Part, *, surface_samples: int = 20_000, seed: int = 0) -> None:
        self.part = part
        self._surface_samples, self._seed = surface_samples, seed
        self._center = np.asarray(part.center, np.float64)
        self._vertices = np.asarray(part.mesh.vertices, np.float64) - self._center
        corners = self._vertices[np.asarray(part.mesh.faces)]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        # a triangle without area has no normal; zero makes it edge-on to every ray
        self._normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
        self._plane_mm = np.sum(self._normals * corners[:, 0], axis=-1)
        self._radius = float(np.linalg.norm(self._vertices, axis=-1).max())
        # robust: without it rays slip between two triangles that share an edge
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(
            self._scene,
            self._vertices.astype(np.float32),
            np.ascontiguousarray(part.mesh.faces, np.int32),
        )
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """First intersections of any rays with the part, seen from outside.

        A ray that first meets the back of a face counts as a miss: it started inside the solid, or
        it met a vertex exactly and slipped in, which Embree's robust mode prevents at edges only.
        Open surfaces are seen from both sides.

        Args:
          origins: [N, 3] mm, part frame.
          directions: [N, 3], part frame, any length but zero.

        Raises:
          InputError: shapes that do not match, or a direction that is zero or not finite.
        """
        origins = np.asarray(origins, np.float64)
        directions = np.asarray(directions, np.float64)
        if origins.ndim != 2 or origins.shape != directions.shape or origins.shape[1] != 3:
            raise InputError(
                f"rays need [N, 3] origins and directions, got {origins.shape}, {directions.shape}"
            )
        length = np.linalg.norm(directions, axis=-1, keepdims=True)
        if not (np.isfinite(length).all() and np.isfinite(origins).all() and (length > 0).all()):
            raise InputError("rays need finite origins and finite directions that are not zero")
        return self.cast_unit(origins - self._center, directions / length)

    def cast_unit(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """`cast` without its checks, for the inner loop of a registration.

        Args:
          origins: [..., 3] f64 mm, about the part's centre; broadcast against ``directions``.
          directions: [..., 3] f64, unit.

        Returns:
          Hits with [...] in place of [N].
        """
        # jump to just before the part's bounding sphere, where float32 is finest
        skip = -np.einsum("...i,...i->...", origins, directions) - 1.01 * self._radius
        starts = origins + np.maximum(skip, 0)[..., None] * directions
        face = self._scene.run(
            starts.reshape(-1, 3).astype(np.float32), directions.reshape(-1, 3).astype(np.float32)
        ).reshape(directions.shape[:-1])
        normals = self._normals[face]
        closing = np.einsum("...i,...i->...", normals, directions)
        gap = self._plane_mm[face] - np.einsum("...i,...i->...", normals, origins)
        if not self.part.closed:  # the normal that faces the ray counts
            side = -np.sign(closing)
            normals *= side[..., None]
            gap, closing = side * gap, side * closing
        missed = (face < 0) | (closing >= -EDGE_ON_COSINE)
        closing[missed] = 1.0
        distance = gap / closing
        distance[missed] = np.inf
        face[missed] = -1
        normals[missed] = 0.0
        return Hits(distance_mm=distance, face=face.astype(np.int32), normals=normals)

    def scan(
        self, camera: Camera, camera_from_part: RigidTransform, *, hidden: bool = False
    ) -> Scan:
        """One view of the part.

        The clip planes work as a renderer's do (the paper renders with PCL): they are depths along
        the optical axis, what lies before the near plane is cut away, and what stood behind it is
        then seen, if need be from its inside. Rays start at the near plane for that reason.

        Args:
          camera: intrinsics.
          camera_from_part: rotation [3, 3] and translation [3] mm, as in `Viewpoints.view`.
          hidden: whether to compute `Scan.hidden` as well.

        Raises:
          InputError: no pixel sees the part (the message says why), or the camera stands inside it.
        """
        rotation = np.asarray(camera_from_part.rotation, np.float64)
        translation = np.asarray(camera_from_part.translation, np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise InputError(f"a scan needs one pose, got rotations of shape {rotation.shape}")
        label = RigidTransform(rotation, translation)
        # "local" is the part's frame moved to the part's centre
        camera_from_local = RigidTransform(rotation, translation + rotation @ self._center)
        self._refuse_camera_inside(camera_from_local)
        vertices = camera_from_local.apply(self._vertices)
        strips = self._cast_pixels(camera, camera_from_local, vertices)
        points, face, cosine, pixel = map(np.concatenate, zip(*strips, strict=True))
        if not len(points):
            raise InputError(_why_nothing_is_seen(camera, vertices))
        normals = self._normals @ rotation.T
        normals = normals.astype(np.float32)[face]
        normals *= -np.sign(cosine)[:, None].astype(np.float32)
        return Scan(
            points=points.astype(np.float32),
            normals=normals,
            range_mm=np.linalg.norm(points, axis=-1).astype(np.float32),
            face=face,
            incidence_deg=np.degrees(np.arccos(np.minimum(np.abs(cosine), 1))).astype(np.float32),
            pixel=pixel,
            camera_from_part=label,
            hidden=self._hidden(camera, camera_from_local) if hidden else None,
        )

    def _cast_pixels(
        self, camera: Camera, camera_from_local: RigidTransform, vertices: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Strips of image rows: points [N, 3] f64, face, cosine of normal and ray, pixel.

        The direction of a pixel's ray is (x, y, -1) in the camera frame and not made a unit
        vector: Embree does not mind, and the ray's parameter is then the depth.
        """
        rotation = camera_from_local.rotation
        eye = camera_from_local.inverse().translation
        normals = self._normals @ rotation.T
        plane = self._plane_mm + normals @ camera_from_local.translation
        nearest = float(-vertices[:, 2].max())
        start = max(camera.near_mm, nearest - 1.0)
        columns, rows = _window(camera, vertices)
        x, y = camera.slopes(columns, rows)
        across = x[:, None] * rotation[0] - rotation[2]
        down = y[:, None] * rotation[1]
        step = max(1, RAYS_PER_STRIP // max(1, len(columns)))
        strips = []
        for first in range(0, max(1, len(rows)), step):
            strip = slice(first, first + step)
            directions = (down[strip, None] + across).reshape(-1, 3)
            starts = eye + start * directions
            face = self._scene.run(starts.astype(np.float32), directions.astype(np.float32))
            hit = np.flatnonzero(face >= 0)
            face = face[hit]
            row, column = np.divmod(hit, max(1, len(columns)))
            ray = np.stack([x[column], y[strip][row], np.full(len(hit), -1.0)], axis=-1)
            closing = np.einsum("ni,ni->n", normals[face], ray)
            cosine = closing / np.sqrt(np.einsum("ni,ni->n", ray, ray))
            measured = np.abs(cosine) > EDGE_ON_COSINE
            depth = np.divide(plane[face], closing, out=np.zeros_like(closing), where=measured)
            keep = (depth >= camera.near_mm) & (depth <= camera.far_mm)
            if nearest >= camera.near_mm and self.part.closed:
                # not cut open, so a back face means a ray slipped in through a vertex, as in `cast`
                keep &= closing < 0
            pixel = rows[strip][row] * camera.width + columns[column]
            strips.append(
                (
                    (depth[:, None] * ray)[keep],
                    face[keep],
                    cosine[keep],
                    pixel[keep].astype(np.int32),
                )
            )
        return strips

    @functools.cached_property
    def _surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Area-uniform points [S, 3] about the part's centre, and their normals [S, 3]; f64."""
        points, normals, _ = self.part.sample(self._surface_samples, self._seed)
        return points - self._center, normals

    def _hidden(self, camera: Camera, camera_from_local: RigidTransform) -> np.ndarray:
        """The surface samples [H, 3] f32, camera frame, that this view does not see.

        A sample is seen when it lies between the clip planes, projects into the image, is not
        edge-on, and the way from it to the near plane is free. That last test also decides which
        samples face away: their way leads through the solid.
        """
        points_local, normals_local = self._surface
        points = camera_from_local.apply(points_local)
        normals = camera_from_local.rotate(normals_local)
        depth = -points[:, 2]
        pixel = camera.project(points)
        size = np.array([camera.width, camera.height])
        inside = np.all((pixel >= 0) & (pixel < size), axis=-1)
        inside &= (depth >= camera.near_mm) & (depth <= camera.far_mm)
        points, normals = points[inside], normals[inside]
        towards = points / points[:, 2:]  # one unit of the ray's parameter is 1 mm of depth
        cosine = np.einsum("ni,ni->n", normals, towards) / np.linalg.norm(towards, axis=-1)
        # leave the sample's own triangle by several float32 roundings, on the camera's side
        lift = 3e-5 * self._radius * np.sign(cosine)
        lifted = points + lift[:, None] * normals
        local_from_camera = camera_from_local.inverse()
        starts = local_from_camera.apply(lifted)
        directions = local_from_camera.rotate(towards)
        blocker = self._scene.run(
            starts.astype(np.float32),
            directions.astype(np.float32),
            dists=(-lifted[:, 2] - camera.near_mm).astype(np.float32),
            query="OCCLUDED",
        )
        seen = inside
        seen[inside] = (blocker < 0) & (np.abs(cosine) > EDGE_ON_COSINE)
        return camera_from_local.apply(points_local[~seen]).astype(np.float32)

    def _refuse_camera_inside(self, camera_from_local: RigidTransform) -> None:
        """Raises InputError for a camera inside the solid.

        That is where the first face in any direction is seen from its back. The direction taken is
        that of the face that looks largest from the camera, so that it is neither edge-on nor far.
        """
        eye = camera_from_local.inverse().translation
        if np.linalg.norm(eye) > self._radius:
            return
        corners = self._vertices[np.asarray(self.part.mesh.faces)]
        middle = corners.mean(axis=1) - eye
        area = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
        )
        distance = np.maximum(np.linalg.norm(middle, axis=-1), 1e-6 * self._radius)
        solid_angle = area * np.abs(np.sum(self._normals * middle, axis=-1)) / distance**3
        direction = middle[[np.argmax(solid_angle)]]
        face = self._scene.run(eye[None].astype(np.float32), direction.astype(np.float32))
        if face[0] >= 0 and np.sum(self._normals[face[0]] * direction[0]) > 0:
            raise InputError(
                f"the camera at {np.round(eye + self._center, 3)} mm (part frame) is inside the "
                f"part {self.part.name}; move it at least camera.near_mm away"
            )


def scan_views(
    part: Part,
    camera: Camera,
    viewpoints: Viewpoints,
    *,
    transform: Callable[[Scan], T] = lambda scan: scan,
    hidden: bool = False,
    workers: int | None = None,
    progress: bool = True,
) -> list[T]:
    """Scans a part from every viewpoint, on all cores.

    A view of 200,000 points takes 8 MB, so 216 of them do not belong in memory: ``transform`` is
    applied to each scan in the thread that made it, and only its result is kept.

    Args:
      part: what is seen.
      camera: by what.
      viewpoints: from where; V views.
      transform: from `Scan` to what is kept of it, such as a thinned cloud; runs in threads.
      hidden: whether `Scan.hidden` is wanted.
      workers: number of threads; None for one per core. Does not change the result.
      progress: whether to show a progress bar.

    Returns:
      V results in the order of the viewpoints.

    Raises:
      InputError: a view that does not see the part; the message names the view.
    """
    if workers is not None and workers < 1:
        raise InputError(f"workers must be at least 1, got {workers}")
    scanner = Scanner(part)

    def one(index: int) -> T:
        try:
            scan = scanner.scan(camera, viewpoints.view(index), hidden=hidden)
        except InputError as error:
            elevation, azimuth = viewpoints.elevation_deg[index], viewpoints.azimuth_deg[index]
            where = f"view {index} (elevation {elevation:g} deg, azimuth {azimuth:g} deg)"
            raise InputError(f"{where}: {error}") from error
        return transform(scan)

    # an error, or Ctrl-C, leaves the generator of `map`, which cancels the views not yet begun
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        results = pool.map(one, range(len(viewpoints)))
        bar = tqdm(results, "scanning", len(viewpoints), unit="view", disable=not progress)
        return list(bar)


def _window(camera: Camera, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows, i64, of the smallest image rectangle that contains the projected part.

    Its margin of one pixel is for rays that float32 turns by some 1e-5 of a pixel. A part that
    reaches behind the camera has no bounded projection: every pixel.
    """
    size = np.array([camera.width, camera.height])
    first, last = np.zeros(2), size - 1.0
    if (vertices[:, 2] < 0).all():
        pixels = camera.project(vertices)
        first = np.clip(np.floor(pixels.min(axis=0)) - 1, 0, size)
        last = np.clip(np.floor(pixels.max(axis=0)) + 1, -1, size - 1)
    columns, rows = (np.arange(int(a), int(b) + 1) for a, b in zip(first, last, strict=True))
    return columns, rows


def _why_nothing_is_seen(camera: Camera, vertices: np.ndarray) -> str:
    """The message for a view without a point, from the part's vertices [V, 3] in camera frame."""
    depth = -vertices[:, 2]
    nearest, farthest = depth.min(), depth.max()
    where = f"the part lies {nearest:.1f} to {farthest:.1f} mm in front of the camera"
    if farthest <= 0:
        return "the part is behind the camera; check the sign of the pose (+z is to the camera)"
    if farthest < camera.near_mm:
        return f"{where}, before its near plane at {camera.near_mm:g} mm; move the camera away"
    if nearest > camera.far_mm:
        return f"{where}, beyond its far plane at {camera.far_mm:g} mm; move the camera closer"
    columns, rows = _window(camera, vertices)
    if not len(columns) or not len(rows):
        return f"{where}, outside its field of view; point the camera at the part's center"
    return (
        f"{where}, but no pixel's ray meets it between the clip planes at {camera.near_mm:g} and "
        f"{camera.far_mm:g} mm; it may be too small for {camera.width} x {camera.height} pixels"
    )
