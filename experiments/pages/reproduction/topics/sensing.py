"""Virtual scans under bad conditions: distance, angle and light as in Fig. 11, clutter and more."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from experiments.pages.reproduction.claim import (
    Claim,
    Finding,
    Report,
    Results,
    Verdict,
    digits,
    met_if,
    over_floor,
)
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.topic import Part, Picture, Topic, origin
from experiments.runner.required_accuracy import NEED_DEG, NEED_MM
from experiments.studies.robustness import report as robustness_report
from experiments.studies.robustness import study as robustness
from experiments.studies.robustness.report import networks, share_within_need, values

PAPER_SERIES = ("distance", "angle", "light")
ON_PAGE = 3  # series side by side: more are too small on paper


def _series(results: Results, name: str) -> Report:
    return next(s for s in results["robustness"]["series"] if s["name"] == name)


def _mean(results: Results, *, series: str, metric: str) -> Finding:
    """The last network's mean over a series after refinement, against the paper's."""
    report, network = _series(results, series), networks(results["robustness"])[-1]
    found = [values(step, network, "refined", metric) for step in report["steps"]]
    truth = [[row["truth"][metric] for row in step["rows"]] for step in report["steps"]]
    return over_floor(
        float(np.concatenate(found).mean()),
        float(np.concatenate(truth).mean()),
        report["paper"][metric],
        "the spacing of the CAD points and the camera's noise",
    )


def _paper_mean(results: Results, *, series: str, metric: str) -> str:
    return f"{_series(results, series)['paper'][metric]:.4f} mm"


def _within_need(results: Results, *, series: str) -> Finding:
    steps, network = _series(results, series)["steps"], networks(results["robustness"])[-1]
    shares, alone = (
        [share_within_need(step, network, stage) for step in steps]
        for stage in ("refined", "alone")
    )
    turn, shift = (
        max(float(values(step, network, "refined", key).max()) for step in steps)
        for key in ("rotation_deg", "translation_mm")
    )
    most = max(np.mean([row["hole_share"] for row in step["rows"]]) for step in steps)
    return Finding(
        f"at most {digits(turn)} deg and {digits(shift)} mm off",
        met_if(min(shares) == 1),
        f"{np.mean(shares):.0%} of the virtual scans are within {NEED_DEG:g} deg and "
        f"{NEED_MM:g} mm after refinement by ray casting, {np.mean(alone):.0%} before it; up "
        f"to {most:.0%} of the pixels are lost.",
    )


def _sensing(results: Results, _: Live | None) -> list[Part]:
    report = _only(results["robustness"], PAPER_SERIES)
    return [
        "The paper turned and moved a real camera above a real vane; here a virtual "
        f"structured-light camera ({report['sensor']}) with shadow, dropout, calibration errors "
        "and noise does. FFMDE and RMSE have a floor, printed beside them: what they are at the "
        "true pose.",
        Picture(
            "Errors, FFMDE and RMSE over distance, angle and saturated pixels",
            "The paper's Fig. 11: each network alone (dashed), refined (full), at the true pose "
            "(dotted); the paper's mean in grey.",
            docs="robustness.png",
            draw=lambda: robustness_report.picture(report),
        ),
        robustness_report.markdown(report),
        origin(results, "robustness"),
    ]


def _only(report: Report, names: Sequence[str]) -> Report:
    """A record of robustness with these series alone."""
    return {**report, "series": [s for s in report["series"] if s["name"] in names]}


def _random(results: Results) -> Finding:
    report = results["robustness"]["random"]
    if not report:
        return Finding("–", Verdict.UNKNOWN, "The study was run without random scans.")
    return Finding(
        f"{report['right']:.1%} of {report['scans']:,}, {report['accepted_wrong']} wrong accepted",
        met_if(report["right"] >= robustness.LEAST_RIGHT and not report["accepted_wrong"]),
        f"Mean {digits(report['rotation_deg']['mean'])} deg and "
        f"{digits(report['translation_mm']['mean'])} mm, {digits(report['seconds']['median'])} s "
        "each (median).",
    )


def _clutter(results: Results, _: Live | None) -> list[Part]:
    report = results["robustness"]
    names = [s["name"] for s in report["series"] if s["name"] not in PAPER_SERIES]
    parts: list[Part] = [_series_picture(_only(report, shown)) for shown in _in_rows(names)]
    parts.append(robustness_report.markdown(_only(report, names)))
    if report["random"]:
        parts.append(robustness_report.random_lines(report["random"]))
    return [*parts, origin(results, "robustness")]


def _in_rows(names: Sequence[str]) -> list[Sequence[str]]:
    """As many as a page has room for; the few come first: castings stand beside castings."""
    first = len(names) % ON_PAGE
    rows = [names[start : start + ON_PAGE] for start in range(first, len(names), ON_PAGE)]
    return [names[:first], *rows] if first else rows


def _series_picture(report: Report) -> Picture:
    words = "; ".join(series["title"].lower() for series in report["series"])
    return Picture(
        f"Errors, FFMDE and RMSE over {words}",
        f"Drawn as Fig. 11, each network alone (dashed) and refined (full): {words}.",
        draw=lambda: robustness_report.picture(report),
    )


SENSING = Topic(
    "Distance, angle, strong light: Figs 10 and 11",
    (
        *(
            Claim(
                f"mean {words} over the {series}s",
                functools.partial(_paper_mean, series=series, metric=metric),
                ("robustness",),
                functools.partial(_mean, series=series, metric=metric),
                place=f"Fig. 11 ({letter})",
            )
            for letter, series, metric, words in (
                ("a", "distance", "ffmde_abs_mm", "FFMDE"),
                ("b", "distance", "rmse_mm", "RMSE"),
                ("c", "angle", "ffmde_abs_mm", "FFMDE"),
                ("d", "angle", "rmse_mm", "RMSE"),
            )
        ),
        *(
            Claim(
                f"the pose stays right over {words}",
                paper,
                ("robustness",),
                functools.partial(_within_need, series=series),
                place=f"Fig. 11 ({letters})",
            )
            for letters, series, words, paper in (
                ("a, b", "distance", "all distances", "small fluctuations"),
                ("c, d", "angle", "all angles", "small fluctuations"),
                ("e", "light", "strong light", "no large deviation, by eye"),
            )
        ),
    ),
    _sensing,
    needs=("robustness",),
)
CLUTTER = Topic(
    "Clutter, castings, noise, random scans",
    (
        Claim(
            "scans from anywhere between 300 and 500 mm by random cameras: right",
            f"{robustness.LEAST_RIGHT:.0%}, no wrong one accepted",
            ("robustness",),
            _random,
        ),
    ),
    _clutter,
    needs=("robustness",),
)
