"""What a sensor makes of ideal hits: holes with their reasons, noise and bias.

Pure and seeded. A sensor without effects gives the ideal scan bit for bit.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import math

import numpy as np

from vanejax.rigid import RigidTransform
from vanejax.scanner.exposure import Exposure
from vanejax.scanner.range_errors import jumps, mixed_disparity, rim, smooth_field, windowed
from vanejax.scanner.sensor import Sensor
from vanejax.scanner.virtual_scanner import Scan, Scanner


class Reason(enum.IntEnum):
    """Why a pixel measures nothing; the first reason that holds is given."""

    MEASURED = 0
    SHADOWED = 1
    """The projector does not light what the pixel sees."""
    GRAZING = 2
    """The surface is seen too flat."""
    SATURATED = 3
    """Too bright: a highlight, a strong lamp, a long exposure."""
    DARK = 4
    """Too little of the projector's light comes back."""
    LOST = 5
    """No match was found: singly, or along the part's outline."""
    OUT_OF_RANGE = 6
    """Measured before the near or behind the far clip plane."""
    NOTHING = 7
    """No surface in the pixel's way; in organised arrays only."""


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
    def clean_range_mm(self) -> np.ndarray:
        """[n] f32, mm from the camera, of the ideal scan."""
        return self.ideal.range_mm[self.kept]

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
    """One scan of the part by a sensor: `Scanner.scan`, then `sensed`.

    Raises:
      InputError: no pixel sees the part.
    """
    return sensed(scanner, scanner.scan(sensor.camera, camera_from_part), sensor, rng)


def sensed(scanner: Scanner, scan: Scan, sensor: Sensor, rng: np.random.Generator) -> Measurement:
    """What a sensor makes of an ideal scan by its own camera.

    Args:
      scanner: that made the scan: it casts the shadows.
      scan: N pixels.
      sensor: whose camera made it.
      rng: of all that is random; the same state gives the same bits.
    """
    return _Sensing(scanner, scan, sensor, rng).measurement()


class _Sensing:
    """One scan on its way through the sensor."""

    def __init__(
        self, scanner: Scanner, scan: Scan, sensor: Sensor, rng: np.random.Generator
    ) -> None:
        self.scanner, self.scan, self.sensor, self.rng = scanner, scan, sensor, rng
        self.reason = np.zeros(len(scan.points), np.uint8)
        self.noise_growth: np.ndarray | None = None

    def measurement(self) -> Measurement:
        sensor = self.sensor
        self._drop_dark()
        if sensor.dropout_rate:
            lost = self.rng.random(len(self.reason), dtype=np.float32) < sensor.dropout_rate
            self._drop(lost, Reason.LOST)
        if sensor.border_dropout_px:
            self._drop(self._at_outline(), Reason.LOST)
        kept = np.flatnonzero(self.reason == Reason.MEASURED)
        points = self._measured(kept)
        depth = -points[:, 2]
        inside = (depth >= sensor.camera.near_mm) & (depth <= sensor.camera.far_mm)
        self.reason[kept[~inside]] = Reason.OUT_OF_RANGE
        return Measurement(sensor, self.scan, self.reason, points[inside])

    def _drop(self, which: np.ndarray, reason: Reason) -> None:
        self.reason[which & (self.reason == Reason.MEASURED)] = reason

    def _at_outline(self) -> np.ndarray:
        """[N] bool, the pixels whose window holds too much of what is not the part."""
        row, column = self._places()
        return rim(row, column, self.sensor.border_dropout_px * (1 + self._field(row, column)))

    def _places(self, which: slice | np.ndarray = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the pixels [N], or of some of them."""
        return np.divmod(self.scan.pixel[which], np.int32(self.sensor.camera.width))

    def _field(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """[N] f32: a new random field as smooth as the correlated error."""
        return smooth_field(self.rng, row, column, length_px=self.sensor.correlation_px)

    def _drop_dark(self) -> None:
        """Shadow, grazing incidence and exposure."""
        sensor, scan = self.sensor, self.scan
        points, normals = scan.points, scan.normals
        to_projector = np.float32([sensor.baseline_mm, 0, 0]) - points
        if sensor.shadow:
            lit = self.scanner.lit(points, normals, to_projector, scan.camera_from_part)
            self._drop(~lit, Reason.SHADOWED)
        if sensor.max_incidence_deg < 90:
            inverse = 1 / np.sqrt(np.einsum("ni,ni->n", points, points))
            cosine = -np.einsum("ni,ni->n", points, normals) * inverse
            if sensor.incidence_spread_deg:
                limit = sensor.max_incidence_deg + sensor.incidence_spread_deg * self._field(
                    *self._places()
                )
                least = np.cos(np.radians(np.clip(limit, 0, 90)))
            else:
                least = np.float32(math.cos(math.radians(sensor.max_incidence_deg)))
            self._drop(cosine < least, Reason.GRAZING)
        if sensor.exposure is not None:
            self._expose(sensor.exposure, to_projector)

    def _expose(self, exposure: Exposure, to_projector: np.ndarray) -> None:
        scan = self.scan
        to_camera = -scan.points
        to_camera /= np.sqrt(np.einsum("ni,ni->n", to_camera, to_camera))[:, None]
        distance = np.sqrt(np.einsum("ni,ni->n", to_projector, to_projector))
        way = to_projector / distance[:, None]
        shine = exposure.reflected(scan.normals, to_camera, way)
        modulation = exposure.modulation(shine, distance)
        total = modulation
        if exposure.ambient_per_ms:
            lamp = np.float32(exposure.ambient_towards)
            lamp /= np.linalg.norm(lamp)
            ambient = exposure.ambient(exposure.reflected(scan.normals, to_camera, lamp))
            total = modulation + ambient
        self._drop(total >= 1, Reason.SATURATED)
        self._drop(modulation < exposure.least_modulation, Reason.DARK)
        self.noise_growth = exposure.noise_growth(modulation, total)

    def _measured(self, kept: np.ndarray) -> np.ndarray:
        """Points [n, 3] f32 of the kept pixels [n], with all errors."""
        sensor = self.sensor
        points = self.scan.points.take(kept, axis=0)
        depth = -points[:, 2]
        measured = self._triangulated(depth, kept)
        if sensor.trueness is not None:
            camera = sensor.camera
            row, column = self._places(kept)
            x = (column + np.float32(0.5)) / np.float32(camera.width / 2) - 1
            y = (row + np.float32(0.5)) / np.float32(camera.height / 2) - 1
            measured = measured + sensor.trueness.error_mm(measured, x, y).astype(np.float32)
        if sensor.outlier_rate:
            far = np.flatnonzero(self.rng.random(len(kept), dtype=np.float32) < sensor.outlier_rate)
            measured = measured.copy()
            measured[far] += np.float32(sensor.outlier_mm) * (
                2 * self.rng.random(len(far), dtype=np.float32) - 1
            )
        if sensor.depth_quantisation_mm:
            step = np.float32(sensor.depth_quantisation_mm)
            measured = step * np.round(measured / step)
        if measured is not depth:
            points *= (measured / depth)[:, None]
        if sensor.lens is not None:
            camera = sensor.camera
            x, y = points[:, 0] / measured, points[:, 1] / measured
            for axis, shift in enumerate(sensor.lens.shifts(x, y, fx=camera.fx, fy=camera.fy)):
                points[:, axis] += (measured * shift).astype(np.float32)
        return points

    def _window_shifts(self) -> np.ndarray:
        """[N] f32 pixels: what the matching window adds to the disparity of all that is seen."""
        sensor = self.sensor
        row, column = self._places()
        depth = -self.scan.points[:, 2]
        true = np.float32(sensor.focal_baseline) / depth
        aside = None
        if sensor.edge_fattening_px:
            aside = sensor.edge_fattening_px * np.stack(
                [self._field(row, column) for _ in range(2)]
            )
        mean = windowed(row, column, true, window_px=sensor.window_px, aside_px=aside)
        # a window over two surfaces that lie apart locks onto its own
        near = np.abs(np.float32(sensor.focal_baseline) / mean - depth) < sensor.jump_mm
        return np.where(near, mean - true, np.float32(0))

    def _triangulated(self, depth: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Depths [n] f32 from disparities with their errors; the same array without any."""
        sensor, rng = self.sensor, self.rng
        error = None
        if sensor.noise_px:
            error = np.float32(sensor.noise_px) * rng.standard_normal(len(depth), dtype=np.float32)
            if self.noise_growth is not None:
                error *= self.noise_growth.take(kept)
        if sensor.correlated_px:
            field = self._field(*self._places(kept)) * np.float32(sensor.correlated_px)
            error = field if error is None else error + field
        matched = sensor.window_px or sensor.edge_fattening_px
        if error is None and not (
            sensor.flying_pixel_rate or sensor.disparity_quantisation_px or matched
        ):
            return depth
        disparity = np.float32(sensor.focal_baseline) / depth
        if matched:
            disparity += self._window_shifts().take(kept)
        if error is not None:
            disparity += error
        if sensor.flying_pixel_rate:
            pixel = self.scan.pixel.take(kept)
            sides = jumps(pixel, depth, width=sensor.camera.width, jump_mm=sensor.jump_mm)
            mixed, added = mixed_disparity(rng, sides, disparity, share=sensor.flying_pixel_rate)
            disparity[mixed] += added
        if sensor.disparity_quantisation_px:
            step = np.float32(sensor.disparity_quantisation_px)
            disparity = step * np.round(disparity / step)
        # no depth is measured beyond the far plane, and none from a disparity that is not positive
        least = np.float32(sensor.focal_baseline / (2 * sensor.camera.far_mm))
        return np.float32(sensor.focal_baseline) / np.maximum(disparity, least)
