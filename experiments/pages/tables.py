"""Tables of the records whose studies have none in Markdown: training, tuning, benchmark."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.benchmarks.timing import comparison, shown
from experiments.runner.markdown import table
from experiments.studies.comparison.methods import TITLES

Report = Mapping[str, Any]
MEASURES = {
    "rotation_error_deg": "rotation error (deg)",
    "translation_error_mm": "translation error at the part's centre (mm)",
    "ffmde_abs_mm": "FFMDE, absolute, eq. 2 (mm)",
    "rmse_mm": "RMSE, eq. 1 (mm)",
    "time_s": "time per registration (s)",
}


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
