"""The effects of a sensor, one function each, and the order in which a scan goes through them.

A new effect is a function here and its place in one of the tables at the end of the file, with the
fields of `vanejax.scanner.sensor.Sensor` that switch it on; its mathematics, where it is long,
stands in `exposure` or `range_errors`. An effect that is switched off is not called: it draws no
random number and changes no bit. Effects draw in the order of the tables.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
from collections.abc import Callable

import numpy as np

from vanejax.scanner.ideal_scan import Scan
from vanejax.scanner.range_errors import (
    depth_jumps,
    flying_pixel_errors,
    near_outline,
    smooth_field,
    window_mean,
)
from vanejax.scanner.sensor import Sensor
from vanejax.scanner.virtual_scanner import Scanner


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
class SensedView:
    """An ideal scan of N pixels by the sensor's camera, the scanner that made it, and chance."""

    scanner: Scanner
    scan: Scan
    sensor: Sensor
    rng: np.random.Generator

    def active(self, effects: tuple[tuple, ...]) -> list[Callable[..., np.ndarray]]:
        """Those of a table that the sensor has switched on."""
        return [
            effect for effect, *fields in effects if any(getattr(self.sensor, f) for f in fields)
        ]

    def rows_columns(self, which: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, ...]:
        """Rows and columns [n] i32 of the pixels, or of the indices ``which``."""
        return np.divmod(self.scan.pixel[which], np.int32(self.sensor.camera.width))

    def random_field(self, which: np.ndarray | slice = slice(None)) -> np.ndarray:
        """[n] f32: a new field of unit variance, as smooth in the image as ``correlation_px``."""
        row, column = self.rows_columns(which)
        return smooth_field(self.rng, row, column, length_px=self.sensor.correlation_px)

    @functools.cached_property
    def to_projector(self) -> np.ndarray:
        """[N, 3] f32 mm, camera frame: from each point to the projector."""
        return np.float32([self.sensor.baseline_mm, 0, 0]) - self.scan.points

    @functools.cached_property
    def brightness(self) -> tuple[np.ndarray, np.ndarray]:
        """[N] f32 each: what the projector adds, and all light; needs an exposure."""
        exposure, normals = self.sensor.exposure, self.scan.normals
        to_camera = -self.scan.points
        to_camera /= np.sqrt(np.einsum("ni,ni->n", to_camera, to_camera))[:, None]
        distance = np.sqrt(np.einsum("ni,ni->n", self.to_projector, self.to_projector))
        to_light = self.to_projector / distance[:, None]
        reflected = exposure.reflected(normals, to_camera, to_light)
        modulation = exposure.modulation(reflected, distance)
        if not exposure.ambient_per_ms:
            return modulation, modulation
        lamp = np.float32(exposure.ambient_towards)
        lamp /= np.linalg.norm(lamp)
        ambient = exposure.ambient(exposure.reflected(normals, to_camera, lamp))
        return modulation, modulation + ambient


# Dropouts: which of the N pixels measure nothing, [N] bool.


def projector_shadow(view: SensedView) -> np.ndarray:
    """What the projector does not light."""
    return ~view.scanner.lit(view.scan, view.to_projector)


def grazing_incidence(view: SensedView) -> np.ndarray:
    """What is seen flatter than a limit, which may vary from place to place."""
    sensor, points = view.sensor, view.scan.points
    if sensor.max_incidence_deg >= 90:
        return np.zeros(len(points), bool)
    inverse = 1 / np.sqrt(np.einsum("ni,ni->n", points, points))
    cosine = -np.einsum("ni,ni->n", points, view.scan.normals) * inverse
    if not sensor.incidence_spread_deg:
        return cosine < np.float32(np.cos(np.radians(sensor.max_incidence_deg)))
    limit_deg = sensor.max_incidence_deg + sensor.incidence_spread_deg * view.random_field()
    return cosine < np.cos(np.radians(np.clip(limit_deg, 0, 90)))


def saturation(view: SensedView) -> np.ndarray:
    """Where the brightest fringe fills the pixel's well."""
    return view.brightness[1] >= 1


def darkness(view: SensedView) -> np.ndarray:
    """Where the fringes are too weak."""
    return view.brightness[0] < view.sensor.exposure.least_modulation


def pixel_dropout(view: SensedView) -> np.ndarray:
    """Pixels that are lost singly."""
    return view.rng.random(len(view.scan.pixel), dtype=np.float32) < view.sensor.dropout_rate


def border_dropout(view: SensedView) -> np.ndarray:
    """A strip along the outline, where the window holds too much of what is not the part."""
    width_px = view.sensor.border_dropout_px * (1 + view.random_field())
    return near_outline(*view.rows_columns(), width_px)


# Errors of the disparity of the n pixels ``kept``, [n] f32, pixels.


def range_noise(view: SensedView, kept: np.ndarray) -> np.ndarray:
    """White noise, which grows where less light comes back, and noise smooth in the image."""
    sensor, error = view.sensor, np.float32(0)
    if sensor.noise_px:
        white = view.rng.standard_normal(len(kept), dtype=np.float32)
        error = np.float32(sensor.noise_px) * white
        if sensor.exposure is not None:
            error *= sensor.exposure.noise_gain(*view.brightness).take(kept)
    if sensor.correlated_px:
        error = error + view.random_field(kept) * np.float32(sensor.correlated_px)
    return error


def matching_window(view: SensedView, kept: np.ndarray) -> np.ndarray:
    """A window matched as one: rounded edges, and edge fattening where its texture lies aside."""
    sensor = view.sensor
    row, column = view.rows_columns()
    depth = -view.scan.points[:, 2]
    true = np.float32(sensor.focal_baseline) / depth
    offset_px = None
    if sensor.edge_fattening_px:
        offset_px = sensor.edge_fattening_px * np.stack([view.random_field() for _ in range(2)])
    mean = window_mean(row, column, true, window_px=sensor.window_px, offset_px=offset_px)
    # a window over two surfaces that lie apart locks onto its own
    near = np.abs(np.float32(sensor.focal_baseline) / mean - depth) < sensor.jump_mm
    return np.where(near, mean - true, np.float32(0)).take(kept)


# Changes of the measured disparity [n] f32, pixels, of the pixels ``kept``.


def flying_pixels(view: SensedView, kept: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Pixels at depth edges that see some of both surfaces."""
    sensor = view.sensor
    pixel, depth = view.scan.pixel.take(kept), -view.scan.points[kept, 2]
    sides = depth_jumps(pixel, depth, width=sensor.camera.width, jump_mm=sensor.jump_mm)
    mixed, error = flying_pixel_errors(view.rng, sides, disparity, rate=sensor.flying_pixel_rate)
    disparity = disparity.copy()
    disparity[mixed] += error
    return disparity


def disparity_quantisation(view: SensedView, kept: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Disparities in whole steps."""
    return _quantised(disparity, view.sensor.disparity_quantisation_px)


# Changes of the measured depth [n] f32, mm, of the pixels ``kept``.


def trueness(view: SensedView, kept: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """What calibration leaves of the depth: the same in every scan."""
    sensor = view.sensor
    row, column = view.rows_columns(kept)
    x = (column + np.float32(0.5)) / np.float32(sensor.camera.width / 2) - 1
    y = (row + np.float32(0.5)) / np.float32(sensor.camera.height / 2) - 1
    return depth + sensor.trueness.error_mm(depth, x, y).astype(np.float32)


def outliers(view: SensedView, kept: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Points that lie anywhere near."""
    sensor, rng = view.sensor, view.rng
    wrong = np.flatnonzero(rng.random(len(kept), dtype=np.float32) < sensor.outlier_rate)
    depth = depth.copy()
    side = 2 * rng.random(len(wrong), dtype=np.float32) - 1
    depth[wrong] += np.float32(sensor.outlier_mm) * side
    return depth


def depth_quantisation(view: SensedView, kept: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Depths in whole steps."""
    return _quantised(depth, view.sensor.depth_quantisation_mm)


def _quantised(values: np.ndarray, step: float) -> np.ndarray:
    return np.float32(step) * np.round(values / np.float32(step))


# Moves of the measured points across the ray.


def lens_distortion(view: SensedView, points: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """[n, 3] f32 mm: what calibration leaves of the lens, for points at depths [n]."""
    sensor = view.sensor
    x, y = points[:, 0] / depth, points[:, 1] / depth
    shifts = sensor.lens.shifts(x, y, fx=sensor.camera.fx, fy=sensor.camera.fy)
    points = points.copy()
    for axis, shift in enumerate(shifts):
        points[:, axis] += (depth * shift).astype(np.float32)
    return points


# Each with the fields of the sensor of which one, at least, must be set.
DROPOUTS = (
    (Reason.SHADOWED, projector_shadow, "shadow"),
    (Reason.GRAZING, grazing_incidence, "max_incidence_deg"),
    (Reason.SATURATED, saturation, "exposure"),
    (Reason.DARK, darkness, "exposure"),
    (Reason.LOST, pixel_dropout, "dropout_rate"),
    (Reason.LOST, border_dropout, "border_dropout_px"),
)
DISPARITY_ERRORS = (
    (range_noise, "noise_px", "correlated_px"),
    (matching_window, "window_px", "edge_fattening_px"),
)
DISPARITY_CHANGES = (
    (flying_pixels, "flying_pixel_rate"),
    (disparity_quantisation, "disparity_quantisation_px"),
)
DEPTH_CHANGES = (
    (trueness, "trueness"),
    (outliers, "outlier_rate"),
    (depth_quantisation, "depth_quantisation_mm"),
)
POINT_CHANGES = ((lens_distortion, "lens"),)
