"""What `experiments.castings` found: a summary of each kind of casting, a table, a picture."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.runner.markdown import table as markdown_table
from experiments.runner.required_accuracy import NEED_DEG, NEED_MM, within_need
from experiments.studies.castings.casting_line import KINDS
from experiments.studies.verdicts.report import STATUSES
from vanejax.localization.pose_result import BOUND
from vanejax.plotting.canvas import (
    FAINT,
    INK,
    MARKERS,
    SERIES,
    VERDICTS,
    WIDTH_IN,
    add_legend,
    new_figure,
    style_chart,
)

Report = Mapping[str, Any]
FOUND_DEG = 5.0  # the pitch of the vanes is 7: what is farther off is another pose
MOST_SIGMAS = 3.0
STAGES = {"before": "fine registration alone, from the truth", "after": "register"}
FIGURES = ("rotation_deg", "translation_mm", "squared", "covered")


def is_wrong(row: Report) -> bool:
    """Whether an accepted pose would be wrong: off by more than the need, or than it says."""
    after = row["after"]
    if after is None:
        return True
    over = max(after["rotation_over_bound"], after["translation_over_bound"])
    needed = within_need(after["rotation_deg"], after["translation_mm"])
    return bool(not needed or over * BOUND > MOST_SIGMAS)


def summarize(rows: Sequence[Report]) -> dict[str, Any]:
    """Each kind, all of them, and wrong poses accepted, one by one."""
    return {
        "kinds": {
            kind: _summary([row for row in rows if row["kind"] == kind])
            for kind in KINDS
            if any(row["kind"] == kind for row in rows)
        },
        "all": _summary(rows),
        "accepted_wrong": [r for r in rows if r["verdict"] == "accepted" and is_wrong(r)],
        "rows": list(rows),
    }


def _summary(rows: Sequence[Report]) -> dict[str, Any]:
    """Counts, and figures of the scans in which the pose was found."""
    found = [r for r in rows if r["after"] and r["after"]["rotation_deg"] < FOUND_DEG]
    accepted = [row for row in rows if row["verdict"] == "accepted"]
    return {
        "cases": len(rows),
        **{status: sum(row["verdict"] == status for row in rows) for status in STATUSES},
        "accepted_wrong": sum(map(is_wrong, accepted)),
        "found": len(found),
        "listed": sum(row["listed"] for row in rows),
        **{
            stage: {
                name: {"median": _of(np.median, values), "mean": _of(np.mean, values)}
                for name in FIGURES
                for values in ([row[stage][name] for row in found],)
            }
            for stage in STAGES
        },
        "covered_accepted": _of(np.mean, [r["after"]["covered"] for r in accepted if r["after"]]),
        "seconds": _of(np.median, [row["seconds"] for row in rows]),
    }


def _of(statistic: Any, values: Sequence[float]) -> float:
    return float(statistic(values)) if values else float("nan")


def _lines(report: Report) -> Iterable[list[str]]:
    """Cells of the table: a row for each kind, then all."""
    kinds = {KINDS[kind].title: summary for kind, summary in report["kinds"].items()}
    for title, summary in {**kinds, "all": report["all"]}.items():
        before, after = summary["before"], summary["after"]
        yield [
            title,
            *(str(summary[name]) for name in ("cases", *STATUSES, "accepted_wrong", "listed")),
            _digits(after["covered"]["mean"], "{:.0%}"),
            _digits(summary["covered_accepted"], "{:.0%}"),
            *(_digits(after["squared"][name], "{:.3g}") for name in ("median", "mean")),
            *(
                _digits(stage[name]["median"], "{:.2g}")
                for stage in (before, after)
                for name in ("rotation_deg", "translation_mm")
            ),
            _digits(summary["seconds"], "{:.1f}"),
        ]


def _digits(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def table(report: Report) -> str:
    """A row for each kind in Markdown, and every wrong pose that was accepted."""
    head = (
        "kind", "cases", *STATUSES, "accepted and wrong", "right pose given", "95 % bounds hold",
        "of accepted", "squared error: median", "mean", "before: deg", "mm", "after: deg", "mm",
        "s",
    )  # fmt: skip
    lines = [
        markdown_table(head, _lines(report)),
        "",
        f"Wrong: off by more than {NEED_DEG:g} deg or {NEED_MM:g} mm, or than {MOST_SIGMAS:g} "
        "standard deviations in the weakest direction. Right pose given: as the result, or among "
        "the competing poses. Bounds: the share of the six axes of all poses found (within "
        f"{FOUND_DEG:g} deg). Squared error: over the covariance, 1 on average where the "
        "covariance is true. Before: fine registration alone, from nearly the true pose; after: "
        "`register`; medians.",
    ]
    if report["accepted_wrong"]:
        lines.append("")
    for row in report["accepted_wrong"]:
        after = row["after"]
        off = "another part"
        if after is not None:
            over = BOUND * max(after["rotation_over_bound"], after["translation_over_bound"])
            off = (
                f"{after['rotation_deg']:.2g} deg and {after['translation_mm']:.2g} mm off, "
                f"{over:.1f} standard deviations"
            )
        lines.append(
            f"- accepted and wrong: {row['part']}, {KINDS[row['kind']].title}, number "
            f"{row['number']}: {off}; “{row['reason']}”"
        )
    return "\n".join(lines)


def picture(report: Report) -> Figure:
    """By kind: verdicts, translation errors before and after, how often the 95 % bounds hold."""
    kinds = report["kinds"]
    figure = new_figure(WIDTH_IN, 0.27 * len(kinds) + 1.4)
    bars, errors, bounds = figure.subplots(1, 3, sharey=True)
    names = [f"{KINDS[kind].title} ({summary['cases']})" for kind, summary in kinds.items()]
    left = np.zeros(len(kinds))
    for status, color in VERDICTS.items():
        share = np.array([summary[status] / summary["cases"] for summary in kinds.values()])
        bars.barh(names, share, left=left, color=color, label=status)
        left += share
    bars.invert_yaxis()
    style_chart(bars, title="verdicts", xlabel="share of the scans")
    for (stage, label), color, marker in zip(STAGES.items(), SERIES[1::-1], MARKERS, strict=False):
        for axes, name, kind in ((errors, "translation_mm", "median"), (bounds, "covered", "mean")):
            values = [summary[stage][name][kind] for summary in kinds.values()]
            values = [np.nan if value is None else value for value in values]
            axes.plot(values, names, marker, color=color, markersize=5, label=label)
    errors.set_xscale("log")
    errors.xaxis.set_major_formatter("{x:g}")
    errors.axvline(NEED_MM, color=FAINT, linewidth=0.8)
    style_chart(errors, title="translation error", xlabel="median, mm")
    bounds.axvline(0.95, color=INK, linewidth=0.8)
    bounds.set_xlim(0, 1.03)
    style_chart(bounds, title="95 % bounds", xlabel="share that holds")
    for axes in (errors, bounds):
        axes.grid(axis="x", color=FAINT, alpha=0.3)
    bars.grid(False)
    handles = [h for axes in (bars, errors) for h in axes.get_legend_handles_labels()[0]]
    add_legend(figure, handles, loc="outside lower center", ncols=5, columnspacing=1.0)
    return figure
