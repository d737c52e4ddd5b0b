"""RMSE and FFMDE over the density of the points."""

from __future__ import annotations

import re

from experiments.pages.reproduction.claim import Claim, Finding, Report, Results, met_if
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.topic import Part, Picture, Topic, origin
from experiments.runner.markdown import text_block
from experiments.studies.density import report as density_report
from experiments.studies.density.report import STEADY, TO_TELL


def _cad(results: Results) -> list[Report]:
    return [sweep for sweep in results["density"]["sweeps"] if sweep["varied"] == "CAD"]


def _changes(results: Results, metric: str) -> list[float]:
    return [sweep[metric]["coarsest_over_finest"][TO_TELL] for sweep in _cad(results)]


def _rmse(results: Results) -> Finding:
    found = _changes(results, "rmse_mm")
    first = _cad(results)[0]
    error, sizes = first["errors"][TO_TELL], first["cad_points"]
    return Finding(
        f"falls {min(found):.1f} to {max(found):.1f} times",
        met_if(min(found) > STEADY),
        f"At a fixed pose error of {error['deg']:g} deg and {error['mm']:g} mm, from "
        f"{sizes[0]:,} to {sizes[-1]:,} CAD points, in {len(found)} cases of noise.",
    )


def _ffmde(results: Results) -> Finding:
    face, rmse = (_changes(results, name) for name in ("ffmde_abs_mm", "rmse_mm"))
    steadier = sum(f < r for f, r in zip(face, rmse, strict=True))
    free = max(face) < STEADY
    more = "It is free of density" if free else "It is not free of density"
    return Finding(
        f"falls {min(face):.1f} to {max(face):.1f} times",
        met_if(free, partly=steadier == len(face)),
        f"{more}, but changes less than RMSE in {steadier} of {len(face)} cases, at the same fixed "
        "pose error.",
    )


def _density(results: Results, _: Live | None) -> list[Part]:
    sweeps = results["density"]["sweeps"]
    return [
        "Scans lie on samples of the CAD surface at a fixed error of the pose, and the number of "
        "points is varied: a metric that judges the pose alone would draw level lines.",
        Picture(
            "RMSE and FFMDE over the number of CAD points, at fixed pose errors",
            "The paper's Fig. 1 (left) with FFMDE, absolute and as printed, beside it; a row for "
            "each kind of noise.",
            docs="density.png",
            draw=lambda: density_report.picture(sweeps),
        ),
        _in_lines(density_report.verdict(sweeps)),
        text_block("\n\n".join(density_report.table(sweep) for sweep in sweeps)),
        text_block(density_report.LEGEND),
        origin(results, "density"),
    ]


def _in_lines(text: str) -> str:
    """The study's verdict, which is one long paragraph, as a list: a line for each sweep."""
    return "\n".join(f"- {line}" for line in re.split(r" (?=With more |The scan's |So at )", text))


DENSITY = Topic(
    "Metrics and density: Figs 1 and 2",
    (
        Claim(
            "RMSE falls with the density of the points at the same registration",
            "curve without figures",
            ("density",),
            _rmse,
            place="Fig. 1",
        ),
        Claim(
            "FFMDE is free of the density of the points",
            "stated",
            ("density",),
            _ffmde,
            place="Fig. 2, eq. 2",
        ),
    ),
    _density,
    needs=("density",),
)
