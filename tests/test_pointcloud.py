"""Clouds of a fixed number of rows: neighbours, distances, thinning."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vanejax.pointcloud import PointCloud, ball_query, squared_distances
from vanejax.rigid import RigidTransform
from vanejax.scans.voxels import voxel_thin

query = jax.jit(ball_query, static_argnames=("radius", "num_neighbors"))


def neighbors_by_loop(xyz, mask, radius, num_neighbors) -> list[list[int]]:
    """The first other real points by index, then the point itself."""
    rows = []
    for i in range(len(xyz)):
        row = []
        for j in range(len(xyz)):
            if j != i and mask[j] and np.linalg.norm(xyz[j] - xyz[i]) <= radius:
                row.append(j)
        rows.append((row + [i] * num_neighbors)[:num_neighbors])
    return rows


@settings(max_examples=60, deadline=None)
@given(
    # a grid of eighths: distances are exact in f32, so that the rim of the ball is decided
    grid=arrays(np.int8, (12, 3), elements=st.integers(-8, 8)),
    mask=arrays(bool, 12),
    num_neighbors=st.sampled_from([3, 20]),
)
def test_ball_query_is_the_loop(grid, mask, num_neighbors):
    xyz = grid.astype(np.float32) / 8
    found = query(xyz, mask, radius=0.625, num_neighbors=num_neighbors)
    assert found.dtype == jnp.int32
    assert found.tolist() == neighbors_by_loop(xyz, mask, 0.625, num_neighbors)


def test_squared_distances_far_from_the_origin():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(20, 3)), rng.normal(size=(30, 3))
    # on a grid of 2^-10, so that the shift to 1,000 is itself exact in f32
    a, b = np.round(a * 1024) / 1024, np.round(b * 1024) / 1024
    expected = np.sum((a[:, None] - b[None]) ** 2, -1)
    found = jax.jit(squared_distances)(np.float32(a + 1000), np.float32(b + 1000))
    assert found.shape == (20, 30)
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # f32 eps x 5 operations


def test_a_cloud_moves_with_its_normals():
    xyz, normals = np.random.default_rng(0).normal(size=(2, 5, 3)).astype(np.float32)
    cloud = PointCloud.create(xyz, normals)
    assert cloud.mask.shape == (5,)
    assert cloud.mask.all()
    quarter = RigidTransform(
        np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32), np.array([1, 2, 3], np.float32)
    )
    moved = cloud.replace(mask=np.arange(5) < 3).transform(quarter)
    expected = xyz[:, [1, 0, 2]] * [-1, 1, 1] + [1, 2, 3]
    np.testing.assert_allclose(moved.xyz, expected, atol=1e-6)  # f32 eps x 5
    np.testing.assert_array_equal(moved.normals, normals[:, [1, 0, 2]] * [-1, 1, 1])
    assert moved.mask.tolist() == [True, True, True, False, False]


clouds = st.integers(1, 40).flatmap(
    lambda n: arrays(np.float64, (n, 3), elements=st.floats(-50, 50, allow_subnormal=False))
)


@settings(max_examples=150, deadline=None)
@given(points=clouds, voxel_mm=st.floats(0.5, 60), seed=st.integers(0, 99))
def test_thinning_keeps_one_point_of_each_occupied_voxel(points, voxel_mm, seed):
    kept = voxel_thin(points, voxel_mm=voxel_mm)
    assert kept.dtype == np.int64
    assert (np.diff(kept) > 0).all()  # ascending, none twice
    cells = [tuple(cell) for cell in np.floor(points / voxel_mm).astype(int)]
    assert sorted(cells[i] for i in kept) == sorted(set(cells))

    members = {cell: [p for p, c in zip(points, cells, strict=True) if c == cell] for cell in cells}
    for i in kept:
        distances = np.linalg.norm(members[cells[i]] - np.mean(members[cells[i]], axis=0), axis=1)
        chosen = np.linalg.norm(points[i] - np.mean(members[cells[i]], axis=0))
        assert chosen <= distances.min() + 1e-9  # f64 eps x 50 x 40 points; the nearest, or a tie

    order = np.random.default_rng(seed).permutation(len(points))
    permuted = voxel_thin(points[order], voxel_mm=voxel_mm)
    # ties between equally near points may fall the other way: the voxels may not
    assert {cells[i] for i in order[permuted]} == set(cells)


@pytest.mark.parametrize("shift", [0.0, 1e6, -1e6])
def test_thinning_of_nothing_and_far_away(shift):
    assert voxel_thin(np.zeros((0, 3)), voxel_mm=1.0).shape == (0,)
    line = np.arange(10.0)[:, None] * [1, 0, 0] + 0.25 + shift
    assert len(voxel_thin(line, voxel_mm=1.0)) == 10
    assert len(voxel_thin(line.astype(np.float32), voxel_mm=2.0)) == 5
