"""What `experiments.robustness` found: tables, the paper's Fig. 11 drawn again, Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.runner.required_accuracy import within_need
from vanejax.plotting.canvas import FAINT, INK, new_figure, style_chart
from vanejax.plotting.charts import SERIES

Report = Mapping[str, Any]
STAGES = ("alone", "refined")
METRICS = {"ffmde_abs_mm": "FFMDE (mm)", "rmse_mm": "RMSE (mm)"}


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
        for k, network in enumerate(networks(report)):
            cells = [label, f"{_mean(rows, 'hole_share'):.0%}"] if not k else ["", ""]
            cells.append(network)
            for stage in STAGES:
                turn, shift = (
                    float(np.median(values(step, network, stage, name)))
                    for name in ("rotation_deg", "translation_mm")
                )
                cells += [
                    f"{turn:.3f}",
                    f"{shift:.3f}",
                    f"{share_within_need(step, network, stage):.0%}",
                ]
            cells += [f"{np.mean(values(step, network, 'refined', name)):.3f}" for name in METRICS]
            cells += [f"{np.mean([row['truth'][name] for row in rows]):.3f}" for name in METRICS]
            yield cells


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
        widths = [max(len(row[k]) for row in rows) for k in range(len(HEADERS))]
        lines.append(f"{series['title']} ({series['unit']}){_paper(series)}")
        lines += [
            "  " + "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
            for row in rows
        ]
        lines.append("")
    if report["random"]:
        lines += [random_lines(report["random"]), ""]
    lines.append("deg, mm: medians; within need: 0.5 deg and 1 mm; FFMDE, RMSE: means, mm, refined")
    return "\n".join(lines)


def markdown(report: Report) -> str:
    """The same for docs/robustness.md."""
    blocks = []
    for series in report["series"]:
        rows = list(series_lines(report, series))
        blocks.append(
            "\n".join(
                [
                    f"### {series['title']} ({series['unit']}){_paper(series)}",
                    "",
                    "| " + " | ".join(HEADERS) + " |",
                    "|" + "---|" * len(HEADERS),
                    *("| " + " | ".join(row) + " |" for row in rows),
                ]
            )
        )
    return "\n\n".join(blocks)


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


def _mean(rows: list[Report], name: str) -> float:
    return float(np.mean([row[name] for row in rows]))


def picture(report: Report) -> Figure:
    """The paper's Fig. 11: FFMDE and RMSE over every series, and the pose's own errors above."""
    panels = {
        "rotation_deg": "rotation (deg)",
        "translation_mm": "translation (mm)",
        **METRICS,
    }
    shown = report["series"]
    figure = new_figure(3.1 * len(shown), 10.5)
    grid = figure.subplots(len(panels), len(shown), squeeze=False, sharex="col")
    for row, (name, label) in enumerate(panels.items()):
        for column, series in enumerate(shown):
            axes = grid[row, column]
            style_chart(
                axes,
                title=series["title"] if not row else "",
                xlabel=series["unit"] if row == len(panels) - 1 else "",
                ylabel=label if not column else "",
            )
            _panel(axes, report, series, name)
    handles, labels = grid[-1, 0].get_legend_handles_labels()
    room = max(1, 3 * len(shown) // 2)  # for so many of them in a row
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=min(room, len(labels)),
        frameon=False,
        fontsize=10,
    )
    return figure


def _panel(axes: Axes, report: Report, series: Report, name: str) -> None:
    """One quantity over one series: means, and the spread over the scans."""
    strengths = [step["value"] for step in series["steps"]]
    for k, network in enumerate(networks(report)):
        for stage, line in zip(STAGES, ("--", "-"), strict=True):
            found = [values(step, network, stage, name) for step in series["steps"]]
            middle = [float(np.median(values)) for values in found]
            color = SERIES[k % len(SERIES)]
            axes.plot(
                strengths, middle, line, color=color, linewidth=1.5, label=f"{network}, {stage}"
            )
            if min(len(values) for values in found) > 1:
                low, high = (
                    [float(np.percentile(values, q)) for values in found] for q in (10, 90)
                )
                axes.fill_between(strengths, low, high, color=color, alpha=0.12, linewidth=0)
    if name in METRICS:
        floor = [
            float(np.median([r["truth"][name] for r in step["rows"]])) for step in series["steps"]
        ]
        axes.plot(strengths, floor, ":", color=INK, linewidth=1.3, label="at the true pose")
        if series["paper"] is not None:
            axes.axhline(series["paper"][name], color=FAINT, linewidth=1.3, label="paper's mean")
        axes.set_ylim(bottom=0)
    else:
        axes.set_yscale("log")
