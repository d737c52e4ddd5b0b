"""Shaded pictures from scans: what the virtual camera would photograph."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vanejax.errors import InputError
from vanejax.plotting.canvas import new_figure
from vanejax.scanner import Camera, Scan

_METAL = np.array([0.63, 0.68, 0.74])
_BACKGROUND = np.array([1.0, 1.0, 1.0])
# over the photographer's left shoulder, and a weak one from the right; camera frame
_KEY_LIGHT = np.array([-0.45, 0.55, 0.70])
_FILL_LIGHT = np.array([0.80, -0.10, 0.60])
# where creases are looked for: pixels away, and in which directions
_REACHES = (2, 5, 11)
_AROUND = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))


def shade(scan: Scan, camera: Camera) -> np.ndarray:
    """The part as the camera would see it: [height, width, 3] f64 in 0 to 1, on white.

    Lambert shading by the normals of the triangles that the pixels' rays met, with a highlight,
    and creases darkened by depth (eye-dome lighting; Boucheny, 2009). Pixels are the camera's: if
    these are not square, give ``fx / fy`` to imshow as the aspect.

    Raises:
      InputError: the scan has pixels that the camera lacks.
    """
    if len(scan.pixel) and scan.pixel[-1] >= camera.width * camera.height:
        raise InputError(
            f"the scan has more pixels than {camera.width} x {camera.height}: another camera's"
        )
    normals = scan.normals.astype(np.float64)
    to_camera = -scan.points / np.linalg.norm(scan.points, axis=1, keepdims=True)
    key, fill = (light / np.linalg.norm(light) for light in (_KEY_LIGHT, _FILL_LIGHT))
    diffuse = 0.40 + 0.55 * np.maximum(normals @ key, 0) + 0.20 * np.maximum(normals @ fill, 0)
    half = to_camera + key
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    highlight = 0.22 * np.maximum(np.sum(normals * half, axis=1), 0) ** 40
    depth = np.full(camera.width * camera.height, np.inf)
    depth[scan.pixel] = -scan.points[:, 2]
    creases = _creases(depth.reshape(camera.height, camera.width)).ravel()[scan.pixel]
    color = (diffuse * creases)[:, None] * _METAL + highlight[:, None]
    image = np.tile(_BACKGROUND, (camera.width * camera.height, 1))
    image[scan.pixel] = np.clip(color, 0, 1)
    return image.reshape(camera.height, camera.width, 3)


def part_picture(scan: Scan, camera: Camera) -> Figure:
    """The shaded part alone, cropped to what the camera that made the scan sees of it."""
    image = shade(scan, camera)
    wide, high = crop_size(scan, camera)
    longest = 5.0 / max(high, wide)
    figure = new_figure(longest * wide, longest * high)
    draw_part(figure.subplots(), scan, camera, image)
    return figure


def draw_part(axes: Axes, scan: Scan, camera: Camera, image: np.ndarray) -> None:
    """A shaded image [height, width, 3], cropped to the part, with true proportions."""
    rows, columns = crop(scan, camera)
    axes.imshow(image[rows, columns], aspect=camera.fx / camera.fy, interpolation="antialiased")
    axes.set_axis_off()


def crop(scan: Scan, camera: Camera) -> tuple[slice, slice]:
    """Rows and columns of the image that show the part, with a margin of 3 % of its size."""
    row, column = np.divmod(scan.pixel, camera.width)
    slices = []
    for index, size in ((row, camera.height), (column, camera.width)):
        low, high = int(index.min()), int(index.max()) + 1
        pad = round(0.03 * (high - low)) + 1
        slices.append(slice(max(0, low - pad), min(size, high + pad)))
    return slices[0], slices[1]


def crop_size(scan: Scan, camera: Camera) -> tuple[float, float]:
    """Width and height of what `crop` leaves, in true proportions."""
    rows, columns = crop(scan, camera)
    return (columns.stop - columns.start) / camera.fx, (rows.stop - rows.start) / camera.fy


def _creases(depth: np.ndarray) -> np.ndarray:
    """Factors in 0 to 1 that darken pixels behind their neighbours: [H, W] of depths, inf outside.

    A neighbour in front by a few per mille of the depth counts fully. The background does not
    count: it is behind everything.
    """
    logarithm = np.log(depth)
    padded = np.pad(logarithm, max(_REACHES), constant_values=np.inf)
    total = np.zeros_like(depth)
    for reach in _REACHES:
        for dy, dx in _AROUND:
            y, x = max(_REACHES) + reach * dy, max(_REACHES) + reach * dx
            neighbor = padded[y : y + depth.shape[0], x : x + depth.shape[1]]
            with np.errstate(invalid="ignore"):
                behind = logarithm - neighbor
            total += np.clip(np.nan_to_num(behind, nan=0.0, posinf=0.0, neginf=0.0), 0, 0.02)
    return np.exp(-60.0 * total / (len(_REACHES) * len(_AROUND)))
