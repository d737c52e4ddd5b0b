"""What `experiments.position` found: tables with goals, and the paper's Fig. 15 drawn again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from experiments.runner import markdown
from vanejax.plotting.canvas import (
    INK,
    SERIES,
    TICK_PT,
    WIDTH_IN,
    add_legend,
    new_figure,
    style_chart,
)
from vanejax.plotting.canvas import (
    PAPER as PAPER_COLOR,
)

Report = Mapping[str, Any]
Rows = list[Report]

PAPER = {"turns": (0.142, 0.32), "moves": (0.692, 0.85)}  # mean and maximum, Fig. 15
GOAL = {"turns": 0.05, "moves": 0.1}  # mean, registration and calibration included
STATUSES = ("accepted", "ambiguous", "rejected")

# figures of turns and of moves: name in the rows, words, unit
TURNS = {
    "error_deg": ("angle about the R axis", "deg"),
    "whole_deg": ("the whole rotation", "deg"),
    "whole_mm": ("displacement of the part's centre", "mm"),
}
MOVES = {
    "against_probe_mm": ("against the probe, as the paper has it", "mm"),
    "against_truth_mm": ("against the truth", "mm"),
    "known_frame_mm": ("against the truth, were T_b known", "mm"),
    "probe_mm": ("of the probe's own mean (eq. 12)", "mm"),
    "distance_mm": ("of the distance alone, against the probe", "mm"),
    "origin_mm": ("of eq. 13's translation as printed, against the probe", "mm"),
    "whole_deg": ("rotation found where there was none", "deg"),
}
SINGLE = {
    "rotation_deg": ("of one registration: rotation", "deg"),
    "translation_mm": ("of one registration: translation", "mm"),
}


def turns_of(camera: Report) -> Rows:
    """Rows of Fig. 15a."""
    return camera["rotation"]["rows"]


def moves_of(camera: Report) -> Rows:
    """Rows of Fig. 15b."""
    return camera["translation"]


def singles_of(camera: Report) -> Rows:
    """All registrations of a camera, the initial position's too."""
    rest = [row["single"] for row in turns_of(camera) + moves_of(camera)]
    return [camera["first"], *rest]


def magnitudes(report: Report, rows_of: Callable[[Report], Rows], name: str) -> np.ndarray:
    """[cameras, rows] of one figure, without its sign."""
    return np.abs(
        np.array([[row[name] for row in rows_of(camera)] for camera in report["cameras"]])
    )


def is_met(report: Report) -> dict[str, bool]:
    """Whether the mean errors of turns and moves are within the goals."""
    found = {
        "turns": magnitudes(report, turns_of, "error_deg").mean(),
        "moves": magnitudes(report, moves_of, "against_probe_mm").mean(),
    }
    return {name: bool(value <= GOAL[name]) for name, value in found.items()}


def table(report: Report) -> str:
    """Everything, in Markdown."""
    cameras = report["cameras"]
    verdicts = Counter(row["verdict"] for camera in cameras for row in singles_of(camera))
    count = sum(verdicts.values())
    seconds = [row["seconds"] for camera in cameras for row in singles_of(camera)]
    outcome = ", ".join(f"{verdicts[status]} {status}" for status in STATUSES)
    blocks = [
        _summary_table(report),
        f"Cameras of the kind `{report['sensor']}`: {len(cameras)}; positions turned and moved to: "
        f"{report['positions']} each; {count} registrations ({report['method']}): {outcome}; "
        f"{np.median(seconds):.2f} s each (median).",
        _details(report),
        _predictions(report),
        _frames(report),
        "Virtual means: the part is its CAD model, the stage's angles are exact, its moves turn "
        "nothing. The probe errs by 0.015 mm along each axis, the cube's faces are flat and square "
        "to 0.02 mm.",
    ]
    return "\n\n".join(blocks)


def _summary_table(report: Report) -> str:
    met = is_met(report)
    rows = []
    for name, words, unit, rows_of, figure in (
        ("turns", "rotation angle", "deg", turns_of, "error_deg"),
        ("moves", "translation", "mm", moves_of, "against_probe_mm"),
    ):
        values = magnitudes(report, rows_of, figure)
        rows.append(
            [
                f"{words} ({unit})",
                f"{PAPER[name][0]:g} ({PAPER[name][1]:g})",
                f"{values.mean():.3f} ({values.max():.3f})",
                f"{GOAL[name]:g}",
                "met" if met[name] else "MISSED",
            ]
        )
    return markdown.table(
        ["error, mean (maximum)", "paper", "here", "goal for the mean", "goal"], rows
    )


def _details(report: Report) -> str:
    rows = []
    for title, rows_of, figures in (
        ("turned: ", turns_of, TURNS),
        ("moved: ", moves_of, MOVES),
        ("", singles_of, SINGLE),
    ):
        for name, (words, unit) in figures.items():
            values = magnitudes(report, rows_of, name)
            means = values.mean(axis=1)
            means_range = f"{means.min():.4f} to {means.max():.4f}"
            row = [f"{title}{words} ({unit})", f"{values.mean():.4f}", f"{values.max():.4f}"]
            rows.append([*row, means_range])
    away = np.mean([camera["machine_mm"] for camera in report["cameras"]])
    return (
        markdown.table(["error", "mean", "maximum", "means of the cameras"], rows)
        + f"\n\nEq. 13's translation is that of the machine's origin, {away / 1000:.1f} m from the "
        "part: the registration's rotation error times that lever. All other figures are taken "
        "at the part's centre."
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _predictions(report: Report) -> str:
    predicted = [
        [words, *(f"{_rms(magnitudes(report, rows_of, name)):.4f}" for name in names)]
        for words, rows_of, names in (
            ("angle (deg)", turns_of, ("error_deg", "sigma_noise_deg", "sigma_deg")),
            (
                "translation against the truth (mm)",
                moves_of,
                ("against_truth_mm", "sigma_noise_mm", "sigma_mm"),
            ),
        )
    ]
    head = ["root mean square", "error", "predicted from the scan's noise"]
    noise = markdown.table([*head, "with the camera's own calibration"], predicted)
    rows = []
    for kind in ("turns", "moves"):
        shares = [camera["bias"][kind] for camera in report["cameras"]]
        for unit in ("deg", "mm"):
            parts = [
                _rms(np.array([share[f"{part}_{unit}"] for share in shares]))
                for part in ("pose", "motion")
            ]
            rows.append([f"{kind} ({unit})", *(f"{value:.4f}" for value in parts)])
    head = ["what the camera's own calibration does, predicted", "to one pose", "to a motion"]
    return f"{noise}\n\n{markdown.table(head, rows)}"


def _frames(report: Report) -> str:
    figures = ("rotation_deg", "translation_mm", "sigma_deg", "sigma_mm", "left_deg", "left_mm")
    rows = []
    for name, words in (
        ("joint", "all planes of 8 placements at once"),
        ("mean", "mean of 8 matrices (the paper's way)"),
    ):
        found = [camera["calibration"][name] for camera in report["cameras"]]
        means = [np.mean([row[figure] for row in found]) for figure in figures]
        rows.append([words, *(f"{mean:.4f}" for mean in means)])
    joint = [camera["calibration"]["joint"] for camera in report["cameras"]]
    bias = {
        unit: _rms(np.array([row[f"bias_sigma_{unit}"] for row in joint])) for unit in ("deg", "mm")
    }
    head = ["camera to machine, mean of the cameras", "rotation (deg)", "at the cubes (mm)"]
    head += ["predicted (deg)", "(mm)", "left over (deg)", "(mm)"]
    return (
        markdown.table(head, rows)
        + "\n\nPredicted is without the camera's own calibration, whose share of the error is "
        f"{bias['deg']:.4f} deg and {bias['mm']:.4f} mm (one standard deviation)."
    )


def picture(report: Report) -> Figure:
    """Fig. 15: errors at every position, the paper's figures, and what was predicted."""
    figure = new_figure(WIDTH_IN, 4.2)
    turned, moved = figure.subplots(1, 2)
    first = report["cameras"][0]
    errors = magnitudes(report, turns_of, "error_deg")
    probe = magnitudes(report, moves_of, "against_probe_mm")
    style_chart(
        turned,
        title=f"(a) angle about the R axis\n{_summary(errors, 'deg')}",
        xlabel="turned by (deg)",
        ylabel="error (deg)",
    )
    labels = [f"{row['true_deg'] % 360:g}" for row in turns_of(first)]
    turned.set_xticks(range(len(labels)), labels)
    sigma = magnitudes(report, turns_of, "sigma_deg")
    _points(turned, errors, SERIES[0], "each camera")
    _means(turned, errors, SERIES[0], "-", "mean of the cameras")
    whole = magnitudes(report, turns_of, "whole_deg")
    _means(turned, whole, SERIES[2], "--", "whole rotation, mean of the cameras")
    _means(turned, sigma, INK, ":", "predicted (one sigma)")
    _levels(turned, PAPER["turns"], GOAL["turns"])

    style_chart(
        moved,
        title=f"(b) translation, against the probe\n{_summary(probe, 'mm')}",
        xlabel="moved along X, Y, Z by (mm)",
        ylabel="error (mm)",
    )
    labels = ["\n".join(f"{v:g}" for v in row["stage_mm"]) for row in moves_of(first)]
    moved.set_xticks(range(len(labels)), labels)
    _points(moved, probe, SERIES[0], "against the probe, each camera")
    _means(moved, probe, SERIES[0], "-", "against the probe, mean")
    for name, color, words in (
        ("against_truth_mm", SERIES[2], "against the truth, mean"),
        ("known_frame_mm", SERIES[1], "the same with the true frame T_b"),
        ("origin_mm", SERIES[3], "eq. 13 as printed (machine's origin)"),
    ):
        _means(moved, magnitudes(report, moves_of, name), color, "--", words)
    _means(moved, magnitudes(report, moves_of, "sigma_mm"), INK, ":", "predicted (one sigma)")
    _levels(moved, PAPER["moves"], GOAL["moves"])
    for axes in (turned, moved):
        add_legend(axes, loc="upper center", bbox_to_anchor=(0.5, -0.27))
    return figure


def _summary(values: np.ndarray, unit: str) -> str:
    return f"mean {values.mean():.3f}, maximum {values.max():.3f} {unit}"


def _points(axes: Axes, values: np.ndarray, color: str, label: str) -> None:
    """Every value [cameras, positions] as a dot."""
    places = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    axes.plot(
        places.ravel(), values.ravel(), "o", color=color, alpha=0.35, markersize=3, label=label,
        markeredgewidth=0,
    )  # fmt: skip


def _means(axes: Axes, values: np.ndarray, color: str, line: str, label: str) -> None:
    """The mean of values [cameras, positions] over the cameras as a line."""
    axes.plot(values.mean(axis=0), line, color=color, linewidth=1.2, label=label)


def _levels(axes: Axes, paper: tuple[float, float], goal: float) -> None:
    """The paper's mean and maximum, and the goal, on a logarithmic scale."""
    axes.set_yscale("log")
    left = axes.get_xlim()[0]
    for value, line, words, side in (
        (paper[0], "-", "paper, mean", "top"),
        (paper[1], "--", "paper, maximum", "bottom"),
        (goal, "-.", "goal for the mean", "bottom"),
    ):
        color = INK if words.startswith("goal") else PAPER_COLOR
        axes.axhline(value, linestyle=line, color=color, linewidth=1.2)
        axes.text(
            left, value * (1.04 if side == "bottom" else 0.96), f" {words} {value:g}",
            ha="left", va=side, color=color, fontsize=TICK_PT,
        )  # fmt: skip
    axes.set_xlim(left)
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, 3e-4), max(high, 2.0 * paper[1]))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
