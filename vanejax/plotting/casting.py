"""Figure of one casting: how far its surface stands off the CAD model's."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize, to_rgb
from matplotlib.figure import Figure

from vanejax.cad import Part
from vanejax.plotting import canvas
from vanejax.plotting.shading import crop_size, draw_part, shade
from vanejax.scanner import Camera, Scan, Scanner, hemisphere_viewpoints

_PIXELS = 900
_FIELD_DEG = 12.0  # from so far away a millimetre is nearly as long everywhere
_SIDES_DEG = {"from above": (30.0, 40.0), "from below": (-25.0, 220.0)}  # elevation, azimuth
_REACH_MM = 4.0  # no casting is off by half of it
_SAME_FACE = 0.9  # cosine: the CAD face under a point of the casting, not the one round an edge


def casting_map(part: Part, cast: Part) -> Figure:
    """The casting from two opposite sides, coloured by its offset from the CAD model.

    The offset is along the casting's normals, positive outward. Grey is where no CAD surface of
    about the same direction lies under the casting: beside edges, by the width of the stock.

    Args:
      part: the CAD model.
      cast: its casting, in the same frame, as from `vanejax.cad.investment_casting.as_cast`.
    """
    distance = 1.05 * cast.radius / np.sin(np.radians(_FIELD_DEG) / 2)
    camera = Camera(
        width=_PIXELS, height=_PIXELS, fov_x_deg=_FIELD_DEG, fov_y_deg=_FIELD_DEG,
        near_mm=distance - 1.5 * cast.radius, far_mm=distance + 1.5 * cast.radius,
    )  # fmt: skip
    scanner, bare = Scanner(cast), Scanner(part)
    scans = []
    for elevation, azimuth in _SIDES_DEG.values():
        view = hemisphere_viewpoints(
            cast.center, distance_mm=distance, elevations_deg=[elevation], azimuths_deg=[azimuth]
        ).view(0)
        scans.append(scanner.scan(camera, view))
    offsets = [_offset_mm(scan, bare) for scan in scans]
    scale, colors = _scale(np.concatenate(offsets))
    sizes = [crop_size(scan, camera) for scan in scans]
    widths = [wide / high for wide, high in sizes]
    figure = canvas.new_figure(canvas.WIDTH_IN, (canvas.WIDTH_IN - 0.9) / sum(widths) + 0.3)
    panels = figure.subplots(1, 2, width_ratios=widths)
    for axes, title, scan, offset in zip(panels, _SIDES_DEG, scans, offsets, strict=True):
        image = shade(scan, camera)
        light = image.reshape(-1, 3)[scan.pixel].mean(axis=1, keepdims=True)
        color = colors(scale(offset))[:, :3]
        color[np.isnan(offset)] = to_rgb(canvas.FAINT)
        # the surface's light keeps its shape readable
        bright = np.clip(light / np.percentile(light, 80), 0, 1)
        image.reshape(-1, 3)[scan.pixel] = color * (0.55 + 0.45 * bright)
        draw_part(axes, scan, camera, image)
        canvas.name_panel(axes, title)
    label = "offset from the CAD surface (mm), + outward"
    canvas.add_color_bar(
        figure, panels, ScalarMappable(scale, colors), label, fraction=0.025, extend="both"
    )
    return figure


def _offset_mm(scan: Scan, bare: Scanner) -> np.ndarray:
    """[N] mm from the CAD model to the points of a scan of the casting; NaN where there is none."""
    part_from_camera = scan.camera_from_part.inverse()
    points = part_from_camera.apply(scan.points.astype(np.float64))
    normals = part_from_camera.rotate(scan.normals.astype(np.float64))
    hits = bare.cast(points + _REACH_MM / 2 * normals, -normals)
    same = np.einsum("ni,ni->n", hits.normals, normals) > _SAME_FACE
    return np.where(same & (hits.distance_mm < _REACH_MM), hits.distance_mm - _REACH_MM / 2, np.nan)


def _scale(offset: np.ndarray) -> tuple[Normalize, Colormap]:
    """Limits that 1 % of the offsets are beyond; about zero where they have both signs."""
    known = offset[np.isfinite(offset)]
    low, high = np.percentile(known, [0.5, 99.5]) if len(known) else (0.0, 0.0)
    low, high = low - 0.005, high + 0.005  # a uniform offset has a scale too
    if low < -0.01:
        limit = max(-low, high)
        return Normalize(-limit, limit), colormaps[canvas.DEVIATION_COLORMAP]
    return Normalize(low, high), colormaps[canvas.ERROR_COLORMAP]
