"""Poses: position verification, the bound, the verdict, any pose, and what they cost."""

from __future__ import annotations

import functools

from experiments.pages.reproduction.claim import (
    Claim,
    Finding,
    Report,
    Topic,
    Verdict,
    better_if,
    claim,
    digits,
    met_by_count,
    met_if,
)
from experiments.pages.reproduction.live import position_errors
from experiments.studies.any_pose import study as any_pose
from experiments.studies.fine import study as fine
from experiments.studies.position.report import PAPER, magnitudes, moves_of

# ---- position verification


def _error(report: Report, *, motion: str, statistic: str, unit: str, paper: float) -> Finding:
    value = position_errors(report)[motion][statistic]
    because = (
        f"On a virtual stand, {len(report['cameras'])} cameras, {report['positions']} positions "
        f"each, by {report['method']}: another part and other instruments, in the paper's chain."
    )
    if motion == "moves":
        at_origin = magnitudes(report, moves_of, "origin_mm")
        because += (
            f" At the part's centre; at the machine's origin, to which the letter of eq. 13 "
            f"refers, it is {digits(float(getattr(at_origin, statistic)()))} mm."
        )
    verdict = Verdict.MET if value == paper else better_if(value < paper)
    return Finding(f"{digits(value)} {unit}", verdict, because)


POSITION = Topic(
    "Position verification: Figs 12 to 15",
    [
        Claim(
            f"{size} error of the {words}",
            f"{within}{paper} {unit}",
            functools.partial(_error, motion=motion, statistic=statistic, unit=unit, paper=paper),
            ("position",),
            f"Fig. 15 ({letter})",
        )
        for letter, motion, words, unit in (
            ("a", "turns", "rotation", "deg"),
            ("b", "moves", "translation", "mm"),
        )
        for (statistic, size, within), paper in zip(
            (("mean", "mean", ""), ("max", "largest", "within ")), PAPER[motion], strict=True
        )
    ],
)

# ---- the bound


@claim(
    "error of the fine registration over the Cramer-Rao bound",
    f"at most {fine.MOST_RMS_RATIO:g} times, a view at most {fine.MOST_VIEW_RATIO:g} times",
    "fine",
)
def _ratio(report: Report) -> Finding:
    rows = [level[name] for level in report["levels"] for name in fine.PAPER]
    ratio, worst = (max(row[k] for row in rows) for k in ("ratio", "worst_view_ratio"))
    level = min(report["levels"], key=lambda level: abs(level["noise_mm"] - 0.1))
    return Finding(
        f"at most {ratio:.2f} times, a view at most {worst:.2f} times",
        met_if(ratio <= fine.MOST_RMS_RATIO and worst <= fine.MOST_VIEW_RATIO),
        f"At {level['noise_mm']:g} mm of white noise that is "
        f"{digits(level['rotation_deg']['rms'])} deg and "
        f"{digits(level['translation_mm']['rms'])} mm.",
    )


@claim("truth inside the reported 95 % ellipsoid", "95 %", "fine")
def _coverage(report: Report) -> Finding:
    shares, inside = [], 0
    for level in report["levels"]:
        low, high = level["coverage_interval_95"]
        shares.append(level["coverage_95"])
        inside += low <= shares[-1] <= high
    return Finding(
        f"{min(shares):.0%} to {max(shares):.0%}",
        met_by_count(inside, len(shares)),
        f"Within what chance allows at {inside} of {len(shares)} noise levels; honest for white "
        "noise only.",
    )


BOUND = Topic("Error against the Cramer-Rao bound", (_ratio, _coverage))

# ---- the verdict, and any pose


@claim("wrong poses that the verdict accepts", "none", "verdicts")
def _wrong_accepted(report: Report) -> Finding:
    poses = sum(words["wrong"]["accepted"] for words in report["verdicts_by_sensor"].values())
    runs = sum(count["accepted_wrong"] for count in report["register"].values())
    right = report["verdicts_by_kind"]["right"]
    share = right["accepted"] / max(1, sum(right[s] for s in ("accepted", "ambiguous", "rejected")))
    return Finding(
        f"{poses} of {report['poses']['wrong']:,} poses, {runs} of "
        f"{len(report['registered'])} registrations",
        met_if(not poses + runs),
        f"The price: {share:.0%} of the poses started from the truth are accepted; most others are "
        "ambiguous, because most of these parts are symmetric or nearly so.",
    )


VERDICT = Topic("Whether the verdict can be trusted", (_wrong_accepted,))


@claim(
    "guide vane from any rotation, no guess: right",
    f"{any_pose.LEAST_RIGHT:.0%}, no wrong one accepted",
    "any_pose",
)
def _any_rotation(report: Report) -> Finding:
    return Finding(
        f"{report['right']:.1%} of {report['attempts']}, {report['accepted_wrong']} wrong accepted",
        met_if(report["right"] >= any_pose.LEAST_RIGHT and not report["accepted_wrong"]),
        f"Right is within {any_pose.RIGHT_DEG:g} deg and {any_pose.RIGHT_MM:g} mm; "
        f"{digits(report['seconds']['median'])} s each (median).",
    )


ANY_POSE = Topic("From any pose", (_any_rotation,))

# ---- times


@claim(
    "times compared with other programs and the machine's limits",
    "every goal of the benchmark",
    "benchmark",
)
def _fast(report: Report) -> Finding:
    rows = report["rows"]
    goals = [entry["met"] for row in rows for entry in (row, *row["against"]) if entry["met"]]
    met = goals.count("met")
    row = next(r for r in rows if r["name"] == "register, weights, rough pose")
    return Finding(
        f"{met} of {len(goals)} goals",
        met_by_count(met, len(goals)),
        f"A whole registration takes {digits(row['seconds']['median'])} s from a rough pose with "
        "weights; Open3D, small_gicp and PyTorch were timed in the same run.",
    )


SPEED = Topic("Times", (_fast,))
