"""Pictures of point clouds: registrations before and after, and what a view sees and misses."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from vanejax.errors import InputError
from vanejax.plotting.canvas import INK, REFERENCE_RED, SOURCE_GREEN, new_figure
from vanejax.pointcloud import voxel_thin
from vanejax.scanner.camera import look_at
from vanejax.scanner.ideal_scan import Scan

# Where the reader stands, as a viewpoint of the hemisphere: oblique enough to see a tilt.
READER_ELEVATION_DEG = 50.0
READER_AZIMUTH_DEG = 325.0
_COLUMN_IN = 2.55


@dataclasses.dataclass(frozen=True, eq=False)
class Overlay:
    """One registration to look at; clouds in mm, target frame with the part's centre at 0.

    Attributes:
      source: [N, 3] before registration.
      moved: [N, 3] after it; not finite where it failed.
      reference: [M, 3].
      elevation_deg, azimuth_deg: of the view.
      visible_fraction: X / Y of the view, 0 to 1.
      rotation_error_deg, translation_error_mm: of the result.
    """

    source: np.ndarray
    moved: np.ndarray
    reference: np.ndarray
    elevation_deg: float
    azimuth_deg: float
    visible_fraction: float
    rotation_error_deg: float
    translation_error_mm: float


@dataclasses.dataclass(frozen=True, eq=False)
class _Dots:
    """A cloud [N, 3] in mm and how it is drawn; ``area`` is in points squared."""

    points: np.ndarray
    color: str
    area: float


def view_name(elevation_deg: float, azimuth_deg: float) -> str:
    """How figures call a viewpoint."""
    return f"elevation {elevation_deg:g}°, azimuth {azimuth_deg:g}°"


def registration_overlays(overlays: Sequence[Overlay]) -> Figure:
    """Source (green) on reference (red) before and after registration, as in the paper's Fig. 7.

    One column for each registration; every panel has the same scale and the same direction.

    Raises:
      InputError: no registration.
    """
    if not overlays:
        raise InputError("registration_overlays needs at least one registration")
    befores = [(overlay.source, overlay.reference) for overlay in overlays]
    afters = [(overlay.moved, overlay.reference) for overlay in overlays]
    row_limits = [limits([cloud for pair in row for cloud in pair]) for row in (befores, afters)]
    heights = [_COLUMN_IN * height_per_width(limit) for limit in row_limits]
    size = (_COLUMN_IN * len(overlays) + 0.3, sum(heights) + 1.5)
    figure = new_figure(*size)
    rows = figure.subplots(2, len(overlays), squeeze=False, gridspec_kw={"height_ratios": heights})
    for column, overlay in enumerate(overlays):
        for axes, limit, source in zip(
            rows[:, column], row_limits, (overlay.source, overlay.moved), strict=True
        ):
            draw_overlay(axes, source, overlay.reference)
            set_limits(axes, limit)
        rows[0, column].set_title(
            f"elevation {overlay.elevation_deg:g}°, azimuth {overlay.azimuth_deg:g}°\n"
            f"{100 * overlay.visible_fraction:.0f} % visible",
            color=INK,
            fontsize=10,
        )
        rows[1, column].set_title(_pose_error(overlay), color=INK, fontsize=10, fontweight="bold")
    for axes, name in zip(rows[:, 0], ("before", "after"), strict=True):
        axes.text(
            0.0, 0.5, name, transform=axes.transAxes, rotation=90, ha="right", va="center",
            color=INK, fontsize=11, fontweight="bold",
        )  # fmt: skip
    for axes in rows[:, 0]:
        _scale_bar(axes)
    _cloud_legend(figure, "source (virtual scan)", "reference (CAD)")
    return figure


def method_overlays(overlays: Mapping[str, Overlay], *, columns: int = 4) -> Figure:
    """One view after registration by several methods, as in the paper's Fig. 3.

    Args:
      overlays: by method, of the same view.
      columns: panels side by side.

    Raises:
      InputError: no registration.
    """
    if not overlays:
        raise InputError("method_overlays needs at least one registration")
    limit = limits([c for o in overlays.values() for c in (o.moved, o.reference)])
    columns = min(columns, len(overlays))
    lines = -(-len(overlays) // columns)
    height = _COLUMN_IN * height_per_width(limit)
    figure = new_figure(_COLUMN_IN * columns + 0.3, (height + 0.4) * lines + 0.3)
    panels = figure.subplots(lines, columns, squeeze=False)
    for axes in panels.flat[len(overlays) :]:
        axes.set_axis_off()
    for axes, (name, overlay) in zip(panels.flat, overlays.items(), strict=False):
        draw_overlay(axes, overlay.moved, overlay.reference)
        set_limits(axes, limit)
        axes.set_title(f"{name}\n{_pose_error(overlay)}", color=INK, fontsize=10)
    _scale_bar(panels[0, 0])
    _cloud_legend(figure, "source (virtual scan)", "reference (CAD)")
    return figure


def _pose_error(overlay: Overlay) -> str:
    if not np.isfinite(overlay.rotation_error_deg + overlay.translation_error_mm):
        return "no finite pose"
    return f"{overlay.rotation_error_deg:.2f}°, {overlay.translation_error_mm:.2f} mm"


def view_and_shadow(
    scans: Sequence[Scan], names: Sequence[str], *, voxel_mm: float = 1.0
) -> Figure:
    """What views see (green) and what self-occlusion hides from them (red): the paper's Fig. 5.

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
    panel_in = 3.6
    size = (panel_in * columns, (panel_in * height_per_width(limit) + 0.3) * lines + 0.4)
    figure = new_figure(*size)
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, (seen, hidden), name in zip(panels, pictures, names, strict=False):
        draw_view(axes, seen, hidden)
        axes.set_title(name, color=INK, fontsize=10)
        set_limits(axes, limit)
    for axes in panels[len(scans) :]:
        axes.set_axis_off()
    _scale_bar(panels[0])
    _cloud_legend(figure, "seen by the camera", "hidden by self-occlusion")
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


def draw_view(axes: Axes, seen: np.ndarray, hidden: np.ndarray) -> None:
    """Seen and hidden points [N, 3] into axes."""
    _draw(axes, [_Dots(hidden, REFERENCE_RED, 11.0), _Dots(seen, SOURCE_GREEN, 11.0)])


def draw_overlay(axes: Axes, source: np.ndarray, reference: np.ndarray) -> None:
    """Source [N, 3] on reference [M, 3] into axes."""
    _draw(axes, [_Dots(reference, REFERENCE_RED, 2.5), _Dots(source, SOURCE_GREEN, 6.5)])


def flattened(points: np.ndarray) -> np.ndarray:
    """Points [N, 3] as the reader sees them: x right, y up, z towards the reader."""
    a, b = np.radians([READER_ELEVATION_DEG, READER_AZIMUTH_DEG])
    eye = np.array([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)])
    return look_at(eye, np.zeros(3)).rotate(np.asarray(points, np.float64))


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


def set_limits(axes: Axes, limit: np.ndarray) -> None:
    """Shows what lies in limits [2, 2], lowest and highest (x, y)."""
    axes.set_xlim(limit[:, 0])
    axes.set_ylim(limit[:, 1])


def _draw(axes: Axes, clouds: Sequence[_Dots]) -> None:
    """Clouds as dots, far ones first and paler, so that near points hide far ones."""
    flat = np.concatenate([flattened(cloud.points) for cloud in clouds])
    areas = np.concatenate([np.full(len(cloud.points), cloud.area) for cloud in clouds])
    colors = np.concatenate([np.tile(to_rgb(c.color), (len(c.points), 1)) for c in clouds])
    finite = np.isfinite(flat).all(axis=1)
    flat, areas, colors = flat[finite], areas[finite], colors[finite]
    axes.set_axis_off()
    axes.set_aspect("equal")
    if not len(flat):
        return
    depth = flat[:, 2]
    far = (depth.max() - depth) / max(float(np.ptp(depth)), 1e-9)
    colors = colors + (1 - colors) * 0.45 * far[:, None]
    order = np.argsort(depth, kind="stable")
    axes.scatter(
        flat[order, 0], flat[order, 1], s=areas[order], c=colors[order], linewidths=0, zorder=2
    )


def _scale_bar(axes: Axes, length_mm: float = 20.0) -> None:
    """A bar of known length in the lower left corner, which `limits` keeps free."""
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    x, y = left + 0.02 * (right - left), bottom + 0.01 * (top - bottom)
    axes.plot([x, x + length_mm], [y, y], color=INK, linewidth=2, solid_capstyle="butt")
    axes.text(
        x + length_mm / 2, y + 0.012 * (top - bottom), f"{length_mm:g} mm", color=INK, fontsize=8,
        ha="center", va="bottom",
    )  # fmt: skip


def _cloud_legend(figure: Figure, green: str, red: str) -> None:
    """Names the two clouds below the panels."""
    axes = figure.axes[0]
    entries = [
        axes.scatter([], [], s=36, color=color, label=label, linewidths=0)
        for color, label in ((SOURCE_GREEN, green), (REFERENCE_RED, red))
    ]
    figure.legend(
        handles=entries, loc="outside lower center", ncols=2, frameon=False, fontsize=10,
        labelcolor=INK, handletextpad=0.2,
    )  # fmt: skip
