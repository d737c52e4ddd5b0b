"""What a matching window rounds off is taken out, and the pose is nearer for it."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from experiments.runner.vane_views import magnitudes, pose_error
from experiments.studies.verdicts.challenge_parts import challenge_parts
from experiments.studies.verdicts.depth_camera import random_pose
from vanejax.cad.part import Part
from vanejax.cli.program import main
from vanejax.errors import InputError
from vanejax.localization import RayCasting, measurement_model, refine, register
from vanejax.localization.edge_rounding import ROUNDS, refine_sharpened, without_rounding
from vanejax.localization.pose_result import Refinement
from vanejax.rigid import RigidTransform
from vanejax.scanner import Measurement, Sensor, measure, preset
from vanejax.scans import MeasuredScan, save_points

FULL = preset("consumer_depth")
WINDOW = Sensor(
    camera=FULL.camera, baseline_mm=FULL.baseline_mm, window_px=FULL.window_px, jump_mm=FULL.jump_mm
)


@functools.cache
def part() -> Part:
    return challenge_parts(["l_bracket"])["l_bracket"].part


@functools.cache
def model() -> RayCasting:
    return measurement_model(part(), np.zeros(3))


@functools.cache
def scan(number: int) -> Measurement:
    """By the window alone: no noise, no holes."""
    rng = np.random.default_rng(number)
    return measure(model().scanner, WINDOW, random_pose(rng, part(), 250.0), rng)


def points(number: int) -> np.ndarray:
    return scan(number).points.astype(np.float64)


def errors(found: Refinement, number: int) -> tuple[float, float]:
    truth = scan(number).camera_from_part.inverse()
    return magnitudes(pose_error(found.part_from_camera, truth, part().center))


def test_at_the_true_pose_the_ideal_scan_comes_back() -> None:
    ideal = scan(0).ideal.points[scan(0).kept].astype(np.float64)
    assert np.abs(points(0) - ideal).max() > 0.5  # there is something to take out
    truth = scan(0).camera_from_part.inverse()
    sharp = without_rounding(model().scanner, FULL, points(0), truth)
    np.testing.assert_allclose(sharp, ideal, atol=1e-4)  # f32 of 300 mm


def test_points_beside_the_image_stay() -> None:
    beside = np.array([[900.0, 0.0, -300.0], [0.0, 0.0, 300.0], [0.0, -2000.0, -300.0]])
    truth = scan(0).camera_from_part.inverse()
    np.testing.assert_array_equal(without_rounding(model().scanner, FULL, beside, truth), beside)


def test_the_pose_is_nearer_for_it() -> None:
    number = 0
    cloud = MeasuredScan(points(number), None, np.zeros(3))
    before = refine(model(), cloud.points, scan(number).camera_from_part.inverse())
    after, sharp = refine_sharpened(model(), cloud, before, FULL)
    assert sharp.shape == cloud.points.shape
    angles, shifts = zip(errors(before, number), errors(after, number), strict=True)
    assert angles[1] < 0.3 * angles[0]
    assert shifts[1] < 0.6 * shifts[0]
    assert after.iterations >= before.iterations + ROUNDS


def test_a_camera_that_looks_along_plus_z_gives_the_same() -> None:
    """The frame of most depth cameras: x right, y down, z forward."""
    flip = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    cloud = MeasuredScan(points(0), None, np.zeros(3))
    other = MeasuredScan(flip.apply(points(0)), None, np.zeros(3))
    start = scan(0).camera_from_part.inverse()
    found = [
        refine_sharpened(model(), one, refine(model(), one.points, init), FULL)[0].part_from_camera
        for one, init in ((cloud, start), (other, start @ flip))
    ]
    back = (found[1] @ flip).as_matrix()
    np.testing.assert_allclose(back, found[0].as_matrix(), atol=2e-3)  # other subsets and sums


def test_register_takes_it_out_when_it_is_told_the_sensor() -> None:
    truth = scan(1).camera_from_part.inverse()
    off = [
        errors(register(points(1), part(), init=truth, sensor=sensor).refinement, 1)
        for sensor in (None, "consumer_depth")
    ]
    assert off[1][0] < 0.3 * off[0][0]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"sensor": "paper_camera"}, "codes single pixels"),
        ({"sensor": "hawk"}, "no sensor 'hawk'"),
        ({"sensor": "consumer_depth", "sensor_origin": "unknown"}, "in the camera's frame"),
        ({"sensor": "consumer_depth", "sensor_origin": np.array([0, 0, 9.0])}, "camera's frame"),
    ],
)
def test_what_cannot_be_is_refused(options: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        register(points(0), part(), **options)


def test_the_command_takes_the_name(tmp_path, capsys) -> None:
    save_points(tmp_path / "scan.ply", points(0))
    part().export(tmp_path / "part.stl")
    files = ["register", str(tmp_path / "scan.ply"), str(tmp_path / "part.stl")]
    assert main([*files, "--sensor", "paper_camera"]) == 2
    assert "codes single pixels" in capsys.readouterr().err
