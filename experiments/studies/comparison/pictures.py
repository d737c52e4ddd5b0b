"""The pictures of a comparison: shares of views below an error, and one view under every method."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from experiments.runner.evaluation_pictures import overlay
from experiments.runner.registrations import Results
from experiments.studies.comparison.methods import TITLES
from vanejax import plotting
from vanejax.plotting.canvas import FAINT, INK, new_figure, save_figure, style_chart
from vanejax.plotting.charts import SERIES
from vanejax.training.dataset import ScanSet

ERRORS = (
    ("rotation_error_deg", "rotation error (deg)", "rotation_deg"),
    ("translation_error_mm", "translation error (mm)", "translation_mm"),
)
STAGES = (("alone", "as the method leaves it"), ("refined", "refined by ray casting"))


def draw(
    report: Mapping[str, Any], results: Mapping[str, Results], scans: ScanSet, folder: Path
) -> None:
    """errors.png, and methods.png: the paper's Fig. 3 for the hardest view."""
    save_figure(error_shares(report), folder / "errors.png")
    view = int(report["hardest"][0])
    shown = {TITLES[name]: overlay(found, scans, view) for name, found in results.items()}
    save_figure(plotting.method_overlays(shown), folder / "methods.png")


def error_shares(report: Mapping[str, Any]) -> Figure:
    """For each method the share of the views that err by less, before and after refinement."""
    figure = new_figure(12.0, 8.0)
    panels = figure.subplots(2, 2, sharex="col", sharey=True)
    methods = [method for method in report["methods"] if "alone" in method]
    for row, (stage, words) in zip(panels, STAGES, strict=True):
        for axes, (name, label, need) in zip(row, ERRORS, strict=True):
            style_chart(axes, title=words, xlabel=label, ylabel="share of the views")
            for number, method in enumerate(methods):
                _share(axes, method[stage][name], number, method["title"])
            axes.axvline(report["need"][need], color=FAINT, linewidth=1.0)
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.tick_params(labelbottom=True)
            axes.set_ylim(0, 1.02)
    lines, titles = panels[0, 0].get_legend_handles_labels()
    figure.legend(
        lines, titles, loc="outside upper center", ncols=4, frameon=False, fontsize=9,
        labelcolor=INK,
    )  # fmt: skip
    return figure


def _share(axes: Axes, errors: list[float | None], number: int, label: str) -> None:
    values = np.sort([np.inf if error is None else error for error in errors])
    share = np.arange(1, len(values) + 1) / len(values)
    color = SERIES[number % len(SERIES)]
    style = "-" if number < len(SERIES) else "--"
    axes.plot(values, share, style, color=color, label=label, drawstyle="steps-post")
