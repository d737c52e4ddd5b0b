"""What a study of verdicts says in numbers and pictures: ROC, verdicts by kind of pose."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import rankdata

from vanejax.plotting.canvas import (
    FAINT,
    SERIES,
    VERDICTS,
    WIDTH_IN,
    add_legend,
    new_figure,
    style_chart,
)

STATUSES = ("accepted", "ambiguous", "rejected")
RIGHT, OTHER_PART = "right", "another part"
# what may tell a right pose from a wrong one, signed so that more is better
FIGURES = {
    "score": "verification score",
    "inlier_share": "inlier share",
    "violation_share": "free-space violations (negative)",
    "unmeasured_share": "unmeasured surface (negative)",
    "preference": "preference to the best other",
}
NEGATIVE = ("violation_share", "unmeasured_share")


def roc(right: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """False and true accept rates [2, T] over all thresholds, from accepting nothing to everything.

    Args:
      right, wrong: [n], [m] a figure of right and of wrong poses; larger is better.
    """
    thresholds = np.unique(np.concatenate([right, wrong]))[::-1]
    rates = [(0.0, 0.0), *((np.mean(wrong >= t), np.mean(right >= t)) for t in thresholds)]
    return np.array(rates).T


def _corners(right: np.ndarray, wrong: np.ndarray) -> list[list[float]]:
    """The curve of `roc` by its corners alone: false accepts, true accepts."""
    rates = roc(right, wrong).T
    steps = np.diff(rates, axis=0)
    turn = steps[:-1, 0] * steps[1:, 1] != steps[:-1, 1] * steps[1:, 0]
    return rates[np.concatenate([[True], turn, [True]])].round(4).T.tolist()


def area_under_roc(right: np.ndarray, wrong: np.ndarray) -> float:
    """The chance that a right pose's figure exceeds a wrong one's, half for equal ones.

    The Mann-Whitney statistic.
    """
    ranks = rankdata(np.concatenate([right, wrong]))[: len(right)]
    pairs = len(right) * len(wrong)
    return float((ranks.sum() - len(right) * (len(right) + 1) / 2) / pairs)


def figure_of(rows: Sequence[Mapping[str, Any]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """A figure of the right and of the wrong poses, signed so that more is better."""
    sign = -1.0 if name in NEGATIVE else 1.0
    return tuple(
        sign * np.array([row[name] for row in rows if row["right"] is right], np.float64)
        for right in (True, False)
    )


def summarize(
    judged: Sequence[Mapping[str, Any]], runs: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """ROC figures, and verdicts by kind of pose and by sensor."""
    by_kind, by_sensor = _grouped(judged, "kind"), _grouped(judged, "sensor")
    figures = {}
    for name in FIGURES:
        right, wrong = figure_of(judged, name)
        if len(right) and len(wrong):
            figures[name] = {
                "auc": area_under_roc(right, wrong),
                "true_accepts_at_no_false": float(np.mean(right > wrong.max())),
                "curve": _corners(right, wrong),
                "auc_by_kind": {
                    kind: area_under_roc(right, figure_of(rows, name)[1])
                    for kind, rows in by_kind.items()
                    if kind != RIGHT
                },
            }
    return {
        "poses": {
            "right": sum(row["right"] for row in judged),
            "wrong": sum(not row["right"] for row in judged),
            "truth_lost": sum(row["kind"] == RIGHT and not row["right"] for row in judged),
        },
        "figures": figures,
        "verdicts_by_kind": {kind: _verdicts(rows) for kind, rows in by_kind.items()},
        "verdicts_by_sensor": {
            sensor: {
                word: _verdicts([row for row in rows if row["right"] is right])
                for word, right in (("right", True), ("wrong", False))
            }
            for sensor, rows in by_sensor.items()
        },
        "register": {sensor: _outcomes(rows) for sensor, rows in _grouped(runs, "sensor").items()},
        "accepted_wrong": [
            row for row in judged if row["verdict"] == "accepted" and not row["right"]
        ],
        "registered": list(runs),
    }


def _grouped(rows: Sequence[Mapping[str, Any]], name: str) -> dict[str, list[Mapping[str, Any]]]:
    """Rows by their value of that name, in the order of the first ones."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(row[name], []).append(row)
    return groups


def verdict_counts(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Right and wrong poses of each verdict, and how many wrong ones were accepted."""
    count = Counter((row["verdict"], row["right"]) for row in rows)
    return {
        "accepted_wrong": count["accepted", False],
        "verdicts": {
            status: {"right": count[status, True], "wrong": count[status, False]}
            for status in STATUSES
        },
    }


def _verdicts(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts of the verdicts, with competing hypotheses and without."""
    count = Counter(row["verdict"] for row in rows)
    alone = Counter(row["verdict_alone"] for row in rows)
    return {status: count[status] for status in STATUSES} | {"accepted_alone": alone["accepted"]}


def _outcomes(rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """What became of the registrations of one sensor."""
    counts = verdict_counts(rows)["verdicts"]
    lists = [row for row in rows if row["verdict"] == "ambiguous"]
    return {
        "accepted_right": counts["accepted"]["right"],
        "accepted_wrong": counts["accepted"]["wrong"],
        "ambiguous": len(lists),
        "ambiguous_right_not_given": sum(not (r["right"] or r["right_listed"]) for r in lists),
        "rejected_right": counts["rejected"]["right"],
        "rejected_wrong": counts["rejected"]["wrong"],
    }


def table(report: Mapping[str, Any]) -> str:
    """The report as aligned text."""
    poses = report["poses"]
    lines = [f"{poses['right']} right and {poses['wrong']} wrong poses", ""]
    kinds = [kind for kind in report["verdicts_by_kind"] if kind != RIGHT]
    lines.append(
        f"{'AUC against':<34}{'all':>8}"
        + "".join(f"{kind:>15}" for kind in kinds)
        + f"{'accepts at no wrong':>21}"
    )
    for name, row in report["figures"].items():
        cells = "".join(f"{row['auc_by_kind'][kind]:>15.3f}" for kind in kinds)
        rate = row["true_accepts_at_no_false"]
        lines.append(f"  {FIGURES[name]:<32}{row['auc']:>8.3f}{cells}{rate:>21.1%}")
    head = "".join(f"{status:>11}" for status in STATUSES)
    lines += ["", f"{'verdict on poses':<34}{head}{'accepted without others':>25}"]
    rows = list(report["verdicts_by_kind"].items())
    for sensor, words in report["verdicts_by_sensor"].items():
        rows += [(f"{sensor}, {word}", count) for word, count in words.items()]
    for name, count in rows:
        cells = "".join(f"{count[status]:>11}" for status in STATUSES)
        lines.append(f"  {name:<32}{cells}{count['accepted_alone']:>25}")
    head = "".join(f"{sensor:>18}" for sensor in report["register"])
    lines += ["", f"{'register, no guess':<34}{head}"]
    outcomes = next(iter(report["register"].values()), {})
    for outcome in outcomes:
        cells = "".join(f"{count[outcome]:>18}" for count in report["register"].values())
        lines.append(f"  {outcome.replace('_', ' '):<32}{cells}")
    for row in (*report["accepted_wrong"], *report["registered"]):
        if row["verdict"] == "accepted" and not row["right"]:
            error = row.get("kind", "register")
            if error == OTHER_PART:
                error = f"taken for {row['sought']}"
            else:
                error += f", {row['rotation_deg']:.2f} deg, {row['translation_mm']:.2f} mm off"
            lines.append(f"ACCEPTED AND WRONG: {row['part']}, {row['sensor']}: {error}")
    return "\n".join(lines)


def picture(report: Mapping[str, Any]) -> Figure:
    """The ROC of each figure, and the verdicts by kind of pose."""
    figure = new_figure(WIDTH_IN, 3.2)
    curves, bars = figure.subplots(1, 2)
    lines = ("-", "--", "-.", ":", (0, (1, 3)))
    for color, line, name in zip(SERIES, lines, report["figures"], strict=False):
        figure_row = report["figures"][name]
        label = f"{FIGURES[name]}: {figure_row['auc']:.3f}"
        false_accepts, true_accepts = figure_row["curve"]
        curves.plot(false_accepts, true_accepts, color=color, linestyle=line, label=label)
    curves.plot([0, 1], [0, 1], color=FAINT, linewidth=0.8)
    add_legend(
        curves, loc="upper center", bbox_to_anchor=(0.5, -0.2), title="area under the curve",
        title_fontsize=8,
    )  # fmt: skip
    style_chart(
        curves, title="right against wrong poses", xlabel="share of the wrong poses accepted",
        ylabel="share of the right poses accepted",
    )  # fmt: skip
    kinds = report["verdicts_by_kind"]
    left = np.zeros(len(kinds))
    totals = np.array([sum(count[s] for s in STATUSES) for count in kinds.values()])
    names = [f"{kind} ({total})" for kind, total in zip(kinds, totals, strict=True)]
    for status, color in VERDICTS.items():
        share = np.array([count[status] for count in kinds.values()]) / np.maximum(totals, 1)
        bars.barh(names, share, left=left, color=color, label=status)
        left += share
    bars.invert_yaxis()
    style_chart(bars, title="verdict by kind of pose", xlabel="share of the poses")
    bars.grid(False)
    add_legend(bars, loc="upper center", bbox_to_anchor=(0.4, -0.2), ncols=3)
    return figure
