"""Turns and moves of a part on a virtual stand."""

from __future__ import annotations

import functools

from experiments.pages.reproduction.claim import (
    Claim,
    Finding,
    Report,
    Results,
    Verdict,
    better_if,
    digits,
)
from experiments.pages.reproduction.live import Live, side_by_side
from experiments.pages.reproduction.topic import Part, Picture, Topic, missing, origin
from experiments.studies.position import report as position_report
from experiments.studies.position.report import PAPER, magnitudes, moves_of, turns_of


def position_errors(report: Report) -> dict[str, dict[str, float]]:
    """Mean and largest error of all cameras' turns about the R axis and moves against the probe."""
    errors = {
        "turns": magnitudes(report, turns_of, "error_deg"),
        "moves": magnitudes(report, moves_of, "against_probe_mm"),
    }
    return {
        name: {"mean": float(found.mean()), "max": float(found.max())}
        for name, found in errors.items()
    }


def _error(results: Results, *, what: str, statistic: str, unit: str, paper: float) -> Finding:
    report = results["position"]
    value = position_errors(report)[what][statistic]
    because = (
        f"On a virtual stand, {len(report['cameras'])} cameras, {report['positions']} positions "
        f"each, by {report['method']}: another part and other instruments, in the paper's chain."
    )
    if what == "moves":
        letter = magnitudes(report, moves_of, "origin_mm")
        because += (
            f" At the part's centre; at the machine's origin, to which the letter of eq. 13 "
            f"refers, it is {digits(float(getattr(letter, statistic)()))} mm."
        )
    verdict = Verdict.MET if value == paper else better_if(value < paper)
    return Finding(f"{digits(value)} {unit}", verdict, because)


def _position(results: Results, live: Live | None) -> list[Part]:
    parts: list[Part] = [
        "A stage turns the vane about its R axis and moves it along X, Y and Z; each position is "
        "scanned by a virtual camera with its own errors of calibration and registered, and the "
        "motion T2 T1^-1 is compared with the stage's or with that of a probe, whose frame a "
        "scanned and touched cube joins to the camera's."
    ]
    if "position" not in results:
        return [*parts, missing("position")]
    report = results["position"]
    if live is not None and live.position is not None:
        parts.append(_against_record(report, live.position))
    return [
        *parts,
        Picture(
            "Errors of the recognised turns and moves over the positions of the stage",
            "The paper's Fig. 15 again: errors of the turns about R and of the moves.",
            docs="position.png",
            draw=lambda: position_report.picture(report),
        ),
        position_report.table(report),
        origin(results, "position"),
    ]


def _against_record(report: Report, live: Report) -> str:
    """Whether the stand that was run for the page found what the record says."""
    if report is live:
        return "There is no record of this study; it was run for this page."
    old, new = (position_errors(one) for one in (report, live))
    pairs = {
        f"{words}, {column}": (old[name][column], new[name][column])
        for name, words in (("turns", "rotation (deg)"), ("moves", "translation (mm)"))
        for column in ("mean", "max")
    }
    return "The stand was run again for this page.\n\n" + side_by_side(pairs)


POSITION = Topic(
    "Position verification: Figs 12 to 15",
    tuple(
        Claim(
            f"{size} error of the {words}",
            f"{within}{paper} {unit}",
            ("position",),
            functools.partial(_error, what=what, statistic=statistic, unit=unit, paper=paper),
            place=f"Fig. 15 ({letter})",
        )
        for letter, what, words, unit in (
            ("a", "turns", "rotation", "deg"),
            ("b", "moves", "translation", "mm"),
        )
        for (statistic, size, within), paper in zip(
            (("mean", "mean", ""), ("max", "largest", "within ")), PAPER[what], strict=True
        )
    ),
    _position,
)
