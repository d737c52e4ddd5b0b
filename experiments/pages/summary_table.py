"""The README's table of the main figures, from the recorded results."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.runner.markdown import table
from experiments.studies.position import report as stand
from experiments.studies.real_scans import study as real_scans
from experiments.studies.robustness import study as robustness

Report = Mapping[str, Any]
NOISE_MM = 0.1  # of the levels of `experiments.fine`


def summary_table(results: Mapping[str, Report]) -> str:
    """Two columns: what was measured, and the figures."""
    rows = [
        _fine(results["fine"]),
        _position(results["position"]),
        _any_pose(results["any_pose"]),
        _random_scans(results["robustness"]["random"]),
        _real_scans(results["real_scans"]),
        _verdicts(results["verdicts"]),
        *_times(results["benchmark"]),
    ]
    return table(["measured on two CPU cores", "result"], rows)


def _fine(report: Report) -> tuple[str, str]:
    level = next(level for level in report["levels"] if level["noise_mm"] == NOISE_MM)
    angle, shift = level["rotation_deg"], level["translation_mm"]
    return (
        f"fine registration of {level['views']} test views, {NOISE_MM:g} mm of white noise",
        f"{angle['rms']:.4f} deg and {shift['rms']:.4f} mm rms: {angle['ratio']:.2f} and "
        f"{shift['ratio']:.2f} times the Cramer-Rao bound",
    )


def _position(report: Report) -> tuple[str, str]:
    turns = stand.magnitudes(report, stand.turns_of, "error_deg")
    moves = stand.magnitudes(report, stand.moves_of, "against_probe_mm")
    (turn, largest_turn), (move, largest_move) = (
        stand.PAPER["turns"],
        stand.PAPER["moves"],
    )
    return (
        "the paper's position verification, on a virtual stand; in brackets the paper's figures "
        "from its own machine",
        f"rotation {turns.mean():.4f} deg mean, {turns.max():.3f} largest ({turn:g}, "
        f"{largest_turn:g}); translation {moves.mean():.3f} mm, {moves.max():.3f} ({move:g}, "
        f"{largest_move:g})",
    )


def _any_pose(report: Report) -> tuple[str, str]:
    return (
        f"{report['attempts']} random rotations, no initial guess",
        f"{round(report['right'] * report['attempts'])} right, {report['accepted_wrong']} wrong "
        f"poses accepted; {report['seconds']['median']:.1f} s each",
    )


def _random_scans(report: Report) -> tuple[str, str]:
    return (
        f"{report['scans']:,} virtual cameras at 300 to 500 mm, rough initial poses",
        f"{round(report['right'] * report['scans']):,} within {robustness.RIGHT_DEG:g} deg and "
        f"{robustness.RIGHT_MM:g} mm, {report['accepted_wrong']} wrong poses accepted; "
        f"{report['seconds']['median']:.1f} s each",
    )


def _real_scans(report: Report) -> tuple[str, str]:
    return (
        f"{report['scans']} real depth-camera scans of two parts, no training, no initial guess",
        f"{report['right']} within {real_scans.RIGHT_DEG:g} deg and {real_scans.RIGHT_MM:g} mm; "
        f"{report['accepted']} accepted, {report['accepted_wrong']} of them wrong",
    )


def _verdicts(report: Report) -> tuple[str, str]:
    accepted = sum(words["wrong"]["accepted"] for words in report["verdicts_by_sensor"].values())
    parts = len({row["part"] for row in report["registered"]})
    return (
        f"{report['poses']['wrong']:,} wrong poses of {parts} parts, most of them nearly symmetric",
        f"{accepted or 'none'} accepted",
    )


def _times(report: Report) -> list[tuple[str, str]]:
    rows = {row["name"]: row for row in report["rows"]}

    def seconds(name: str) -> str:
        return f"{rows[name]['seconds']['median']:.2g} s"

    def times_as_fast(name: str, peer: str) -> str:
        (ratio,) = (e["ratio"] for e in rows[name]["against"] if e["name"] == peer)
        return f"{seconds(name)}, {ratio:.1f} times as fast as {peer.split(',')[0].split(' ')[0]}"

    return [
        (
            "216 scans of 1280 x 1024 pixels; a training step of four pairs",
            f"{times_as_fast('scan, 216 views of 1280 x 1024', 'Open3D RaycastingScene')}; "
            + times_as_fast("training step, batch 4", "PyTorch, training step"),
        ),
        (
            "`register` on 170,000 points, without weights: from a rough pose; without a guess",
            f"{seconds('register, rough pose')}; {seconds('register, any pose')}",
        ),
    ]
