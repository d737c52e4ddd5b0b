"""Pictures of point clouds: registrations before and after, and what a view sees and misses."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.figure import Figure

from vanejax.errors import InputError
from vanejax.plotting.canvas import (
    CAD,
    FAINT,
    HIDDEN,
    INK,
    SCAN,
    TICK_PT,
    TITLE_PT,
    WIDTH_IN,
    add_color_bar,
    name_colors,
    name_panel,
    new_figure,
)
from vanejax.scanner import Scan, look_at
from vanejax.scans.voxels import voxel_thin

# Where the reader stands, as a viewpoint of the hemisphere: oblique enough to see a tilt.
READER_ELEVATION_DEG = 50.0
READER_AZIMUTH_DEG = 325.0
DISPLACEMENT_MM = (0.1, 10.0)  # ends of the colours of `method_displacements`


@dataclasses.dataclass(frozen=True, eq=False)
class Overlay:
    """One registration to look at; clouds in mm, target frame with the part's centre at 0.

    Attributes:
      source: [N, 3] before registration.
      moved: [N, 3] after it; not finite where it failed.
      true: [N, 3] where its points truly lie.
      reference: [M, 3].
      elevation_deg, azimuth_deg: of the view.
      visible_fraction: X / Y of the view, 0 to 1.
      rotation_error_deg, translation_error_mm: of the result.
    """

    source: np.ndarray
    moved: np.ndarray
    true: np.ndarray
    reference: np.ndarray
    elevation_deg: float
    azimuth_deg: float
    visible_fraction: float
    rotation_error_deg: float
    translation_error_mm: float

    @property
    def error(self) -> str:
        """The pose error in words."""
        if not np.isfinite(self.rotation_error_deg + self.translation_error_mm):
            return "no finite pose"
        return f"{self.rotation_error_deg:.2f}°, {self.translation_error_mm:.2f} mm"


@dataclasses.dataclass(frozen=True, eq=False)
class Dots:
    """A cloud [N, 3] in mm; one colour for all or [N, 3], 0 to 1; ``area`` in points squared."""

    points: np.ndarray
    color: str | np.ndarray
    area: float


def view_name(elevation_deg: float, azimuth_deg: float) -> str:
    """How figures call a viewpoint."""
    return f"elevation {elevation_deg:g}°, azimuth {azimuth_deg:g}°"


def registration_overlays(overlays: Sequence[Overlay]) -> Figure:
    """Scan on CAD before and after registration, as in the paper's Fig. 7.

    One column for each registration; every panel has the same scale and the same direction.

    Raises:
      InputError: no registration.
    """
    if not overlays:
        raise InputError("registration_overlays needs at least one registration")
    limit = limits([c for o in overlays for c in (o.source, o.moved, o.reference)])
    width = min(2.4, (WIDTH_IN - 0.4) / len(overlays))
    figure = new_figure(width * len(overlays) + 0.4, 2 * width * height_per_width(limit) + 1.3)
    rows = figure.subplots(2, len(overlays), squeeze=False)
    for (before, after), overlay in zip(rows.T, overlays, strict=True):
        for axes, source in ((before, overlay.source), (after, overlay.moved)):
            draw_dots(axes, overlay_dots(source, overlay.reference, width), limit)
        view = view_name(overlay.elevation_deg, overlay.azimuth_deg).replace(", ", "\n")
        title = f"{view}\n{100 * overlay.visible_fraction:.0f} % visible"
        name_panel(before, title, fontsize=TICK_PT)
        name_panel(after, overlay.error, fontsize=TICK_PT, fontweight="bold")
    for axes, name in zip(rows[:, 0], ("before", "after"), strict=True):
        axes.text(
            0.0, 0.5, name, transform=axes.transAxes, rotation=90, ha="right", va="center",
            color=INK, fontsize=TITLE_PT, fontweight="bold",
        )  # fmt: skip
        _scale_bar(axes)
    name_colors(figure, {"scan": SCAN, "CAD": CAD})
    return figure


def method_displacements(overlays: Mapping[str, Overlay]) -> Figure:
    """How far several methods leave the points of one view from where they truly lie.

    The paper's Fig. 3 shows the clouds alone, which look alike. Here each point has the colour of
    its displacement, on one logarithmic scale for all methods; the CAD model is grey.

    Args:
      overlays: by method, of the same view.

    Raises:
      InputError: no registration.
    """
    if not overlays:
        raise InputError("method_displacements needs at least one registration")
    limit = limits([c for o in overlays.values() for c in (o.true, o.reference)])
    columns = min(4, len(overlays))
    lines = -(-len(overlays) // columns)
    width = (WIDTH_IN - 0.8) / columns
    figure = new_figure(
        width * columns + 0.8, (width * height_per_width(limit) + 0.45) * lines + 0.2
    )
    panels = figure.subplots(lines, columns, squeeze=False)
    scale = ScalarMappable(LogNorm(*DISPLACEMENT_MM, clip=True), colormaps["viridis_r"])
    for axes in panels.flat[len(overlays) :]:
        axes.set_axis_off()
    for axes, (name, overlay) in zip(panels.flat, overlays.items(), strict=False):
        displacement = np.linalg.norm(overlay.moved - overlay.true, axis=1)
        color = scale.to_rgba(np.nan_to_num(displacement))[:, :3]
        cloud = Dots(overlay.moved, color, 9.0 * (width / 2) ** 2)
        draw_dots(axes, [Dots(overlay.reference, FAINT, 1.5 * (width / 2) ** 2), cloud], limit)
        name_panel(axes, f"{name}\n{overlay.error}")
    _scale_bar(panels[0, 0])
    add_color_bar(figure, panels, scale, "distance of each point from its true place (mm)",
                  shrink=0.6, aspect=30, extend="both")  # fmt: skip
    return figure


def view_and_shadow(
    scans: Sequence[Scan], names: Sequence[str], *, voxel_mm: float = 1.0
) -> Figure:
    """What views see and what self-occlusion hides from them: the paper's Fig. 5.

    All panels show the part's frame from one direction, so that they can be compared.

    Args:
      scans: with `Scan.hidden`.
      names: one title for each, such as `view_name` gives.
      voxel_mm: one point per voxel is drawn, of either cloud.

    Raises:
      InputError: no scan, or one without its hidden points.
    """
    if not scans:
        raise InputError("view_and_shadow needs at least one scan")
    columns = min(len(scans), 3)
    lines = -(-len(scans) // columns)
    pictures = [seen_and_hidden(scan, voxel_mm=voxel_mm) for scan in scans]
    limit = limits([cloud for pair in pictures for cloud in pair])
    width = WIDTH_IN / 3
    figure = new_figure(width * columns, (width * height_per_width(limit) + 0.3) * lines + 0.4)
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in panels[len(scans) :]:
        axes.set_axis_off()
    for axes, clouds, name in zip(panels, pictures, names, strict=False):
        draw_dots(axes, view_dots(*clouds, width), limit)
        name_panel(axes, name)
    _scale_bar(panels[0])
    name_colors(figure, {"seen by the camera": SCAN, "hidden by self-occlusion": HIDDEN})
    return figure


def seen_and_hidden(scan: Scan, *, voxel_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Seen [n, 3] and hidden [h, 3] points of a scan, part frame, mm, equally dense.

    Raises:
      InputError: the scan was made without hidden points.
    """
    if scan.hidden is None:
        raise InputError("this scan has no hidden points; scan with hidden=True")
    part_from_camera = scan.camera_from_part.inverse()
    clouds = (part_from_camera.apply(np.asarray(c, np.float64)) for c in (scan.points, scan.hidden))
    seen, hidden = (cloud[voxel_thin(cloud, voxel_mm=voxel_mm)] for cloud in clouds)
    return seen, hidden


def view_dots(seen: np.ndarray, hidden: np.ndarray, width_in: float) -> list[Dots]:
    """Dense seen and hidden points [N, 3] that close their gaps in a panel so wide."""
    return [Dots(points, color, 1.2 * width_in**2)
            for points, color in ((hidden, HIDDEN), (seen, SCAN))]  # fmt: skip


def overlay_dots(source: np.ndarray, reference: np.ndarray, width_in: float) -> list[Dots]:
    """Source [N, 3] on reference [M, 3], for a panel so wide."""
    return [Dots(reference, CAD, 0.7 * width_in**2), Dots(source, SCAN, 1.4 * width_in**2)]


def flattened(points: np.ndarray) -> np.ndarray:
    """Points [N, 3] as the reader sees them: x right, y up, z towards the reader."""
    return look_at(reader_direction(), np.zeros(3)).rotate(np.asarray(points, np.float64))


def reader_direction() -> np.ndarray:
    """Unit vector [3], part frame, towards the reader."""
    a, b = np.radians([READER_ELEVATION_DEG, READER_AZIMUTH_DEG])
    return np.array([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)])


def limits(clouds: Sequence[np.ndarray]) -> np.ndarray:
    """Lowest and highest (x, y) [2, 2] of clouds as the reader sees them, with margins.

    The one below is for the scale bar.
    """
    flat = np.concatenate([flattened(cloud)[:, :2] for cloud in clouds])
    flat = flat[np.isfinite(flat).all(axis=1)]
    if not len(flat):
        flat = np.array([[-1.0, -1.0], [1.0, 1.0]])
    low, high = flat.min(axis=0), flat.max(axis=0)
    pad = 0.02 * np.max(high - low)
    return np.stack([low - [pad, 4 * pad], high + pad])


def height_per_width(limit: np.ndarray) -> float:
    """Proportions of limits [2, 2]."""
    width, height = limit[1] - limit[0]
    return height / width


def draw_dots(axes: Axes, clouds: Sequence[Dots], limit: np.ndarray) -> None:
    """Clouds into ``limit`` [2, 2], far dots first and paler, so that near points hide far ones."""
    flat = np.concatenate([flattened(cloud.points) for cloud in clouds])
    areas = np.concatenate([np.full(len(cloud.points), cloud.area) for cloud in clouds])
    colors = np.concatenate(
        [
            np.tile(to_rgb(c.color), (len(c.points), 1)) if isinstance(c.color, str) else c.color
            for c in clouds
        ]
    )
    finite = np.isfinite(flat).all(axis=1)
    flat, areas, colors = flat[finite], areas[finite], colors[finite]
    axes.set_axis_off()
    axes.set(aspect="equal", xlim=limit[:, 0], ylim=limit[:, 1])
    if not len(flat):
        return
    depth = flat[:, 2]
    far = (depth.max() - depth) / max(float(np.ptp(depth)), 1e-9)
    colors = colors + (1 - colors) * 0.35 * far[:, None]
    order = np.argsort(depth, kind="stable")
    axes.scatter(
        flat[order, 0], flat[order, 1], s=areas[order], c=colors[order], linewidths=0, zorder=2
    )


def _scale_bar(axes: Axes) -> None:
    """A bar of 20 mm in the lower left corner, which `limits` keeps free."""
    bottom, top = axes.get_ylim()
    y = bottom + 0.01 * (top - bottom)
    draw_scale_bar(axes, 20.0, y, y + 0.012 * (top - bottom), "bottom")


def draw_scale_bar(axes: Axes, length_mm: float, y: float, words_y: float, words_va: str) -> None:
    """A bar of known length near the left edge at height ``y``, its length in words beside it."""
    left, right = axes.get_xlim()
    x = left + 0.02 * (right - left)
    axes.plot([x, x + length_mm], [y, y], color=INK, linewidth=1.5, solid_capstyle="butt")
    axes.text(x + length_mm / 2, words_y, f"{length_mm:g} mm", color=INK, fontsize=TICK_PT,
              ha="center", va=words_va)  # fmt: skip
