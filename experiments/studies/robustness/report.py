"""What `experiments.robustness` found: tables, the paper's Fig. 11 drawn again, Markdown."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.runner.markdown import table as markdown_table
from experiments.runner.required_accuracy import NEED_MM, within_need
from experiments.runner.study_command import aligned
from vanejax.plotting.canvas import (
    INK,
    OURS,
    PAPER,
    SERIES,
    TICK_PT,
    WIDTH_IN,
    add_legend,
    new_figure,
    style_chart,
)

Report = Mapping[str, Any]
STAGES = ("alone", "refined")
METRICS = {"ffmde_abs_mm": "FFMDE (mm)", "rmse_mm": "RMSE (mm)"}
PANELS = {"translation_mm": "translation error (mm)", **METRICS}


def networks(report: Report) -> list[str]:
    """Names of the networks, in order."""
    return list(report["networks"])


def values(step: Report, network: str, stage: str, name: str) -> np.ndarray:
    """[V] one figure of all scans of a step."""
    return np.array([row[network][stage][name] for row in step["rows"]], np.float64)


def share_within_need(step: Report, network: str, stage: str) -> float:
    """Share of a step's scans within the 0.5 deg and 1 mm of the paper's process."""
    turn, shift = (
        values(step, network, stage, name) for name in ("rotation_deg", "translation_mm")
    )
    return float(np.mean(within_need(turn, shift)))


def steps_of(series: Report) -> Iterator[tuple[str, Report]]:
    """Labelled steps; angles, of which there are many, are put together."""
    if len(series["steps"]) > 12:
        rows = [row for step in series["steps"] for row in step["rows"]]
        first, last = (series["steps"][k]["value"] for k in (0, -1))
        yield f"{first:g} to {last:g}", {"rows": rows}
        return
    for step in series["steps"]:
        yield f"{step['value']:g}", step


def series_lines(report: Report, series: Report) -> Iterator[list[str]]:
    """Cells of one series: a row for each strength and network."""
    for label, step in steps_of(series):
        rows = step["rows"]
        first = [label, f"{np.mean([row['hole_share'] for row in rows]):.0%}"]
        at_truth = [f"{np.mean([row['truth'][name] for row in rows]):.3f}" for name in METRICS]
        for network in networks(report):
            cells = [*first, network]
            for stage in STAGES:
                cells += [
                    f"{np.median(values(step, network, stage, name)):.3f}"
                    for name in ("rotation_deg", "translation_mm")
                ]
                cells.append(f"{share_within_need(step, network, stage):.0%}")
            cells += [f"{np.mean(values(step, network, 'refined', name)):.3f}" for name in METRICS]
            yield [*cells, *at_truth]
            first = ["", ""]


HEADERS = (
    "strength",
    "holes",
    "network",
    "alone: deg",
    "mm",
    "within need",
    "refined: deg",
    "mm",
    "within need",
    "FFMDE",
    "RMSE",
    "FFMDE at truth",
    "RMSE at truth",
)


def table(report: Report) -> str:
    """Everything as aligned text."""
    lines = []
    for series in report["series"]:
        rows = [list(HEADERS), *series_lines(report, series)]
        lines.append(f"{series['title']} ({series['unit']}){_paper(series)}")
        lines += [f"  {line}" for line in aligned(rows)]
        lines.append("")
    if report["random"]:
        lines += [random_lines(report["random"]), ""]
    lines.append("deg, mm: medians; within need: 0.5 deg and 1 mm; FFMDE, RMSE: means, mm, refined")
    return "\n".join(lines)


def markdown(report: Report) -> str:
    """The same in Markdown."""
    return "\n\n".join(
        f"### {series['title']} ({series['unit']}){_paper(series)}\n\n"
        + markdown_table(HEADERS, series_lines(report, series))
        for series in report["series"]
    )


def random_lines(found: Report) -> str:
    """The scans from anywhere, in words."""
    turn, shift = found["rotation_deg"], found["translation_mm"]
    verdicts = ", ".join(
        f"{counts['right'] + counts['wrong']} {status} ({counts['wrong']} of them wrong)"
        for status, counts in found["verdicts"].items()
    )
    return (
        f"{found['scans']:,} random scans, network {found['network']}, then the whole of "
        f"`register`: {found['right']:.1%} right (within 0.1 deg and 0.15 mm); {verdicts}. "
        f"Rotation error: mean {turn['mean']:.4f}, 99 % {turn['p99']:.4f}, largest "
        f"{turn['max']:.3g} deg; translation error: mean {shift['mean']:.4f}, 99 % "
        f"{shift['p99']:.4f}, largest {shift['max']:.3g} mm; "
        f"{found['seconds']['median']:.2f} s each (median)."
    )


def _paper(series: Report) -> str:
    """What the paper has on this series."""
    paper = series["paper"]
    if paper is None:
        return ""
    return f"; paper: FFMDE {paper['ffmde_abs_mm']:.4f}, RMSE {paper['rmse_mm']:.4f} mm on average"


def picture(report: Report) -> Figure:
    """Translation errors under every disturbance, then the paper's Fig. 11: FFMDE and RMSE.

    Rotation errors are in the table; their curves look the same. Refinement ends in the same pose
    from either network: it is one line, with the middle 80 % of the scans.
    """
    pose = [(series, "translation_mm") for series in report["series"]]
    fig_11 = [(s, name) for name in METRICS for s in report["series"] if s["paper"] is not None]
    rows = [block[k : k + 4] for block in (pose, fig_11) for k in range(0, len(block), 4)]
    figure = new_figure(WIDTH_IN, 1.75 * len(rows) + 0.5)
    grid = figure.subplots(len(rows), 4, squeeze=False)
    shared: dict[str, Axes] = {}
    for line, block in zip(grid, rows, strict=True):
        previous = ""
        for axes in line[len(block) :]:
            axes.set_axis_off()
        for axes, (series, name) in zip(line, block, strict=False):
            style_chart(
                axes, title=textwrap.fill(series["title"], 18), xlabel=series["unit"],
                ylabel=PANELS[name] if name != previous else "",
            )  # fmt: skip
            if name in shared:
                axes.sharey(shared[name])
            shared.setdefault(name, axes)
            _panel(axes, report, series, name)
            previous = name
    for name in set(shared) & set(METRICS):
        shared[name].set_ylim(bottom=0)
    shared["translation_mm"].yaxis.set_major_formatter("{x:g}")
    shared["translation_mm"].text(
        0.98, 1.4 * NEED_MM, f"need: {NEED_MM:g} mm", transform=grid[0, 0].get_yaxis_transform(),
        ha="right", va="bottom", color=INK, fontsize=TICK_PT,
    )  # fmt: skip
    # some are in the panels of Fig. 11 alone
    handles = {line.get_label(): line for axes in grid.flat for line in axes.lines}
    handles = [line for label, line in handles.items() if not label.startswith("_")]
    add_legend(figure, handles, loc="outside lower center", ncols=3)
    return figure


def _panel(axes: Axes, report: Report, series: Report, name: str) -> None:
    """One quantity over one series: medians over the scans."""
    steps, names = series["steps"], networks(report)
    strengths = [step["value"] for step in steps]
    for network, color in zip(names, SERIES[1:], strict=False):
        alone = [np.median(values(step, network, "alone", name)) for step in steps]
        axes.plot(
            strengths, alone, "--", color=color, linewidth=1.1, label=f"network alone ({network})"
        )
    refined = [
        np.concatenate([values(step, network, "refined", name) for network in names])
        for step in steps
    ]
    axes.plot(
        strengths, [np.median(found) for found in refined], color=OURS, linewidth=1.4,
        label="refined by ray casting",
    )  # fmt: skip
    if len(steps[0]["rows"]) > 1:
        low, high = ([np.percentile(found, share) for found in refined] for share in (10, 90))
        axes.fill_between(strengths, low, high, color=OURS, alpha=0.15, linewidth=0)
    if name in METRICS:
        floor = [np.median([row["truth"][name] for row in step["rows"]]) for step in steps]
        axes.plot(strengths, floor, ":", color=INK, linewidth=1.2, label="at the true pose")
        axes.axhline(series["paper"][name], color=PAPER, linewidth=1.1, label="paper, mean")
    else:
        axes.axhline(NEED_MM, color=INK, linewidth=0.6)
        axes.set_yscale("log")
