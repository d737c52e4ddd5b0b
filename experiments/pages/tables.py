"""The summary, and tables of the studies that have none in Markdown: training, tuning, times."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2

from experiments.benchmarks.timing import comparison, shown
from experiments.runner.markdown import table
from experiments.studies.comparison.methods import TITLES
from experiments.studies.position import report as stand
from experiments.studies.real_scans import study as real_scans
from experiments.studies.robustness import study as robustness

Report = Mapping[str, Any]
NOISE_MM = 0.1  # of the levels of `experiments.fine`
MEASURES = {
    "rotation_error_deg": "rotation error (deg)",
    "translation_error_mm": "translation error at the part's centre (mm)",
    "ffmde_abs_mm": "FFMDE, absolute, eq. 2 (mm)",
    "rmse_mm": "RMSE, eq. 1 (mm)",
    "time_s": "time per registration (s)",
}


def summary_table(results: Mapping[str, Report]) -> str:
    """The README's table of the main figures: the template summary.md."""
    benchmark = {row["name"]: row for row in results["benchmark"]["rows"]}

    def seconds(name: str) -> str:
        return f"{benchmark[name]['seconds']['median']:.2g} s"

    def ratio(name: str, peer: str) -> str:
        (entry,) = (entry for entry in benchmark[name]["against"] if entry["name"] == peer)
        return f"{entry['ratio']:.1f}"

    position, levels = results["position"], results["fine"]["levels"]
    template = jinja2.Template(Path(__file__).with_name("summary.md").read_text())
    return template.render(
        results,
        level=next(level for level in levels if level["noise_mm"] == NOISE_MM),
        turns=stand.magnitudes(position, stand.turns_of, "error_deg"),
        moves=stand.magnitudes(position, stand.moves_of, "against_probe_mm"),
        paper=stand.PAPER,
        random=results["robustness"]["random"],
        random_right=(robustness.RIGHT_DEG, robustness.RIGHT_MM),
        real_right=(real_scans.RIGHT_DEG, real_scans.RIGHT_MM),
        seconds=seconds,
        ratio=ratio,
    )


def evaluation_table(report: Report) -> str:
    """The errors of the default recipe's network over the test views."""
    columns = ("mean", "median", "p95", "max")
    rows = [
        [label, *(f"{report['summary'][name][column]:.2f}" for column in columns)]
        for name, label in MEASURES.items()
    ]
    return table([f"{report['views']} test views", "mean", "median", "95 %", "max"], rows)


def tuning_table(report: Report) -> str:
    """The best settings of each classical method."""
    rows = []
    for name, method in report["methods"].items():
        if "skipped" in method:
            continue
        best = method["best"]
        rows.append(
            [
                TITLES[name],
                str(len(method["cells"])),
                f"{best['score_deg']:.3g}",
                f"{best['median_rotation_deg']:.3g}, {best['median_translation_mm']:.3g}",
                f"{best['time_s']:.2g}",
                ", ".join(f"{path} = {value}" for path, value in best["values"].items()),
            ]
        )
    views = ", ".join(str(view) for view in report["training_views"])
    head = ["method", "cells", "score (deg)", "median (deg, mm)", "time (s)", "best settings"]
    return f"Training views {views}; score: {report['score']}.\n\n{table(head, rows)}"


def benchmark_table(report: Report) -> str:
    """Every time of the benchmark, with what it is compared with."""
    rows = []
    for row in report["rows"]:
        if not row["seconds"]:
            rows.append([row["name"], "", "", "", row["note"]])
            continue
        median, least, most = (shown(row["seconds"][key]) for key in ("median", "min", "max"))
        goal = "" if row["goal_s"] is None else f"{row['goal_s']:g} s: {row['met']}"
        against = "; ".join(comparison(entry) for entry in row["against"])
        rows.append([row["name"], median, f"{least} to {most}", goal, against])
    repeats = min(row["repeats"] for row in report["rows"] if row["repeats"])
    rate = report["machine"]["matmul_flops_per_second"] / 1e9
    return (
        f"Medians of at least {repeats} repeats; {rate:.0f} GFLOP/s in a large f32 product.\n\n"
        + table(["time of", "median (s)", "min to max", "goal", "compared with"], rows)
    )


def scaling_table(report: Report) -> str:
    """How the times grow with the sizes."""
    rows = []
    for row in report["scaling"]:
        sizes = ", ".join(f"{point['size']:,.0f}" for point in row["points"])
        medians = ", ".join(shown(point["seconds"]["median"]) for point in row["points"])
        power = "" if row["exponent"] is None else f"{row['exponent']:.2f}"
        rows.append([row["name"], f"{sizes} {row['unit']}", medians, power])
    return table(["time of", "sizes", "median (s)", "exponent"], rows)
