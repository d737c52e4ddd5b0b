"""Times beside other programs and the machine's limits."""

from __future__ import annotations

from experiments.pages import tables
from experiments.pages.reproduction.claim import Claim, Finding, Results, digits, met_by_count
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.topic import Part, Topic


def _fast(results: Results) -> Finding:
    rows = results["benchmark"]["rows"]
    goals = [row["met"] for row in rows if row["met"]]
    goals += [entry["met"] for row in rows for entry in row["against"] if entry["met"]]
    met = goals.count("met")
    row = next(r for r in rows if r["name"] == "register, weights, rough pose")
    return Finding(
        f"{met} of {len(goals)} goals",
        met_by_count(met, len(goals)),
        f"A whole registration takes {digits(row['seconds']['median'])} s from a rough pose with "
        "weights; Open3D, small_gicp and PyTorch stood beside it in the same run.",
    )


def _speed(results: Results, _: Live | None) -> list[Part]:
    return [tables.performance_table(results["benchmark"], results["scaling"])]


SPEED = Topic(
    "Times",
    (
        Claim(
            "times beside other programs and the machine's limits",
            "every goal of the benchmark",
            ("benchmark",),
            _fast,
        ),
    ),
    _speed,
    needs=("benchmark", "scaling"),
)
