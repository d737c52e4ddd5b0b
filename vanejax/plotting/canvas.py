"""What all figures share: size, fonts, the palette, legends, colour bars, and their files.

One thing has one colour on every page. Colours that appear side by side differ for every kind of
colour vision and in lightness, so that they survive a greyscale print; a test simulates both. The
hues are Okabe and Ito's (2008) and Tol's (2021).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vanejax.errors import InputError
from vanejax.files import atomic_write

INK, FAINT, GRID = "#26292e", "#8a8f98", "#e3e5e8"
SCAN, CAD, HIDDEN = "#0072b2", "#e69f00", "#e3a3c6"  # clouds; HIDDEN: surface that a view misses
OURS, PAPER = "#0072b2", "#d55e00"  # where a figure has both
CLUTTER, TABLE = "#8c2d04", "#d9c9a3"
RIGHT, WRONG = INK, "#d55e00"  # matches
VERDICTS = {"accepted": "#0072b2", "ambiguous": "#e69f00", "rejected": "#8c2d04"}
NO_PARTNER = "#e3c800"  # a point without a surface to deviate from
DEVIATION_COLORMAP = "coolwarm"  # blue below the surface, red above it, grey on it
FAR_BELOW, FAR_ABOVE = "#0b1640", "#4a0010"  # beyond the ends of these colours
ERROR_COLORMAP = "YlGnBu"  # what has no sign: darker is more
SERIES = ("#0072b2", "#e69f00", "#882255", "#56b4e9", "#d55e00", "#009e73")
MARKERS = ("o", "s", "^", "D", "v", "P")  # of the series: not by colour alone


class Style(NamedTuple):
    """How one line of a chart looks."""

    color: str
    line: str
    marker: str


# Open3D's methods have the colour of ours, dashed
METHODS = {
    "rpmnet": Style("#0072b2", "-", "o"),
    "icp": Style("#26292e", "-", "s"),
    "sac_ia": Style("#e69f00", "-", "^"),
    "sac_ia_icp": Style("#d55e00", "-", "v"),
    "fgr": Style("#882255", "-", "D"),
    "dcp": Style("#56b4e9", "-", "P"),
    "pointnetlk": Style("#009e73", "-", "X"),
    "pcrnet": Style("#cc79a7", "-", "*"),
    "open3d_icp": Style("#26292e", "--", "s"),
    "open3d_ransac_icp": Style("#d55e00", "--", "v"),
    "open3d_fgr": Style("#882255", "--", "D"),
}
SENSORS = {
    "real": Style(INK, "-", "o"),
    "ideal": Style(FAINT, ":", "s"),
    "consumer_depth": Style("#d55e00", "--", "^"),
}

WIDTH_IN = 7.2  # of two columns in print; a wider figure would be printed smaller than drawn
TITLE_PT, LABEL_PT, TICK_PT = 9.0, 8.0, 7.5
_DPI = 200
_MANY_POINTS = 500  # a scatter of more is stored in a PDF as pixels


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure on an Agg canvas, whose panels arrange themselves without overlap."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained", facecolor="white")
    figure.get_layout_engine().set(w_pad=0.05, h_pad=0.05)
    FigureCanvasAgg(figure)
    return figure


def style_chart(axes: Axes, *, title: str = "", xlabel: str = "", ylabel: str = "") -> None:
    """Labels and light grid lines behind the data; no box."""
    axes.set_title(title, color=INK, fontsize=TITLE_PT, loc="left")
    axes.set_xlabel(xlabel, color=INK, fontsize=LABEL_PT)
    axes.set_ylabel(ylabel, color=INK, fontsize=LABEL_PT)
    axes.tick_params(which="both", colors=INK, labelsize=TICK_PT)
    axes.set_axisbelow(True)
    axes.grid(axis="y", color=GRID, linewidth=0.8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)


def name_panel(axes: Axes, title: str, **look: Any) -> None:
    """A title over a panel."""
    axes.set_title(title, **{"color": INK, "fontsize": LABEL_PT, **look})


def add_legend(owner: Axes | Figure, handles: Sequence[Artist] | None = None, **place: Any) -> None:
    """A legend without a frame; of a figure's first panel if no handles are given."""
    if handles is None:
        axes = owner.axes[0] if isinstance(owner, Figure) else owner
        handles = axes.get_legend_handles_labels()[0]
    owner.legend(
        handles=handles, frameon=False, fontsize=LABEL_PT, labelcolor=INK, handletextpad=0.5,
        **place,
    )  # fmt: skip


def name_colors(figure: Figure, colors: Mapping[str, str], *, columns: int | None = None) -> None:
    """A legend of dots below the panels: what each colour means; in one row if no columns."""
    dots = [
        Line2D([], [], marker="o", markersize=6, linestyle="", color=color, label=name)
        for name, color in colors.items()
    ]
    add_legend(figure, dots, loc="outside lower center", ncols=columns or len(dots))


def add_color_bar(
    figure: Figure, panels: Any, scale: ScalarMappable, label: str, **place: Any
) -> Colorbar:
    """A colour bar with its label, for all of the panels."""
    bar = figure.colorbar(scale, ax=panels, **{"pad": 0.02, **place})
    bar.outline.set_visible(False)
    bar.ax.tick_params(which="both", colors=INK, labelsize=TICK_PT, length=0)
    bar.set_label(label, color=INK, fontsize=LABEL_PT)
    return bar


def save_figure(figure: Figure, path: str | os.PathLike[str], *, dpi: int = _DPI) -> None:
    """Writes .png and, beside it, the same as .pdf; or one file, where the suffix is .pdf or .svg.

    Lines and words of a .pdf are vectors, large clouds of points are pixels. Files appear complete
    or not at all.

    Raises:
      InputError: another suffix, or a folder that cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".pdf", ".svg"):
        raise InputError(f"{path}: cannot draw {suffix or 'no suffix'}; use .png, .pdf or .svg")
    for axes in figure.axes:
        for cloud in axes.collections:
            cloud.set_rasterized(len(cloud.get_offsets()) > _MANY_POINTS)
    dates = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
    # TrueType: a journal's press and a reader's search find the words
    with rc_context({"pdf.fonttype": 42}):
        for kind in ("png", "pdf") if suffix == ".png" else (suffix[1:],):
            with atomic_write(path.with_suffix(f".{kind}")) as partial:
                figure.savefig(partial, format=kind, dpi=dpi, metadata=dates[kind])
