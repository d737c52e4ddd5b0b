"""The picture of an ablation: errors over the first swept field, a line for each other value."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator, StrMethodFormatter

from experiments.studies.ablation.table import CELL_TESTS, labels, shown, two_tests
from vanejax.plotting.canvas import MARKERS, SERIES, WIDTH_IN, add_legend, new_figure, style_chart

ERRORS = (
    ("rotation_error_deg", "rotation error (deg)"),
    ("translation_error_mm", "translation error (mm)"),
)


def picture(report: Mapping[str, Any]) -> Figure:
    """Mean errors over the test views; bars span the seeds, a budget ended what is hollow.

    Args:
      report: what ablation.json holds.
    """
    points, sweeps = report["points"], report["sweeps"]
    fields = [sweep["field"] for sweep in sweeps]
    tests = list(CELL_TESTS) if two_tests(points) else ["own"]
    cut = any("budget" in point["ended_by"] for point in points)
    name = labels(fields)[0] + (" (hollow: the budget ended the training)" if cut else "")
    figure = new_figure(WIDTH_IN, 0.2 + 2.3 * len(tests))
    panels = figure.subplots(len(tests), len(ERRORS), squeeze=False)
    for row, test in zip(panels, tests, strict=True):
        for axes, (measure, label) in zip(row, ERRORS, strict=True):
            style_chart(axes, title=CELL_TESTS[test], xlabel=name, ylabel=f"mean {label}")
            places = _value_axis(axes, sweeps[0]["values"])
            for number, (words, line) in enumerate(_lines(points, fields).items()):
                spreads = [
                    (
                        places[json.dumps(point["overrides"][fields[0]])],
                        point["tests"][test][measure]["mean"],
                        "budget" in point["ended_by"],
                    )
                    for point in line
                    if point["tests"][test]
                ]
                _draw(axes, spreads, number % len(SERIES), words)
            _error_axis(axes)
    if len(fields) > 1:
        add_legend(panels[0, 0])
    return figure


def geometric(values: Sequence[float]) -> bool:
    """Whether positive values are spaced more evenly by their logarithms than as they are."""
    ordered = np.sort(values)
    if len(ordered) < 3 or ordered[0] <= 0:
        return False
    plain, logarithmic = (np.diff(scale) for scale in (ordered, np.log(ordered)))
    return bool(np.std(logarithmic) / np.mean(logarithmic) < np.std(plain) / np.mean(plain))


def _lines(
    points: Sequence[Mapping[str, Any]], fields: Sequence[str]
) -> dict[str, list[Mapping[str, Any]]]:
    """Points by the values of every field but the first."""
    lines: dict[str, list[Mapping[str, Any]]] = {}
    for point in points:
        values = [shown(point["overrides"][field]) for field in fields[1:]]
        named = zip(labels(fields)[1:], values, strict=True)
        lines.setdefault(", ".join(f"{name} {value}" for name, value in named), []).append(point)
    return lines


def _draw(
    axes: Axes, spreads: Sequence[tuple[float, Mapping[str, Any], bool]], number: int, label: str
) -> None:
    """One line; ``spreads``: place, spread over the seeds, and whether a budget ended one."""
    known = sorted(row for row in spreads if row[1]["mean"] is not None)
    color, marker = SERIES[number], MARKERS[number]
    x, means = [place for place, _, _ in known], [spread["mean"] for _, spread, _ in known]
    axes.plot(x, means, f"{marker}-", color=color, label=label, linewidth=1.2, markersize=4)
    for place, spread, cut in known:
        axes.plot([place] * 2, [spread["min"], spread["max"]], color=color, linewidth=1.0)
        if cut:
            hollow = {"markerfacecolor": "white", "markersize": 4}
            axes.plot(place, spread["mean"], marker, color=color, **hollow)


def _value_axis(axes: Axes, values: Sequence[Any]) -> dict[str, float]:
    """Readies the axis of the swept field: numbers where they are, all else side by side.

    Returns:
      The place of each value, by its JSON.
    """
    numbers = all(type(value) in (int, float) for value in values)
    places = [float(value) if numbers else float(index) for index, value in enumerate(values)]
    if numbers and geometric(places):
        axes.set_xscale("log")
    axes.set_xticks(places, [shown(value) for value in values])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.margins(x=0.08)
    return {json.dumps(value): place for value, place in zip(values, places, strict=True)}


def _error_axis(axes: Axes) -> None:
    """Logarithmic where the errors differ more than tenfold, else from zero."""
    drawn = np.concatenate([np.zeros(0), *(line.get_ydata() for line in axes.lines)])
    if drawn.size and drawn.min() > 0 and drawn.max() > 10 * drawn.min():
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    elif drawn.size:
        axes.set_ylim(0, 1.08 * drawn.max())
