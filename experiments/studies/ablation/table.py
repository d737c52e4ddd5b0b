"""What an ablation found: figures over the seeds of each point of the grid, and a table."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.runner.study_command import aligned

CELL_TESTS = {"own": "each under its own settings", "same": "the same test for all"}
STATISTICS = ("mean", "median", "p95", "max")


def over_seeds(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Points of the grid, in the order of their first rows, with figures over their seeds.

    Args:
      rows: of cells.jsonl.

    Returns:
      ``overrides``, ``seeds``, ``ended_by`` and ``steps`` of each seed, mean ``hours``, and under
      ``tests`` for each test, measure and statistic over the views its ``mean``, ``std`` (of the
      sample; None for a single seed), ``min`` and ``max`` over the seeds. Seeds that diverged are
      left out of the tests; where all did, the test is None.
    """
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(json.dumps(row["overrides"], sort_keys=True), []).append(row)
    return [
        {
            "overrides": group[0]["overrides"],
            "seeds": [row["seed"] for row in group],
            "ended_by": [row["training"]["ended_by"] for row in group],
            "steps": [row["training"]["steps"] for row in group],
            "hours": float(np.mean([row["training"]["hours"] for row in group])),
            "tests": {
                test: _spreads([row["tests"][test] for row in group if row["tests"][test]])
                for test in CELL_TESTS
            },
        }
        for group in groups.values()
    ]


def _spreads(tests: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    if not tests:
        return None
    totals: dict[str, Any] = {
        name: sum(test[name] for test in tests) for name in ("views", "non_finite_views")
    }
    for measure in (name for name in tests[0] if name not in totals):
        totals[measure] = {
            statistic: _spread([test[measure][statistic] for test in tests])
            for statistic in STATISTICS
        }
    return totals


def _spread(values: Sequence[float | None]) -> dict[str, float | None]:
    known = [value for value in values if value is not None]
    if not known:
        return dict.fromkeys(("mean", "std", "min", "max"))
    return {
        "mean": float(np.mean(known)),
        "std": float(np.std(known, ddof=1)) if len(known) > 1 else None,
        "min": min(known),
        "max": max(known),
    }


def labels(fields: Sequence[str]) -> list[str]:
    """Fields by their last word alone, where that says which."""
    last = [field.rpartition(".")[2] for field in fields]
    return [
        name if last.count(name) == 1 else field for name, field in zip(last, fields, strict=True)
    ]


def shown(value: Any) -> str:
    """A swept value for the eye."""
    if isinstance(value, list | tuple):
        return f"({', '.join(map(shown, value))})"
    if isinstance(value, float):
        return f"{value:g}"
    return str(value) or "(none)"


def two_tests(points: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the two tests are two: a sweep of the network alone makes them one."""
    return any(point["tests"]["own"] != point["tests"]["same"] for point in points)


def table(report: Mapping[str, Any]) -> str:
    """The points as aligned text: errors under each test, and what ended the training.

    Args:
      report: what ablation.json holds.
    """
    points, fields = report["points"], [sweep["field"] for sweep in report["sweeps"]]
    head = [
        *labels(fields), "rotation (deg)", "median", "p95", "translation (mm)", "median", "p95",
        "FFMDE, abs. (mm)", "hours", "steps", "ended by",
    ]  # fmt: skip
    lines = []
    for test, words in CELL_TESTS.items():
        if test == "same" and not two_tests(points):
            continue
        rows = [head, *(_row(point, fields, test) for point in points)]
        lines += [f"{report['part']['name']}: test views, {words}, mean", *aligned(rows)]
        lost = sum((point["tests"][test] or {}).get("non_finite_views", 0) for point in points)
        if lost:
            lines.append(f"WARNING: {lost} registrations are not finite and are left out.")
        lines.append("")
    if len(report["seeds"]) > 1:
        lines.append(f"mean ± standard deviation over the seeds {shown(report['seeds'])}")
    if any("budget" in point["ended_by"] for point in points):
        lines.append(
            "budget: the minutes ended the training before its steps; such cells depend on the "
            "machine."
        )
    return "\n".join(lines).rstrip()


def _row(point: Mapping[str, Any], fields: Sequence[str], test: str) -> list[str]:
    spreads = point["tests"][test]

    def cells(measure: str, *statistics: str) -> list[str]:
        return [_figure(spreads[measure][name]) if spreads else "-" for name in statistics]

    steps = sorted(set(point["steps"]))
    ended = Counter(point["ended_by"])
    return [
        *(shown(point["overrides"][field]) for field in fields),
        *cells("rotation_error_deg", "mean", "median", "p95"),
        *cells("translation_error_mm", "mean", "median", "p95"),
        *cells("ffmde_abs_mm", "mean"),
        f"{point['hours']:.2f}",
        f"{steps[0]}-{steps[-1]}" if len(steps) > 1 else str(steps[0]),
        next(iter(ended)) if len(ended) == 1 else ", ".join(f"{n} {w}" for w, n in ended.items()),
    ]


def _figure(spread: Mapping[str, float | None]) -> str:
    if spread["mean"] is None:
        return "-"
    more = "" if spread["std"] is None else f" ± {spread['std']:.3f}"
    return f"{spread['mean']:.3f}{more}"
