"""Puts recorded results into README.md and the pages of docs/ that tell of them.

python -m experiments.results_page

Run it after copying a run's JSON to experiments/results (`NAMES` says under which name) and its
pictures to docs; a test checks that the pages are current.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from experiments.pages import summary_table as headline
from experiments.pages.marked_page import with_block
from experiments.studies.ablation import table as ablation_table
from experiments.studies.comparison import table as comparison_table
from experiments.studies.comparison.methods import TITLES
from experiments.studies.density import report as density_report
from experiments.studies.public_vs_virtual import study as public_vs_virtual
from experiments.studies.real_scans import study as real_scans
from experiments.studies.robustness import report as robustness_report
from experiments.studies.sensor_fit import study as sensor_fit
from experiments.studies.sensor_transfer import study as sensor_transfer
from vanejax.files import write_text

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "experiments" / "results"
README, DETAILS = ROOT / "README.md", ROOT / "docs" / "comparison.md"
ROBUSTNESS, REAL_SCANS = ROOT / "docs" / "robustness.md", ROOT / "docs" / "real_scans.md"
TRAINING = ROOT / "docs" / "training.md"
PAGES = (README, TRAINING, DETAILS, ROBUSTNESS, REAL_SCANS)
NAMES = (
    *headline.NEEDS,
    "vane",
    "comparison",
    "tuning",
    "public_vs_virtual",
    "density",
    "ablation_neighbors",
    "ablation_noise",
    "sensor_fit",
    "sensor_transfer",
)
Report = Mapping[str, Any]


def recorded() -> dict[str, Report]:
    """What stands under experiments/results, by name."""
    return {name: json.loads((RESULTS / f"{name}.json").read_text()) for name in NAMES}


def made_by(report: Report) -> str:
    """Machine, date and commit of a result, in a line."""
    commit = str(report["commit"] or "unknown")[:10]
    return f"{measured_on(report)}; {report['date'][:10]}, commit {commit}."


def measured_on(report: Report) -> str:
    """The machine of a result, as far as it says."""
    told = report.get("machine", {})
    name = told.get("cpu") or told.get("processor") or report.get("device") or "unknown"
    cores = told.get("cores")
    return f"{name}, {cores} core{'s' if cores != 1 else ''}" if cores else str(name)


def vane_table(report: Report) -> str:
    """The errors of the default recipe's network over the test views."""
    measures = {
        "rotation_error_deg": "rotation error (deg)",
        "translation_error_mm": "translation error at the part's centre (mm)",
        "ffmde_abs_mm": "FFMDE, absolute, eq. 2 (mm)",
        "rmse_mm": "RMSE, eq. 1 (mm)",
        "time_s": "time per registration (s)",
    }
    columns = ("mean", "median", "p95", "max")
    lines = [
        f"| {report['views']} test views | mean | median | 95 % | max |",
        "|---|---|---|---|---|",
    ]
    for name, label in measures.items():
        cells = " | ".join(f"{report['summary'][name][column]:.2f}" for column in columns)
        lines.append(f"| {label} | {cells} |")
    return "\n".join(lines)


def tuning_table(report: Report) -> str:
    """The best settings of each classical method."""
    lines = [
        f"Training views {', '.join(str(view) for view in report['training_views'])}; score: "
        f"{report['score']}.",
        "",
        "| method | cells | score (deg) | median (deg, mm) | time (s) | best settings |",
        "|---|---|---|---|---|---|",
    ]
    for name, found in report["methods"].items():
        if "skipped" in found:
            continue
        best = found["best"]
        settings = ", ".join(f"{path} = {value}" for path, value in best["values"].items())
        lines.append(
            f"| {TITLES[name]} | {len(found['cells'])} | {best['score_deg']:.3g} | "
            f"{best['median_rotation_deg']:.3g}, {best['median_translation_mm']:.3g} | "
            f"{best['time_s']:.2g} | {settings} |"
        )
    return "\n".join(lines)


def text_block(text: str) -> str:
    """Aligned text as Markdown shows it."""
    return f"```text\n{text.rstrip()}\n```"


def density_block(report: Report) -> str:
    """What the study of densities found, then its figures."""
    tables = "\n\n".join(density_report.table(sweep) for sweep in report["sweeps"])
    return f"{report['verdict']}\n\n{text_block(tables)}"


def blocks(results: Mapping[str, Report]) -> dict[Path, dict[str, str]]:
    """Every generated block by page and name."""

    def dated(name: str, body: Callable[[Report], str]) -> str:
        return f"{body(results[name])}\n\n{made_by(results[name])}"

    return {
        README: {"measured": headline.table(results)},
        TRAINING: {"vane": vane_table(results["vane"])},
        DETAILS: {
            "table 1": dated("comparison", comparison_table.table),
            "tuning": dated("tuning", tuning_table),
            "public": dated("public_vs_virtual", public_vs_virtual.table),
            "density": dated("density", density_block),
            "neighbors": dated(
                "ablation_neighbors", lambda report: text_block(ablation_table.table(report))
            ),
            "noise": dated(
                "ablation_noise", lambda report: text_block(ablation_table.table(report))
            ),
        },
        ROBUSTNESS: {
            "random": robustness_report.random_lines(results["robustness"]["random"]),
            "series": dated("robustness", robustness_report.markdown),
        },
        REAL_SCANS: {
            "table": dated("sensor_fit", sensor_fit.table),
            "known sensor": dated("real_scans", real_scans.sensor_table),
            "trained on": dated("sensor_transfer", sensor_transfer.table),
        },
    }


def page(path: Path, results: Mapping[str, Report]) -> str:
    """A page with its blocks replaced."""
    text = path.read_text()
    for name, body in blocks(results)[path].items():
        text = with_block(text, name, body)
    return text


def main() -> None:
    """Rewrites the pages."""
    results = recorded()
    for path in PAGES:
        write_text(path, page(path, results))


if __name__ == "__main__":
    main()
