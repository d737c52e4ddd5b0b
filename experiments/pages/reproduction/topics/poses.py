"""What the paper has not: errors against the bound, whether verdicts hold, poses from anywhere."""

from __future__ import annotations

from experiments.pages.reproduction.claim import (
    Claim,
    Finding,
    Results,
    digits,
    met_by_count,
    met_if,
)
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.topic import Part, Picture, Topic, dated_text, origin
from experiments.runner.markdown import text_block
from experiments.studies.any_pose import study as any_pose
from experiments.studies.fine import study as fine
from experiments.studies.verdicts import report as verdict_report


def _ratio(results: Results) -> Finding:
    levels = results["fine"]["levels"]
    rows = [level[name] for level in levels for name in fine.PAPER]
    ratio, worst = (max(row[k] for row in rows) for k in ("ratio", "worst_view_ratio"))
    level = min(levels, key=lambda level: abs(level["noise_mm"] - 0.1))
    return Finding(
        f"at most {ratio:.2f} times, a view at most {worst:.2f} times",
        met_if(ratio <= fine.MOST_RMS_RATIO and worst <= fine.MOST_VIEW_RATIO),
        f"At {level['noise_mm']:g} mm of white noise that is "
        f"{digits(level['rotation_deg']['rms'])} deg and "
        f"{digits(level['translation_mm']['rms'])} mm.",
    )


def _covariance(results: Results) -> Finding:
    levels = results["fine"]["levels"]
    inside = [
        level["coverage_interval_95"][0] <= level["coverage_95"] <= level["coverage_interval_95"][1]
        for level in levels
    ]
    shares = [level["coverage_95"] for level in levels]
    return Finding(
        f"{min(shares):.0%} to {max(shares):.0%}",
        met_by_count(sum(inside), len(inside)),
        f"Within what chance allows at {sum(inside)} of {len(levels)} noise levels; honest for "
        "white noise only.",
    )


def _bound(results: Results, _: Live | None) -> list[Part]:
    levels = results["fine"]["levels"]
    return [
        "The paper asks how far a registration is off; the bound says how far the best possible "
        "one would be, from the same rays and noise. Full scans with white noise along the rays, "
        "started 5 deg and 5 mm off.",
        Picture(
            "Errors over noise with the Cramer-Rao bound, and how often the ellipsoid holds",
            "Errors of every view (grey), their rms (blue) on the bound (black), the paper's mean "
            "errors (red dashes); right: truth inside the reported 95 % ellipsoid.",
            run="fine/fine.png",
            draw=lambda: fine.picture(levels),
        ),
        dated_text(results, "fine", lambda report: fine.table(report["levels"])),
    ]


def _wrong_accepted(results: Results) -> Finding:
    report = results["verdicts"]
    poses = sum(words["wrong"]["accepted"] for words in report["verdicts_by_sensor"].values())
    runs = sum(count["accepted_wrong"] for count in report["register"].values())
    right = report["verdicts_by_kind"]["right"]
    share = right["accepted"] / max(1, sum(right[s] for s in ("accepted", "ambiguous", "rejected")))
    return Finding(
        f"{poses} of {report['poses']['wrong']:,} poses, {runs} of "
        f"{len(report['registered'])} registrations",
        met_if(not poses + runs),
        f"The price: of the poses started from the truth {share:.0%} are accepted, most others are "
        "ambiguous, for most of these parts are symmetric or nearly so.",
    )


def _verdict(results: Results, _: Live | None) -> list[Part]:
    report = results["verdicts"]
    return [
        "Poses that a registration might end in, right and wrong, of many parts under virtual "
        "sensors, each judged as `register` judges its own. AUC: the chance that a right pose "
        "scores above a wrong one.",
        Picture(
            "ROC curves, and verdicts by kind of pose",
            "Right against wrong poses by each figure alone; verdicts by kind of pose.",
            draw=lambda: verdict_report.picture(report),
        ),
        text_block(verdict_report.table(report)),
        origin(results, "verdicts"),
    ]


def _any_rotation(results: Results) -> Finding:
    report = results["any_pose"]
    return Finding(
        f"{report['right']:.1%} of {report['attempts']}, {report['accepted_wrong']} wrong accepted",
        met_if(report["right"] >= any_pose.LEAST_RIGHT and not report["accepted_wrong"]),
        f"Right is within {any_pose.RIGHT_DEG:g} deg and {any_pose.RIGHT_MM:g} mm; "
        f"{digits(report['seconds']['median'])} s each (median).",
    )


def _any_pose(results: Results, _: Live | None) -> list[Part]:
    return [
        "`register` without a guess, on scans turned to uniformly random rotations.",
        dated_text(results, "any_pose", any_pose.table),
    ]


BOUND = Topic(
    "Error against the Cramer-Rao bound",
    (
        Claim(
            "error of the fine registration over the Cramer-Rao bound",
            f"at most {fine.MOST_RMS_RATIO:g} times, a view at most {fine.MOST_VIEW_RATIO:g} times",
            ("fine",),
            _ratio,
        ),
        Claim("truth inside the reported 95 % ellipsoid", "95 %", ("fine",), _covariance),
    ),
    _bound,
    needs=("fine",),
)
VERDICT = Topic(
    "Whether the verdict can be trusted",
    (Claim("wrong poses that the verdict accepts", "none", ("verdicts",), _wrong_accepted),),
    _verdict,
    needs=("verdicts",),
)
ANY_POSE = Topic(
    "From any pose",
    (
        Claim(
            "guide vane from any rotation, no guess: right",
            f"{any_pose.LEAST_RIGHT:.0%}, no wrong one accepted",
            ("any_pose",),
            _any_rotation,
        ),
    ),
    _any_pose,
)
