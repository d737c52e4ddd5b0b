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
from vanejax.plotting.canvas import GRID, INK, new_figure, style_chart

# distinguishable for every kind of colour vision (Okabe and Ito, 2008)
SERIES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")


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
    """Errors of V views over azimuth and elevation, a cell with its value for each view.

    Args:
      elevation_deg, azimuth_deg: [V] viewpoints; they need not fill the grid.
      rotation_deg, translation_mm: [V] errors; not finite ones are marked "failed".
    """
    elevations, row = np.unique(elevation_deg, return_inverse=True)
    azimuths, column = np.unique(azimuth_deg, return_inverse=True)
    wide = max(0.62 * len(azimuths) + 1.9, 4.2)
    high = max(0.46 * len(elevations) + 1.1, 1.9)
    side_by_side = wide < 8
    size = (2 * wide, high) if side_by_side else (wide, 2 * high)
    figure = new_figure(*size)
    panels = figure.subplots(*((1, 2) if side_by_side else (2, 1)))
    for axes, values, title, unit in (
        (panels[0], rotation_deg, "rotation error", "deg"),
        (panels[1], translation_mm, "translation error at the part's centre", "mm"),
    ):
        cells = np.full((len(elevations), len(azimuths)), np.nan)
        there = np.zeros(cells.shape, bool)
        cells[row, column], there[row, column] = values, True
        _heat_map(figure, axes, cells, there, f"{title} ({unit})")
        style_chart(
            axes, title=f"{title} ({unit})", xlabel="azimuth (deg)", ylabel="elevation (deg)"
        )
        axes.grid(False)
        axes.set_xticks(range(len(azimuths)), [f"{angle:g}" for angle in azimuths])
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
    figure = new_figure(11.0, 6.4)
    panels = figure.subplots(2, 2, gridspec_kw={"width_ratios": (1, 2.2)})
    for line, (name, unit, field) in enumerate(
        (("rotation", "deg", "rotation_deg"), ("translation", "mm", "translation_mm"))
    ):
        bars, lines = panels[line]
        width = 0.72 / len(series)
        for index, (label, errors) in enumerate(series.items()):
            values = np.asarray(getattr(errors, field), np.float64)
            color = SERIES[index % len(SERIES)]
            place = np.arange(3) + (index - (len(series) - 1) / 2) * width
            with np.errstate(invalid="ignore"):
                finite = np.isfinite(values).all(axis=1)
            heights = values[finite].mean(axis=0) if finite.any() else np.full(3, np.nan)
            container = bars.bar(place, heights, 0.94 * width, color=color, label=label)
            bars.bar_label(container, fmt="%.2f", padding=2, color=INK, fontsize=9)
            views = np.arange(1, len(values) + 1)
            per_view = values.mean(axis=1)
            lines.plot(views, per_view, "o-", color=color, markersize=3.5, linewidth=1.1)
            lines.plot(views[~finite], np.zeros((~finite).sum()), "x", color=color, clip_on=False)
        style_chart(bars, title=f"mean {name} error per axis", ylabel=unit)
        bars.set_xticks(range(3), ["x", "y", "z"])
        bars.tick_params(axis="x", length=0)
        bars.margins(y=0.14)
        style_chart(lines, title=f"mean {name} error over the axes, per view", ylabel=unit)
        lines.set_xlabel("test view" if line else "", color=INK, fontsize=10)
        lines.set_ylim(bottom=0)
        lines.xaxis.set_major_locator(MaxNLocator(integer=True))
    if len(series) > 1:
        figure.legend(
            *panels[0, 0].get_legend_handles_labels(), loc="outside upper right",
            ncols=len(series), frameon=False, labelcolor=INK,
        )  # fmt: skip
    return figure


def training_curves(rows: Sequence[Mapping[str, float]]) -> Figure:
    """Loss, rotation error and translation error over steps, with validation points over them.

    Args:
      rows: of a run's JSONL log: ``step`` and any of ``loss``, ``rotation_error_deg``,
        ``translation_error_mm`` and the last two with ``validation_`` before.

    Raises:
      InputError: no row has any of them.
    """
    figure = new_figure(13.0, 3.9)
    panels = figure.subplots(1, 3)
    drawn = 0
    for axes, name, title, unit in (
        (panels[0], "loss", "training loss", ""),
        (panels[1], "rotation_error_deg", "rotation error", "deg"),
        (panels[2], "translation_error_mm", "translation error at the part's centre", "mm"),
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
            axes.legend(frameon=False, fontsize=9, labelcolor=INK)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    if not drawn:
        raise InputError("training_curves: the log has no loss and no errors")
    return figure


def _heat_map(figure: Figure, axes: Axes, cells: np.ndarray, there: np.ndarray, label: str) -> None:
    """Cells [R, C] as colours and numbers; ``there`` [R, C] tells failures from missing views."""
    finite = cells[np.isfinite(cells)]
    scale = Normalize(0.0, float(finite.max()) if finite.size and finite.max() > 0 else 1.0)
    axes.set_facecolor(GRID)
    image = axes.imshow(
        np.ma.masked_invalid(cells), cmap="YlGnBu", norm=scale, origin="lower", aspect="auto"
    )
    for (row, column), value in np.ndenumerate(cells):
        if there[row, column]:
            dark = np.isfinite(value) and scale(value) > 0.55
            axes.text(
                column, row, f"{value:.2f}" if np.isfinite(value) else "failed",
                ha="center", va="center", fontsize=9, color="white" if dark else INK,
            )  # fmt: skip
    # white lines between the cells
    rows, columns = cells.shape
    for edge in np.arange(0.5, columns - 1):
        axes.axvline(edge, color="white", linewidth=1.5)
    for edge in np.arange(0.5, rows - 1):
        axes.axhline(edge, color="white", linewidth=1.5)
    bar = figure.colorbar(image, ax=axes, pad=0.02, fraction=0.05)
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=INK, labelsize=9, length=0)
    bar.ax.set_ylabel(label.rpartition("(")[2].rstrip(")"), color=INK, fontsize=10)


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
