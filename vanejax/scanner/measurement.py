"""What a sensor makes of ideal hits: holes with their reasons, noise and bias.

Pure and seeded. A sensor without effects gives the ideal scan bit for bit; `sensor_effects` has
the effects and their order.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from vanejax.rigid import RigidTransform
from vanejax.scanner.ideal_scan import Scan
from vanejax.scanner.sensor import Sensor
from vanejax.scanner.sensor_effects import (
    DEPTH_CHANGES,
    DISPARITY_CHANGES,
    DISPARITY_ERRORS,
    DROPOUTS,
    POINT_CHANGES,
    Reason,
    SensedView,
)
from vanejax.scanner.virtual_scanner import Scanner


@dataclasses.dataclass(frozen=True, eq=False)
class Measurement:
    """A scan as a sensor measured it, and what it would have been; N pixels see something.

    Attributes:
      sensor: that measured.
      ideal: the scan without any effect, [N].
      reason: [N] u8, a `Reason` for each pixel of ``ideal``.
      points: [n, 3] f32, mm, camera frame, of the n measured pixels in pixel order.
    """

    sensor: Sensor
    ideal: Scan
    reason: np.ndarray
    points: np.ndarray

    @functools.cached_property
    def kept(self) -> np.ndarray:
        """[n] i64, which of the N pixels are measured."""
        return np.flatnonzero(self.reason == Reason.MEASURED)

    @property
    def camera_from_part(self) -> RigidTransform:
        """The pose label."""
        return self.ideal.camera_from_part

    @property
    def normals(self) -> np.ndarray:
        """[n, 3] f32, unit, camera frame: of the surface, not of the measured points."""
        return self.ideal.normals[self.kept]

    @property
    def face(self) -> np.ndarray:
        """[n] i32, the triangles that were measured."""
        return self.ideal.face[self.kept]

    @property
    def pixel(self) -> np.ndarray:
        """[n] i32, ``row * width + column``."""
        return self.ideal.pixel[self.kept]

    @property
    def range_mm(self) -> np.ndarray:
        """[n] f32, mm from the camera, measured."""
        return np.linalg.norm(self.points.astype(np.float64), axis=-1).astype(np.float32)

    @property
    def hole_share(self) -> float:
        """Share of the N pixels that are not measured."""
        return 1 - len(self.kept) / max(1, len(self.reason))

    def organised(self) -> dict[str, np.ndarray]:
        """Arrays of the image's shape [H, W]; NaN, or -1 for faces, where there is nothing.

        ``points`` [H, W, 3] and ``range_mm`` are measured; ``clean_range_mm``, ``incidence_deg``
        and ``face`` are those of the ideal scan; ``reason`` is u8.
        """
        camera, ideal = self.sensor.camera, self.ideal
        size = camera.width * camera.height

        def image(values: np.ndarray, pixel: np.ndarray, empty: float) -> np.ndarray:
            full = np.full((size, *values.shape[1:]), empty, values.dtype)
            full[pixel] = values
            return full.reshape(camera.height, camera.width, *values.shape[1:])

        return {
            "points": image(self.points, self.pixel, np.nan),
            "range_mm": image(self.range_mm, self.pixel, np.nan),
            "clean_range_mm": image(ideal.range_mm, ideal.pixel, np.nan),
            "incidence_deg": image(ideal.incidence_deg, ideal.pixel, np.nan),
            "face": image(ideal.face, ideal.pixel, -1),
            "reason": image(self.reason, ideal.pixel, Reason.NOTHING),
        }


def measure(
    scanner: Scanner, sensor: Sensor, camera_from_part: RigidTransform, rng: np.random.Generator
) -> Measurement:
    """One scan of the part by a sensor: `Scanner.scan`, then what the sensor makes of it.

    The same state of ``rng`` gives the same bits. InputError if no pixel sees the part.
    """
    scan = scanner.scan(sensor.camera, camera_from_part)
    view = SensedView(scanner, scan, sensor, rng)
    reason = np.zeros(len(scan.points), np.uint8)
    for why, dropout, field in DROPOUTS:
        if getattr(sensor, field):
            reason[dropout(view) & (reason == Reason.MEASURED)] = why
    kept = np.flatnonzero(reason == Reason.MEASURED)
    points = _points_with_errors(view, kept)
    depth = -points[:, 2]
    inside = (depth >= sensor.camera.near_mm) & (depth <= sensor.camera.far_mm)
    reason[kept[~inside]] = Reason.OUT_OF_RANGE
    return Measurement(sensor, scan, reason, points[inside])


def _points_with_errors(view: SensedView, kept: np.ndarray) -> np.ndarray:
    """Points [n, 3] f32 mm of the pixels ``kept`` [n] i64."""
    points = view.scan.points.take(kept, axis=0)
    true_depth = -points[:, 2]
    depth = _triangulated(view, kept, true_depth)
    for change in view.active(DEPTH_CHANGES):
        depth = change(view, kept, depth)
    if depth is not true_depth:
        points *= (depth / true_depth)[:, None]
    for change in view.active(POINT_CHANGES):
        points = change(view, points, depth)
    return points


def _triangulated(view: SensedView, kept: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Depths [n] f32 mm from disparities with their errors; the same array where there are none."""
    errors = [error(view, kept) for error in view.active(DISPARITY_ERRORS)]
    changes = view.active(DISPARITY_CHANGES)
    if not (errors or changes):
        return depth
    focal_baseline = np.float32(view.sensor.focal_baseline)
    disparity = focal_baseline / depth
    # the first that is drawn is added last: recorded scans hold this order of rounding
    for error in reversed(errors):
        disparity = disparity + error
    for change in changes:
        disparity = change(view, kept, disparity)
    # no depth is measured beyond the far plane, and none from a disparity that is not positive
    least = np.float32(view.sensor.focal_baseline / (2 * view.sensor.camera.far_mm))
    return focal_baseline / np.maximum(disparity, least)
