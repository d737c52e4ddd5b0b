"""The pictures of a comparison: shares of views below an error, and which views each method misses.

`error_shares` and `error_maps` need the record alone; `draw` adds the hardest view's clouds.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.runner.evaluation_pictures import overlay
from experiments.runner.registrations import Results
from experiments.studies.comparison.methods import TITLES
from vanejax import plotting
from vanejax.plotting.canvas import (
    ERROR_COLORMAP,
    FAINT,
    INK,
    LABEL_PT,
    METHODS,
    OURS,
    TICK_PT,
    WIDTH_IN,
    add_color_bar,
    add_legend,
    new_figure,
    save_figure,
    style_chart,
)
from vanejax.scanner.camera import TEST_AZIMUTH_STEP_DEG
from vanejax.training.dataset import ScanSet

ERRORS = (
    ("rotation_error_deg", "rotation error (deg)", "rotation_deg", "deg"),
    ("translation_error_mm", "translation error (mm)", "translation_mm", "mm"),
)
# of the eleven curves those that are named, with the share at which their name stands
NAMED = {"rpmnet": 0.9, "sac_ia": 0.75, "icp": 0.6, "dcp": 0.42, "fgr": 0.25, "open3d_fgr": 0.12}


def draw(
    report: Mapping[str, Any], results: Mapping[str, Results], scans: ScanSet, folder: Path
) -> None:
    """errors.png; methods.png; and hardest_view.png: the paper's Fig. 3."""
    save_figure(error_shares(report), folder / "errors.png")
    save_figure(error_maps(report), folder / "methods.png")
    view = int(report["hardest"][0])
    shown = {TITLES[name]: overlay(found, scans, view) for name, found in results.items()}
    save_figure(plotting.method_displacements(shown), folder / "hardest_view.png")


def error_shares(report: Mapping[str, Any]) -> Figure:
    """For each method the share of the views that err by less; in blue, refined, of all methods.

    The band spans all methods whose refinement converges in at least nine of ten views.
    """
    figure = new_figure(WIDTH_IN, 3.3)
    panels = figure.subplots(1, 2, sharey=True)
    methods = [method for method in report["methods"] if "alone" in method]
    for axes, (name, label, need, unit) in zip(panels, ERRORS, strict=True):
        style_chart(axes, xlabel=label)
        axes.set_xscale("log")
        for method in sorted(methods, key=lambda method: method["name"] in NAMED):
            _share(axes, method, name)
        refined = [_sorted(m["refined"][name]) for m in methods if m["refined"]["success"] >= 0.9]
        if refined:
            share = _steps(refined[0])
            low, high = np.min(refined, axis=0), np.max(refined, axis=0)
            high = np.minimum(high, 1e3)  # infinite where there is no pose
            axes.fill_betweenx(share, low, high, color=OURS, alpha=0.3, step="post", linewidth=0)
            middle = np.median(refined, axis=0)
            axes.plot(middle, share, ":", color=OURS, linewidth=1.8)
            place = (float(np.interp(0.75, share, middle)), 0.75)
            axes.annotate(
                "any of\nthem,\nrefined", place, (-5, 0), textcoords="offset points",
                color=OURS, fontsize=LABEL_PT, va="center", ha="right",
            )  # fmt: skip
        limit = report["need"][need]
        axes.axvline(limit, color=INK, linewidth=0.8)
        axes.text(limit, 1.01, f"need: {limit:g} {unit}", color=INK, fontsize=TICK_PT, ha="center")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_ylim(0, 1.0)
    panels[0].set_ylabel("share of the views with a smaller error")
    others = [m for m in methods if m["name"] not in NAMED]
    handles = [
        Line2D([], [], color=FAINT, linewidth=0.8, linestyle=line, label=", ".join(titles))
        for line in ("-", "--")
        if (titles := [m["title"] for m in others if METHODS[m["name"]].line == line])
    ]
    if handles:
        add_legend(figure, handles, loc="outside lower center", ncols=2)
    return figure


def _sorted(errors: list[float | None]) -> np.ndarray:
    return np.sort([np.inf if error is None else error for error in errors])


def _steps(values: np.ndarray) -> np.ndarray:
    return np.arange(1, len(values) + 1) / len(values)


def _share(axes: Axes, method: Mapping[str, Any], error: str) -> None:
    """One curve; grey without a name where others say the same."""
    values, style = _sorted(method["alone"][error]), METHODS[method["name"]]
    shares, height = _steps(values), NAMED.get(method["name"])
    color, width = (FAINT, 0.7) if height is None else (style.color, 1.5)
    axes.plot(values, shares, style.line, color=color, drawstyle="steps-post", linewidth=width)
    if height is not None:
        place = (float(np.interp(height, shares, values)), height)
        axes.annotate(
            method["title"], place, (4, 0), textcoords="offset points", color=color,
            fontsize=LABEL_PT, va="center",
            bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none",
                  "alpha": 0.8},
        )  # fmt: skip


def error_maps(report: Mapping[str, Any]) -> Figure:
    """Translation errors of each method over the test views, all in the same colours.

    A cell is a view: rows are elevations, columns azimuths, in the order of the record. Views that
    need more than the process allows stand out dark, those without a finite pose are crossed.
    """
    methods = [method for method in report["methods"] if "alone" in method]
    columns = min(4, len(methods))
    lines = -(-len(methods) // columns)
    views = report["config"]["experiment"]["views"]
    elevations, azimuths = views["elevations_deg"], np.array(views["azimuths_deg"])
    azimuths = azimuths[azimuths % TEST_AZIMUTH_STEP_DEG == 0]
    figure = new_figure(WIDTH_IN, 1.45 * lines + 0.4)
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    need = report["need"]["translation_mm"]
    scale = ScalarMappable(LogNorm(0.1 * need, 10 * need), ERROR_COLORMAP)
    for axes in panels.flat[len(methods) :]:
        axes.set_axis_off()
    for axes, method in zip(panels.flat, methods, strict=False):
        errors = np.array(method["alone"]["translation_error_mm"], np.float64)
        cells = errors.reshape(len(elevations), len(azimuths))
        axes.imshow(
            np.ma.masked_invalid(cells), cmap=ERROR_COLORMAP, norm=scale.norm, origin="lower",
            aspect="auto",
        )  # fmt: skip
        for row, column in np.argwhere(~np.isfinite(cells)):
            axes.text(column, row, "×", ha="center", va="center", color=INK, fontsize=TICK_PT)
        style_chart(axes)
        within = f"{np.mean(errors <= need):.0%} within {need:g} mm"
        title = textwrap.fill(method["title"], 20)
        axes.set_title(f"{title}\n{within}", color=INK, fontsize=LABEL_PT, loc="left")
        axes.grid(False)
        axes.set_xticks(range(0, len(azimuths), 4), [f"{a:g}" for a in azimuths[::4]])
        axes.set_yticks(range(len(elevations))[::2], [f"{e:g}" for e in elevations[::2]])
    for axes in panels[:, 0]:
        axes.set_ylabel("elevation (deg)")
    for axes in panels[-1]:
        axes.set_xlabel("azimuth (deg)")
    bar = add_color_bar(figure, panels, scale, "translation error (mm)", extend="both", aspect=35)
    bar.ax.yaxis.set_major_formatter("{x:g}")
    return figure
