"""The project in one picture: part, virtual scan, registration."""

from __future__ import annotations

import itertools

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.offsetbox import AnchoredOffsetbox, HPacker, TextArea
from matplotlib.patches import ConnectionPatch

from vanejax.plotting.canvas import FAINT, INK, REFERENCE_RED, SOURCE_GREEN, new_figure
from vanejax.plotting.clouds import (
    Overlay,
    draw_overlay,
    draw_view,
    height_per_width,
    limits,
    seen_and_hidden,
    set_limits,
)
from vanejax.plotting.shading import crop, draw_part, shade
from vanejax.scanner.camera import Camera
from vanejax.scanner.ideal_scan import Scan

_HEIGHT_IN, _GAP_IN = 3.4, 0.7


def overview_picture(portrait: Scan, camera: Camera, scan: Scan, overlay: Overlay) -> Figure:
    """Four panels in a row: the shaded part; seen and hidden surface; before; after.

    Args:
      portrait: a view that shows the part well, with all its pixels.
      camera: the one that made ``portrait``.
      scan: the view that is registered, with `Scan.hidden`.
      overlay: its registration.
    """
    rows, columns = crop(portrait, camera)
    wide, high = (columns.stop - columns.start) / camera.fx, (rows.stop - rows.start) / camera.fy
    pictures = (
        seen_and_hidden(scan, voxel_mm=1.0),
        (overlay.source, overlay.reference),
        (overlay.moved, overlay.reference),
    )
    frames = [limits(clouds) for clouds in pictures]
    widths = [wide / high] + [1 / height_per_width(frame) for frame in frames]
    figure = new_figure(_HEIGHT_IN * sum(widths) + 3 * _GAP_IN, _HEIGHT_IN + 0.7)
    figure.get_layout_engine().set(wspace=4 * _GAP_IN / (_HEIGHT_IN * sum(widths)))
    panels = figure.subplots(1, 4, gridspec_kw={"width_ratios": widths})
    draw_part(panels[0], portrait, camera, shade(portrait, camera))
    for axes, clouds, frame, drawn in zip(
        panels[1:], pictures, frames, (draw_view, draw_overlay, draw_overlay), strict=True
    ):
        drawn(axes, *clouds)
        set_limits(axes, frame)
    _caption(panels[0], "CAD part", [("all that is given", FAINT)])
    _caption(
        panels[1],
        "virtual scan",
        [("seen", SOURCE_GREEN), (" and ", FAINT), ("self-occluded", REFERENCE_RED)],
    )
    _caption(
        panels[2],
        "before registration",
        [("scan", SOURCE_GREEN), (" and ", FAINT), ("CAD", REFERENCE_RED), (", noisy", FAINT)],
    )
    error = f"{overlay.rotation_error_deg:.2f}°, {overlay.translation_error_mm:.2f} mm off"
    _caption(panels[3], "after registration", [(error, FAINT)])
    for left, right in itertools.pairwise(panels):
        _arrow(figure, left, right)
    return figure


def _caption(axes: Axes, title: str, words: list[tuple[str, str]]) -> None:
    """A bold title and, below it, words in their own colours."""
    axes.set_title(title + "\n", color=INK, fontsize=14, fontweight="bold")
    areas = [TextArea(w, textprops={"color": color, "fontsize": 11.5}) for w, color in words]
    axes.add_artist(
        AnchoredOffsetbox(
            "lower center",
            child=HPacker(children=areas, pad=0, sep=0),
            bbox_to_anchor=(0.5, 1.0),
            bbox_transform=axes.transAxes,
            frameon=False,
            borderpad=0.1,
        )
    )


def _arrow(figure: Figure, left: Axes, right: Axes) -> None:
    """From one panel to the next."""
    figure.add_artist(
        ConnectionPatch(
            (1.0, 0.5), (0.0, 0.5), "axes fraction", "axes fraction", axesA=left, axesB=right,
            arrowstyle="-|>", color=FAINT, linewidth=2, mutation_scale=18,
        )
    )  # fmt: skip
