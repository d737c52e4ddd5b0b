"""Scans as real sensors deliver them: noise, bias, steps of depth, flying pixels, holes, clutter.

The ideal ranges come from `Scanner.scan`; everything is added in the image, where it arises. The
depth camera's defaults are set after 15 scans of a short-range stereo camera (focal length 220
pixels, depth in steps of 1 mm, 2 to 8 thousand points, 1 to 2 mm rms from the CAD surface).
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from vanejax.camera import Camera, field_of_view_deg
from vanejax.errors import InputError
from vanejax.part import Part
from vanejax.rigid import RigidTransform
from vanejax.scanner import Scan, Scanner

KINDS = ("structured_light", "depth_camera", "clutter")


@dataclasses.dataclass(frozen=True)
class Sensor:
    """A camera and its errors; one scan draws what is given as a range (low, high) uniformly.

    Attributes:
      camera: pinhole model.
      noise_mm: standard deviation along the ray at 0 deg incidence; it grows with 1 / cosine.
      largest_noise_mm: where that growth ends.
      errors_at_mm: the depth at which noise and bias are as given; both grow with the square of
        the depth, as triangulation does. 0 for no growth.
      lateral_noise_mm: standard deviation across the ray, in each direction.
      steepest_deg: faces seen at a larger incidence are not measured.
      bias_mm: amplitude (standard deviation) of an error that is smooth in the image.
      bias_pixels: its correlation length.
      depth_step_mm: depths are rounded to multiples of it; 0 for none.
      flying_share: of the pixels beside a jump of depth, those that measure a mixture.
      jump_mm: what difference of neighbouring depths is a jump.
      flight_mm: the farthest that a mixture may lie behind the front surface; what flies
        farther is cut away with the background.
      blur_pixels: standard deviation of the smoothing that a matching window does to depth.
      fattened_share: of the pixels just outside the part's outline, those that a matching window
        gives the depth of the outline.
      lost_share: of the pixels, lost singly.
      holes: number of round holes.
      hole_pixels: their radius.
      cropped_share: of the points, lost at one side of the part.
      clutter_share: of the points, those of a table or a clamp; zero for none.
    """

    camera: Camera
    noise_mm: float
    largest_noise_mm: float
    lateral_noise_mm: float
    steepest_deg: float
    errors_at_mm: float = 0.0
    bias_mm: tuple[float, float] = (0.0, 0.0)
    bias_pixels: float = 20.0
    depth_step_mm: float = 0.0
    flying_share: float = 0.0
    jump_mm: float = 4.0
    flight_mm: float = 12.0
    blur_pixels: float = 0.0
    fattened_share: float = 0.0
    lost_share: float = 0.0
    holes: tuple[int, int] = (0, 0)
    hole_pixels: tuple[float, float] = (2.0, 6.0)
    cropped_share: tuple[float, float] = (0.0, 0.0)
    clutter_share: tuple[float, float] = (0.0, 0.0)


def sensor(kind: str) -> Sensor:
    """The settings of a kind of sensor, one of `KINDS`.

    Raises:
      InputError: no such kind.
    """
    if kind == "depth_camera":
        width, height, focal = 424, 240, 220.0
        return Sensor(
            camera=Camera(
                width=width,
                height=height,
                fov_x_deg=field_of_view_deg(width, focal),
                fov_y_deg=field_of_view_deg(height, focal),
                near_mm=50.0,
            ),
            noise_mm=0.3,
            largest_noise_mm=1.0,
            lateral_noise_mm=0.1,
            steepest_deg=82.0,
            errors_at_mm=230.0,
            bias_mm=(0.5, 1.5),
            depth_step_mm=1.0,
            flying_share=0.5,
            blur_pixels=1.0,
            fattened_share=0.4,
            lost_share=0.05,
            holes=(1, 5),
            hole_pixels=(2.0, 7.0),
            cropped_share=(0.0, 0.15),
        )
    if kind not in KINDS:
        raise InputError(f"no sensor kind {kind!r}; there are {', '.join(KINDS)}")
    return Sensor(
        camera=Camera(width=640, height=512, near_mm=50.0),
        noise_mm=0.05,
        largest_noise_mm=0.2,
        lateral_noise_mm=0.02,
        steepest_deg=75.0,
        clutter_share=(0.1, 0.2) if kind == "clutter" else (0.0, 0.0),
    )


def random_pose(rng: np.random.Generator, part: Part, distance_mm: float) -> RigidTransform:
    """camera_from_part: uniformly random in SO(3), the part's centre ``distance_mm`` away.

    The centre lies up to 3 % of the distance off the optical axis, in x and in y.

    Raises:
      InputError: the camera would stand inside the part's sphere.
    """
    if not part.radius < distance_mm < math.inf:
        raise InputError(
            f"a camera {distance_mm!r} mm from the centre of {part.name} is not outside of it; "
            f"its radius is {part.radius:.1f} mm"
        )
    rotation = Rotation.random(rng=rng).as_matrix()
    aside = rng.uniform(-0.03, 0.03, 2) * distance_mm
    center = np.array([aside[0], aside[1], -distance_mm])
    return RigidTransform(rotation, center - rotation @ part.center)


def measure(
    part: Part, scanner: Scanner, camera_from_part: RigidTransform, *, kind: str, seed: int
) -> np.ndarray:
    """One scan of the part by a real sensor.

    Args:
      part: what is scanned.
      scanner: of that part.
      camera_from_part: the pose, such as `random_pose` gives.
      kind: one of `KINDS`; "clutter" is structured light with a table or a clamp in the view.
      seed: of all errors; the same arguments give the same points.

    Returns:
      points [N, 3] f64, mm, camera frame (looking along -z), in pixel order.

    Raises:
      InputError: no such kind, or nothing of the part is measured.
    """
    settings = sensor(kind)
    scan = scanner.scan(settings.camera, camera_from_part)
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    depth = _measured_depth(settings, scan, rng)
    if settings.clutter_share[1] > 0:
        share = rng.uniform(*settings.clutter_share)
        add = _table if rng.random() < 0.5 else _clamp
        depth = add(settings, depth, camera_from_part.apply(part.mesh.vertices), share, rng)
    rows, columns = np.nonzero(np.isfinite(depth))
    if not len(rows):
        raise InputError(f"no point of {part.name} is measured from this pose")
    x, y = settings.camera.slopes(columns, rows)
    points = depth[rows, columns][:, None] * np.stack([x, y, np.full_like(x, -1.0)], axis=-1)
    points[:, :2] += settings.lateral_noise_mm * rng.standard_normal((len(points), 2))
    return points


def _image(camera: Camera, scan: Scan, values: np.ndarray) -> np.ndarray:
    """[height, width] f64 with NaN where the scan has no point."""
    image = np.full(camera.height * camera.width, np.nan)
    image[scan.pixel] = values
    return image.reshape(camera.height, camera.width)


def _measured_depth(settings: Sensor, scan: Scan, rng: np.random.Generator) -> np.ndarray:
    """[height, width] f64: measured depths in mm, NaN where there is none."""
    camera = settings.camera
    depth = _image(camera, scan, -scan.points[:, 2].astype(np.float64))
    incidence = _image(camera, scan, scan.incidence_deg)
    along = _image(camera, scan, -scan.points[:, 2] / scan.range_mm)  # depth per mm of range
    flying = _flying(settings, depth, rng)
    depth = _blurred(settings, depth)
    sigma = settings.noise_mm / np.maximum(np.cos(np.radians(incidence)), 1e-3)
    error = np.minimum(sigma, settings.largest_noise_mm) * rng.standard_normal(depth.shape)
    error += rng.uniform(*settings.bias_mm) * _smooth(depth.shape, settings.bias_pixels, rng)
    if settings.errors_at_mm:
        error *= (depth / settings.errors_at_mm) ** 2
    measured = depth + error * along
    steep = incidence > settings.steepest_deg
    measured[steep & ~(flying > 0)] = np.nan
    measured += flying
    measured = _fattened(measured, settings.fattened_share, rng)
    measured[rng.random(depth.shape) < settings.lost_share] = np.nan
    _drop_holes(settings, measured, rng)
    _crop(measured, rng.uniform(*settings.cropped_share), rng)
    if settings.depth_step_mm:
        measured = settings.depth_step_mm * np.round(measured / settings.depth_step_mm)
    return measured


def _smooth(shape: tuple[int, ...], pixels: float, rng: np.random.Generator) -> np.ndarray:
    """A random field of mean 0 and standard deviation 1 over many draws, smooth over ``pixels``."""
    # coarse: white noise on a grid half as wide as the correlation, interpolated by cubic splines
    step = pixels / 2
    coarse = rng.standard_normal([int(n / step) + 4 for n in shape])
    coarse = ndimage.gaussian_filter(coarse, 1.0, mode="wrap") * (2 * math.sqrt(math.pi))
    start = rng.uniform(0, 2, len(shape))
    grid = np.meshgrid(
        *(s + np.arange(n) / step for s, n in zip(start, shape, strict=True)), indexing="ij"
    )
    return ndimage.map_coordinates(coarse, grid, order=3, mode="nearest")


def _blurred(settings: Sensor, depth: np.ndarray) -> np.ndarray:
    """The Gaussian mean of the measured depths around, but as it was beside a jump."""
    if not settings.blur_pixels:
        return depth
    seen = np.isfinite(depth)
    total = ndimage.gaussian_filter(np.where(seen, depth, 0.0), settings.blur_pixels)
    weight = ndimage.gaussian_filter(seen.astype(np.float64), settings.blur_pixels)
    mean = np.divide(total, weight, out=np.full_like(depth, np.nan), where=seen)
    return np.where(np.abs(mean - depth) < settings.jump_mm, mean, depth)


def _fattened(depth: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Pixels next to the measured ones get the nearest depth among their eight neighbours."""
    near = ndimage.minimum_filter(np.where(np.isfinite(depth), depth, np.inf), size=3)
    chosen = ~np.isfinite(depth) & np.isfinite(near) & (rng.random(depth.shape) < share)
    return np.where(chosen, near, depth)


def _flying(settings: Sensor, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """[height, width] mm by which pixels before a jump of depth mix in what is behind; else 0."""
    filled = np.where(np.isfinite(depth), depth, np.inf)
    gap = ndimage.maximum_filter(filled, size=3) - np.where(np.isfinite(depth), depth, np.nan)
    gap = np.minimum(np.nan_to_num(gap, nan=0.0, posinf=np.inf), settings.flight_mm)
    chosen = (gap > settings.jump_mm) & (rng.random(depth.shape) < settings.flying_share)
    # squared: most lie near the front surface
    return np.where(chosen, gap * rng.random(depth.shape) ** 2, 0.0)


def _drop_holes(settings: Sensor, depth: np.ndarray, rng: np.random.Generator) -> None:
    """Round patches around random measured pixels become NaN, in place."""
    for _ in range(rng.integers(settings.holes[0], settings.holes[1] + 1)):
        places = np.argwhere(np.isfinite(depth))
        if not len(places):
            return
        middle = places[rng.integers(len(places))]
        rows, columns = np.ogrid[: depth.shape[0], : depth.shape[1]]
        radius = rng.uniform(*settings.hole_pixels)
        depth[(rows - middle[0]) ** 2 + (columns - middle[1]) ** 2 < radius**2] = np.nan


def _crop(depth: np.ndarray, share: float, rng: np.random.Generator) -> None:
    """That share of the measured pixels, farthest to a random side, becomes NaN, in place."""
    angle = rng.uniform(0, 2 * math.pi)
    rows, columns = np.nonzero(np.isfinite(depth))
    order = np.argsort(rows * math.sin(angle) + columns * math.cos(angle), kind="stable")
    lost = order[: int(share * len(order))]
    depth[rows[lost], columns[lost]] = np.nan


def _plane_depth(camera: Camera, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """[height, width]: depth of a plane along each pixel's ray; NaN behind the camera."""
    x, y = camera.slopes(np.arange(camera.width), np.arange(camera.height)[:, None])
    closing = normal[0] * x + normal[1] * y - normal[2]
    depth = np.dot(normal, point) / np.where(closing == 0, np.nan, closing)
    return np.where((depth > camera.near_mm) & (depth < camera.far_mm), depth, np.nan)


def _count(measured: np.ndarray, share: float) -> int:
    """How many points make up that share of the scan when added to the measured ones."""
    return round(share / (1 - share) * np.count_nonzero(np.isfinite(measured)))


def _table(
    settings: Sensor,
    depth: np.ndarray,
    vertices: np.ndarray,
    share: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """The part lies on a plane that is seen, in a patch, where the part does not hide it."""
    normal = rng.standard_normal(3)
    normal[2] = 1 + abs(normal[2])  # at most some 55 deg from the viewing direction
    normal /= np.linalg.norm(normal)
    foot = vertices[np.argmin(vertices @ normal)]
    plane = _plane_depth(settings.camera, foot, normal)
    plane += settings.noise_mm * rng.standard_normal(plane.shape)
    # not where the part stands but was not measured
    free = ndimage.binary_dilation(np.isfinite(depth), iterations=2)
    plane[ndimage.binary_fill_holes(free)] = np.nan
    rows, columns = np.nonzero(np.isfinite(plane))
    there = np.argwhere(np.isfinite(depth))
    middle = there[rng.integers(len(there))]
    order = np.argsort(np.hypot(rows - middle[0], columns - middle[1]), kind="stable")
    seen = order[: _count(depth, share)]
    result = depth.copy()
    result[rows[seen], columns[seen]] = plane[rows[seen], columns[seen]]
    return result


def _clamp(
    settings: Sensor,
    depth: np.ndarray,
    vertices: np.ndarray,
    share: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """A jaw of a few mm before the part, square in the image, across a place of its outline."""
    del vertices
    measured = np.isfinite(depth)
    outline = np.argwhere(measured & ~ndimage.binary_erosion(measured))
    row, column = outline[rng.integers(len(outline))]
    x, y = settings.camera.slopes(column, row)
    front = depth[row, column] - rng.uniform(4, 12)
    tilt = np.append(rng.uniform(-0.3, 0.3, 2), 1.0)
    plane = _plane_depth(settings.camera, front * np.array([x, y, -1.0]), tilt)
    plane += settings.noise_mm * rng.standard_normal(plane.shape)
    rows, columns = np.ogrid[: depth.shape[0], : depth.shape[1]]
    square = np.maximum(np.abs(rows - row), np.abs(columns - column))
    seen = np.isfinite(plane) & ~(depth < plane)
    # what the jaw hides is lost, so its half width is found by trying
    for half in range(1, max(depth.shape)):
        jaw = (square <= half) & seen
        if np.count_nonzero(jaw) >= share * np.count_nonzero(jaw | measured):
            break
    return np.where(jaw, plane, depth)
