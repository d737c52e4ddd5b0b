"""Cubes of points against brute force, and folds of two planes."""

from __future__ import annotations

import numpy as np
import pytest

from vanejax.scans.voxels import Voxels


def sheet(count: int, *, fold_deg: float, seed: int = 0) -> np.ndarray:
    """Points on two half planes that meet along y, bent by an angle towards +z at x > 0."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-30, 30, (2, count))
    angle = np.radians(fold_deg)
    right = np.stack([x * np.cos(angle), y, x * np.sin(angle)], axis=1)
    return np.where(x[:, None] > 0, right, np.stack([x, y, np.zeros(count)], axis=1))


def test_every_point_lies_in_its_voxel():
    points = np.random.default_rng(0).uniform(-20, 30, (2_000, 3))
    voxels = Voxels(points, 2.5)
    np.testing.assert_array_equal(voxels.cell[voxels.of_point], np.floor(points / 2.5))
    assert len(np.unique(voxels.cell, axis=0)) == len(voxels)
    for k in (0, len(voxels) - 1):
        expected = points[voxels.of_point == k].mean(axis=0)
        np.testing.assert_allclose(voxels.middle[k], expected, atol=1e-12)


def test_neighbors_and_clusters_are_those_of_all_pairs():
    points = np.random.default_rng(1).uniform(0, 20, (300, 3))
    voxels = Voxels(points, 2.0)
    far = np.abs(voxels.cell[:, None] - voxels.cell).max(axis=-1)
    touch = far <= 1
    found = np.zeros_like(touch)
    found[tuple(voxels.neighbors)] = True
    assert found.sum() == voxels.neighbors.shape[1]  # each once
    np.testing.assert_array_equal(found | found.T | np.eye(len(voxels), dtype=bool), touch)
    for _ in range(9):  # 2^9 steps: everything that can be reached
        touch = touch @ touch
    cluster = voxels.clusters()
    np.testing.assert_array_equal(cluster[:, None] == cluster, touch)
    assert 1 < cluster.max() + 1 < len(voxels)


@pytest.mark.parametrize("fold_deg", [60.0, 90.0])
def test_a_fold_towards_the_sensor_parts_a_sheet(fold_deg):
    points = sheet(40_000, fold_deg=fold_deg)
    voxels = Voxels(points, 1.0)
    piece = voxels.pieces(np.array([-100.0, 0.0, 300.0]), least=50)[voxels.of_point]
    flat = points[:, 0] < 0
    assert np.bincount(piece[flat]).max() > 0.98 * flat.sum()  # but for the fold
    assert np.bincount(piece[~flat]).max() > 0.98 * (~flat).sum()
    assert np.argmax(np.bincount(piece[flat])) != np.argmax(np.bincount(piece[~flat]))


@pytest.mark.parametrize("fold_deg", [-90.0, -45.0, 0.0, 3.0])
def test_a_fold_away_from_the_sensor_or_none_does_not(fold_deg):
    points = sheet(40_000, fold_deg=fold_deg)
    voxels = Voxels(points, 1.0)
    piece = voxels.pieces(np.array([100.0, 0.0, 200.0]), least=50)
    assert (piece == 0).all()


def test_pieces_too_small_are_one():
    voxels = Voxels(sheet(40_000, fold_deg=90.0), 1.0)
    assert (voxels.pieces(np.array([-100.0, 0.0, 300.0]), least=10**6) == 0).all()


def test_a_single_point():
    voxels = Voxels(np.array([[1e5, -3.0, 7.0]]), 1.0)
    assert voxels.neighbors.shape == (2, 0)
    np.testing.assert_array_equal(voxels.clusters(), [0])
    np.testing.assert_array_equal(voxels.pieces(np.zeros(3), least=1), [0])
