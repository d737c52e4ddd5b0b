"""Errors of measured ranges: random fields, windows, mixed pixels, lens and trueness.

A camera and a projector triangulate: a surface at the depth z appears shifted by the disparity
``d = f b / z`` pixels, with the focal length f in pixels and the baseline b in mm. What goes wrong
in the image is an error of d, and ``dz = z^2 / (f b) dd``.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy import ndimage, sparse

from vanejax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Lens:
    """What calibration leaves of the camera's lens; all 0 is the pinhole.

    A ray of the true slopes (x, y) is taken for one of other slopes: the model of Brown (1971),
    with ``r^2 = x^2 + y^2``, then an error of the focal length and of the principal point.

    Attributes:
      k1, k2: radial distortion.
      p1, p2: tangential distortion.
      focal_error: relative.
      center_error_px: (columns, rows), pixels.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    focal_error: float = 0.0
    center_error_px: tuple[float, float] = (0.0, 0.0)

    def shifts(
        self, x: np.ndarray, y: np.ndarray, *, fx: float, fy: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """By how much the slopes x, y [N] come out wrong, [N] each."""
        squared = x * x + y * y
        radial = squared * (self.k1 + self.k2 * squared) + self.focal_error
        cross = 2 * x * y
        columns, rows = self.center_error_px
        return (
            x * radial + self.p1 * cross + self.p2 * (squared + 2 * x * x) + columns / fx,
            y * radial + self.p2 * cross + self.p1 * (squared + 2 * y * y) - rows / fy,
        )


@dataclasses.dataclass(frozen=True)
class Trueness:
    """A smooth error of the depth that is the same in every scan: it biases the pose.

    Attributes:
      scale: relative error of the depth.
      bend_mm: (columns, rows): how much too far the middles of the image's sides come out at a
        depth of 400 mm; the error is quadratic in the image and grows as the depth squared, as
        that of a bent baseline does.
    """

    scale: float = 0.0
    bend_mm: tuple[float, float] = (0.0, 0.0)

    def error_mm(self, depth: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """[N] mm at depths [N] mm; x and y [N] are -1 to 1 between the sides of the image."""
        across, down = self.bend_mm
        bend = (across * x * x + down * y * y) * (depth / 400.0) ** 2
        return self.scale * depth + bend


def smooth_field(
    rng: np.random.Generator, row: np.ndarray, column: np.ndarray, *, length_px: float
) -> np.ndarray:
    """A Gaussian random field [N] f32 at pixels [N]: mean 0, variance 1 at every one of them.

    White noise on a grid of ``length_px``, interpolated by cubic B-splines of unit square sum:
    pixels ``length_px`` apart correlate by 0.49 on average, twice as far apart by 0.05. A length
    below one pixel raises InputError.
    """
    if not 1 <= length_px < math.inf:
        raise InputError(f"a correlation length must be 1 pixel or more, got {length_px!r}")
    if not len(row):
        return np.zeros(0, np.float32)
    first = row.min(), column.min()
    size = row.max() - first[0] + 1, column.max() - first[1] + 1
    down, across = (_spline(int(n), length_px) for n in size)
    coarse = rng.standard_normal((down.shape[1], across.shape[1]), dtype=np.float32)
    # four weights a pixel; sparse, since dense products start BLAS's threads, which wait for ours
    down, across = sparse.csr_array(down), sparse.csr_array(across)
    field = down @ (across @ coarse.T).T
    return field[row - first[0], column - first[1]]


def _spline(count: int, length_px: float) -> np.ndarray:
    """[count, grid] f32 weights of cubic B-splines, each row of unit square sum."""
    place = np.arange(count) / length_px
    knots = np.arange(int(place[-1]) + 4) - 1
    distance = np.abs(place[:, None] - knots[None, :])
    inner = 2 / 3 - distance**2 + distance**3 / 2
    weight = np.where(distance < 1, inner, np.maximum(2 - distance, 0) ** 3 / 6)
    weight /= np.linalg.norm(weight, axis=1, keepdims=True)
    return weight.astype(np.float32)


def window_mean(
    row: np.ndarray,
    column: np.ndarray,
    disparity: np.ndarray,
    *,
    window_px: float,
    offset_px: np.ndarray | None = None,
) -> np.ndarray:
    """The mean disparity around each of the pixels [N] f32 that see the part; others do not count.

    Stereo compares windows, not pixels: it finds the mean disparity of the texture in a window,
    which rounds edges off, and which may lie ``offset_px`` [2, N] rows and columns beside the pixel
    (edge fattening). The window is a Gaussian of the standard deviation ``window_px``.
    """
    if not len(row):
        return disparity
    place = row - row.min(), column - column.min()
    shape = tuple(int(p.max()) + 1 for p in place)
    total, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    total[place], weight[place] = disparity, 1
    total, weight = (
        ndimage.gaussian_filter(image, window_px, mode="constant") for image in (total, weight)
    )
    own = total[place] / weight[place]
    if offset_px is None:
        return own
    middle = np.stack(place) + offset_px
    total, weight = (
        ndimage.map_coordinates(image, middle, order=1, mode="nearest") for image in (total, weight)
    )
    return np.where(weight > 0.25, total / np.maximum(weight, 0.25), own)


def near_outline(row: np.ndarray, column: np.ndarray, width_px: np.ndarray) -> np.ndarray:
    """[N] bool: whether the centre of a pixel is nearer than ``width_px`` [N] to the outline.

    The outline runs between the pixels [N] that see the part and all others.
    """
    if not len(row):
        return np.zeros(0, bool)
    place = row - row.min() + 1, column - column.min() + 1
    seen = np.zeros(tuple(int(p.max()) + 2 for p in place), bool)
    seen[place] = True
    return ndimage.distance_transform_edt(seen)[place] - 0.5 < width_px


def depth_jumps(
    pixel: np.ndarray, depth: np.ndarray, *, width: int, jump_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours between which the depth [N] f32 mm jumps by ``jump_mm`` or more.

    Of pixels [N] i32, ascending, ``row * width + column``; the result is the indices, [J] each, of
    the two sides.
    """
    if not len(pixel):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    right = np.flatnonzero((np.diff(pixel) == 1) & (np.abs(np.diff(depth)) >= jump_mm))
    right = right[pixel[right] % width != width - 1]
    # rows below each other: where each pixel stands among those of the image
    first = int(pixel[0])
    place = np.full(int(pixel[-1]) - first + 1, -1, np.int32)
    place[pixel - first] = np.arange(len(pixel), dtype=np.int32)
    upper = np.searchsorted(pixel, pixel[-1] - width, side="right")
    lower = place.take(pixel[:upper] - (first - width))
    step = np.abs(depth.take(lower, mode="wrap") - depth[:upper])
    below = np.flatnonzero((lower >= 0) & (step >= jump_mm))
    return np.concatenate([right, below]), np.concatenate([right + 1, lower[below]])


def flying_pixel_errors(
    rng: np.random.Generator,
    sides: tuple[np.ndarray, np.ndarray],
    disparity: np.ndarray,
    *,
    rate: float,
) -> tuple[np.ndarray, np.ndarray]:
    """What pixels at depth edges measure of the surface beside their own.

    A pixel that an edge crosses sees both sides, and its own for the larger part: the other's
    weight is uniform up to one half. ``rate`` is the share of the edges, those of `depth_jumps`, at
    which a pixel is mixed.

    Returns:
      indices of the mixed pixels [m], no two alike, and what is added to their disparity [m].
    """
    swap, weight, chance = rng.random((3, len(sides[0])), dtype=np.float32)
    chosen = np.flatnonzero(chance < rate)
    own, other = (np.where(swap < 0.5, *pair)[chosen] for pair in (sides, sides[::-1]))
    own, first = np.unique(own, return_index=True)
    other, weight = other[first], 0.5 * weight[chosen][first]
    return own, weight * (disparity[other] - disparity[own])
