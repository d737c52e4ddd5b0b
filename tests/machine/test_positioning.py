"""Motions between registrations: laws, the equations of the paper, errors against Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.machine.positioning import (
    angle_sigma_deg,
    camera_motion,
    common_axis,
    displacement,
    displacement_covariance,
    in_machine,
    motion_errors,
    probe_translation,
    recentred,
    twist_about,
    wrapped_deg,
)
from vanejax.rigid import RigidTransform

CENTER = np.array([5.0, -3.0, 20.0])


def pose(rng: np.random.Generator, reach: float = 300.0) -> RigidTransform:
    return RigidTransform(Rotation.random(rng=rng).as_matrix(), reach * rng.standard_normal(3))


def small(e: np.ndarray, center: np.ndarray) -> RigidTransform:
    """The small motion ``x -> c + exp(w) (x - c) + v``."""
    rotation = Rotation.from_rotvec(e[:3]).as_matrix()
    return RigidTransform(rotation, center - rotation @ center + e[3:])


def error_of(found: RigidTransform, truth: RigidTransform, center: np.ndarray) -> np.ndarray:
    left = truth @ found.inverse()
    shift = left.rotation @ center + left.translation - center
    return np.concatenate([Rotation.from_matrix(left.rotation).as_rotvec(), shift])


def test_the_motion_is_what_the_camera_sees_the_part_do():
    rng = np.random.default_rng(0)
    part_from_camera, moved = pose(rng), pose(rng)
    on_part = rng.standard_normal((7, 3)) * 50
    seen_before, seen_after = (p.inverse().apply(on_part) for p in (part_from_camera, moved))
    motion = camera_motion(part_from_camera, moved)
    np.testing.assert_allclose(motion.apply(seen_before), seen_after, atol=1e-9)
    # the paper's T2 T1^-1, T from the model to the scan; the other order is another motion
    model_to_scan = [p.inverse() for p in (part_from_camera, moved)]
    printed = model_to_scan[1] @ model_to_scan[0].inverse()
    np.testing.assert_allclose(printed.as_matrix(), motion.as_matrix(), atol=1e-9)
    other = (moved @ part_from_camera.inverse()).as_matrix()
    assert np.abs(other - motion.as_matrix()).max() > 0.1


def test_a_stage_that_turns_by_an_angle_is_seen_to_turn_by_it():
    """About its own axis, with its sign, wherever the camera stands."""
    rng = np.random.default_rng(1)
    turn = Rotation.from_rotvec([0, 0, 30], degrees=True).as_matrix()
    place = np.array([10.0, 20.0, 0.0])
    stage = RigidTransform(turn, place - turn @ place)
    camera_from_stage, stage_from_part = pose(rng), pose(rng)
    start = (camera_from_stage @ stage_from_part).inverse()
    end = (camera_from_stage @ stage @ stage_from_part).inverse()
    seen = camera_motion(start, end)
    assert twist_about(seen.rotation, camera_from_stage.rotation[:, 2]).angle_deg == pytest.approx(
        30.0, abs=1e-9
    )
    back = in_machine(seen, camera_from_stage.inverse())
    np.testing.assert_allclose(back.as_matrix(), stage.as_matrix(), atol=1e-9)


@settings(deadline=None, max_examples=60)
@given(
    turn=st.floats(-179.9, 180.0),
    swing=st.floats(0.0, 170.0),
    direction=st.floats(0.0, 360.0),
    seed=st.integers(0, 100),
)
def test_a_turn_then_a_swing_are_told_apart(turn, swing, direction, seed):
    frame = Rotation.random(rng=np.random.default_rng(seed))
    axis, across = frame.apply([[0, 0, 1], [np.cos(direction), np.sin(direction), 0]])
    twist = Rotation.from_rotvec(np.radians(turn) * axis)
    rotation = (Rotation.from_rotvec(np.radians(swing) * across) * twist).as_matrix()
    found = twist_about(rotation, 3 * axis)
    assert wrapped_deg(found.angle_deg - turn) == pytest.approx(0, abs=1e-6)
    assert found.swing_deg == pytest.approx(swing, abs=1e-6)
    # nearest: no neighbour on the axis leaves less
    for beside in (-0.5, 0.5):
        other = Rotation.from_rotvec(np.radians(turn + beside) * axis)
        left = (Rotation.from_matrix(rotation) * other.inv()).magnitude()
        assert np.degrees(left) > found.swing_deg - 1e-9


def test_angles_wrap_and_a_tiny_swing_keeps_its_digits():
    rotation = Rotation.from_rotvec([1e-9, 0, 0], degrees=True).as_matrix()
    assert twist_about(rotation, np.array([0, 0, 1])).swing_deg == pytest.approx(1e-9, rel=1e-5)
    np.testing.assert_allclose(
        wrapped_deg(np.array([180, -180, 181, 359, -190])), [180, 180, -179, -1, 170]
    )


def test_no_angle_where_there_is_none():
    flip = np.diag([1.0, -1.0, -1.0])
    with pytest.raises(InputError, match="turns the axis round"):
        twist_about(flip, np.array([0, 0, 1]))
    with pytest.raises(InputError, match="direction"):
        twist_about(np.eye(3), np.zeros(3))


def test_the_stage_axis_is_found_from_its_turns():
    rng = np.random.default_rng(3)
    axis = np.array([0.6, 0.0, 0.8])
    turns = np.radians(np.arange(30, 331, 30))[:, None] * axis
    noisy = Rotation.from_rotvec(1e-4 * rng.standard_normal((11, 3))) * Rotation.from_rotvec(turns)
    found = common_axis(noisy.as_matrix())
    assert np.degrees(np.arccos(abs(found @ axis))) < 0.01
    few = Rotation.from_rotvec(turns[:3]).as_matrix()
    np.testing.assert_allclose(common_axis(few), axis, atol=1e-12)
    np.testing.assert_allclose(common_axis(few.swapaxes(1, 2)), -axis, atol=1e-12)
    for nothing in (np.eye(3)[None], np.zeros((0, 3, 3))):
        with pytest.raises(InputError, match="axis"):
            common_axis(nothing)


def test_the_probe_gives_the_way_there():
    before = np.array([[0.0, 0, 0], [100, 0, 0], [0, 80, 0]])
    np.testing.assert_allclose(
        probe_translation(before, before + np.array([10, -2, 3])), [10, -2, 3]
    )
    for bad, words in ((before[:2], "same before and after"), (before * np.nan, "finite")):
        with pytest.raises(InputError, match=words):
            probe_translation(before, bad)


def test_a_small_motion_is_the_same_about_any_centre():
    rng = np.random.default_rng(5)
    e = 1e-7 * rng.standard_normal(6)
    old, new = 100 * rng.standard_normal((2, 3))
    there = recentred(old, new) @ e
    # second order: |e|^2 times the way
    np.testing.assert_allclose(small(e, old).as_matrix(), small(there, new).as_matrix(), atol=1e-11)


@pytest.mark.parametrize("seed", range(4))
def test_jacobians_are_those_of_small_errors(seed):
    """Forward differences of the true motion by each of the 18 errors."""
    rng = np.random.default_rng(seed)
    before, after, machine = pose(rng), pose(rng), pose(rng, 1000.0)
    place = 500 * rng.standard_normal(3)
    errors = motion_errors(
        before, after, CENTER, machine_from_camera=machine, calibration_center=place
    )
    found = in_machine(camera_motion(before, after), machine)
    arrived = in_machine(camera_motion(before, after), machine).apply(
        (machine @ before.inverse()).apply(CENTER[None])
    )
    np.testing.assert_allclose(errors.center, arrived[0], atol=1e-8)
    step = 1e-6
    for k, way in enumerate((errors.of_before, errors.of_after, errors.of_calibration)):
        columns = []
        for i in range(6):
            e = [np.zeros(6), np.zeros(6), np.zeros(6)]
            e[k][i] = step
            truth = in_machine(
                camera_motion(small(e[0], CENTER) @ before, small(e[1], CENTER) @ after),
                small(e[2], place) @ machine,
            )
            columns.append(error_of(found, truth, errors.center) / step)
        # second order: the step times 1000 mm of lever
        np.testing.assert_allclose(np.stack(columns, axis=1), way, atol=5e-3)


@pytest.mark.parametrize("seed", range(4))
def test_sigmas_of_the_figures_follow_the_motions_error(seed):
    """By the differences of angle and displacement under each small error of the motion.

    Also of rotations far off the axis, whose swing turns the gradient of the angle.
    """
    rng = np.random.default_rng(seed)
    motion, axis, step = pose(rng), np.array([0.0, 0.6, 0.8]), 1e-6
    root = rng.standard_normal((6, 6))
    # what the machine's origin does counts the lever: the printed translation of eq. 13
    for spot in (CENTER, np.zeros(3)):
        angles, shifts = [], []
        for e in step * np.eye(6):
            ends = [small(side * e, CENTER) @ motion for side in (-1, 1)]
            twists = [twist_about(end.rotation, axis).angle_deg for end in ends]
            angles.append(wrapped_deg(twists[1] - twists[0]) / (2 * step))
            shifts.append((displacement(ends[1], spot) - displacement(ends[0], spot)) / (2 * step))
        sigma = np.linalg.norm(np.array(angles) @ root)
        assert angle_sigma_deg(root @ root.T, motion.rotation, axis) == pytest.approx(sigma, 1e-6)
        arrived = spot + displacement(motion, spot)
        found = displacement_covariance(root @ root.T, CENTER, arrived)
        by_differences = np.array(shifts).T @ root
        np.testing.assert_allclose(found, by_differences @ by_differences.T, rtol=1e-5, atol=1e-3)


def test_what_both_registrations_share_cancels():
    rng = np.random.default_rng(8)
    before, after = pose(rng), pose(rng)
    errors = motion_errors(before, after, CENTER)
    cause = rng.standard_normal((6, 4))
    np.testing.assert_allclose(errors.common(cause, cause), 0, atol=1e-12)
    single = errors.common(cause, 0 * cause)
    np.testing.assert_allclose(
        single @ single.T, errors.covariance(cause @ cause.T, np.zeros((6, 6)))
    )
    with_frame = errors.common(cause, cause, cause)
    np.testing.assert_allclose(with_frame, errors.of_calibration @ cause, atol=1e-9)
    nothing = np.zeros((6, 6))
    np.testing.assert_allclose(
        with_frame @ with_frame.T, errors.covariance(nothing, nothing, cause @ cause.T)
    )
