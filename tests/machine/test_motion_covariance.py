"""How well a point is known, against errors drawn at random and moved as rigid motions."""

from __future__ import annotations

import numpy as np
import pytest
from example_result import pose
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.localization.pose_result import magnitude_bound
from vanejax.machine import motion_covariance
from vanejax.machine.motion_covariance import MotionCovariance
from vanejax.rigid import RigidTransform

CENTER = np.array([5.0, -3.0, 25.0])
FACTOR = np.random.default_rng(0).normal(size=(6, 6)) * np.repeat([2e-4, 0.02], 3)[:, None]
POSE = MotionCovariance(FACTOR @ FACTOR.T, CENTER)


def small(e: np.ndarray, center: np.ndarray) -> RigidTransform:
    """``x -> c + exp(w) (x - c) + v``."""
    rotation = Rotation.from_rotvec(e[:3]).as_matrix()
    return RigidTransform(rotation, center - rotation @ center + e[3:])


def test_points_move_as_their_bounds_say() -> None:
    """True poses drawn around the reported ones: of the camera in the machine, and of the part."""
    machine_from_camera = pose((170.0, 5.0, 80.0), (900.0, -150.0, 800.0))
    part_from_camera = pose((10.0, -20.0, 30.0), (1.5, -2.25, 400.0))
    machine_from_part = machine_from_camera @ part_from_camera.inverse()
    camera = MotionCovariance.alike(machine_from_camera.translation, sigma_mm=0.03, sigma_deg=0.01)
    found = POSE.moved(machine_from_part).with_independent(camera)
    points = CENTER + np.array([[0.0, 0, 0], [60, 0, 0], [0, -40, 90]])
    rng = np.random.default_rng(1)
    moved = []
    for _ in range(4000):
        of_pose = small(rng.multivariate_normal(np.zeros(6), POSE.covariance), CENTER)
        of_camera = small(rng.multivariate_normal(np.zeros(6), camera.covariance), camera.center)
        true = of_camera @ machine_from_camera @ (of_pose @ part_from_camera).inverse()
        moved.append(true.apply(points) - machine_from_part.apply(points))
    for at, shifts in zip(
        found.bounds_mm(machine_from_part.apply(points)), np.stack(moved, axis=1), strict=True
    ):
        assert np.mean(np.linalg.norm(shifts, axis=1) > at) == pytest.approx(0.05, abs=0.015)


def test_an_angle_counts_by_its_lever_arm() -> None:
    camera = MotionCovariance.alike(np.zeros(3), sigma_mm=0.02, sigma_deg=0.01)
    bounds = camera.bounds_mm(np.array([[0.0, 0, 0], [0, 0, 400.0], [300.0, 0, 400.0]]))
    arms = np.radians(0.01) * np.array([0.0, 400.0, 500.0])
    # along the arm no angle counts
    sigma = np.stack([np.full(3, 0.02), *[np.hypot(0.02, arms)] * 2], axis=1)
    expected = magnitude_bound(sigma[:, :, None] ** 2 * np.eye(3))
    np.testing.assert_allclose(bounds, expected, rtol=1e-12)


def test_the_frame_changes_nothing() -> None:
    points = np.random.default_rng(2).normal(0, 50, (20, 3))
    motion = pose((40.0, -10.0, 100.0), (300.0, 20.0, -50.0))
    np.testing.assert_allclose(
        POSE.moved(motion).bounds_mm(motion.apply(points)), POSE.bounds_mm(points), rtol=1e-9
    )


def test_of_independent_errors_the_centre_of_the_first_is_kept() -> None:
    other = MotionCovariance.alike(np.array([0.0, 400.0, 0.0]), sigma_mm=0.01, sigma_deg=0.02)
    points = np.random.default_rng(3).normal(0, 50, (5, 3))
    one, two = POSE.with_independent(other), other.with_independent(POSE)
    np.testing.assert_array_equal(one.center, CENTER)
    np.testing.assert_allclose(one.bounds_mm(points), two.bounds_mm(points), rtol=1e-9)


def test_many_points_are_taken_in_blocks(monkeypatch) -> None:
    points = np.random.default_rng(4).normal(0, 50, (10, 3))
    expected = POSE.bounds_mm(points)
    monkeypatch.setattr(motion_covariance, "BLOCK", 3)
    np.testing.assert_array_equal(POSE.bounds_mm(points), expected)


def test_what_is_beyond_any_machine_is_refused() -> None:
    far = np.array([0.0, 1e300, 0.0])
    with pytest.raises(InputError, match=r"more than 1e[+]07 mm away: check the unit"):
        POSE.bounds_mm(far[None])
    with pytest.raises(InputError, match="mm away"):
        POSE.moved(RigidTransform(np.eye(3), far))
