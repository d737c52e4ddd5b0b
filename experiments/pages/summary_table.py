"""The README's table of what was measured, from the recorded results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from experiments.studies.position import report as stand
from experiments.studies.real_scans.study import NEAR_DEG, NEAR_MM, RIGHT_DEG, RIGHT_MM
from experiments.studies.robustness.study import RIGHT_DEG as RANDOM_DEG
from experiments.studies.robustness.study import RIGHT_MM as RANDOM_MM

Report = Mapping[str, Any]
NEEDS = ("fine", "position", "any_pose", "real_scans", "verdicts", "robustness", "benchmark")
NOISE_MM = (0.1, 0.5)  # of the levels of `experiments.fine`


def table(results: Mapping[str, Report]) -> str:
    """Two columns: what was done, and what came out."""
    rows = [
        *_fine(results["fine"]),
        _position(results["position"]),
        _any_pose(results["any_pose"]),
        _random(results["robustness"]["random"]),
        _real(results["real_scans"]),
        *_verdicts(results["verdicts"]),
        *_times(results["benchmark"]),
    ]
    head = ["| measured (two CPU cores; `experiments/results`) | |", "|---|---|"]
    return "\n".join(head + [f"| {what} | {found} |" for what, found in rows])


def _fine(report: Report) -> list[tuple[str, str]]:
    rows = []
    config = report["config"]
    for level in report["levels"]:
        noise = level["noise_mm"]
        if noise not in NOISE_MM:
            continue
        angle, shift = level["rotation_deg"], level["translation_mm"]
        rows.append(
            (
                f"{level['views']} test views, {noise:g} mm of white noise, from "
                f"{config['start_deg']:g} deg and {config['start_mm']:g} mm off",
                f"{angle['rms']:.4f} deg, {shift['rms']:.4f} mm rms: {angle['ratio']:.2f} and "
                f"{shift['ratio']:.2f} times the Cramer-Rao bound",
            )
        )
    return rows


def _position(report: Report) -> tuple[str, str]:
    turns = stand.magnitudes(report, stand.turns_of, "error_deg")
    moves = stand.magnitudes(report, stand.moves_of, "against_probe_mm")
    true = stand.magnitudes(report, stand.moves_of, "against_truth_mm")
    count = sum(len(stand.singles_of(camera)) for camera in report["cameras"])
    (turn, most_turn), (move, most_move) = stand.PAPER["turns"], stand.PAPER["moves"]
    return (
        f"the paper's position verification on a virtual stand: {len(report['cameras'])} cameras "
        f"with errors of calibration, {count} registrations, probe, cube",
        f"turns: {turns.mean():.4f} deg mean, {turns.max():.3f} largest (paper, on its machine: "
        f"{turn:g}, {most_turn:g}); moves: {moves.mean():.3f} mm mean, {moves.max():.3f} largest "
        f"({move:g}, {most_move:g}) against the probe, {true.mean():.4f} mean against the truth",
    )


def _any_pose(report: Report) -> tuple[str, str]:
    right = round(report["right"] * report["attempts"])
    accepted = report["verdicts"]["accepted"]
    return (
        f"{report['attempts']} random rotations, {report['config']['noise_mm']:g} mm of noise, "
        "with weights",
        f"{right} right, {accepted['right'] + accepted['wrong']} accepted, {accepted['wrong']} of "
        f"them wrong; {report['seconds']['median']:.1f} s each",
    )


def _random(report: Report) -> tuple[str, str]:
    angle, shift = report["rotation_deg"], report["translation_mm"]
    accepted = report["verdicts"]["accepted"]
    return (
        f"{report['scans']:,} scans by as many cameras of the kind `paper_camera`, from anywhere "
        "between 300 and 500 mm, rough poses, with weights",
        f"{round(report['right'] * report['scans']):,} within {RANDOM_DEG:g} deg and "
        f"{RANDOM_MM:g} mm, {accepted['right'] + accepted['wrong']:,} accepted, "
        f"{accepted['wrong']} of them wrong; mean {angle['mean']:.4f} deg and "
        f"{shift['mean']:.3f} mm, largest {angle['max']:.3f} and {shift['max']:.2f}; "
        f"{report['seconds']['median']:.2f} s each",
    )


def _real(report: Report) -> tuple[str, str]:
    verdicts = Counter(row["verdict"] for row in report["rows"])
    return (
        f"{report['scans']} real depth-camera scans of two parts, one of them symmetric; no "
        "training, no guess",
        f"{report['right']} within {RIGHT_DEG:g} deg and {RIGHT_MM:g} mm, {report['near']} within "
        f"{NEAR_DEG:g} and {NEAR_MM:g} ({report['sensor']['near']} with `--sensor`); "
        f"{verdicts['accepted']} accepted, {report['accepted_wrong']} of them wrong, "
        f"{verdicts['ambiguous']} ambiguous, {verdicts['rejected']} rejected",
    )


def _verdicts(report: Report) -> list[tuple[str, str]]:
    accepted = sum(words["wrong"]["accepted"] for words in report["verdicts_by_sensor"].values())
    parts = len({row["part"] for row in report["registered"]})
    runs: Counter[str] = Counter()
    for outcome in report["register"].values():
        runs.update(outcome)
    coarse = report["register"]["depth_camera"]["ambiguous_right_not_given"]
    return [
        (
            f"{parts} parts, most of them symmetric or nearly so, under "
            f"{len(report['verdicts_by_sensor'])} virtual sensors: {report['poses']['wrong']:,} "
            "wrong poses",
            f"{accepted or 'none'} accepted",
        ),
        (
            f"the same, `register` from no guess on {len(report['registered'])} scans",
            f"{runs['accepted_right'] + runs['accepted_wrong']} accepted, "
            f"{runs['accepted_wrong'] or 'none'} of them wrong; "
            f"{runs['rejected_right'] + runs['rejected_wrong']} rejected; {runs['ambiguous']} "
            f"ambiguous, {runs['ambiguous_right_not_given']} of these without the right pose among "
            f"those listed, {coarse} of them by the coarse depth camera",
        ),
    ]


def _times(report: Report) -> list[tuple[str, str]]:
    rows = {row["name"]: row for row in report["rows"]}

    def seconds(name: str) -> str:
        return f"{rows[name]['seconds']['median']:.2g}"

    def beside(name: str, other: str) -> str:
        (ratio,) = (e["ratio"] for e in rows[name]["against"] if e["name"] == other)
        return f"{ratio:.1f}"

    scan, step = "scan, 216 views of 1280 x 1024", "training step, batch 4"
    register = [f"register, {name}" for name in ("weights, rough pose", "weights, any pose")]
    register += ["register, rough pose", "register, any pose"]
    command = "command, weights, rough pose"
    return [
        (
            "refining a scan of 170,000 points",
            f"{seconds('refine')} s: "
            f"{beside('refine', 'Open3D ICP, point to plane')} times as fast as Open3D's ICP, "
            f"{beside('refine', 'small_gicp, point to plane')} times small_gicp's, and nearer",
        ),
        (
            "`register` on it: with weights from a rough pose, from any; without from a rough "
            "pose, from any",
            f"{', '.join(map(seconds, register))} s",
        ),
        (
            "216 views of 1280 x 1024 pixels: 33 million points, normals, faces",
            f"{seconds(scan)} s: {beside(scan, 'Open3D RaycastingScene')} times as fast as Open3D, "
            f"{beside(scan, 'bare casts of the scans')} times as long as Embree's bare casts",
        ),
        (
            "a training step of four pairs, 717 x 1024 points",
            f"{seconds(step)} s: {beside(step, 'PyTorch, training step')} times as fast as "
            f"PyTorch, {beside(step, 'arithmetic of a step')} times as long as its arithmetic at "
            "full rate",
        ),
        (
            "the command with weights and a rough pose: first run, later ones",
            f"{seconds(f'{command}, first run')}, {seconds(f'{command}, second run')} s",
        ),
    ]
