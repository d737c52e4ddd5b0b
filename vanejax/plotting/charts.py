"""Charts of errors: over viewpoints, over axes, over training."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from vanejax.errors import InputError
from vanejax.matching.metrics import mean_per_axis, mean_per_view
from vanejax.plotting.canvas import (
    ERROR_COLORMAP,
    GRID,
    INK,
    MARKERS,
    SERIES,
    TICK_PT,
    WIDTH_IN,
    add_color_bar,
    add_legend,
    new_figure,
    style_chart,
)


@dataclasses.dataclass(frozen=True, eq=False)
class AxisErrors:
    """Errors of V views along x, y and z, the terms of eqs 8 to 11.

    Attributes:
      rotation_deg: [V, 3].
      translation_mm: [V, 3].
    """

    rotation_deg: np.ndarray
    translation_mm: np.ndarray


def error_map(
    elevation_deg: np.ndarray,
    azimuth_deg: np.ndarray,
    rotation_deg: np.ndarray,
    translation_mm: np.ndarray,
) -> Figure:
    """Errors of V views over azimuth and elevation: a cell for each, with its value if it fits.

    Args:
      elevation_deg: [V] of the viewpoints, which need not fill the grid.
      azimuth_deg: [V].
      rotation_deg: [V] errors; not finite ones are marked "failed".
      translation_mm: [V] errors, likewise.
    """
    elevations, row = np.unique(elevation_deg, return_inverse=True)
    azimuths, column = np.unique(azimuth_deg, return_inverse=True)
    side_by_side = len(azimuths) <= 3
    high = max(0.25 * len(elevations) + 0.7, 1.5)
    figure = new_figure(WIDTH_IN, high if side_by_side else 2 * high)
    panels = figure.subplots(*((1, 2) if side_by_side else (2, 1)))
    for axes, values, title, unit in (
        (panels[0], rotation_deg, "rotation error", "deg"),
        (panels[1], translation_mm, "translation error at the part's centre", "mm"),
    ):
        cells = np.full((len(elevations), len(azimuths)), np.nan)
        there = np.zeros(cells.shape, bool)
        cells[row, column], there[row, column] = values, True
        _heat_map(figure, axes, cells, there, unit)
        style_chart(
            axes, title=f"{title} ({unit})", xlabel="azimuth (deg)", ylabel="elevation (deg)"
        )
        axes.grid(False)
        some = slice(None, None, -(-len(azimuths) // 18))
        axes.set_xticks(range(len(azimuths))[some], [f"{angle:g}" for angle in azimuths[some]])
        axes.set_yticks(range(len(elevations)), [f"{angle:g}" for angle in elevations])
    return figure


def axis_errors(series: Mapping[str, AxisErrors]) -> Figure:
    """Mean errors per axis as bars (Fig. 8) and per view as lines (Fig. 9).

    Args:
      series: what is compared, by name, such as a network by what it was trained on.

    Raises:
      InputError: nothing to draw.
    """
    if not series:
        raise InputError("axis_errors needs at least one series")
    figure = new_figure(WIDTH_IN, 4.4)
    panels = figure.subplots(2, 2, gridspec_kw={"width_ratios": (1, 2.2)})
    for (bars, lines), name, unit, equations in (
        (panels[0], "rotation", "deg", ("MRE, eq. 8", "MRE, eq. 10")),
        (panels[1], "translation", "mm", ("MTE, eq. 9", "MTE, eq. 11")),
    ):
        values = {
            label: np.asarray(getattr(errors, f"{name}_{unit}"), np.float64)
            for label, errors in series.items()
        }
        _axis_bars(bars, values)
        _view_lines(lines, values)
        style_chart(
            bars, title=f"per axis ({equations[0]})", xlabel="axis",
            ylabel=f"mean {name} error ({unit})",
        )  # fmt: skip
        title = f"per view, mean of the axes ({equations[1]})"
        style_chart(lines, title=title, xlabel="test view, by elevation, then azimuth")
    if len(series) > 1:
        add_legend(figure, loc="outside upper right", ncols=len(series))
    return figure


def _axis_bars(axes: Axes, series: Mapping[str, np.ndarray]) -> None:
    """Bars of the means over views, for each series [V, 3] of errors; failed views left out."""
    width = 0.72 / len(series)
    for index, (label, values) in enumerate(series.items()):
        finite = np.isfinite(values).all(axis=1)
        heights = mean_per_axis(values[finite]) if finite.any() else np.full(3, np.nan)
        bars = axes.bar(
            np.arange(3) + (index - (len(series) - 1) / 2) * width,
            np.asarray(heights),
            0.94 * width,
            color=SERIES[index % len(SERIES)],
            label=label,
        )
        axes.bar_label(bars, fmt="%.2f", padding=2, color=INK, fontsize=7)
    axes.set_xticks(range(3), ["x", "y", "z"])
    axes.tick_params(axis="x", length=0)
    axes.margins(y=0.14)


def _view_lines(axes: Axes, series: Mapping[str, np.ndarray]) -> None:
    """Lines of the means over axes, for each series [V, 3]; failed views are crosses at 0."""
    for index, values in enumerate(series.values()):
        color = SERIES[index % len(SERIES)]
        views = np.arange(1, len(values) + 1)
        axes.plot(
            views, np.asarray(mean_per_view(values)), f"{MARKERS[index % len(MARKERS)]}-",
            color=color, markersize=2.5, linewidth=0.9,
        )  # fmt: skip
        lost = views[~np.isfinite(values).all(axis=1)]
        if len(lost):
            axes.plot(lost, np.zeros(len(lost)), "x", color=color, label="failed")
            add_legend(axes)
    axes.set_ylim(bottom=0)
    axes.set_xlim(0.3, max(map(len, series.values())) + 0.7)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def training_curves(rows: Sequence[Mapping[str, float]]) -> Figure:
    """Loss, rotation and translation error over steps, with validation points over them.

    Translation errors are at the part's centre.

    Args:
      rows: of a run's JSONL log: ``step`` and any of ``loss``, ``rotation_error_deg``,
        ``translation_error_mm`` and the last two with ``validation_`` before.

    Raises:
      InputError: no row has any of them.
    """
    figure = new_figure(WIDTH_IN, 2.4)
    panels = figure.subplots(1, 3)
    drawn = 0
    for axes, name, title, unit in (
        (panels[0], "loss", "training loss", ""),
        (panels[1], "rotation_error_deg", "rotation error", "deg"),
        (panels[2], "translation_error_mm", "translation error", "mm"),
    ):
        steps, values = _column(rows, name)
        drawn += len(steps)
        style_chart(axes, title=title, xlabel="step", ylabel=unit)
        axes.set_yscale("log")
        axes.plot(steps, values, color=SERIES[0], alpha=0.25, linewidth=0.8)
        axes.plot(steps, _smooth(values), color=SERIES[0], linewidth=1.8, label="training")
        steps, values = _column(rows, f"validation_{name}")
        if len(steps):
            drawn += len(steps)
            axes.plot(
                steps, values, "o", color=SERIES[5], markersize=4.5, markeredgecolor="white",
                markeredgewidth=0.6, label="validation (averaged weights)",
            )  # fmt: skip
            add_legend(axes)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_major_locator(MaxNLocator(nbins=6, steps=(1, 2, 5, 10), integer=True))
    if not drawn:
        raise InputError("training_curves: the log has no loss and no errors")
    return figure


def _heat_map(figure: Figure, axes: Axes, cells: np.ndarray, there: np.ndarray, unit: str) -> None:
    """Cells [R, C] as colours and numbers; ``there`` [R, C] tells failures from missing views."""
    finite = cells[np.isfinite(cells)]
    scale = Normalize(0.0, float(finite.max()) if finite.size and finite.max() > 0 else 1.0)
    axes.set_facecolor(GRID)
    image = axes.imshow(
        np.ma.masked_invalid(cells), cmap=ERROR_COLORMAP, norm=scale, origin="lower", aspect="auto"
    )
    roomy = cells.shape[1] <= 12
    for (row, column), value in np.ndenumerate(cells):
        if there[row, column]:
            dark = np.isfinite(value) and scale(value) > 0.55
            words = f"{value:.2f}" if roomy else ""
            axes.text(
                column, row, words if np.isfinite(value) else "failed" if roomy else "×",
                ha="center", va="center", fontsize=TICK_PT, color="white" if dark else INK,
            )  # fmt: skip
    # white lines between the cells
    rows, columns = cells.shape
    for edge in np.arange(0.5, columns - 1):
        axes.axvline(edge, color="white", linewidth=1.5)
    for edge in np.arange(0.5, rows - 1):
        axes.axhline(edge, color="white", linewidth=1.5)
    add_color_bar(figure, axes, image, unit, fraction=0.05)


def _column(rows: Sequence[Mapping[str, float]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps [n] and the values [n] of ``name`` in the rows that have a finite positive one."""
    found = [(row["step"], row[name]) for row in rows if name in row]
    steps, values = np.array(found, np.float64).reshape(-1, 2).T
    drawable = np.isfinite(values) & (values > 0)
    return steps[drawable], values[drawable]


def _smooth(values: np.ndarray) -> np.ndarray:
    """Running geometric mean over about a fortieth of the values, shorter at both ends."""
    half = len(values) // 80
    if not half:
        return values
    total = np.concatenate([[0.0], np.cumsum(np.log(values))])
    index = np.arange(len(values))
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    return np.exp((total[high] - total[low]) / (high - low))
