"""The virtual structured-light scanner: rays against the part.

Embree answers in float32 *which* triangle a ray hits (`embree_scene`); the range is then the exact
float64 intersection of the pixel's ray with that triangle's plane (`pixel_rays`).
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from tqdm import tqdm

from vanejax.cad.part import Part
from vanejax.cad.triangles import areas
from vanejax.errors import InputError
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Camera, Viewpoints
from vanejax.scanner.embree_scene import EmbreeScene
from vanejax.scanner.ideal_scan import Hits, Scan
from vanejax.scanner.image_window import PartEnvelope, Window
from vanejax.scanner.pixel_rays import EDGE_ON_COSINE, MeasuredPixels, PixelRays, turned

T = TypeVar("T")

RAYS_PER_STRIP = 24 * 1024  # what is computed of this many rays stays in the cache
FACES_AT_ONCE = 1 << 14
LIFT = 3e-5  # of the part's radius: several float32 roundings, to leave a point's own triangle


class Scanner:
    """Casts rays at one part. Safe to share between threads; the same call gives the same bits.

    Args:
      part: what to scan.
      surface_samples: number of surface points among which `scan` looks for hidden ones.
    """

    def __init__(self, part: Part, *, surface_samples: int = 20_000) -> None:
        self.part = part
        self._surface_samples = surface_samples
        self._center = np.asarray(part.center, np.float64)
        vertices = np.asarray(part.mesh.vertices, np.float64) - self._center
        self._radius = float(np.linalg.norm(vertices, axis=-1).max())
        self._envelope = PartEnvelope(vertices)
        self._planes = np.empty((len(part.mesh.faces), 4))
        for faces, corners in self._triangles():
            self._planes[faces] = _planes_of(corners)
        self._scene = EmbreeScene(vertices, part.mesh.faces)

    def _triangles(self) -> Iterator[tuple[slice, np.ndarray]]:
        """Faces and their corners [K, 3, 3] f64, mm, about the centre: not all at a time."""
        vertices, faces = np.asarray(self.part.mesh.vertices), np.asarray(self.part.mesh.faces)
        for first in range(0, len(faces), FACES_AT_ONCE):
            block = slice(first, min(first + FACES_AT_ONCE, len(faces)))
            yield block, vertices[faces[block]] - self._center

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """First intersections of any rays with the part, seen from outside.

        A ray that first meets the back of a face misses: it started inside the solid, or slipped in
        at a vertex, which Embree's robust mode prevents at edges only. Open surfaces are seen from
        both sides. Origins, mm, and directions, of any length, are [N, 3] in the part's frame;
        other shapes, and a direction that is zero or not finite, raise InputError.
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
        """`cast` without its checks, for the inner loop of a registration; [...] in place of [N].

        Origins [..., 3] f64 mm, about the part's centre, broadcast against unit directions.
        """
        # jump to just before the part's bounding sphere, where float32 is finest
        skip = -np.einsum("...i,...i->...", origins, directions) - 1.01 * self._radius
        starts = origins + np.maximum(skip, 0)[..., None] * directions
        face = self._scene.first_face(starts.reshape(-1, 3), directions.reshape(-1, 3))
        face = face.reshape(directions.shape[:-1])
        planes = self._planes.take(face, axis=0, mode="wrap")  # of any face where none is hit
        normals = np.ascontiguousarray(planes[..., :3])
        closing = np.einsum("...i,...i->...", normals, directions)
        gap = planes[..., 3] - np.einsum("...i,...i->...", normals, origins)
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
        """One view of the part from a pose of `Viewpoints.view`; ``hidden`` for `Scan.hidden`.

        The clip planes work as a renderer's do (the paper renders with PCL): what lies before the
        near plane is cut away, and what stood behind it is seen, if need be from its inside.
        InputError if no pixel sees the part (it says why), or the camera stands inside the part.
        """
        rotation = np.asarray(camera_from_part.rotation, np.float64)
        translation = np.asarray(camera_from_part.translation, np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise InputError(f"a scan needs one pose, got rotations of shape {rotation.shape}")
        label = RigidTransform(rotation, translation)
        # "local" is the part's frame moved to the part's centre
        camera_from_local = RigidTransform(rotation, translation + rotation @ self._center)
        self._refuse_camera_inside(camera_from_local)
        measured = self._measure(camera, camera_from_local)
        if not len(measured.pixel):
            depth_mm = -label.apply(np.asarray(self.part.mesh.vertices))[:, 2]
            windows = self._windows(camera, camera_from_local)
            raise InputError(_why_nothing_is_seen(camera, depth_mm, windows))
        return Scan(
            points=measured.points,
            normals=measured.normals,
            face=measured.face,
            pixel=measured.pixel,
            camera_from_part=label,
            hidden=self._hidden(camera, camera_from_local) if hidden else None,
        )

    def _measure(self, camera: Camera, camera_from_local: RigidTransform) -> MeasuredPixels:
        """What the pixels see, strip by strip of the image."""
        windows = self._windows(camera, camera_from_local)
        rays = self._rays(camera, camera_from_local)
        measured = MeasuredPixels(sum(window.size for window in windows))
        # to turn every plane once is cheaper than one for each hit, unless they are more
        once = len(self._planes) <= len(measured.pixel)
        planes = rays.facing(self._planes) if once else self._planes
        for window in windows:
            face = self._scene.first_face(*rays.through(window))
            hit = np.flatnonzero(face >= 0)
            face = face.take(hit)
            plane = planes.take(face, axis=0)
            measured.add(rays, *window.pixels(hit), face, plane if once else rays.facing(plane))
        measured.cut()
        return measured

    def _windows(self, camera: Camera, camera_from_local: RigidTransform) -> list[Window]:
        """The strips of the image in which the part may be seen."""
        return self._envelope.windows(camera, camera_from_local, pixels=RAYS_PER_STRIP)

    def _rays(self, camera: Camera, camera_from_local: RigidTransform) -> PixelRays:
        """The view's rays, from the near plane or just before the part, whichever is farther."""
        corners = camera_from_local.apply(self._envelope.corners)
        nearest = -corners[:, 2].max()
        cut_open = nearest < camera.near_mm and self._nearest_mm(camera_from_local) < camera.near_mm
        return PixelRays(
            camera,
            camera_from_local,
            start_mm=max(camera.near_mm, nearest),
            farthest_mm=np.linalg.norm(corners, axis=-1).max(),
            # the back of a solid that is whole means that a ray slipped in through a vertex, as in
            # `cast`
            backs=cut_open or not self.part.closed,
        )

    def _nearest_mm(self, camera_from_local: RigidTransform) -> float:
        """The depth of the part's nearest vertex."""
        back = camera_from_local.rotation[2]
        along = (np.asarray(self.part.mesh.vertices) - self._center) @ back
        return float(-along.max() - camera_from_local.translation[2])

    @functools.cached_property
    def _surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Area-uniform points [S, 3] about the part's centre, and their normals [S, 3]; f64."""
        points, normals, _ = self.part.sample(self._surface_samples, 0)
        return points - self._center, normals

    def _hidden(self, camera: Camera, camera_from_local: RigidTransform) -> np.ndarray:
        """The surface samples [H, 3] f32, camera frame, that this view does not see.

        A sample is seen when it lies between the clip planes, projects into the image, is not
        edge-on, and the way from it to the near plane is free; that of one that faces away is not.
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
        lifted = points + (LIFT * self._radius * np.sign(cosine))[:, None] * normals
        local_from_camera = camera_from_local.inverse()
        blocked = self._scene.is_blocked(
            local_from_camera.apply(lifted),
            local_from_camera.rotate(towards),
            -lifted[:, 2] - camera.near_mm,
        )
        seen = inside
        seen[inside] = ~blocked & (np.abs(cosine) > EDGE_ON_COSINE)
        return camera_from_local.apply(points_local[~seen]).astype(np.float32)

    def lit(self, scan: Scan, towards: np.ndarray) -> np.ndarray:
        """[N] bool, whether a light reaches a scan's points; it lies ``towards`` [N, 3] f32 mm.

        What stands in between shades the point, on its own face too.
        """
        lit = np.einsum("ni,ni->n", scan.normals, towards) > 0
        facing = np.flatnonzero(lit)
        center = scan.camera_from_part.apply(self._center[None])
        starts = scan.points.take(facing, axis=0) - center.astype(np.float32)
        starts += np.float32(LIFT * self._radius) * scan.normals.take(facing, axis=0)
        turn = scan.camera_from_part.rotation.astype(np.float32)
        ways = turned(towards.take(facing, axis=0), turn)
        lit[facing] = ~self._scene.is_blocked(turned(starts, turn), ways, np.ones(len(facing)))
        return lit

    def _refuse_camera_inside(self, camera_from_local: RigidTransform) -> None:
        """Raises InputError for a camera that sees the back of the face that looks largest."""
        eye = camera_from_local.inverse().translation
        if np.linalg.norm(eye) > self._radius:
            return
        largest, direction = 0.0, np.ones((1, 3))
        for faces, corners in self._triangles():
            middle = corners.mean(axis=1) - eye
            distance = np.maximum(np.linalg.norm(middle, axis=-1), 1e-6 * self._radius)
            towards = np.abs(np.einsum("ni,ni->n", self._planes[faces, :3], middle))
            solid_angle = areas(corners) * towards / distance**3
            face = np.argmax(solid_angle)
            if solid_angle[face] > largest:
                largest, direction = solid_angle[face], middle[[face]]
        face = self._scene.first_face(eye[None], direction)[0]
        if face >= 0 and self._planes[face, :3] @ direction[0] > 0:
            raise InputError(
                f"the camera at {np.round(eye + self._center, 3)} mm (part frame) is inside the "
                f"part {self.part.name}; move it at least camera.near_mm away"
            )


def _planes_of(corners: np.ndarray) -> np.ndarray:
    """Planes [K, 4] f64 of triangles [K, 3, 3]: outward unit normal and distance, mm."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    # a triangle without area has no normal; zero makes it edge-on to every ray
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return np.column_stack([normals, np.einsum("ni,ni->n", normals, a)])


def _why_nothing_is_seen(camera: Camera, depth_mm: np.ndarray, windows: list[Window]) -> str:
    """The message for a view without a point, from the depths [V] of the part's vertices."""
    nearest, farthest = depth_mm.min(), depth_mm.max()
    where = f"the part lies {nearest:.1f} to {farthest:.1f} mm in front of the camera"
    if farthest <= 0:
        return "the part is behind the camera; check the sign of the pose (+z is to the camera)"
    if farthest < camera.near_mm:
        return f"{where}, before its near plane at {camera.near_mm:g} mm; move the camera away"
    if nearest > camera.far_mm:
        return f"{where}, beyond its far plane at {camera.far_mm:g} mm; move the camera closer"
    if not windows:
        return f"{where}, outside its field of view; point the camera at the part's center"
    return (
        f"{where}, but no pixel's ray meets it between the clip planes at {camera.near_mm:g} and "
        f"{camera.far_mm:g} mm; it may be too small for {camera.width} x {camera.height} pixels"
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

    A view of 200,000 points takes 6 MB, so 216 of them do not belong in memory: ``transform`` is
    applied to each scan in the thread that made it, and only its result is kept.

    Args:
      part, camera, viewpoints: what is seen, by what, and from where.
      transform: from `Scan` to what is kept of it, such as a thinned cloud; runs in threads.
      hidden: whether `Scan.hidden` is wanted.
      workers: number of threads; None for one per core. Does not change the result.
      progress: whether to show a progress bar.

    The results are in the order of the viewpoints. A view that does not see the part raises
    InputError that names it.
    """
    if workers is not None and workers < 1:
        raise InputError(f"workers must be at least 1, got {workers}")
    scanner = Scanner(part)

    def scan_view(index: int) -> T:
        try:
            scan = scanner.scan(camera, viewpoints.view(index), hidden=hidden)
        except InputError as error:
            elevation, azimuth = viewpoints.elevation_deg[index], viewpoints.azimuth_deg[index]
            where = f"view {index} (elevation {elevation:g} deg, azimuth {azimuth:g} deg)"
            raise InputError(f"{where}: {error}") from error
        return transform(scan)

    # an error, or Ctrl-C, leaves the generator of `map`, which cancels the views not yet begun
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        results = pool.map(scan_view, range(len(viewpoints)))
        bar = tqdm(results, "scanning", len(viewpoints), unit="view", disable=not progress)
        return list(bar)
