"""The project in one picture: part, virtual scan, registration."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.offsetbox import AnchoredOffsetbox, HPacker, TextArea
from matplotlib.patches import ConnectionPatch

from vanejax.camera import Camera
from vanejax.plotting.canvas import FAINT, INK, REFERENCE_RED, SOURCE_GREEN, new_figure
from vanejax.plotting.clouds import Overlay, draw_overlay, draw_view, seen_and_hidden
from vanejax.plotting.shading import draw_part, shade
from vanejax.scanner import Scan


def overview_picture(portrait: Scan, camera: Camera, scan: Scan, overlay: Overlay) -> Figure:
    """Four panels in a row: the shaded part; seen and hidden surface; before; after.

    Args:
      portrait: a view that shows the part well, with all its pixels.
      camera: the one that made ``portrait``.
      scan: the view that is registered, with `Scan.hidden`.
      overlay: its registration.
    """
    figure = new_figure(16.0, 3.9)
    panels = figure.subplots(1, 4, gridspec_kw={"width_ratios": (1.0, 1.0, 1.15, 1.0)})
    draw_part(panels[0], portrait, camera, shade(portrait, camera))
    draw_view(panels[1], *seen_and_hidden(scan, voxel_mm=1.0))
    draw_overlay(panels[2], overlay.source, overlay.reference)
    draw_overlay(panels[3], overlay.moved, overlay.reference)
    _caption(panels[0], "CAD part", [("its shape is all that is given", FAINT)])
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
    for left, right in zip(panels[:-1], panels[1:], strict=True):
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
