"""Every method of Table 1 on the same scans."""

from __future__ import annotations

import functools

from experiments.pages.reproduction.claim import (
    Claim,
    Finding,
    Report,
    Results,
    better_if,
    digits,
    met_by_count,
    over_floor,
)
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.topic import Part, Picture, Topic, dated
from experiments.pages.tables import tuning_table
from experiments.studies.comparison import pictures as comparison_pictures
from experiments.studies.comparison import table as comparison_table
from experiments.studies.comparison.methods import TABLE_1

PAPER = TABLE_1["rpmnet"]
_RANKED = {
    "FFMDE": "ffmde_abs_mm",
    "rotation error": "rotation_error_deg",
    "translation error": "translation_error_mm",
    "RMSE": "rmse_mm",
}


def _of_paper(results: Results) -> dict[str, Report]:
    methods = {m["name"]: m for m in results["comparison"]["methods"] if "alone" in m}
    return {name: methods[name]["alone"] for name in TABLE_1 if name in methods}


def _best(results: Results) -> Finding:
    rows = _of_paper(results)
    ranks = {}
    for label, measure in _RANKED.items():
        means = {name: row["summary"][measure]["mean"] for name, row in rows.items()}
        ranks[label] = sorted(means, key=means.__getitem__).index("rpmnet") + 1
    return Finding(
        ", ".join(f"no. {rank} in {label}" for label, rank in ranks.items()),
        met_by_count(list(ranks.values()).count(1), len(ranks)),
        f"Means over {results['comparison']['views']} views, {len(rows)} methods. All networks "
        "were trained on scans of this part here, on ModelNet40 in the paper.",
    )


def _metric(results: Results, *, name: str, paper: float) -> Finding:
    rpmnet = _of_paper(results)["rpmnet"]
    ours, floor = (rpmnet[where][name]["mean"] for where in ("summary", "at_true_pose"))
    return over_floor(ours, floor, paper, "noise and the spacing of 1,024 points")


def _time(results: Results) -> Finding:
    ours = _of_paper(results)["rpmnet"]["summary"]["time_s"]["median"]
    return Finding(
        f"{digits(ours)} s",
        better_if(ours < PAPER.time_s),
        f"{PAPER.time_s / ours:.0f} times the paper's rate, on another machine, without a GPU.",
    )


def _methods(results: Results, _: Live | None) -> list[Part]:
    report = results["comparison"]
    return [
        "The same noisy points of the same views for every method, no initial guess. Refined is "
        "what ray casting makes of the same points from where the method ended.",
        dated(results, "comparison", comparison_table.table),
        Picture(
            "Share of the test views whose error is below a value, a line for each method",
            "As the method leaves the pose (above) and refined by ray casting (below); the grey "
            "line is what the paper's process needs.",
            docs="comparison_errors.png",
            draw=lambda: comparison_pictures.error_shares(report),
        ),
        Picture(
            "The hardest test view after each method, scan in green, CAD model in red",
            "The paper's Fig. 3: the least visible view after each method.",
            docs="comparison_methods.png",
            run="comparison/methods.png",
        ),
        "### How the classical methods were tuned",
        dated(results, "tuning", tuning_table),
    ]


METHODS = Topic(
    "Every method: Table 1 and Fig. 3",
    (
        Claim(
            "RPM-Net is the best of the seven methods",
            "first in RMSE and FFMDE",
            ("comparison",),
            _best,
            place="Table 1",
        ),
        *(
            Claim(
                f"{words} of RPM-Net",
                f"{paper:.4f} mm",
                ("comparison",),
                functools.partial(_metric, name=name, paper=paper),
                place="Table 1",
            )
            for words, name, paper in (
                ("FFMDE", "ffmde_abs_mm", PAPER.ffmde_mm),
                ("RMSE", "rmse_mm", PAPER.rmse_mm),
            )
        ),
        Claim(
            "time of one registration by RPM-Net",
            f"{PAPER.time_s:.4f} s",
            ("comparison",),
            _time,
            place="Table 1",
        ),
    ),
    _methods,
    needs=("comparison",),
)
