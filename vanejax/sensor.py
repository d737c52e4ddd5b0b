"""What a structured-light camera makes of ideal hits: holes, noise and bias, each with its unit.

A projector stands beside the camera, ``baseline_mm`` along the camera's +x; what it does not light
is not measured. The rest is triangulated: errors of the disparity in pixels become errors of the
depth that grow with its square (`range_errors`), and light that is too much or too little leaves
holes (`exposure`). Every effect has its own switch, and a sensor without effects gives the ideal
scan bit for bit.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import math

import numpy as np

from vanejax.camera import Camera
from vanejax.errors import InputError
from vanejax.exposure import REFERENCE_MM, Exposure
from vanejax.range_errors import (
    Lens,
    Trueness,
    jumps,
    mixed_disparity,
    rim,
    smooth_field,
    windowed,
)
from vanejax.rigid_transform import RigidTransform
from vanejax.scanner import Scan, Scanner


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


@dataclasses.dataclass(frozen=True)
class Sensor:
    """A structured-light camera; the defaults are an ideal one.

    Attributes:
      camera: intrinsics and clip planes.
      baseline_mm: from the camera to the projector, along the camera's +x (negative: to its left).
      shadow: whether what the projector does not see is left out.
      most_incidence_deg: surfaces seen flatter are not measured; 90 for no limit.
      incidence_spread_deg: standard deviation of that limit from place to place, smooth over
        ``correlation_px``.
      exposure: light and shine; None: every surface is bright enough and none too bright.
      noise_px: standard deviation of the disparity, white; at `Exposure.reference_signal` if there
        is an exposure.
      correlated_px: standard deviation of an error of the disparity that is smooth in the image,
        and new in every scan.
      correlation_px: its length, see `range_errors.smooth_field`.
      window_px: the matching window of a stereo camera, as the standard deviation of a Gaussian: it
        rounds edges off, see `range_errors.windowed`; 0 for a camera that codes single pixels.
      adhesion_px: standard deviation, in columns and in rows, of how far beside its pixel the
        texture lies that a window matched; smooth over ``correlation_px``. The error grows with the
        slope of the surface.
      rim_px: how wide a strip along the part's outline finds no match, on average; its width
        varies as the correlated error does, see `range_errors.rim`.
      mixed_share: of the places where the depth jumps, those where a pixel mixes both sides.
      jump_mm: what difference of neighbouring depths is a jump.
      step_px, step_mm: disparities, and depths, are rounded to multiples of it; 0 for none.
      lens: what calibration leaves of the lens; None for nothing.
      trueness: what it leaves of the depth; None for nothing.
      lost_share: of the pixels, lost singly.
      outlier_share: of the measured points, those that lie anywhere within ``outlier_mm`` of depth.
      outlier_mm: largest error of an outlier.

    Raises:
      InputError: a value that no sensor can have.
    """

    camera: Camera = dataclasses.field(default_factory=Camera)
    baseline_mm: float = 120.0
    shadow: bool = False
    most_incidence_deg: float = 90.0
    incidence_spread_deg: float = 0.0
    exposure: Exposure | None = None
    noise_px: float = 0.0
    correlated_px: float = 0.0
    correlation_px: float = 16.0
    window_px: float = 0.0
    adhesion_px: float = 0.0
    rim_px: float = 0.0
    mixed_share: float = 0.0
    jump_mm: float = 2.0
    step_px: float = 0.0
    step_mm: float = 0.0
    lens: Lens | None = None
    trueness: Trueness | None = None
    lost_share: float = 0.0
    outlier_share: float = 0.0
    outlier_mm: float = 20.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.baseline_mm) and self.baseline_mm):
            raise InputError(f"sensor: baseline_mm={self.baseline_mm!r} must be a length, not 0")
        if not 0 < self.most_incidence_deg <= 90:
            raise InputError(
                f"sensor: most_incidence_deg={self.most_incidence_deg!r} must lie in (0, 90]"
            )
        for name in (
            "noise_px",
            "correlated_px",
            "incidence_spread_deg",
            "window_px",
            "adhesion_px",
            "rim_px",
            "step_px",
            "step_mm",
            "outlier_mm",
            "jump_mm",
        ):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"sensor: {name}={getattr(self, name)!r} must be 0 or more")
        if not 1 <= self.correlation_px < math.inf:
            raise InputError(f"sensor: correlation_px={self.correlation_px!r} must be 1 or more")
        for name in ("mixed_share", "lost_share", "outlier_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(
                    f"sensor: {name}={getattr(self, name)!r} must be a share from 0 to 1"
                )

    @property
    def focal_baseline(self) -> float:
        """Focal length times baseline, pixels times mm: the depth times the disparity."""
        return self.camera.fx * abs(self.baseline_mm)

    def range_sigma_mm(self, depth_mm: float) -> float:
        """Standard deviation of the depth that ``noise_px`` makes: ``z^2 / (f b) noise_px``."""
        return depth_mm**2 / self.focal_baseline * self.noise_px

    def scaled(self, factor: float) -> Sensor:
        """The same errors in mm with ``factor`` times the pixels per side."""
        factors = self.camera.scaled(factor).width / self.camera.width
        lens = self.lens
        if lens is not None:
            columns, rows = lens.center_error_px
            lens = dataclasses.replace(lens, center_error_px=(columns * factors, rows * factors))
        return dataclasses.replace(
            self,
            camera=self.camera.scaled(factor),
            noise_px=self.noise_px * factors,
            correlated_px=self.correlated_px * factors,
            correlation_px=max(1.0, self.correlation_px * factors),
            window_px=self.window_px * factors,
            adhesion_px=self.adhesion_px * factors,
            rim_px=self.rim_px * factors,
            step_px=self.step_px * factors,
            lens=lens,
        )

    def exposed_for(self, distance_mm: float) -> Sensor:
        """The same with the exposure that a part at this distance needs.

        An exposure that suits 400 mm is longer by the square of the distance: the projector's light
        spreads.
        """
        if self.exposure is None:
            return self
        factor = (distance_mm / REFERENCE_MM) ** 2
        exposure = dataclasses.replace(
            self.exposure, exposure_ms=factor * self.exposure.exposure_ms
        )
        return dataclasses.replace(self, exposure=exposure)

    def another(self, rng: np.random.Generator, *, spread: float = 0.3) -> Sensor:
        """Another camera of this kind, as its maker's next one would be.

        Errors of calibration are normally distributed with this sensor's as standard deviations;
        all other magnitudes, light and finish of the surface among them, are multiplied by the
        exponential of a normal number of standard deviation ``spread``. Settings of the matching,
        such as its window, stay.
        """

        def vary(value: float) -> float:
            return value * math.exp(spread * rng.standard_normal())

        def normal(value: float) -> float:
            return value * rng.standard_normal()

        exposure, lens, trueness = self.exposure, self.lens, self.trueness
        if exposure is not None:
            exposure = dataclasses.replace(
                exposure,
                exposure_ms=vary(exposure.exposure_ms),
                ambient_per_ms=vary(exposure.ambient_per_ms),
                ambient_towards=(*rng.standard_normal(2), abs(rng.standard_normal()) + 0.3),
                specular=min(1.0, vary(exposure.specular)),
                roughness=vary(exposure.roughness),
            )
        if lens is not None:
            lens = Lens(
                *(normal(value) for value in (lens.k1, lens.k2, lens.p1, lens.p2)),
                focal_error=normal(lens.focal_error),
                center_error_px=tuple(normal(value) for value in lens.center_error_px),
            )
        if trueness is not None:
            trueness = Trueness(
                scale=normal(trueness.scale),
                bend_mm=tuple(normal(value) for value in trueness.bend_mm),
            )
        return dataclasses.replace(
            self,
            exposure=exposure,
            lens=lens,
            trueness=trueness,
            noise_px=vary(self.noise_px),
            correlated_px=vary(self.correlated_px),
            correlation_px=max(1.0, vary(self.correlation_px)),
            mixed_share=min(1.0, vary(self.mixed_share)),
            lost_share=min(1.0, vary(self.lost_share)),
            outlier_share=min(1.0, vary(self.outlier_share)),
        )


def ideal() -> Sensor:
    """The paper's virtual camera: a z-buffer."""
    return Sensor()


def paper_camera() -> Sensor:
    """The structured-light camera of the paper's Table 2, good to 0.1 mm at 300 and 1 at 1300 mm.

    That is read as a bound on 95 % of the errors, noise and trueness together; what the table does
    not say (baseline, light, calibration) is usual for such cameras. Its near clip plane is at
    200 mm, not at the 300 of the working range: a renderer's clip plane cuts the part open, which
    no camera does.
    """
    return Sensor(
        camera=dataclasses.replace(Camera(), near_mm=200.0),
        baseline_mm=120.0,
        shadow=True,
        most_incidence_deg=78.0,
        exposure=Exposure(),
        noise_px=0.05,
        correlated_px=0.02,
        correlation_px=16.0,
        mixed_share=0.5,
        step_px=1 / 64,
        lens=Lens(k1=1e-3, k2=1e-3, p1=1e-4, p2=1e-4, focal_error=1e-4, center_error_px=(0.1, 0.1)),
        trueness=Trueness(scale=1e-4, bend_mm=(0.02, 0.02)),
        lost_share=2e-3,
        outlier_share=5e-4,
    )


def consumer_depth() -> Sensor:
    """A short-range stereo depth camera, in steps of 1 mm.

    The focal length is that of the pixel grid of 15 real scans; the magnitudes are those for which
    virtual scans of the same parts in the same poses have residuals, steps and holes most alike
    (`experiments.sensor_fit`, on every other scan; docs/real_scans.md). The baseline is that of
    such a camera.
    """
    width, height, focal = 424, 240, 212.945
    opening = [math.degrees(2 * math.atan(size / (2 * focal))) for size in (width, height)]
    return Sensor(
        camera=Camera(
            width=width,
            height=height,
            fov_x_deg=opening[0],
            fov_y_deg=opening[1],
            near_mm=50.0,
        ),
        baseline_mm=18.0,
        shadow=True,
        most_incidence_deg=76.0,
        incidence_spread_deg=10.0,
        noise_px=0.005,
        correlated_px=0.044,
        correlation_px=14.0,
        window_px=2.6,
        adhesion_px=1.1,
        rim_px=0.87,
        mixed_share=0.5,
        jump_mm=10.0,
        step_mm=1.0,
        lost_share=0.017,
    )


PRESETS = {"ideal": ideal, "paper_camera": paper_camera, "consumer_depth": consumer_depth}


def preset(name: str) -> Sensor:
    """The sensor of a name in `PRESETS`.

    Raises:
      InputError: there is none.
    """
    if name not in PRESETS:
        raise InputError(f"no sensor {name!r}; there are {', '.join(PRESETS)}")
    return PRESETS[name]()


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
        if sensor.lost_share:
            lost = self.rng.random(len(self.reason), dtype=np.float32) < sensor.lost_share
            self._drop(lost, Reason.LOST)
        if sensor.rim_px:
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
        return rim(row, column, self.sensor.rim_px * (1 + self._field(row, column)))

    def _places(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns [N]."""
        return np.divmod(self.scan.pixel, np.int32(self.sensor.camera.width))

    def _field(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """[N] f32: a new random field as smooth as the correlated error."""
        return smooth_field(self.rng, row, column, length_px=self.sensor.correlation_px)

    def _drop_dark(self) -> None:
        """Shadow, grazing incidence and exposure."""
        sensor, scan = self.sensor, self.scan
        points, normals = scan.points, scan.normals
        to_projector = np.float32([sensor.baseline_mm, 0, 0]) - points
        lit = np.ones(len(points), bool)
        if sensor.shadow:
            lit = self.scanner.lit(points, normals, to_projector, scan.camera_from_part)
            self._drop(~lit, Reason.SHADOWED)
        if sensor.most_incidence_deg < 90:
            inverse = 1 / np.sqrt(np.einsum("ni,ni->n", points, points))
            cosine = -np.einsum("ni,ni->n", points, normals) * inverse
            if sensor.incidence_spread_deg:
                limit = sensor.most_incidence_deg + sensor.incidence_spread_deg * self._field(
                    *self._places()
                )
                least = np.cos(np.radians(np.clip(limit, 0, 90)))
            else:
                least = np.float32(math.cos(math.radians(sensor.most_incidence_deg)))
            self._drop(cosine < least, Reason.GRAZING)
        if sensor.exposure is not None:
            self._expose(sensor.exposure, to_projector, lit)

    def _expose(self, exposure: Exposure, to_projector: np.ndarray, lit: np.ndarray) -> None:
        scan = self.scan
        to_camera = -scan.points
        to_camera /= np.sqrt(np.einsum("ni,ni->n", to_camera, to_camera))[:, None]
        distance = np.sqrt(np.einsum("ni,ni->n", to_projector, to_projector))
        way = to_projector / distance[:, None]
        shine = exposure.reflected(scan.normals, to_camera, way)
        modulation = exposure.modulation(shine, distance)
        modulation[~lit] = 0
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
        pixel = self.scan.pixel.take(kept)
        measured = self._triangulated(depth, pixel, kept)
        if sensor.trueness is not None:
            camera = sensor.camera
            row, column = np.divmod(pixel, np.int32(camera.width))
            x = (column + np.float32(0.5)) / np.float32(camera.width / 2) - 1
            y = (row + np.float32(0.5)) / np.float32(camera.height / 2) - 1
            measured = measured + sensor.trueness.error_mm(measured, x, y).astype(np.float32)
        if sensor.outlier_share:
            far = np.flatnonzero(
                self.rng.random(len(kept), dtype=np.float32) < sensor.outlier_share
            )
            measured = measured.copy()
            measured[far] += np.float32(sensor.outlier_mm) * (
                2 * self.rng.random(len(far), dtype=np.float32) - 1
            )
        if sensor.step_mm:
            step = np.float32(sensor.step_mm)
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
        if sensor.adhesion_px:
            aside = sensor.adhesion_px * np.stack([self._field(row, column) for _ in range(2)])
        mean = windowed(row, column, true, window_px=sensor.window_px, aside_px=aside)
        # a window over two surfaces that lie apart locks onto its own
        near = np.abs(np.float32(sensor.focal_baseline) / mean - depth) < sensor.jump_mm
        return np.where(near, mean - true, np.float32(0))

    def _triangulated(self, depth: np.ndarray, pixel: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Depths [n] f32 from disparities with their errors; the same array without any."""
        sensor, rng = self.sensor, self.rng
        error = None
        if sensor.noise_px:
            error = np.float32(sensor.noise_px) * rng.standard_normal(len(depth), dtype=np.float32)
            if self.noise_growth is not None:
                error *= self.noise_growth.take(kept)
        if sensor.correlated_px:
            row, column = np.divmod(pixel, np.int32(sensor.camera.width))
            field = smooth_field(rng, row, column, length_px=sensor.correlation_px)
            field *= np.float32(sensor.correlated_px)
            error = field if error is None else error + field
        matched = sensor.window_px or sensor.adhesion_px
        if error is None and not (sensor.mixed_share or sensor.step_px or matched):
            return depth
        disparity = np.float32(sensor.focal_baseline) / depth
        if matched:
            disparity += self._window_shifts().take(kept)
        if error is not None:
            disparity += error
        if sensor.mixed_share:
            sides = jumps(pixel, depth, width=sensor.camera.width, jump_mm=sensor.jump_mm)
            mixed, added = mixed_disparity(rng, sides, disparity, share=sensor.mixed_share)
            disparity[mixed] += added
        if sensor.step_px:
            step = np.float32(sensor.step_px)
            disparity = step * np.round(disparity / step)
        # no depth is measured beyond the far plane, and none from a disparity that is not positive
        least = np.float32(sensor.focal_baseline / (2 * sensor.camera.far_mm))
        return np.float32(sensor.focal_baseline) / np.maximum(disparity, least)
