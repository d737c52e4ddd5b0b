"""The project in one picture: part, virtual scan, registration."""

from __future__ import annotations

import itertools

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.offsetbox import AnchoredOffsetbox, HPacker, TextArea
from matplotlib.patches import ConnectionPatch

from vanejax.plotting.canvas import (
    CAD,
    FAINT,
    HIDDEN,
    INK,
    LABEL_PT,
    SCAN,
    TITLE_PT,
    WIDTH_IN,
    new_figure,
)
from vanejax.plotting.clouds import (
    Overlay,
    draw_dots,
    height_per_width,
    limits,
    overlay_dots,
    seen_and_hidden,
    view_dots,
)
from vanejax.plotting.shading import crop_size, draw_part, shade
from vanejax.scanner import Camera, Scan

_GAP_IN = 0.3


def overview_picture(portrait: Scan, camera: Camera, scan: Scan, overlay: Overlay) -> Figure:
    """Four panels in a row: the shaded part; seen and hidden surface; before; after.

    Args:
      portrait: a view that shows the part well, with all its pixels.
      camera: the one that made ``portrait``.
      scan: the view that is registered, with `Scan.hidden`.
      overlay: its registration.
    """
    wide, high = crop_size(portrait, camera)
    view = seen_and_hidden(scan, voxel_mm=1.0)
    frames = [limits(view), *(limits([c, overlay.reference])
                              for c in (overlay.source, overlay.moved))]  # fmt: skip
    widths = [wide / high] + [1 / height_per_width(frame) for frame in frames]
    height = (WIDTH_IN - 3 * _GAP_IN) / sum(widths)
    figure = new_figure(WIDTH_IN, height + 0.5)
    figure.get_layout_engine().set(wspace=4 * _GAP_IN / WIDTH_IN)
    panels = figure.subplots(1, 4, gridspec_kw={"width_ratios": widths})
    draw_part(panels[0], portrait, camera, shade(portrait, camera))
    dots = [view_dots(*view, height * widths[1])]
    dots += [overlay_dots(c, overlay.reference, 1.6) for c in (overlay.source, overlay.moved)]
    for axes, clouds, frame in zip(panels[1:], dots, frames, strict=True):
        draw_dots(axes, clouds, frame)
    _caption(panels[0], "CAD part", [("the only input", INK)])
    _caption(
        panels[1], "virtual scan", [("● ", SCAN), ("seen  ", INK), ("● ", HIDDEN), ("hidden", INK)]
    )
    _caption(
        panels[2], "before registration", [("● ", SCAN), ("scan  ", INK), ("● ", CAD), ("CAD", INK)]
    )
    error = f"{overlay.rotation_error_deg:.2f}°, {overlay.translation_error_mm:.2f} mm error"
    _caption(panels[3], "after registration", [(error, INK)])
    for left, right in itertools.pairwise(panels):
        figure.add_artist(
            ConnectionPatch(
                (1.0, 0.5), (0.0, 0.5), "axes fraction", "axes fraction", axesA=left, axesB=right,
                arrowstyle="-|>", color=FAINT, linewidth=1.2, mutation_scale=9,
            )
        )  # fmt: skip
    return figure


def _caption(axes: Axes, title: str, words: list[tuple[str, str]]) -> None:
    """A bold title and, below it, words in their own colours."""
    axes.set_title(title + "\n", color=INK, fontsize=TITLE_PT, fontweight="bold")
    areas = [TextArea(w, textprops={"color": color, "fontsize": LABEL_PT}) for w, color in words]
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
