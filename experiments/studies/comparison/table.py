"""A comparison as a Markdown table: the paper's figures beside ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.runner.markdown import table as markdown_table

PEERS = {"icp": "open3d_icp", "sac_ia_icp": "open3d_ransac_icp", "fgr": "open3d_fgr"}
MOST_ERROR = 1.1

HEAD = (
    "method",
    "paper: RMSE, FFMDE (mm), time (s)",
    "FFMDE, absolute (mm)",
    "signed (mm)",
    "RMSE (mm)",
    "rotation error (deg)",
    "translation error (mm)",
    "within need",
    "time (s)",
    "refined: rotation (deg)",
    "translation (mm)",
    "within need",
)


def table(report: Mapping[str, Any]) -> str:
    """One line for each method; errors as mean / median / p95 over the test views."""
    need = report["need"]
    lines = [
        f"{report['views']} test views of the {report['part']['name']}; mean / median / 95 %. "
        f"Within need: within {need['rotation_deg']:g} deg and {need['translation_mm']:g} mm.",
        "",
        markdown_table(HEAD, map(_cells, report["methods"])),
    ]
    floor = next((m["alone"]["at_true_pose"] for m in report["methods"] if "alone" in m), None)
    if floor:
        lines += [
            "",
            "At the true pose noise and spacing of the points alone give a mean RMSE of "
            f"{floor['rmse_mm']['mean']:.3g} mm and an absolute FFMDE of "
            f"{floor['ffmde_abs_mm']['mean']:.3g} mm.",
        ]
    lines += beside_open3d(report)
    trained = [method for method in report["methods"] if method.get("training")]
    lines += [""] + [training_line(method["title"], method["training"]) for method in trained]
    return "\n".join(lines).rstrip() + "\n"


def beside_open3d(report: Mapping[str, Any]) -> list[str]:
    """How the classical methods stand to Open3D's on the same clouds, as ratios of medians.

    The goal is an error of at most `MOST_ERROR` times Open3D's.
    """
    methods = {method["name"]: method for method in report["methods"] if "alone" in method}
    lines = []
    for ours, theirs in PEERS.items():
        if not {ours, theirs} <= set(methods):
            continue
        own, peer = (methods[name]["alone"]["summary"] for name in (ours, theirs))
        turn, shift, time = (
            own[name]["median"] / peer[name]["median"]
            for name in ("rotation_error_deg", "translation_error_mm", "time_s")
        )
        met = "met" if max(turn, shift) <= MOST_ERROR else "MISSED"
        lines.append(
            f"- {methods[ours]['title']} beside {methods[theirs]['title']}: {turn:.2f} times its "
            f"median rotation error, {shift:.2f} times its translation error "
            f"(goal {MOST_ERROR:g}: {met}), {time:.1f} times its time."
        )
    return ["", *lines] if lines else []


def _cells(method: Mapping[str, Any]) -> list[str]:
    if "skipped" in method:
        return [method["title"], method["skipped"], *[""] * (len(HEAD) - 2)]
    alone, refined, paper = method["alone"], method["refined"], method["paper"]
    figures = alone["summary"]
    published = (
        "" if paper is None else "{rmse_mm:.2f}, {ffmde_mm:.2f}, {time_s:.2g}".format(**paper)
    )
    return [
        method["title"],
        published,
        _spread(figures["ffmde_abs_mm"]),
        _number(figures["ffmde_signed_mm"]["mean"]),
        _spread(figures["rmse_mm"]),
        _spread(figures["rotation_error_deg"]),
        _spread(figures["translation_error_mm"]),
        f"{alone['success']:.0%}",
        _number(figures["time_s"]["median"]),
        _spread(refined["summary"]["rotation_error_deg"]),
        _spread(refined["summary"]["translation_error_mm"]),
        f"{refined['success']:.0%}",
    ]


def training_line(title: str, training: Mapping[str, Any]) -> str:
    """How long a network was trained, and whether its curve is flat."""
    steps = f"{training['steps']:,} steps"
    if training["ended_by"] == "budget":
        steps = f"{steps} of {training['wanted_steps']:,}, ended by its budget of time"
    fall = training["fall_in_last_quarter"]
    curve = "too few validations to say whether the curve is flat"
    if fall is not None:
        curve = (
            f"validation error {'fell by' if fall >= 0 else 'rose by'} {abs(fall):.0%} in the last "
            f"quarter: {'flat' if training['flat'] else 'not flat yet'}"
        )
    return f"- {title}: {steps}, {training['hours']:.2f} h; {curve}."


def _spread(figures: Mapping[str, float]) -> str:
    return " / ".join(_number(figures[name]) for name in ("mean", "median", "p95"))


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
