"""The simulated sensors against their own settings."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.studies.verdicts import depth_camera
from experiments.studies.verdicts.challenge_parts import challenge_parts
from experiments.studies.verdicts.depth_camera import KINDS, measure, random_pose, sensor
from vanejax.rigid import RigidTransform
from vanejax.scanner import Scanner
from vanejax.scans.robust_statistics import robust_sigma


@pytest.fixture(scope="module")
def box():
    return challenge_parts(["box"])["box"].part


@pytest.fixture(scope="module")
def scanner(box):
    return Scanner(box)


@pytest.fixture(scope="module")
def frontal(box):
    """The box's largest face, 80 x 60 mm, squarely at 230 mm depth."""
    return RigidTransform(np.eye(3), np.array([0.0, 0.0, -250.0]) - box.center)


def distances_mm(box, pose: RigidTransform, points: np.ndarray) -> np.ndarray:
    """Exact distances [N] to the box."""
    aside = np.abs(pose.inverse().apply(points) - box.center) - np.array([40.0, 30, 20])
    return np.linalg.norm(np.maximum(aside, 0), axis=1) + np.minimum(aside.max(axis=1), 0)


def test_structured_light_is_the_paper_s_camera_with_fewer_pixels(box, scanner, frontal):
    points = measure(box, scanner, frontal, kind="structured_light", seed=1)
    assert points.dtype == np.float64
    assert len(points) > 20_000
    used = sensor("structured_light")
    assert (used.camera.width, used.camera.height) == (640, 512)
    error = points[:, 2] + 230
    # the noise of triangulation, white and correlated, and a bias no larger than some of it
    sigma = np.hypot(1, 0.02 / 0.05) * used.range_sigma_mm(230.0)
    spread = robust_sigma(error - np.median(error))  # outliers apart
    assert 0.8 * sigma < spread < 3 * sigma
    assert abs(np.mean(error)) < 0.05


@pytest.mark.parametrize("seed", range(2))
def test_the_depth_camera_is_like_the_real_one(box, scanner, seed):
    pose = random_pose(np.random.default_rng(seed), box, 250.0)
    points = measure(box, scanner, pose, kind="depth_camera", seed=seed)
    assert 2000 <= len(points) <= 8000
    np.testing.assert_allclose(points[:, 2], np.round(points[:, 2]), atol=1e-4)  # f32
    distance = distances_mm(box, pose, points)
    inliers = np.abs(distance) < 4
    # bias of 0.5 to 1.5 mm and steps of 1 mm, seen at a slant
    assert 0.3 < np.sqrt(np.mean(distance[inliers] ** 2)) < 2.2
    assert 0 < np.mean(distance > 2) < 0.15
    # the error is no white noise: neighbours' errors agree, their mean over a tenth does not vanish
    thirds = [np.abs(np.mean(d)) for d in np.array_split(distance[inliers], 10)]
    assert max(thirds) > 0.2


@pytest.mark.parametrize("seed", range(2))
def test_clutter_is_a_tenth_to_a_fifth_and_not_of_the_part(box, scanner, seed):
    pose = random_pose(np.random.default_rng([seed, 5]), box, 300.0)
    points = measure(box, scanner, pose, kind="clutter", seed=seed)
    clutter = np.abs(distances_mm(box, pose, points)) > 0.4  # 8 times the noise
    # a table's strip along the edge on which the part lies is nearer than that
    assert 0.07 < np.mean(clutter) < 0.21
    assert np.linalg.norm(points - pose.apply(box.center[None]), axis=1).max() < 4 * box.radius


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_gives_the_same_points_and_another_does_not(box, scanner, frontal, kind):
    once, again = (measure(box, scanner, frontal, kind=kind, seed=3) for _ in range(2))
    other = measure(box, scanner, frontal, kind=kind, seed=4)
    np.testing.assert_array_equal(once, again)
    assert other.shape != once.shape or np.any(other != once)


def test_random_poses_are_uniform_and_at_their_distance(box):
    rng = np.random.default_rng(0)
    poses = [random_pose(rng, box, 300.0) for _ in range(2000)]
    rotations = np.stack([p.rotation for p in poses])
    # under the uniform law every entry has mean 0 and variance 1 / 3; 5 sigma
    assert np.abs(rotations.mean(axis=0)).max() < 5 * np.sqrt(1 / 3 / 2000)
    assert np.abs((rotations**2).mean(axis=0) - 1 / 3).max() < 5 * np.sqrt(4 / 45 / 2000)
    centers = np.stack([p.apply(box.center[None])[0] for p in poses])
    np.testing.assert_allclose(centers[:, 2], -300)
    assert np.abs(centers[:, :2]).max() <= 9


def test_a_crop_takes_its_share_from_one_side():
    depth = np.full((50, 50), 200.0)
    depth_camera._crop(depth, 0.1, np.random.default_rng(0))
    lost = np.argwhere(np.isnan(depth))
    assert len(lost) == 250
    assert np.linalg.norm(lost.mean(axis=0) - 24.5) > 15
