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
from experiments.runner.vane_views import VaneViews, error_row, pose_error
from experiments.studies.position import report as position_report
from experiments.studies.position import virtual_test_stand as virtual
from vanejax.errors import InputError
from vanejax.localization.registration import register
from vanejax.machine import Calibration, MotionErrors, motion_errors, positioning
from vanejax.machine.positioning import camera_motion, in_machine
from vanejax.plotting import save_figure
from vanejax.rigid import RigidTransform
from vanejax.scanner.sensor import Sensor, preset
from vanejax.training.weight_file import TrainedMatcher, find_weights

SENSOR = "paper_camera"
VIEWS = "108,115,122,129,136"  # all 75 deg high
_STAND, _SCAN, _PROBE, _CUBE = range(4)  # folded into the seed


@dataclasses.dataclass(frozen=True, eq=False)
class Found:
    """One registered position."""

    pose: RigidTransform  # part_from_camera
    truth: RigidTransform  # what it should be
    covariance: np.ndarray  # [6, 6], as the registration says
    bias: np.ndarray  # [6, K], what each error of the camera's calibration does to it
    verdict: str
    seconds: float

    def row(self, center: np.ndarray) -> dict[str, Any]:
        """Its errors at the part's centre, and what was said of it."""
        errors = error_row(pose_error(self.pose, self.truth, center))
        return errors | {"verdict": self.verdict, "seconds": self.seconds}


def find(
    stand: virtual.VirtualTestStand,
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
    for number, stage in enumerate(positions[len(found) :], len(found)):
        scan = stand.scan(stage, np.random.default_rng([seed, _SCAN, salt, number]))
        init = found[0].pose @ stand.expected(stage).inverse() if found else None
        began = time.perf_counter()
        result = register(scan, stand.part, init=init, weights=weights, seed=seed)
        seconds = time.perf_counter() - began
        pose = result.part_from_camera
        bias = virtual.pose_bias(stand, scan, pose, errors)
        covariance, status = result.uncertainty.covariance, result.verdict.status
        found.append(Found(pose, stand.truth(stage), covariance, bias, status, seconds))
    return found


def covariances(
    ways: MotionErrors,
    first: Found,
    other: Found,
    calibration: np.ndarray | None = None,
    frame_bias: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """[6, 6] of a motion's error: of the scans' noise, and with the camera's own calibration."""
    noise = ways.covariance(first.covariance, other.covariance, calibration)
    common = ways.common(first.bias, other.bias, frame_bias)
    return noise, noise + common @ common.T


def turn_rows(
    stand: virtual.VirtualTestStand, positions: list[RigidTransform], found: list[Found]
) -> dict[str, Any]:
    """Every position's turn against the stage's (Fig. 15a).

    The angle is that about the axis which all measured turns share; the drawing gives its sign.
    """
    first, *others = found
    motions = [camera_motion(first.pose, other.pose) for other in others]
    axis = positioning.common_axis(np.stack([motion.rotation for motion in motions]))
    axis = -axis if axis @ stand.axis < 0 else axis
    rows = []
    for stage, motion, other in zip(positions[1:], motions, others, strict=True):
        true_deg = positioning.twist_about(stage.rotation, np.array([0.0, 0.0, 1.0])).angle_deg
        twist = positioning.twist_about(motion.rotation, axis)
        ways = motion_errors(first.pose, other.pose, stand.part.center)
        noise, both = covariances(ways, first, other)
        whole = error_row(pose_error(motion, camera_motion(first.truth, other.truth), ways.center))
        rows.append(
            {
                "true_deg": true_deg,
                "error_deg": float(positioning.wrapped_deg(twist.angle_deg - true_deg)),
                "swing_deg": twist.swing_deg,
                "whole_deg": whole["rotation_deg"],
                "whole_mm": whole["translation_mm"],
                "sigma_deg": positioning.angle_sigma_deg(both, motion.rotation, axis),
                "sigma_noise_deg": positioning.angle_sigma_deg(noise, motion.rotation, axis),
                "single": other.row(stand.part.center),
            }
        )
    true_axis = stand.camera_from_stage.rotation[:, 2]
    between = np.arctan2(_length(np.cross(axis, true_axis)), axis @ true_axis)
    return {"axis_error_deg": float(np.degrees(between)), "rows": rows}


def move_rows(
    stand: virtual.VirtualTestStand,
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
    first, center = found[0], stand.part.center

    def way_of(motion: RigidTransform, frame: RigidTransform) -> tuple[np.ndarray, np.ndarray]:
        """How far the part's centre came in a machine's frame, and where to."""
        start = (frame @ first.pose.inverse()).apply(center[None])[0]
        way = positioning.displacement(motion, start)
        return way, start + way

    rows = []
    for stage, other, touched in zip(positions[1:], found[1:], probed[1:], strict=True):
        seen = camera_motion(first.pose, other.pose)
        true_motion = in_machine(stand.moved(stage), stand.machine_from_camera)
        truth = true_motion.translation  # it turns nothing
        probe = positioning.probe_translation(probed[0], touched)
        motion = in_machine(seen, calibration.machine_from_camera)
        way, arrived = way_of(motion, calibration.machine_from_camera)
        known_motion = in_machine(seen, stand.machine_from_camera)
        known_way, _ = way_of(known_motion, stand.machine_from_camera)
        ways = motion_errors(
            first.pose,
            other.pose,
            center,
            machine_from_camera=calibration.machine_from_camera,
            calibration_center=calibration.center,
        )
        noise_mm, both_mm = (
            float(np.sqrt(np.trace(positioning.displacement_covariance(c, ways.center, arrived))))
            for c in covariances(ways, first, other, calibration.covariance, frame_bias)
        )
        whole = error_row(pose_error(motion, true_motion, ways.center))
        rows.append(
            {
                "stage_mm": stage.translation,
                "true_mm": _length(truth),
                "against_probe_mm": _length(way - probe),
                "against_truth_mm": _length(way - truth),
                "known_frame_mm": _length(known_way - truth),
                "probe_mm": _length(probe - truth),
                "distance_mm": _length(way) - _length(probe),
                "origin_mm": _length(motion.translation - probe),
                "whole_deg": whole["rotation_deg"],
                "whole_mm": whole["translation_mm"],
                "sigma_mm": both_mm,
                "sigma_noise_mm": noise_mm,
                "single": other.row(center),
            }
        )
    return rows


def _length(vector: np.ndarray) -> float:
    return float(np.linalg.norm(vector))


def calibration_row(found: Calibration, stand: virtual.VirtualTestStand) -> dict[str, float]:
    """How good a calibration is, and how good it says it is."""
    error = pose_error(found.machine_from_camera, stand.machine_from_camera, found.center)
    return error_row(error) | {
        "sigma_deg": found.rotation_sigma_deg,
        "sigma_mm": found.translation_sigma_mm,
        "left_deg": float(np.mean(found.rotation_deg)),
        "left_mm": float(np.mean(found.corner_mm)),
        "misfit": found.misfit,
    }


def spread(name: str, biases: list[np.ndarray]) -> dict[str, float]:
    """``name``_deg and ``name``_mm: what K causes [6, K] do together, rms over the biases."""
    squares = np.mean(np.stack(biases) ** 2, axis=0).sum(axis=1)
    return {
        f"{name}_deg": float(np.degrees(np.sqrt(squares[:3].sum()))),
        f"{name}_mm": float(np.sqrt(squares[3:].sum())),
    }


def bias_shares(found: list[Found], center: np.ndarray) -> dict[str, float]:
    """How much of what the camera's calibration does to a pose is left in a motion.

    Predicted, root mean squares over the positions: of one pose, and of the motion from the first.
    """
    first = found[0]
    left = [
        motion_errors(first.pose, other.pose, center).common(first.bias, other.bias)
        for other in found[1:]
    ]
    return spread("pose", [each.bias for each in found]) | spread("motion", left)


def run_camera(
    views: VaneViews, view: int, *, positions: int, weights: TrainedMatcher | None, seed: int
) -> dict[str, Any]:
    """Both verifications and the calibration by one camera."""
    rng = np.random.default_rng([seed, _STAND, view])
    kind, center = preset(SENSOR), views.part.center
    camera_from_part = views.viewpoints.view(view)
    stand = virtual.VirtualTestStand.build(views.part, kind.sample(rng), camera_from_part, rng)
    errors = virtual.calibration_errors(kind)
    turned, moved = virtual.stage_turns(positions), virtual.stage_moves(positions)
    shared = {"errors": errors, "weights": weights, "seed": seed}
    turns = find(stand, turned, None, salt=2 * view, **shared)
    moves = find(stand, moved, turns[0], salt=2 * view + 1, **shared)
    placed = virtual.place_cubes(stand, np.random.default_rng([seed, _CUBE, view]))
    joint, mean = virtual.calibrations(placed)
    bias = virtual.frame_bias(placed, joint, errors)
    machine_from_part = stand.machine_from_camera @ camera_from_part
    return {
        "view": view,
        "machine_mm": _length(machine_from_part.apply(center[None])[0]),
        "first": turns[0].row(center),
        "rotation": turn_rows(stand, turned, turns),
        "translation": move_rows(stand, moved, moves, joint, bias, seed=seed, salt=view),
        "calibration": {
            "joint": calibration_row(joint, stand) | spread("bias_sigma", [bias]),
            "mean": calibration_row(mean, stand),
        },
        "bias": {"turns": bias_shares(turns, center), "moves": bias_shares(moves, center)},
    }


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """All cameras, then the table and the picture."""
    views, positions = VaneViews(), settings.positions
    chosen = views.select(settings.views)
    if positions < 3:
        raise InputError(f"--positions {positions}: at least 3 are needed for an axis")
    virtual.stage_moves(positions)
    named = settings.weights
    weights = None if named is None else find_weights(named, views.part)
    method = "ray casting" if weights is None else "RPM-Net, then ray casting"
    given = {"positions": positions, "weights": weights, "seed": settings.seed}
    report = study.header(method, settings, views.part) | {
        "sensor": SENSOR,
        "positions": positions,
        "cameras": [
            run_camera(views, view, **given) for view in tqdm(chosen, "cameras", unit="camera")
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
