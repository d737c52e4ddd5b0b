"""Networks: every method on the same scans, the test views, what a network is trained on."""

from __future__ import annotations

import functools

import numpy as np

from experiments.pages.reproduction.claim import (
    VISIBLE,
    Claim,
    Finding,
    Report,
    Topic,
    better_if,
    claim,
    digits,
    met_by_count,
    met_if,
    over_floor,
)
from experiments.studies.comparison.methods import TABLE_1
from experiments.studies.public_vs_virtual.study import PAPER_REDUCTION, PUBLIC, VIRTUAL

PAPER = TABLE_1["rpmnet"]
PAPER_NEIGHBORS = 32  # section III.D
_RANKED = {
    "FFMDE": "ffmde_abs_mm",
    "rotation error": "rotation_error_deg",
    "translation error": "translation_error_mm",
    "RMSE": "rmse_mm",
}
# ---- every method


def _of_paper(comparison: Report) -> dict[str, Report]:
    methods = {m["name"]: m for m in comparison["methods"] if "alone" in m}
    return {name: methods[name]["alone"] for name in TABLE_1 if name in methods}


@claim(
    "RPM-Net is the best of the seven methods",
    "first in RMSE and FFMDE",
    "comparison",
    place="Table 1",
)
def _best(comparison: Report) -> Finding:
    rows, ranks = _of_paper(comparison), {}
    for label, measure in _RANKED.items():
        means = {name: row["summary"][measure]["mean"] for name, row in rows.items()}
        ranks[label] = sorted(means, key=means.__getitem__).index("rpmnet") + 1
    return Finding(
        ", ".join(f"no. {rank} in {label}" for label, rank in ranks.items()),
        met_by_count(list(ranks.values()).count(1), len(ranks)),
        f"Means over {comparison['views']} views, {len(rows)} methods. All networks were trained "
        "on scans of this part here, on ModelNet40 in the paper.",
    )


def _metric(comparison: Report, *, name: str, paper: float) -> Finding:
    rpmnet = _of_paper(comparison)["rpmnet"]
    ours, floor = (rpmnet[where][name]["mean"] for where in ("summary", "at_true_pose"))
    return over_floor(ours, floor, paper, "noise and the spacing of 1,024 points")


_METRICS = [
    Claim(
        f"{words} of RPM-Net",
        f"{paper:.4f} mm",
        functools.partial(_metric, name=name, paper=paper),
        ("comparison",),
        "Table 1",
    )
    for words, name, paper in (
        ("FFMDE", "ffmde_abs_mm", PAPER.ffmde_mm),
        ("RMSE", "rmse_mm", PAPER.rmse_mm),
    )
]


@claim(
    "time of one registration by RPM-Net", f"{PAPER.time_s:.4f} s", "comparison", place="Table 1"
)
def _time(comparison: Report) -> Finding:
    ours = _of_paper(comparison)["rpmnet"]["summary"]["time_s"]["median"]
    return Finding(
        f"{digits(ours)} s",
        better_if(ours < PAPER.time_s),
        f"{PAPER.time_s / ours:.0f} times as fast as the paper's, on another machine, without a "
        "GPU.",
    )


# ---- the test views


@claim(
    "the six hardest test views are registered without obvious deviation",
    "pictures",
    "vane",
    place="Fig. 7",
)
def _overlays(report: Report) -> Finding:
    hardest, truth = report["hardest"], report["at_true_pose"]["ffmde_abs_mm"]["mean"]
    rotation, translation = (
        hardest["summary"][name]["max"] for name in ("rotation_error_deg", "translation_error_mm")
    )
    ratio = hardest["summary"]["ffmde_abs_mm"]["mean"] / truth
    return Finding(
        f"at most {digits(rotation)} deg and {digits(translation)} mm off",
        met_if(ratio <= VISIBLE),
        f"On the {len(hardest['rows'])} least visible views FFMDE is {ratio:.2f} times that of the "
        "true pose.",
    )


# ---- what a network is trained on, and with what


@claim(
    "virtual scans in place of ModelNet40 lower the error of six views",
    f"about {PAPER_REDUCTION:.0%}",
    "public_vs_virtual",
    place="Fig. 8",
)
def _reduction(report: Report) -> Finding:
    fall = report["hardest_views"]["reduction"]
    return Finding(
        f"{fall['combined']:.0%} (rotation {fall['rotation']:.0%}, translation "
        f"{fall['translation']:.0%})",
        met_if(fall["combined"] >= PAPER_REDUCTION, partly=fall["combined"] > 0),
        f"The other network saw {report['trained_on'][PUBLIC]['title']}; on all "
        f"{report['views']['all']} views it is {report['all_views']['reduction']['combined']:.0%}.",
    )


@claim(
    "virtual scans make the error vary less from view to view",
    "curves without figures",
    "public_vs_virtual",
    place="Fig. 9",
)
def _stability(report: Report) -> Finding:
    (rotation, translation), (rotation_v, translation_v) = (
        [
            float(np.std(report["hardest_views"][source][key], ddof=1))
            for key in ("mre_per_view_deg", "mte_per_view_mm")
        ]
        for source in (PUBLIC, VIRTUAL)
    )
    return Finding(
        f"{digits(rotation_v)} deg, {digits(translation_v)} mm against "
        f"{digits(rotation)} deg, {digits(translation)} mm",
        met_by_count((rotation_v < rotation) + (translation_v < translation), 2),
        "Standard deviation over the six views of the mean error of the axes (eqs 10 and 11), "
        "virtual against public.",
    )


@claim(
    "k = 32 neighbours train best",
    f"{PAPER_NEIGHBORS}",
    "ablation_neighbors",
    place="section III.D",
)
def _neighbors(report: Report) -> Finding:
    errors = {
        point["overrides"]["model.num_neighbors"]: (
            point["tests"]["own"]["rotation_error_deg"]["mean"]["mean"],
            point["tests"]["own"]["translation_error_mm"]["mean"]["mean"],
        )
        for point in report["points"]
        if point["tests"]["own"]
    }
    best = [min(errors, key=lambda k: errors[k][n]) for n in range(2)]
    count = len(report["seeds"])
    return Finding(
        f"best in rotation: {best[0]}, in translation: {best[1]}",
        met_by_count(best.count(PAPER_NEIGHBORS), len(best)),
        f"Of {', '.join(map(str, errors))}, after {report['points'][0]['steps'][0]:,} steps of "
        f"training with {count} seed{'s' if count > 1 else ''}.",
    )


TOPICS = (
    Topic(
        "methods",
        "Every method: Table 1 and Fig. 3",
        (_best, *_METRICS, _time),
    ),
    Topic("views", "The test views: Fig. 7", (_overlays,)),
    Topic(
        "public shapes",
        "Public shapes against virtual scans: Figs 8 and 9",
        (_reduction, _stability),
    ),
    Topic("ablations", "Ablations: k and noise", (_neighbors,)),
)
