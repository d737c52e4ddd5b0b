"""One picture of the part and a scan on it: what is nearer hides what is farther.

The part is shaded as in `vanejax.plotting.shading`; every point of the scan is a small disc with
its own colour, in the same depth buffer. The reader stands far away, so that a millimetre has
nearly the same length everywhere in the picture.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vanejax.cad import Part
from vanejax.plotting.clouds import draw_scale_bar, reader_direction
from vanejax.plotting.shading import shade
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Scan, Scanner, look_at
from vanejax.scans import MeasuredScan

PART_METAL = "#b4bcc8"
# part radii: a guess may be metres away, and would leave a picture of nothing
_REACH = 2.5
_FIELD_DEG = 12.0
_CLEAR = 0.02  # part radii: farther than noise and stock put a point below its surface
_SHADOW = 0.4  # light in the shadow, of full light


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """A rendered image, and where it lies in the reader's plane through the part's centre.

    Attributes:
      image: [height, width, 4] f64, 0 to 1, red, green, blue and opacity.
      extent_mm: left, right, bottom, top; the part's centre is (0, 0).
    """

    image: np.ndarray
    extent_mm: tuple[float, float, float, float]

    @property
    def width_mm(self) -> float:
        """Width of the image in the plane of the part's centre."""
        return self.extent_mm[1] - self.extent_mm[0]

    @property
    def height_per_width(self) -> float:
        """Proportions of the image."""
        return self.image.shape[0] / self.image.shape[1]


class Scene:
    """Draws one part from any side, with scans on it."""

    def __init__(self, part: Part) -> None:
        self.part = part
        self._scanner = Scanner(part)
        self._reach_mm = _REACH * part.radius
        self._distance_mm = 1.05 * part.radius / np.sin(np.radians(_FIELD_DEG) / 2)

    def frame(self, reader_from_part: np.ndarray, clouds: list[np.ndarray]) -> np.ndarray:
        """Lowest and highest (x, y) [2, 2] in mm of the part and clouds [N, 3] mm, part frame.

        Args:
          reader_from_part: [3, 3], rows right, up, towards the reader; see `reader_rotation`.
          clouds: points more than 2.5 part radii from the part's centre do not count.
        """
        pose = self._camera_from_part(reader_from_part)
        low_high = []
        for points in (
            np.asarray(self.part.mesh.vertices),
            *(cloud[self._near(cloud)] for cloud in clouds),
        ):
            if len(points):
                moved = pose.apply(points)
                flat = self._distance_mm * moved[:, :2] / -moved[:, 2:]
                low_high += [flat.min(axis=0), flat.max(axis=0)]
        low, high = np.min(low_high, axis=0), np.max(low_high, axis=0)
        pad = 0.03 * np.max(high - low)
        return np.stack([low - pad, high + pad])

    def draw(
        self,
        reader_from_part: np.ndarray,
        points: np.ndarray,
        colors: np.ndarray,
        *,
        frame: np.ndarray,
        part_color: str = PART_METAL,
        lift_mm: float = 0.0,
        pixels: int = 760,
    ) -> Picture:
        """The part, and dots where the points are.

        Args:
          reader_from_part: [3, 3], see `reader_rotation`.
          points: [N, 3] mm, part frame; 100,000 leave no gaps on a whole part.
          colors: [N, 3], 0 to 1.
          frame: [2, 2] mm, from `frame`.
          part_color: of the shaded surface.
          lift_mm: points this far below the surface are still drawn on it.
          pixels: the longer side of the image.
        """
        mm_per_pixel = float(np.max(frame[1] - frame[0])) / pixels
        half = np.ceil(np.abs(frame).max(axis=0) / mm_per_pixel).astype(int)
        fov = np.degrees(2 * np.arctan(half * mm_per_pixel / self._distance_mm))
        reach = self._reach_mm
        camera = Camera(
            width=int(2 * half[0]), height=int(2 * half[1]), fov_x_deg=fov[0], fov_y_deg=fov[1],
            near_mm=self._distance_mm - reach, far_mm=self._distance_mm + reach,
        )  # fmt: skip
        pose = self._camera_from_part(reader_from_part)
        scan = self._scanner.scan(camera, pose)
        image, depth = _shaded_part(scan, camera, part_color)
        near = self._near(points)
        _splat(image, depth, camera, pose.apply(points[near]), colors[near], lift_mm)
        first = np.floor(half + frame[0] / mm_per_pixel).astype(int)
        last = np.ceil(half + frame[1] / mm_per_pixel).astype(int)
        rows = slice(2 * half[1] - last[1], 2 * half[1] - first[1])
        box = mm_per_pixel * (np.stack([first, last]) - half)
        return Picture(
            image=image[rows, first[0] : last[0]],
            extent_mm=(box[0, 0], box[1, 0], box[0, 1], box[1, 1]),
        )

    def fuller_side(
        self,
        scan: MeasuredScan,
        part_from_camera: RigidTransform,
        *,
        yaw_deg: float,
        pitch_deg: float,
    ) -> float:
        """``yaw_deg`` or its opposite: where the part hides less of the scan from the reader.

        Args:
          scan: mm.
          part_from_camera: its pose.
          yaw_deg, pitch_deg: of `reader_rotation`.
        """
        points = part_from_camera.apply(scan.points[:: max(1, len(scan.points) // 2000)])
        free = {}
        for yaw in (yaw_deg, -yaw_deg):
            reader = reader_rotation(
                scan, self.part, part_from_camera, yaw_deg=yaw, pitch_deg=pitch_deg
            )
            towards = np.broadcast_to(reader[2], points.shape)
            hits = self._scanner.cast(points + _CLEAR * self.part.radius * towards, towards)
            free[yaw] = np.count_nonzero(hits.face < 0)
        return max(free, key=free.get)

    def _camera_from_part(self, reader_from_part: np.ndarray) -> RigidTransform:
        """The reader as a camera, so far from the part's centre that the whole part is seen."""
        back = np.array([0.0, 0.0, -self._distance_mm])
        return RigidTransform(reader_from_part, back - reader_from_part @ self.part.center)

    def _near(self, points: np.ndarray) -> np.ndarray:
        """[N] bool: which of the points [N, 3] are drawn."""
        return np.linalg.norm(points - self.part.center, axis=1) < self._reach_mm


def reader_rotation(
    scan: MeasuredScan,
    part: Part,
    part_from_camera: RigidTransform,
    *,
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
) -> np.ndarray:
    """reader_from_part [3, 3] f64, rows right, up, towards the reader: as the sensor sees it.

    Where the sensor's place is unknown, the reader looks against the mean outward normal of the
    surface that was measured; if there is no such side, as in all other pictures.

    Args:
      scan: what was measured, mm.
      part: whose frame it is.
      part_from_camera: the pose.
      yaw_deg: the picture turned about its vertical axis, as if the reader stepped to the left.
      pitch_deg: and about its horizontal axis, as if the reader stood up.
    """
    towards, up = _sensor_side(scan, part, part_from_camera)
    right = np.cross(up, towards)
    if np.linalg.norm(right) < 1e-3:
        right = np.cross(np.eye(3)[np.argmin(np.abs(towards))], towards)
    right /= np.linalg.norm(right)
    straight = np.stack([right, np.cross(towards, right), towards])
    return Rotation.from_euler("yx", [yaw_deg, pitch_deg], degrees=True).as_matrix() @ straight


def show(axes: Axes, picture: Picture) -> None:
    """The picture into axes in mm, with a bar of known length."""
    axes.imshow(picture.image, extent=picture.extent_mm, interpolation="antialiased")
    axes.set_axis_off()
    left, right, bottom, top = picture.extent_mm
    y = bottom - 0.02 * (top - bottom)
    draw_scale_bar(axes, scale_bar_mm(picture.width_mm), y, y - 0.012 * (top - bottom), "top")
    axes.set_xlim(left, right)
    axes.set_ylim(bottom - 0.09 * (top - bottom), top)


def scale_bar_mm(width_mm: float) -> float:
    """A round length, 10 to 25 % of a picture's width."""
    power = 10.0 ** np.floor(np.log10(width_mm / 4))
    return float(power * max(step for step in (1, 2, 5) if step * power <= width_mm / 4))


def _sensor_side(
    scan: MeasuredScan, part: Part, part_from_camera: RigidTransform
) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors [3], part frame: towards the reader, and what is up there."""
    rotation = np.asarray(part_from_camera.rotation, np.float64)
    some = scan.points[:: max(1, len(scan.points) // 2000)]
    if scan.sensor_origin is not None and len(some):
        sight = np.median(some, axis=0) - scan.sensor_origin
        length = np.linalg.norm(sight)
        if length > 0:
            # cameras that look along +z have y downwards
            up = np.array([0.0, -1.0 if sight[2] > 0 else 1.0, 0.0])
            return rotation @ (-sight / length), rotation @ up
    towards = reader = reader_direction()
    if len(some):
        surface, normals, _ = part.sample(4000, 0)
        nearest = cKDTree(surface).query(part_from_camera.apply(some))[1]
        mean = normals[nearest].mean(axis=0)
        # a scan from all around has no side
        if np.linalg.norm(mean) > 0.2:
            towards = mean / np.linalg.norm(mean)
    return towards, look_at(reader, np.zeros(3)).rotation[1]


def _shaded_part(scan: Scan, camera: Camera, color: str) -> tuple[np.ndarray, np.ndarray]:
    """Image [H, W, 4] and depth [H, W] mm, inf where the part is not."""
    grey = shade(scan, camera)
    image = np.zeros((camera.height * camera.width, 4))
    light = grey.reshape(-1, 3)[scan.pixel]
    # a full light leaves the colour as it is, and no shadow is so dark that it looks like one
    full = np.percentile(light, 80, axis=0)
    share = _SHADOW + (1 - _SHADOW) * light / full
    image[scan.pixel, :3] = np.clip(share * np.array(to_rgb(color)), 0, 1)
    image[scan.pixel, 3] = 1.0
    depth = np.full(camera.height * camera.width, np.inf)
    depth[scan.pixel] = -scan.points[:, 2]
    size = (camera.height, camera.width)
    return image.reshape(*size, 4), depth.reshape(size)


def _splat(
    image: np.ndarray,
    depth: np.ndarray,
    camera: Camera,
    points: np.ndarray,
    colors: np.ndarray,
    lift_mm: float,
) -> None:
    """Discs into ``image`` [H, W, 4], where ``depth`` [H, W] does not hide them.

    ``points`` [N, 3] are in the camera's frame; the size of the discs closes the gaps between
    them where they are spread over the part. Where discs overlap, a pixel gets the mean colour of
    all that lie within twice ``lift_mm`` of the nearest: the nearest alone would be the one that
    deviates most to the outside, and the picture would show a part that is too large.
    """
    if not len(points):
        return
    covered = np.count_nonzero(np.isfinite(depth))
    # discs of eight times the area: of points at random 0.03 % of the area stays free
    radius = float(np.clip(1.6 * np.sqrt(covered / len(points)), 1.0, 4.0))
    steps = np.arange(-int(radius), int(radius) + 1)
    dy, dx = (g.ravel() for g in np.meshgrid(steps, steps, indexing="ij"))
    disc = dy**2 + dx**2 <= radius**2
    columns, rows = np.floor(camera.project(points)).astype(np.int64).T
    y = rows[:, None] + dy[disc]
    x = columns[:, None] + dx[disc]
    inside = (y >= 0) & (y < camera.height) & (x >= 0) & (x < camera.width)
    which = np.broadcast_to(np.arange(len(points))[:, None], y.shape)[inside]
    pixel = (y * camera.width + x)[inside]
    away = -points[which, 2]
    nearest = np.full(depth.size, np.inf)
    np.minimum.at(nearest, pixel, away)
    seen = (away - lift_mm <= depth.ravel()[pixel]) & (away <= nearest[pixel] + 2 * lift_mm)
    pixel, which = pixel[seen], which[seen]
    count = np.bincount(pixel, minlength=depth.size)
    mean = [np.bincount(pixel, weights=c, minlength=depth.size) for c in colors[which].T]
    dotted = np.flatnonzero(count)
    flat = image.reshape(-1, 4)
    # the surface's own light keeps its shape readable below the dots
    light = flat[:, :3].sum(axis=1)
    factor = np.where(flat[:, 3] > 0, 0.72 + 0.28 * light / max(float(light.max()), 1e-6), 1.0)
    for channel in range(3):
        flat[dotted, channel] = mean[channel][dotted] / count[dotted] * factor[dotted]
    flat[dotted, 3] = 1.0
