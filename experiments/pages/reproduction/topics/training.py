"""What a network is trained on, and with what: public shapes or virtual scans, k, noise."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from experiments.pages.reproduction.claim import (
    Claim,
    Finding,
    Report,
    Results,
    digits,
    met_by_count,
    met_if,
)
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.topic import Part, Picture, Topic, dated, dated_text
from experiments.studies.ablation import picture as ablation_picture
from experiments.studies.ablation import table as ablation_table
from experiments.studies.public_vs_virtual import study as public_vs_virtual
from experiments.studies.public_vs_virtual.study import PAPER_REDUCTION, PUBLIC, VIRTUAL
from vanejax import plotting

PAPER_NEIGHBORS = 32  # section III.D


def _neighbors(results: Results) -> Finding:
    report = results["ablation_neighbors"]
    errors = {
        point["overrides"]["model.num_neighbors"]: (
            point["tests"]["own"]["rotation_error_deg"]["mean"]["mean"],
            point["tests"]["own"]["translation_error_mm"]["mean"]["mean"],
        )
        for point in report["points"]
        if point["tests"]["own"]
    }
    best = [min(errors, key=lambda k: errors[k][n]) for n in range(2)]
    steps = report["points"][0]["steps"][0]
    told = f"{len(report['seeds'])} seed" + ("s" if len(report["seeds"]) > 1 else "")
    return Finding(
        f"best in rotation: {best[0]}, in translation: {best[1]}",
        met_by_count(best.count(PAPER_NEIGHBORS), len(best)),
        f"Of {', '.join(map(str, errors))}, after {steps:,} steps of training with {told}.",
    )


def _ablations(results: Results, _: Live | None) -> list[Part]:
    return [
        *_ablation(results, "ablation_neighbors", "Neighbours k"),
        *_ablation(results, "ablation_noise", "Noise of training"),
    ]


def _ablation(results: Results, name: str, title: str) -> list[Part]:
    parts: list[Part] = [f"### {title}", dated_text(results, name, ablation_table.table)]
    if name in results:
        parts.append(
            Picture(
                f"Mean errors over the swept value: {title}",
                f"{title}: mean errors over the test views.",
                docs=f"{name}.png",
                draw=lambda: ablation_picture.picture(results[name]),
            )
        )
    return parts


def _reduction(results: Results) -> Finding:
    report = results["public_vs_virtual"]
    fall = report["hardest_views"]["reduction"]
    found = fall["combined"]
    title = report["trained_on"][PUBLIC]["title"]
    return Finding(
        f"{found:.0%} (rotation {fall['rotation']:.0%}, translation {fall['translation']:.0%})",
        met_if(found >= PAPER_REDUCTION, partly=found > 0),
        f"The other network saw {title}; on all {report['views']['all']} views it is "
        f"{report['all_views']['reduction']['combined']:.0%}.",
    )


def _stability(results: Results) -> Finding:
    errors = results["public_vs_virtual"]["hardest_views"]
    (turn, shift), (turn_v, shift_v) = (
        [
            float(np.std(errors[source][key], ddof=1))
            for key in ("mre_per_view_deg", "mte_per_view_mm")
        ]
        for source in (PUBLIC, VIRTUAL)
    )
    return Finding(
        f"{digits(turn_v)} deg, {digits(shift_v)} mm against "
        f"{digits(turn)} deg, {digits(shift)} mm",
        met_by_count((turn_v < turn) + (shift_v < shift), 2),
        "Standard deviation over the six views of the mean error of the axes (eqs 10 and 11), "
        "virtual against public.",
    )


def _public(results: Results, _: Live | None) -> list[Part]:
    report = results["public_vs_virtual"]
    return [
        "The same network, loss, optimizer and number of steps; only what is seen in training "
        "differs.",
        dated(results, "public_vs_virtual", public_vs_virtual.table),
        _axis_picture(report, "hardest"),
        _axis_picture(report, "all"),
    ]


def _axis_picture(report: Report, views: str) -> Picture:
    return Picture(
        f"Mean errors per axis and per view of both networks, {views} views",
        f"The paper's Figs 8 and 9, {views} views: bars are MRE and MTE per axis (eqs 8, 9), "
        "lines the means over the axes of each view (eqs 10, 11).",
        docs=f"public_axis_errors_{views}.png",
        draw=lambda: axis_errors(report, views),
    )


def axis_errors(report: Report, views: str) -> Figure:
    """Figs 8 and 9 of a record, which holds the errors' means only.

    The picture shows the means over views and over axes of errors [V, 3]; the product of both over
    the mean of all is such errors.
    """
    series = {}
    for source in (PUBLIC, VIRTUAL):
        found = report[f"{views}_views"][source]
        both = [
            (np.array(found[f"{name}_per_view_{unit}"]), np.array(found[f"{name}_per_axis_{unit}"]))
            for name, unit in (("mre", "deg"), ("mte", "mm"))
        ]
        errors = [np.outer(rows, columns) / columns.mean() for rows, columns in both]
        title = report["trained_on"][source]["title"]
        series[title] = plotting.AxisErrors(rotation_deg=errors[0], translation_mm=errors[1])
    return plotting.axis_errors(series)


ABLATIONS = Topic(
    "Ablations: k and noise",
    (
        Claim(
            "k = 32 neighbours train best",
            f"{PAPER_NEIGHBORS}",
            ("ablation_neighbors",),
            _neighbors,
            place="section III.D",
        ),
    ),
    _ablations,
)
PUBLIC_SHAPES = Topic(
    "Public shapes against virtual scans: Figs 8 and 9",
    (
        Claim(
            "virtual scans in place of ModelNet40 lower the error of six views",
            f"about {PAPER_REDUCTION:.0%}",
            ("public_vs_virtual",),
            _reduction,
            place="Fig. 8",
        ),
        Claim(
            "virtual scans make the error vary less from view to view",
            "curves without figures",
            ("public_vs_virtual",),
            _stability,
            place="Fig. 9",
        ),
    ),
    _public,
    needs=("public_vs_virtual",),
)
