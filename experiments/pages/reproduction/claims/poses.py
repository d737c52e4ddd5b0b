"""Poses: bad conditions, position verification, the bound, the verdict, real scans, and times."""

from __future__ import annotations

import functools

import numpy as np

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
    over_floor,
)
from experiments.pages.reproduction.live import position_errors
from experiments.runner.required_accuracy import NEED_DEG, NEED_MM
from experiments.studies.any_pose import study as any_pose
from experiments.studies.fine import study as fine
from experiments.studies.position.report import PAPER, magnitudes, moves_of
from experiments.studies.real_scans import study as real_scans
from experiments.studies.robustness import study as robustness
from experiments.studies.robustness.report import networks, share_within_need, values

# ---- bad conditions


def _series(report: Report, name: str) -> Report:
    return next(series for series in report["series"] if series["name"] == name)


def _mean(report: Report, *, series: str, metric: str) -> Finding:
    """The last network's mean over a series after refinement, against the paper's."""
    chosen, network = _series(report, series), networks(report)[-1]
    refined = [values(step, network, "refined", metric) for step in chosen["steps"]]
    truth = [[row["truth"][metric] for row in step["rows"]] for step in chosen["steps"]]
    return over_floor(
        float(np.concatenate(refined).mean()),
        float(np.concatenate(truth).mean()),
        chosen["paper"][metric],
        "the spacing of the CAD points and the camera's noise",
    )


def _paper_mean(report: Report, *, series: str, metric: str) -> str:
    return f"{_series(report, series)['paper'][metric]:.4f} mm"


def _within_need(report: Report, *, series: str) -> Finding:
    steps, network = _series(report, series)["steps"], networks(report)[-1]
    refined, alone = (
        [share_within_need(step, network, stage) for step in steps]
        for stage in ("refined", "alone")
    )
    rotation, translation = (
        max(float(values(step, network, "refined", key).max()) for step in steps)
        for key in ("rotation_deg", "translation_mm")
    )
    holes = max(np.mean([row["hole_share"] for row in step["rows"]]) for step in steps)
    return Finding(
        f"at most {digits(rotation)} deg and {digits(translation)} mm off",
        met_if(min(refined) == 1),
        f"{np.mean(refined):.0%} of the virtual scans are within {NEED_DEG:g} deg and "
        f"{NEED_MM:g} mm after refinement by ray casting, {np.mean(alone):.0%} before it; up "
        f"to {holes:.0%} of the pixels are lost.",
    )


_MEANS = (
    ("a", "distance", "ffmde_abs_mm", "FFMDE"),
    ("b", "distance", "rmse_mm", "RMSE"),
    ("c", "angle", "ffmde_abs_mm", "FFMDE"),
    ("d", "angle", "rmse_mm", "RMSE"),
)
_STEADY = (
    ("a, b", "distance", "all distances", "small fluctuations"),
    ("c, d", "angle", "all angles", "small fluctuations"),
    ("e", "light", "strong light", "no large deviation, by eye"),
)

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


# ---- real scans


@claim(
    "real depth-camera scans, no training, no guess: right",
    "all, no wrong one accepted",
    "real_scans",
)
def _real(report: Report) -> Finding:
    return Finding(
        f"{report['right']} of {report['scans']}, {report['accepted_wrong']} wrong accepted",
        met_if(report["right"] == report["scans"] and not report["accepted_wrong"]),
        f"Right is within {real_scans.RIGHT_DEG:g} deg and {real_scans.RIGHT_MM:g} mm, of a truth "
        f"good to about 1 deg and 2 mm; {report['accepted']} accepted.",
    )


@claim(
    "virtual scans by the fitted sensor are as near to real ones as these are to each other",
    lambda report: f"{report['real']['distance_of_halves']:.2f}, as two halves of the real scans",
    "sensor_fit",
)
def _likeness(report: Report) -> Finding:
    ideal, fitted = (report["virtual"][name]["distance_held_out"] for name in ("ideal", "all"))
    return Finding(
        f"{fitted:.2f}, an ideal camera {ideal:.2f}",
        met_if(fitted <= report["real"]["distance_of_halves"], partly=fitted < ideal),
        f"Mean logarithmic distance of {len(report['real']['statistics'])} statistics, on scans "
        "that the sensor was not fitted to.",
    )


# ---- clutter, castings, random cameras


@claim(
    "scans from anywhere between 300 and 500 mm by random cameras: right",
    f"{robustness.LEAST_RIGHT:.0%}, no wrong one accepted",
    "robustness",
)
def _random_cameras(robustness_record: Report) -> Finding:
    report = robustness_record["random"]
    if not report:
        return Finding("–", Verdict.UNKNOWN, "The study was run without random scans.")
    return Finding(
        f"{report['right']:.1%} of {report['scans']:,}, {report['accepted_wrong']} wrong accepted",
        met_if(report["right"] >= robustness.LEAST_RIGHT and not report["accepted_wrong"]),
        f"Mean {digits(report['rotation_deg']['mean'])} deg and "
        f"{digits(report['translation_mm']['mean'])} mm, {digits(report['seconds']['median'])} s "
        "each (median).",
    )


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


TOPICS = (
    Topic(
        "sensing",
        "Distance, angle, strong light: Figs 10 and 11",
        [
            Claim(
                f"mean {words} over the {series}s",
                functools.partial(_paper_mean, series=series, metric=metric),
                functools.partial(_mean, series=series, metric=metric),
                ("robustness",),
                f"Fig. 11 ({letter})",
            )
            for letter, series, metric, words in _MEANS
        ]
        + [
            Claim(
                f"the pose stays right over {words}",
                paper,
                functools.partial(_within_need, series=series),
                ("robustness",),
                f"Fig. 11 ({letters})",
            )
            for letters, series, words, paper in _STEADY
        ],
    ),
    Topic(
        "position",
        "Position verification: Figs 12 to 15",
        [
            Claim(
                f"{size} error of the {words}",
                f"{within}{paper} {unit}",
                functools.partial(
                    _error, motion=motion, statistic=statistic, unit=unit, paper=paper
                ),
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
    ),
    Topic("bound", "Error against the Cramer-Rao bound", (_ratio, _coverage)),
    Topic("verdict", "Whether the verdict can be trusted", (_wrong_accepted,)),
    Topic("any pose", "From any pose", (_any_rotation,)),
    Topic("real scans", "Real scans", (_real, _likeness)),
    Topic("clutter", "Clutter, castings, noise, random scans", (_random_cameras,)),
    Topic("speed", "Times", (_fast,)),
)
