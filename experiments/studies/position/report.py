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
from vanejax.plotting import canvas

Report = Mapping[str, Any]
Rows = list[Report]

PAPER = {"turns": (0.142, 0.32), "moves": (0.692, 0.85)}  # mean and maximum, Fig. 15
GOAL = {"turns": 0.05, "moves": 0.1}  # mean, registration and calibration included
STATUSES = ("accepted", "ambiguous", "rejected")
PARTS, UNITS = ("pose", "motion"), ("deg", "mm")


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


# of the picture's panels: title, axis, unit, what the dots are
PANELS = {
    "turns": ("(a) angle about the R axis", "turned by (deg)", "deg", "each camera"),
    "moves": (
        "(b) translation, against the probe",
        "moved along X, Y, Z by (mm)",
        "mm",
        "against the probe, each camera",
    ),
}
# their lines: colour, line and label of each figure's mean over the cameras
PREDICTED = (canvas.INK, ":", "predicted (one sigma)")
LINES = {
    "turns": {
        "error_deg": (canvas.SERIES[0], "-", "mean of the cameras"),
        "whole_deg": (canvas.SERIES[2], "--", "whole rotation, mean of the cameras"),
        "sigma_deg": PREDICTED,
    },
    "moves": {
        "against_probe_mm": (canvas.SERIES[0], "-", "against the probe, mean"),
        "against_truth_mm": (canvas.SERIES[2], "--", "against the truth, mean"),
        "known_frame_mm": (canvas.SERIES[1], "--", "the same with the true frame T_b"),
        "origin_mm": (canvas.SERIES[3], "--", "eq. 13 as printed (machine's origin)"),
        "sigma_mm": PREDICTED,
    },
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


def compared(report: Report) -> dict[str, np.ndarray]:
    """[cameras, rows] of the errors that have goals: of turns (deg) and of moves (mm)."""
    return {
        "turns": magnitudes(report, turns_of, "error_deg"),
        "moves": magnitudes(report, moves_of, "against_probe_mm"),
    }


def is_met(report: Report) -> dict[str, bool]:
    """Whether the mean errors of turns and moves are within the goals."""
    return {name: bool(e.mean() <= GOAL[name]) for name, e in compared(report).items()}


def table(report: Report) -> str:
    """Everything, in Markdown."""
    cameras = report["cameras"]
    rows = [row for camera in cameras for row in singles_of(camera)]
    verdicts = Counter(row["verdict"] for row in rows)
    outcome = ", ".join(f"{verdicts[status]} {status}" for status in STATUSES)
    blocks = [
        _summary_table(report),
        f"Cameras of the kind `{report['sensor']}`: {len(cameras)}; positions turned and moved to: "
        f"{report['positions']} each; {len(rows)} registrations ({report['method']}): {outcome}; "
        f"{np.median([row['seconds'] for row in rows]):.2f} s each (median).",
        _details(report),
        _predictions(report),
        _frames(report),
        "Virtual means: the part is its CAD model, the stage's angles are exact, its moves turn "
        "nothing. The probe errs by 0.015 mm along each axis, the cube's faces are flat and square "
        "to 0.02 mm.",
    ]
    return "\n\n".join(blocks)


def _summary_table(report: Report) -> str:
    errors, met = compared(report), is_met(report)
    rows = [
        [
            words,
            f"{PAPER[name][0]:g} ({PAPER[name][1]:g})",
            f"{errors[name].mean():.3f} ({errors[name].max():.3f})",
            f"{GOAL[name]:g}",
            "met" if met[name] else "MISSED",
        ]
        for name, words in (("turns", "rotation angle (deg)"), ("moves", "translation (mm)"))
    ]
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
            row = [f"{title}{words} ({unit})", *_digits(values.mean(), values.max())]
            rows.append([*row, " to ".join(_digits(means.min(), means.max()))])
    away = np.mean([camera["machine_mm"] for camera in report["cameras"]])
    return (
        markdown.table(["error", "mean", "maximum", "means of the cameras"], rows)
        + f"\n\nEq. 13's translation is that of the machine's origin, {away / 1000:.1f} m from the "
        "part: the registration's rotation error times that lever. All other figures are taken "
        "at the part's centre."
    )


def _digits(*values: float) -> list[str]:
    return [f"{value:.4f}" for value in values]


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _predictions(report: Report) -> str:
    turned = ("error_deg", "sigma_noise_deg", "sigma_deg")
    moved = ("against_truth_mm", "sigma_noise_mm", "sigma_mm")
    predicted = [
        [words, *_digits(*(_rms(magnitudes(report, rows_of, name)) for name in names))]
        for words, rows_of, names in (
            ("angle (deg)", turns_of, turned),
            ("translation against the truth (mm)", moves_of, moved),
        )
    ]
    head = ["root mean square", "error", "predicted from the scan's noise"]
    noise = markdown.table([*head, "with the camera's own calibration"], predicted)
    rows = []
    for kind in ("turns", "moves"):
        shares = [camera["bias"][kind] for camera in report["cameras"]]
        for unit in UNITS:
            parts = (_rms([share[f"{part}_{unit}"] for share in shares]) for part in PARTS)
            rows.append([f"{kind} ({unit})", *_digits(*parts)])
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
        rows.append(
            [words, *_digits(*(np.mean([row[figure] for row in found]) for figure in figures))]
        )
    joint = [camera["calibration"]["joint"] for camera in report["cameras"]]
    deg, mm = _digits(*(_rms([row[f"bias_sigma_{unit}"] for row in joint]) for unit in UNITS))
    head = ["camera to machine, mean of the cameras", "rotation (deg)", "at the cubes (mm)"]
    head += ["predicted (deg)", "(mm)", "left over (deg)", "(mm)"]
    return (
        markdown.table(head, rows)
        + "\n\nPredicted is without the camera's own calibration, whose share of the error is "
        f"{deg} deg and {mm} mm (one standard deviation)."
    )


def picture(report: Report) -> Figure:
    """Fig. 15: errors at every position, the paper's figures, and what was predicted."""
    figure = canvas.new_figure(canvas.WIDTH_IN, 4.2)
    first = report["cameras"][0]
    turns = [f"{row['true_deg'] % 360:g}" for row in turns_of(first)]
    moves = ["\n".join(f"{v:g}" for v in row["stage_mm"]) for row in moves_of(first)]
    panels = (("turns", turns_of, turns), ("moves", moves_of, moves))
    for axes, (kind, rows_of, ticks) in zip(figure.subplots(1, 2), panels, strict=True):
        title, xlabel, unit, dots = PANELS[kind]
        errors = compared(report)[kind]
        title += f"\nmean {errors.mean():.3f}, maximum {errors.max():.3f} {unit}"
        canvas.style_chart(axes, title=title, xlabel=xlabel, ylabel=f"error ({unit})")
        axes.set_xticks(range(len(ticks)), ticks)
        places = np.broadcast_to(np.arange(len(ticks)), errors.shape)
        axes.plot(
            places.ravel(), errors.ravel(), "o", color=canvas.SERIES[0], alpha=0.35, markersize=3,
            label=dots, markeredgewidth=0,
        )  # fmt: skip
        for name, (color, line, label) in LINES[kind].items():
            means = magnitudes(report, rows_of, name).mean(axis=0)
            axes.plot(means, line, color=color, linewidth=1.2, label=label)
        _levels(axes, PAPER[kind], GOAL[kind])
        canvas.add_legend(axes, loc="upper center", bbox_to_anchor=(0.5, -0.27))
    return figure


def _levels(axes: Axes, paper: tuple[float, float], goal: float) -> None:
    """The paper's mean and maximum, and the goal, on a logarithmic scale."""
    axes.set_yscale("log")
    left = axes.get_xlim()[0]
    for value, line, words, side in (
        (paper[0], "-", "paper, mean", "top"),
        (paper[1], "--", "paper, maximum", "bottom"),
        (goal, "-.", "goal for the mean", "bottom"),
    ):
        color = canvas.INK if words.startswith("goal") else canvas.PAPER
        axes.axhline(value, linestyle=line, color=color, linewidth=1.2)
        axes.text(
            left, value * (1.04 if side == "bottom" else 0.96), f" {words} {value:g}",
            ha="left", va=side, color=color, fontsize=canvas.TICK_PT,
        )  # fmt: skip
    axes.set_xlim(left)
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, 3e-4), max(high, 2.0 * paper[1]))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
