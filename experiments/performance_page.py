"""Puts the figures of the recorded benchmark into docs/performance.md, between its two marks.

python -m experiments.performance_page

Run it after copying a run's benchmark.json to experiments/results, and that of a run with ``--only
scaling`` as growth.json; a test checks that the page is current.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.benchmarks.timing import shown
from experiments.pages.marked_page import with_block
from vanejax.files import write_text

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "performance.md"
RESULTS = ROOT / "experiments" / "results"
NAMES = "benchmark", "growth"


def figures(report: Mapping[str, Any], growth: Mapping[str, Any]) -> str:
    """The two benchmarks as Markdown tables, with the machine and the date above them."""
    machine = report["machine"]
    lines = [
        f"{machine['cpu']}, {machine['cores']} cores, "
        f"{machine['matmul_flops_per_second'] / 1e9:.0f} GFLOP/s in a large f32 product; "
        f"{report['date'][:10]}, commit {report['commit'][:10]}, medians of at least "
        f"{min(row['repeats'] for row in report['rows'] if row['repeats'])} repeats.",
        "",
        "| what | median (s) | min to max | goal | beside |",
        "|---|---|---|---|---|",
    ]
    for row in report["rows"]:
        if not row["seconds"]:
            lines.append(f"| {row['name']} | | | | {row['note']} |")
            continue
        median, least, most = (shown(row["seconds"][key]) for key in ("median", "min", "max"))
        goal = "" if row["goal_s"] is None else f"{row['goal_s']:g} s: {row['met']}"
        beside = "; ".join(_beside(entry) for entry in row["against"])
        lines.append(f"| {row['name']} | {median} | {least} to {most} | {goal} | {beside} |")
    lines += ["", f"Growth: {growth['date'][:10]}, commit {growth['commit'][:10]}."]
    lines += ["", "| how it grows | sizes | median (s) | exponent |", "|---|---|---|---|"]
    for row in growth["growth"]:
        sizes = ", ".join(f"{point['size']:,.0f}" for point in row["points"])
        medians = ", ".join(shown(point["seconds"]["median"]) for point in row["points"])
        power = "" if row["exponent"] is None else f"{row['exponent']:.2f}"
        lines.append(f"| {row['name']} | {sizes} {row['unit']} | {medians} | {power} |")
    return "\n".join(lines)


def _beside(entry: Mapping[str, Any]) -> str:
    """Such as "5.2 times as fast as PyTorch (at least 1: met)"."""
    if entry["ratio"] is None:
        return f"not compared with {entry['name']}"
    peer = entry["kind"] == "peer"
    words = f"{entry['ratio']:.2f} times as {'fast' if peer else 'long'} as {entry['name']}"
    if entry["met"] is None:
        return words
    return f"{words} ({'at least' if peer else 'at most'} {entry['goal']:g}: {entry['met']})"


def page(text: str, report: Mapping[str, Any], growth: Mapping[str, Any]) -> str:
    """The page with its figures replaced."""
    return with_block(text, "figures", figures(report, growth))


def recorded() -> tuple[dict[str, Any], dict[str, Any]]:
    """The benchmark and the growth of costs under experiments/results."""
    one, two = (json.loads((RESULTS / f"{name}.json").read_text()) for name in NAMES)
    return one, two


def main() -> None:
    """Rewrites the page."""
    write_text(PAGE, page(PAGE.read_text(), *recorded()))


if __name__ == "__main__":
    main()
