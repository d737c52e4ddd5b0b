"""What all figures share: canvas, colours, and how they reach a file."""

from __future__ import annotations

import os
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vanejax.errors import InputError
from vanejax.files import atomic_write

# The paper's green and red, in tones that differ in lightness too: a colour-blind eye is helped
# further by the sizes that the figures give the two clouds.
SOURCE_GREEN = "#1b9e4b"
REFERENCE_RED = "#d1342f"
INK = "#26292e"
FAINT = "#8a8f98"
GRID = "#e3e5e8"


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure on an Agg canvas, whose panels arrange themselves without overlap."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained", facecolor="white")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.08)
    FigureCanvasAgg(figure)
    return figure


def style_chart(axes: Axes, *, title: str = "", xlabel: str = "", ylabel: str = "") -> None:
    """Labels and light grid lines behind the data; no box."""
    axes.set_title(title, color=INK, fontsize=11, loc="left")
    axes.set_xlabel(xlabel, color=INK, fontsize=10)
    axes.set_ylabel(ylabel, color=INK, fontsize=10)
    axes.tick_params(colors=INK, labelsize=9)
    axes.set_axisbelow(True)
    axes.grid(axis="y", color=GRID, linewidth=0.8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)


def save_figure(figure: Figure, path: str | os.PathLike[str], *, dpi: int = 150) -> None:
    """Writes .png, .pdf or .svg; the file appears complete or not at all.

    Raises:
      InputError: another suffix, or a folder that cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".pdf", ".svg"):
        raise InputError(f"{path}: cannot draw {suffix or 'no suffix'}; use .png, .pdf or .svg")
    with atomic_write(path) as partial:
        figure.savefig(partial, format=suffix[1:], dpi=dpi)
