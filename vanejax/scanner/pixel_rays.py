"""The rays of a camera's pixels at one pose: cast in float32, measured in float64.

The ray of a pixel is (x, y, -1) in the camera frame, not a unit vector: its parameter is the depth,
and it is the sum of a column's and a row's share, which costs one addition a coordinate.

A plane is four numbers: its unit normal n, and d, mm, with ``n . p = d`` for its points p. "Local"
is the part's frame moved to the part's centre.
"""

from __future__ import annotations

import numpy as np

from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Camera
from vanejax.scanner.image_window import Window

# Faces seen at more than 89.94 deg are not measured: a float32 ray may miss their edge by 1e-5 mm,
# which along the ray would be 0.01 mm and more. No sensor measures them either.
EDGE_ON_COSINE = 1e-3
# few enough that BLAS does not start threads, which would wait for those that scan
ROWS_AT_ONCE = 1 << 14


class PixelRays:
    """The rays of all pixels of one view, which start in the plane at a depth of ``start_mm``.

    Attributes:
      camera: intrinsics; W x H pixels.
      camera_from_local: rotation [3, 3], translation [3] mm, f64.
      farthest_mm: from the camera to what may be measured, at most.
      backs: whether faces are seen from their back too.
      x, y: [W] and [H] f64, the rays' coordinates by column and by row.
      starts: [3, 1, W] and [3, H, 1] f32, mm, local: they sum to where the rays start.
      directions: [3, 1, W] and [3, H, 1] f32, local, likewise.
    """

    def __init__(
        self,
        camera: Camera,
        camera_from_local: RigidTransform,
        *,
        start_mm: float,
        farthest_mm: float,
        backs: bool,
    ) -> None:
        self.camera, self.camera_from_local = camera, camera_from_local
        self.farthest_mm, self.backs = farthest_mm, backs
        right, up, back = camera_from_local.rotation
        eye = camera_from_local.inverse().translation
        self.x, self.y = camera.slopes(np.arange(camera.width), np.arange(camera.height))
        across = np.outer(right, self.x) - back[:, None]
        down = np.outer(up, self.y)
        self.starts = _shares(eye[:, None] + start_mm * across, start_mm * down)
        self.directions = _shares(across, down)

    def through(self, window: Window) -> tuple[np.ndarray, np.ndarray]:
        """Starts and directions [N, 3] f32 of a window's rays, row by row."""
        rows, columns = window
        starts, directions = (
            across[:, :, columns] + down[:, rows] for across, down in (self.starts, self.directions)
        )
        return starts.reshape(3, -1).T, directions.reshape(3, -1).T

    def facing(self, planes: np.ndarray) -> np.ndarray:
        """Local planes [K, 4] in the camera frame, their normals turned towards the camera.

        The camera's distance from a plane whose front it sees is -d, so d is below zero then. It
        is left above zero where the camera is behind a face and sees no `backs`.
        """
        rotation, translation = self.camera_from_local.rotation, self.camera_from_local.translation
        turn = np.eye(4)
        turn[:3, :3] = rotation.T
        turn[:3, 3] = rotation.T @ translation
        facing = turned(planes, turn)
        if self.backs:
            facing *= -np.sign(facing[:, 3:])
        return facing

    def depth(
        self, x: np.ndarray, y: np.ndarray, planes: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """How deep rays (x, y) [N] meet planes [N, 4] of `facing`, and where that is measured.

        The depths, [N] f64, mm, are not finite where nothing is met. Measured, [N] bool, is what
        lies between the clip planes, unless the plane is seen edge-on or from its back.
        """
        normal_x, normal_y, normal_z, plane = planes.T
        closing = normal_x * x
        closing += normal_y * y
        closing -= normal_z
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.divide(plane, closing, out=closing)
        measured = (depth >= self.camera.near_mm) & (depth <= self.camera.far_mm)
        # the cosine is the camera's distance from the plane over the range: hardly ever so small
        doubtful = np.flatnonzero(plane >= -EDGE_ON_COSINE * self.farthest_mm)
        if len(doubtful):
            range_mm = depth[doubtful] * np.sqrt(x[doubtful] ** 2 + y[doubtful] ** 2 + 1)
            measured[doubtful] &= plane[doubtful] < -EDGE_ON_COSINE * range_mm
        return depth, measured


class MeasuredPixels:
    """The arrays of a `Scan`, which are filled strip by strip.

    They begin as long as there are rays and are cut to length in place: to copy them would cost as
    much as all arithmetic.
    """

    def __init__(self, rays: int) -> None:
        self.points = np.empty((rays, 3), np.float32)
        self.normals = np.empty((rays, 3), np.float32)
        self.face = np.empty(rays, np.int32)
        self.pixel = np.empty(rays, np.int32)
        self._count = 0

    def add(
        self,
        rays: PixelRays,
        row: np.ndarray,
        column: np.ndarray,
        face: np.ndarray,
        planes: np.ndarray,
    ) -> None:
        """Pixels [N], the face that each one's ray met, and planes [N, 4] from `PixelRays.facing`.

        What cannot be measured is left out.
        """
        x, y = rays.x.take(column), rays.y.take(row)
        depth, measured = rays.depth(x, y, planes)
        if not measured.all():
            kept = np.flatnonzero(measured)
            values = x, y, depth, row, column, face, planes
            x, y, depth, row, column, face, planes = (v.take(kept, axis=0) for v in values)
        strip = slice(self._count, self._count + len(face))
        self._count = strip.stop
        for axis, coordinate in enumerate((depth * x, depth * y, -depth)):
            self.points[strip, axis] = coordinate
        for axis in range(3):
            self.normals[strip, axis] = planes[:, axis]
        self.face[strip] = face
        self.pixel[strip] = row * np.int32(rays.camera.width) + column

    def cut(self) -> None:
        """Gives back the room that no pixel took."""
        for column in (self.points, self.normals, self.face, self.pixel):
            # unchecked, since a debugger's references would count; no array looks into this one
            column.resize((self._count, *column.shape[1:]), refcheck=False)


def turned(rows: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Rows [N, D] times ``turn`` [D, D], in blocks."""
    out = np.empty_like(rows)
    for first in range(0, len(rows), ROWS_AT_ONCE):
        block = slice(first, first + ROWS_AT_ONCE)
        np.matmul(rows[block], turn, out=out[block])
    return out


def _shares(across: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns' and rows' shares [3, W] and [3, H] as float32 that broadcast to [3, H, W]."""
    return across.astype(np.float32)[:, None], down.astype(np.float32)[:, :, None]
