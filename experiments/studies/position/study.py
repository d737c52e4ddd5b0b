"""Section IV of the paper on a virtual stand: how truly turns and moves of a part are recognised.

python -m experiments.position [--views 108,115,122,129,136] [--positions 12] [--weights vane.npz]
    [--seed 0] [--out runs/position]

At each of the paper's views stands another camera of the kind `paper_camera`, with its own errors
of calibration. A stage turns the guide vane about its R axis to 12 positions over the full turn,
then moves it along X, Y and Z to 12; every position is scanned and registered by
`vanejax.register`, from the first pose and the stage's drawing as a guess; the first pose is
searched. Turns are compared with the stage's, moves with those of a probe in a machine's frame,
which a cube of 60 mm, scanned and touched at eight placements, joins to the camera's. Results:
a table, position.json, and the paper's Fig. 15 drawn again in ``--out``.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments.runner import study_command as study
from experiments.runner.vane_views import VaneViews, magnitudes, pose_error
from experiments.studies.position import report as position_report
from experiments.studies.position.virtual_test_stand import (
    VirtualTestStand,
    calibration_errors,
    calibrations,
    frame_bias,
    place_cubes,
    pose_bias,
    stage_moves,
    stage_turns,
)
from vanejax.errors import InputError
from vanejax.localization.registration import register
from vanejax.machine.calibration import Calibration
from vanejax.machine.positioning import (
    angle_sigma_deg,
    camera_motion,
    common_axis,
    displacement,
    displacement_covariance,
    in_machine,
    motion_errors,
    probe_translation,
    twist_about,
    wrapped_deg,
)
from vanejax.plotting.canvas import save_figure
from vanejax.rigid import RigidTransform
from vanejax.scanner.sensor import Sensor, preset
from vanejax.training.weight_file import TrainedMatcher, find_weights

SENSOR = "paper_camera"
VIEWS = "108,115,122,129,136"  # all 75 deg high
_STAND, _SCAN, _PROBE, _CUBE = range(4)  # folded into the seed


@dataclasses.dataclass(frozen=True, eq=False)
class Found:
    """One registered position.

    Attributes:
      pose: part_from_camera, and ``truth`` what it should be.
      covariance: [6, 6], as the registration says.
      bias: [6, K], what each error of the camera's calibration does to it.
      verdict: of the registration.
      seconds: it took.
    """

    pose: RigidTransform
    truth: RigidTransform
    covariance: np.ndarray
    bias: np.ndarray
    verdict: str
    seconds: float


def find(
    stand: VirtualTestStand,
    positions: Sequence[RigidTransform],
    first: Found | None,
    *,
    errors: list[Sensor],
    weights: TrainedMatcher | None,
    seed: int,
    salt: int,
) -> list[Found]:
    """Scans and registers all positions of the stage, the first of which is the initial one.

    ``first`` is the initial position where it was found before; else it is scanned and searched.
    """
    found = [] if first is None else [first]
    for number in range(len(found), len(positions)):
        rng = np.random.default_rng([seed, _SCAN, salt, number])
        scan = stand.scan(positions[number], rng)
        init = None
        if found:
            init = found[0].pose @ stand.expected(positions[number]).inverse()
        began = time.perf_counter()
        result = register(scan, stand.part, init=init, weights=weights, seed=seed)
        seconds = time.perf_counter() - began
        pose = result.part_from_camera
        found.append(
            Found(
                pose,
                stand.truth(positions[number]),
                result.uncertainty.covariance,
                pose_bias(stand, scan, pose, errors),
                result.verdict.status,
                seconds,
            )
        )
    return found


def single(found: Found, center: np.ndarray) -> dict[str, Any]:
    """What is known of one registration."""
    rotation_deg, translation_mm = magnitudes(pose_error(found.pose, found.truth, center))
    return {
        "rotation_deg": rotation_deg,
        "translation_mm": translation_mm,
        "verdict": found.verdict,
        "seconds": found.seconds,
    }


def turn_rows(
    stand: VirtualTestStand, positions: list[RigidTransform], found: list[Found]
) -> dict[str, Any]:
    """Every position's turn against the stage's (Fig. 15a).

    The angle is that about the axis which all measured turns share; the drawing gives its sign.
    """
    motions = [camera_motion(found[0].pose, other.pose) for other in found[1:]]
    axis = common_axis(np.stack([motion.rotation for motion in motions]))
    if axis @ stand.axis < 0:
        axis = -axis
    rows = []
    for stage, motion, other in zip(positions[1:], motions, found[1:], strict=True):
        true_deg = twist_about(stage.rotation, np.array([0.0, 0.0, 1.0])).angle_deg
        twist = twist_about(motion.rotation, axis)
        ways = motion_errors(found[0].pose, other.pose, stand.part.center)
        noise = ways.covariance(found[0].covariance, other.covariance)
        common = ways.common(found[0].bias, other.bias)
        both = noise + common @ common.T
        whole = pose_error(motion, camera_motion(found[0].truth, other.truth), ways.center)
        rotation_deg, translation_mm = magnitudes(whole)
        rows.append(
            {
                "true_deg": true_deg,
                "error_deg": float(wrapped_deg(twist.angle_deg - true_deg)),
                "swing_deg": twist.swing_deg,
                "whole_deg": rotation_deg,
                "whole_mm": translation_mm,
                "sigma_deg": angle_sigma_deg(both, motion.rotation, axis),
                "sigma_noise_deg": angle_sigma_deg(noise, motion.rotation, axis),
                "single": single(other, stand.part.center),
            }
        )
    true_axis = stand.camera_from_stage.rotation[:, 2]
    return {"axis_error_deg": _between_deg(axis, true_axis), "rows": rows}


def move_rows(
    stand: VirtualTestStand,
    positions: list[RigidTransform],
    found: list[Found],
    calibration: Calibration,
    frame_bias: np.ndarray,
    *,
    seed: int,
    salt: int,
) -> list[dict[str, Any]]:
    """Every position's move in the machine's frame against the probe's (Fig. 15b).

    Compared at the part's centre; ``origin_mm`` is the paper's letter, the translation of eq. 13,
    which is that of the point at the machine's origin.
    """
    probed = [
        stand.probed(stage, np.random.default_rng([seed, _PROBE, salt, number]))
        for number, stage in enumerate(positions)
    ]
    rows = []
    for stage, other, touched in zip(positions[1:], found[1:], probed[1:], strict=True):
        seen = camera_motion(found[0].pose, other.pose)
        true_seen = stand.moved(stage)
        probe = probe_translation(probed[0], touched)
        moved = {}
        for name, frame in (
            ("estimated", calibration.machine_from_camera),
            ("known", stand.machine_from_camera),
        ):
            motion = in_machine(seen, frame)
            start = (frame @ found[0].pose.inverse()).apply(stand.part.center[None])[0]
            moved[name] = (motion, start, displacement(motion, start))
        motion, start, way = moved["estimated"]
        truth = in_machine(true_seen, stand.machine_from_camera).translation  # it turns nothing
        ways = motion_errors(
            found[0].pose,
            other.pose,
            stand.part.center,
            machine_from_camera=calibration.machine_from_camera,
            calibration_center=calibration.center,
        )
        noise = ways.covariance(found[0].covariance, other.covariance, calibration.covariance)
        common = ways.common(found[0].bias, other.bias, frame_bias)
        sigmas = {}
        for name, covariance in (("noise", noise), ("both", noise + common @ common.T)):
            carried = displacement_covariance(covariance, ways.center, start + way)
            sigmas[name] = float(np.sqrt(np.trace(carried)))
        whole = pose_error(motion, in_machine(true_seen, stand.machine_from_camera), ways.center)
        rows.append(
            {
                "stage_mm": stage.translation,
                "true_mm": float(np.linalg.norm(truth)),
                "against_probe_mm": _length(way - probe),
                "against_truth_mm": _length(way - truth),
                "known_frame_mm": _length(moved["known"][2] - truth),
                "probe_mm": _length(probe - truth),
                "distance_mm": _length(way) - _length(probe),
                "origin_mm": _length(motion.translation - probe),
                "whole_deg": magnitudes(whole)[0],
                "whole_mm": magnitudes(whole)[1],
                "sigma_mm": sigmas["both"],
                "sigma_noise_mm": sigmas["noise"],
                "single": single(other, stand.part.center),
            }
        )
    return rows


def _length(vector: np.ndarray) -> float:
    return float(np.linalg.norm(vector))


def _between_deg(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(_length(np.cross(first, second)), first @ second)))


def calibration_row(found: Calibration, stand: VirtualTestStand) -> dict[str, float]:
    """How good a calibration is, and how good it says it is."""
    error = pose_error(found.machine_from_camera, stand.machine_from_camera, found.center)
    rotation_deg, translation_mm = magnitudes(error)
    return {
        "rotation_deg": rotation_deg,
        "translation_mm": translation_mm,
        "sigma_deg": found.rotation_sigma_deg,
        "sigma_mm": found.translation_sigma_mm,
        "left_deg": float(np.mean(found.rotation_deg)),
        "left_mm": float(np.mean(found.corner_mm)),
        "misfit": found.misfit,
    }


def bias_shares(found: list[Found], center: np.ndarray) -> dict[str, float]:
    """How much of what the camera's calibration does to a pose is left in a motion.

    Root mean squares over the positions, predicted: of one pose, and of the motion from the first.
    """

    def rms(columns: list[np.ndarray]) -> tuple[float, float]:
        both = np.stack(columns)
        turn, shift = np.sum(both[:, :3] ** 2, axis=(1, 2)), np.sum(both[:, 3:] ** 2, axis=(1, 2))
        return float(np.degrees(np.sqrt(turn.mean()))), float(np.sqrt(shift.mean()))

    moved = [
        motion_errors(found[0].pose, other.pose, center).common(found[0].bias, other.bias)
        for other in found[1:]
    ]
    pose_deg, pose_mm = rms([other.bias for other in found])
    motion_deg, motion_mm = rms(moved)
    return {
        "pose_deg": pose_deg,
        "pose_mm": pose_mm,
        "motion_deg": motion_deg,
        "motion_mm": motion_mm,
    }


def run_camera(
    views: VaneViews,
    view: int,
    *,
    positions: int,
    weights: TrainedMatcher | None,
    seed: int,
) -> dict[str, Any]:
    """Both verifications and the calibration by one camera."""
    rng = np.random.default_rng([seed, _STAND, view])
    kind = preset(SENSOR)
    camera_from_part = views.viewpoints.view(view)
    stand = VirtualTestStand.build(views.part, kind.sample(rng), camera_from_part, rng)
    errors = calibration_errors(kind)
    turned, moved = stage_turns(positions), stage_moves(positions)
    shared = {"errors": errors, "weights": weights, "seed": seed}
    turns = find(stand, turned, None, salt=2 * view, **shared)
    moves = find(stand, moved, turns[0], salt=2 * view + 1, **shared)
    placed = place_cubes(stand, np.random.default_rng([seed, _CUBE, view]))
    joint, mean = calibrations(placed)
    bias = frame_bias(placed, joint, errors)
    joint_row = calibration_row(joint, stand)
    spread = np.sum(bias**2, axis=1)
    joint_row["bias_sigma_deg"] = float(np.degrees(np.sqrt(spread[:3].sum())))
    joint_row["bias_sigma_mm"] = float(np.sqrt(spread[3:].sum()))
    return {
        "view": view,
        "machine_mm": _length(
            (stand.machine_from_camera @ camera_from_part).apply(stand.part.center[None])[0]
        ),
        "first": single(turns[0], stand.part.center),
        "rotation": turn_rows(stand, turned, turns),
        "translation": move_rows(stand, moved, moves, joint, bias, seed=seed, salt=view),
        "calibration": {"joint": joint_row, "mean": calibration_row(mean, stand)},
        "bias": {
            "turns": bias_shares(turns, stand.part.center),
            "moves": bias_shares(moves, stand.part.center),
        },
    }


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """All cameras, then the table and the picture."""
    views = VaneViews()
    chosen = views.select(settings.views)
    if settings.positions < 3:
        raise InputError(f"--positions {settings.positions}: at least 3 are needed for an axis")
    stage_moves(settings.positions)
    weights = None
    if settings.weights is not None:
        weights = find_weights(settings.weights, views.part)
    method = "ray casting" if weights is None else "RPM-Net, then ray casting"
    report = study.header(method, settings, views.part) | {
        "sensor": SENSOR,
        "positions": settings.positions,
        "cameras": [
            run_camera(
                views, view, positions=settings.positions, weights=weights, seed=settings.seed
            )
            for view in tqdm(chosen, "cameras", unit="camera")
        ],
    }
    report = study.save(settings.out, "position", report)
    save_figure(position_report.picture(report), settings.out / "position.png")
    print(position_report.table(report))
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("position", __doc__)
    parser.add_argument(
        "--views",
        default=VIEWS,
        help=f"which of the paper's 216 views cameras stand at, one each ({VIEWS}); or test, all",
    )
    parser.add_argument(
        "--positions",
        type=study.count,
        default=12,
        help="of the stage, turned and moved, the initial one included (12, which is the most)",
    )
    parser.add_argument(
        "--weights", metavar="FILE", help="of RPM-Net, from `vanejax export`; or pretrained (none)"
    )
    return parser
