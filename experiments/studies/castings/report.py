"""What `experiments.castings` found: a summary of each kind of casting, a table, a picture."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from experiments.runner.markdown import table as markdown_table
from experiments.runner.required_accuracy import NEED_DEG, NEED_MM, within_need
from experiments.studies.castings.casting_line import KINDS
from experiments.studies.verdicts.report import STATUSES
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
LISTED_DEG, LISTED_MM = 1.5, 1.5  # of a right pose; competing poses are not refined
MOST_SIGMAS = 3.0
# of the squared error over the covariance: as rare as `MOST_SIGMAS` of one Gaussian number
RARE = 0.0027
MOST_SQUARED = float(chi2.ppf(1 - RARE, 6))
STAGES = {"before": "fine registration alone, from the truth", "after": "register"}
FIGURES = ("rotation_deg", "translation_mm", "squared", "covered")


def is_wrong(row: Report) -> bool:
    """Whether an accepted pose would be wrong: off by more than the need, or than it says.

    ``squared`` of a row is over 6, and None where it is not finite.
    """
    after = row["after"]
    if after is None or after["squared"] is None:
        return True
    needed = within_need(after["rotation_deg"], after["translation_mm"])
    return bool(not needed or 6 * after["squared"] > MOST_SQUARED)


def is_beyond(row: Report) -> bool:
    """Whether a magnitude exceeds `MOST_SIGMAS` standard deviations in the weakest direction."""
    return row["after"]["over_sigma"] > MOST_SIGMAS


def _over_bounds(row: Report) -> tuple[float, float]:
    """Rotation and translation over their bounds."""
    return row["after"]["rotation_over_bound"], row["after"]["translation_over_bound"]


def _is_first(row: Report) -> bool:
    """Whether the result is the right pose, by the measure of the competing ones."""
    after = row["after"]
    near = after and after["rotation_deg"] < LISTED_DEG and after["translation_mm"] < LISTED_MM
    return bool(near)


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
    placed = [row for row in accepted if row["after"]]  # the part is in the scan
    ratios = [r["after"].get("times_cramer_rao") for r in found]
    ratios = [ratio for ratio in ratios if ratio is not None]
    cpu_seconds = [row["cpu_seconds"] for row in rows if "cpu_seconds" in row]
    return {
        "cases": len(rows),
        **{status: sum(row["verdict"] == status for row in rows) for status in STATUSES},
        "accepted_wrong": sum(map(is_wrong, accepted)),
        "accepted_pitch_off": sum(row.get("pitch_off", False) for row in accepted),
        "accepted_beyond": sum(map(is_beyond, placed)),
        "found": len(found),
        "first": sum(map(_is_first, rows)),
        "listed": sum(row["listed"] for row in rows),
        **{
            stage: {
                name: {"median": _of(np.median, values), "mean": _of(np.mean, values)}
                for name in FIGURES
                for values in ([row[stage][name] for row in found],)
            }
            for stage in STAGES
        },
        "covered_accepted": _of(np.mean, [row["after"]["covered"] for row in placed]),
        "within_bounds_accepted": [
            _of(np.mean, [_over_bounds(row)[which] <= 1 for row in placed]) for which in (0, 1)
        ],
        "beyond_by_chance": sum(row["after"]["beyond_by_chance"] for row in placed),
        "times_cramer_rao": {"median": _of(np.median, ratios), "rms": _of(_rms, ratios)},
        "seconds": _of(np.median, [row["seconds"] for row in rows]),
        "cpu_seconds": _of(np.median, cpu_seconds),
    }


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _of(statistic: Any, values: Sequence[float | None]) -> float:
    """Of the values that are finite; NaN where none is."""
    finite = [value for value in values if value is not None and np.isfinite(value)]
    return float(statistic(finite)) if finite else float("nan")


def _lines(summaries: Report) -> Iterable[list[str]]:
    """Cells of the table: a row for each kind, then all."""
    kinds = {KINDS[kind].title: summary for kind, summary in summaries["kinds"].items()}
    for title, summary in {**kinds, "all": summaries["all"]}.items():
        before, after = summary["before"], summary["after"]
        chance = _digits("{:.2g}", summary["beyond_by_chance"])
        yield [
            title,
            *(str(summary[name]) for name in ("cases", *STATUSES, "accepted_wrong")),
            f"{summary['accepted_beyond']}{chance and f' ({chance})'}",
            f"{summary['first']}, {summary['listed']}",
            _digits("{:.0%}", after["covered"]["mean"], summary["covered_accepted"]),
            _digits("{:.0%}", *summary["within_bounds_accepted"]),
            _digits("{:.3g}", *(after["squared"][name] for name in ("median", "mean"))),
            *(
                _digits("{:.2g}", *(stage[name]["median"] for name in FIGURES[:2]))
                for stage in (before, after)
            ),
            _digits("{:.1f}", summary["cpu_seconds"]),
        ]


def _digits(form: str, *values: float) -> str:
    """The values that there are, with commas between them."""
    return ", ".join(form.format(value) for value in values if np.isfinite(value))


HEAD = (
    "kind", "cases", *STATUSES, "accepted and wrong", "beyond 3 sigma (by chance)",
    "right pose first, given", "axis bounds hold: all, accepted",
    "magnitude bounds hold: deg, mm", "squared error: median, mean", "before: deg, mm",
    "after: deg, mm", "CPU s",
)  # fmt: skip


def table(report: Report) -> str:
    """A row for each kind in Markdown, what it says of all, and every wrong pose accepted.

    Everything is made from the rows of the report.
    """
    summaries = summarize(report["rows"])
    lines = [markdown_table(HEAD, _lines(summaries)), "", LEGEND]
    if remarks := list(_remarks(summaries)):
        lines += ["", *remarks]
    return "\n".join(lines)


LEGEND = (
    f"Wrong: off by more than {NEED_DEG:g} deg or {NEED_MM:g} mm, or by a squared error over the "
    f"covariance of all six axes that {RARE:.2%} of Gaussian errors exceed. Beyond 3 sigma: "
    "accepted, and rotation or translation is larger than three times its standard deviation in "
    "the weakest direction; in brackets, how many Gaussian errors with these covariances would "
    "be. Right pose given: as the result, or among the competing poses. Bounds: of 95 %; the "
    f"share of the six axes of all poses found (within {FOUND_DEG:g} deg) and of those accepted, "
    "and the share of the bounds of rotation and translation that are printed, of those accepted. "
    "Squared error: over the covariance, 1 on average where the covariance is true. Before: fine "
    "registration alone, from nearly the true pose; after: `register`; medians. CPU: median time "
    "of `register`, all threads together."
)


def _remarks(summaries: Report) -> Iterable[str]:
    """Lines of a list below the table."""
    kinds = summaries["kinds"]
    held = summaries["all"]["within_bounds_accepted"]
    if np.isfinite(held).all():
        yield (
            f"- bounds of rotation and translation hold for {held[0]:.1%} and {held[1]:.1%} of "
            "the accepted poses"
        )
    if "equal" in kinds and np.isfinite(kinds["equal"]["times_cramer_rao"]["rms"]):
        ratio = kinds["equal"]["times_cramer_rao"]
        yield (
            f"- {KINDS['equal'].title}: the error is {ratio['rms']:.2f} times the Cramér-Rao bound "
            f"(root mean square of {kinds['equal']['found']}; median {ratio['median']:.2f})"
        )
    if "crop" in kinds:
        crops = kinds["crop"]
        yield (
            f"- {KINDS['crop'].title}: of {crops['cases']}, {crops['accepted']} are accepted, "
            f"{crops['accepted_pitch_off']} of these a pitch off; the right pose is first in "
            f"{crops['first']}, first or among the competing ones in {crops['listed']}"
        )
    yield from map(_accepted_wrong, summaries["accepted_wrong"])


def _accepted_wrong(row: Report) -> str:
    after, off = row["after"], "another part"
    if after is not None:
        squared = "not finite" if after["squared"] is None else f"{6 * after['squared']:.3g}"
        off = (
            f"{after['rotation_deg']:.2g} deg and {after['translation_mm']:.2g} mm off, squared "
            f"error of all six axes {squared} ({MOST_SQUARED:.3g} is the most)"
        )
        if row.get("pitch_off"):
            off += ", a pitch off"
    return (
        f"- accepted and wrong: {row['part']}, {KINDS[row['kind']].title}, number "
        f"{row['number']}: {off}; “{row['reason']}”"
    )


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
