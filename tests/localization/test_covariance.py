"""Covariance and weakest directions against linear algebra; correlated scores against their law."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from example_result import example_result
from example_scans import ideal_scan, model, vane
from scipy.spatial.transform import Rotation

from vanejax.localization.covariance import PATCHES, inflation, moved_to, uncertainty
from vanejax.localization.pose_result import Refinement, magnitude_bound
from vanejax.localization.residuals import SurfaceMatching
from vanejax.localization.scan_patches import patch_labels
from vanejax.rigid import RigidTransform


def refinement(information: np.ndarray) -> Refinement:
    return dataclasses.replace(example_result().refinement, information=information)


@pytest.mark.parametrize("seed", range(2))
def test_uncertainty_reads_the_covariance(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6)) * np.repeat([1e-4, 1e-2], 3)[:, None]
    covariance = root @ root.T
    result = uncertainty(refinement(np.linalg.inv(covariance)), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(result.covariance, covariance, rtol=1e-6, atol=1e-14)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(result.rotation_sigma_deg, np.degrees(sigma[:3]), rtol=1e-6)
    np.testing.assert_allclose(result.translation_sigma_mm, sigma[3:], rtol=1e-6)
    axis = result.weakest_rotation_axis
    assert axis[np.argmax(np.abs(axis))] > 0  # one name for each axis, whatever its sign
    largest = np.degrees(np.sqrt(axis @ covariance[:3, :3] @ axis))
    assert result.weakest_rotation_sigma_deg == pytest.approx(largest)
    assert largest >= result.rotation_sigma_deg.max() - 1e-12
    axis = result.weakest_translation_axis
    largest = np.sqrt(axis @ covariance[3:, 3:] @ axis)
    assert result.weakest_translation_sigma_mm == pytest.approx(largest)
    assert axis[np.argmax(np.abs(axis))] > 0
    np.testing.assert_array_equal(result.center, [1, 2, 3])


def test_what_is_not_known_at_all_is_half_a_turn_not_infinite():
    information = np.diag([1e8, 1e8, 0.0, 1e4, 1e4, 0.0])
    result = uncertainty(refinement(information), np.zeros(3))
    assert np.isfinite(result.covariance).all()
    assert result.weakest_rotation_sigma_deg == pytest.approx(180)
    assert result.weakest_translation_sigma_mm == pytest.approx(100 * np.pi)
    np.testing.assert_allclose(result.weakest_rotation_axis, [0, 0, 1])
    np.testing.assert_allclose(result.weakest_translation_axis, [0, 0, 1])
    assert result.rotation_sigma_deg[0] == pytest.approx(np.degrees(1e-4))


@pytest.mark.parametrize("rays", [True, False])
def test_patches_are_small_and_of_one_place(rays):
    scan, _ = ideal_scan(vane())
    points = scan.points.astype(np.float64)
    mearesultd = model(vane()) if rays else SurfaceMatching(model(vane()).surface, 20.0)
    labels = [patch_labels(mearesultd, points, across) for across in PATCHES]

    for label, across in zip(labels, PATCHES, strict=True):
        assert label.shape == (len(points),)
        assert 20 < label.max() + 1 <= across ** (2 if rays else 3)
        place = points / -points[:, 2:] * 400 if rays else points
        side = np.ptp(place, axis=0).max() / across
        for one in range(0, label.max() + 1, 7):
            # a square on a plane that is tilted a little to that of the image
            assert np.ptp(place[label == one], axis=0).max() < 1.6 * side


def scores(correlated: float, seed: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Scores [n, 6] of 8 x 8 blocks, with a share of their variance common to a block."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(64), np.arange(64))
    coarse = ((x // 8) * 8 + y // 8).ravel()
    fine = ((x // 4) * 16 + y // 4).ravel()
    common = rng.normal(size=(64, 6))[coarse]
    own = rng.normal(size=(4096, 6))
    return np.sqrt(correlated) * common + np.sqrt(1 - correlated) * own, [fine, coarse]


@pytest.mark.parametrize("seed", range(20))
def test_independent_scores_do_not_inflate(seed):
    values, patches = scores(0.0, seed)
    assert inflation(values.T @ values, values - values.mean(axis=0), patches) == 1.0


@pytest.mark.parametrize("seed", range(5))
def test_common_scores_inflate_by_the_design_effect(seed):
    """Blocks of m alike points with correlation r: the variance of sums grows by 1 + (m - 1) r."""
    values, patches = scores(0.2, seed)
    found = inflation(values.T @ values, values - values.mean(axis=0), patches)
    # 64 blocks: a variance ratio is good to sqrt(2 / 64) = 18 %, a median of six to some 10 %
    assert found == pytest.approx(1 + 63 * 0.2, rel=0.4)


def test_few_patches_say_nothing():
    values, patches = scores(0.5, 0)
    few = [patch // 4 for patch in patches][1:] * 2
    assert few[0].max() < 19
    assert inflation(values.T @ values, values, few) == 1.0
    assert inflation(np.zeros((6, 6)), values, patches) == 1.0


@pytest.mark.parametrize("sigmas", [[1.0, 1, 1], [1, 0, 0], [1, 1, 0], [1, 0.7, 0.3], [3, 1, 1]])
def test_a_magnitude_is_within_its_bound_as_often_as_it_says(sigmas) -> None:
    turn = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    covariance = turn @ np.diag(np.square(sigmas)) @ turn.T
    errors = np.random.default_rng(1).normal(size=(200_000, 3)) * sigmas
    within = np.linalg.norm(errors, axis=1) <= magnitude_bound(covariance)
    assert np.mean(within) == pytest.approx(0.95, abs=0.004)
    stacked = magnitude_bound(np.stack([covariance, 4 * covariance, np.zeros((3, 3))]))
    np.testing.assert_allclose(stacked, stacked[0] * np.array([1, 2, 0]), rtol=1e-12)


def test_a_free_rotation_is_in_no_bound():
    """A turn about the free axis says nothing; what is known of the rest stays."""
    axis = (np.array([5.0, -3.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    center = np.array([1.0, 2.0, 3.0])
    moves = np.concatenate([axis[1], np.cross(axis[1], center - axis[0])])
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(50, 6)) * np.repeat([1e3, 10], 3)
    columns -= np.outer(columns @ moves, moves) / (moves @ moves)  # a turn changes no residual
    information = columns.T @ columns
    result = uncertainty(refinement(information), center, axis)
    assert np.isinf(result.rotation_sigma_deg[2])
    assert np.isfinite(result.rotation_sigma_deg[:2]).all()
    np.testing.assert_array_equal(result.free_axis, axis[1])
    assert abs(result.weakest_rotation_axis[2]) < 1e-9
    np.testing.assert_allclose(result.covariance[2], 0, atol=1e-15)
    # of any solution of the normal equations, that which does not turn about the axis
    without_turn = np.eye(6)
    without_turn[:, 2] -= moves / moves[2]
    expected = without_turn @ np.linalg.pinv(information, hermitian=True) @ without_turn.T
    np.testing.assert_allclose(result.covariance, expected, rtol=1e-6, atol=1e-14)
    assert result.rotation_bound_deg < 1
    assert uncertainty(refinement(information), center).rotation_bound_deg > 90


def test_an_equivalent_pose_has_the_information_of_its_own_frame():
    """An error before the motion is the same as one after it, in the turned frame."""
    rng = np.random.default_rng(1)
    center = np.array([4.0, -2.0, 7.0])
    turn = Rotation.from_euler("xyz", [20, 70, -130], degrees=True).as_matrix()
    motion = RigidTransform(turn, np.array([3.0, 8.0, -5.0]))
    columns = rng.normal(size=(30, 6))
    old = refinement(columns.T @ columns)
    new = moved_to(old, motion @ old.part_from_camera, center)
    for e in 1e-6 * rng.normal(size=(5, 6)):
        small = RigidTransform(
            Rotation.from_rotvec(e[:3]).as_matrix(),
            center + e[3:] - Rotation.from_rotvec(e[:3]).as_matrix() @ center,
        )
        after = motion @ small @ motion.inverse()
        turned = Rotation.from_matrix(after.rotation).as_rotvec()
        moved = np.concatenate([turned, after.apply(center[None])[0] - center])
        assert moved @ new.information @ moved == pytest.approx(e @ old.information @ e, rel=1e-4)
