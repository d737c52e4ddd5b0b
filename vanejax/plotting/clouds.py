"""Pictures of point clouds: registrations before and after, and what a view sees and misses."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from vanejax.camera import look_at
from vanejax.errors import InputError
from vanejax.plotting.canvas import INK, REFERENCE_RED, SOURCE_GREEN, new_figure
from vanejax.pointcloud import voxel_thin
from vanejax.scanner import Scan

# Where the reader stands, as a viewpoint of the hemisphere: oblique enough to see a tilt.
READER_ELEVATION_DEG = 50.0
READER_AZIMUTH_DEG = 325.0


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
    reach = [
        np.nanmax(np.abs(_flat(cloud)[:, :2]), axis=0, initial=1.0)
        for overlay in overlays
        for cloud in (overlay.source, overlay.reference)
    ]
    half_width, half_height = 1.04 * np.max(reach, axis=0)
    column_in = 2.55
    panel_in = column_in * half_height / half_width
    figure = new_figure(column_in * len(overlays) + 0.3, 2 * panel_in + 1.4, layout="compressed")
    rows = figure.subplots(2, len(overlays), squeeze=False)
    for column, overlay in enumerate(overlays):
        reference = _Dots(overlay.reference, REFERENCE_RED, 1.6)
        for axes, source in zip(rows[:, column], (overlay.source, overlay.moved), strict=True):
            _draw(axes, [reference, _Dots(source, SOURCE_GREEN, 5.0)])
            axes.set_xlim(-half_width, half_width)
            axes.set_ylim(-half_height, half_height)
        rows[0, column].set_title(
            f"elevation {overlay.elevation_deg:g}°, azimuth {overlay.azimuth_deg:g}°\n"
            f"{100 * overlay.visible_fraction:.0f} % visible",
            color=INK,
            fontsize=10,
        )
        finite = np.isfinite(overlay.rotation_error_deg + overlay.translation_error_mm)
        rows[1, column].set_title(
            f"{overlay.rotation_error_deg:.2f}°, {overlay.translation_error_mm:.2f} mm"
            if finite
            else "no finite pose",
            color=INK,
            fontsize=10,
            fontweight="bold",
        )
    for axes, name in zip(rows[:, 0], ("before", "after"), strict=True):
        axes.text(
            0.0, 0.5, name, transform=axes.transAxes, rotation=90, ha="right", va="center",
            color=INK, fontsize=11, fontweight="bold",
        )  # fmt: skip
    _scale_bar(rows[1, 0])
    _cloud_legend(figure, "source (virtual scan)", "reference (CAD)")
    return figure


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
    flat = np.concatenate([_flat(cloud)[:, :2] for pair in pictures for cloud in pair])
    low, high = flat.min(axis=0), flat.max(axis=0)
    width, height = high - low
    panel_in = 3.6
    size = (panel_in * columns, (panel_in * height / width + 0.3) * lines + 0.4)
    figure = new_figure(*size, layout="compressed")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, (seen, hidden), name in zip(panels, pictures, names, strict=False):
        draw_view(axes, seen, hidden)
        axes.set_title(name, color=INK, fontsize=10)
        axes.set_xlim(low[0] - 2, high[0] + 2)
        axes.set_ylim(low[1] - 0.05 * height, high[1] + 2)
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
    _draw(axes, [_Dots(hidden, REFERENCE_RED, 3.5), _Dots(seen, SOURCE_GREEN, 3.5)])


def draw_overlay(axes: Axes, source: np.ndarray, reference: np.ndarray) -> None:
    """Source [N, 3] on reference [M, 3] into axes."""
    _draw(axes, [_Dots(reference, REFERENCE_RED, 1.6), _Dots(source, SOURCE_GREEN, 5.0)])


def _flat(points: np.ndarray) -> np.ndarray:
    """Points [N, 3] as the reader sees them: x right, y up, z towards the reader."""
    a, b = np.radians([READER_ELEVATION_DEG, READER_AZIMUTH_DEG])
    eye = np.array([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)])
    return look_at(eye, np.zeros(3)).rotate(np.asarray(points, np.float64))


def _draw(axes: Axes, clouds: Sequence[_Dots]) -> None:
    """Clouds as dots, far ones first and paler, so that near points hide far ones."""
    flat = np.concatenate([_flat(cloud.points) for cloud in clouds])
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
    colors = colors + (1 - colors) * 0.55 * far[:, None]
    order = np.argsort(depth, kind="stable")
    axes.scatter(
        flat[order, 0], flat[order, 1], s=areas[order], c=colors[order], linewidths=0, zorder=2
    )


def _scale_bar(axes: Axes, length_mm: float = 20.0) -> None:
    """A bar of known length in the lower left corner."""
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    x, y = left + 0.04 * (right - left), bottom + 0.03 * (top - bottom)
    axes.plot([x, x + length_mm], [y, y], color=INK, linewidth=2, solid_capstyle="butt")
    axes.text(
        x + length_mm / 2, y + 0.02 * (top - bottom), f"{length_mm:g} mm", color=INK, fontsize=8,
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
