"""FPFH: a slow float64 twin, Open3D's numbers, and what must not matter."""

from __future__ import annotations

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_clouds import scattered
from scipy.spatial.transform import Rotation

from vanejax.matching.baselines.fpfh import fpfh
from vanejax.pointcloud import PointCloud

PARITY = Path(__file__).parents[4] / "shared" / "parity" / "open3d.npz"
N, RADIUS = 75, 0.45  # three blocks of rows, the last one not full

histograms = jax.jit(functools.partial(fpfh, radius=RADIUS))


@functools.cache
def points(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy sphere [N, 3] and unit vectors near its normals; f64."""
    rng = np.random.default_rng(seed)
    outward = rng.normal(size=(N, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    normals = outward + 0.3 * rng.normal(size=(N, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return outward * (0.6 + 0.1 * np.sin(5 * outward[:, :1])), normals


def cloud(xyz: np.ndarray, normals: np.ndarray) -> PointCloud:
    return PointCloud(xyz, normals, np.ones(len(xyz), bool))


def slow_angles(point, normal, other, other_normal) -> tuple[float, float, float]:
    """Open3D's ComputePairFeatures: theta in radians, two cosines."""
    offset = other - point
    if not offset.any():
        return 0.0, 0.0, 0.0
    length = np.linalg.norm(offset)
    first, second = normal @ offset / length, other_normal @ offset / length
    if abs(first) < abs(second):
        normal, other_normal, offset, first = other_normal, normal, -offset, -second
    v = np.cross(offset, normal)
    v /= np.linalg.norm(v)
    w = np.cross(normal, v)
    return np.arctan2(w @ other_normal, normal @ other_normal), v @ other_normal, first


def slow_fpfh(xyz: np.ndarray, normals: np.ndarray, radius: float) -> np.ndarray:
    count = len(xyz)
    distance = np.linalg.norm(xyz[:, None] - xyz[None], axis=-1)
    near = (distance <= radius) & ~np.eye(count, dtype=bool)
    own = np.zeros((count, 3, 11))
    for i, j in np.argwhere(near):
        theta, alpha, phi = slow_angles(xyz[i], normals[i], xyz[j], normals[j])
        shares = (theta / np.pi + 1) / 2, (alpha + 1) / 2, (phi + 1) / 2
        for angle, share in enumerate(shares):
            own[i, angle, min(int(11 * share), 10)] += 100 / near[i].sum()
    result = own.copy()
    for i in range(count):
        around = sum(own[j] / distance[i, j] ** 2 for j in np.flatnonzero(near[i] * distance[i]))
        if np.any(around):
            result[i] += 100 * around / around.sum(axis=1, keepdims=True)
    return result.reshape(count, 33)


def test_it_is_the_slow_twin_whatever_the_padding():
    """In f64: in f32 one of 3000 angles may lie within rounding of a bin's edge."""
    xyz, normals = points()
    xyz = np.concatenate([xyz[:-1], xyz[:1]])  # a coincident pair with two normals
    padded_xyz, mask = scattered(xyz, N + 40, xyz[3])
    with jax.enable_x64(True):
        padded = PointCloud(padded_xyz, scattered(normals, N + 40, 7.0)[0], mask)
        found = np.asarray(histograms(padded))
    expected = slow_fpfh(xyz, normals, RADIUS)
    np.testing.assert_allclose(found[mask], expected, atol=1e-9)  # f64 eps x 200 percent x sums
    np.testing.assert_array_equal(found[~mask], 0)
    filled = np.count_nonzero(expected.sum(axis=0))
    assert filled >= 30, "a problem that reaches nearly every bin"


def test_many_neighbours_count():
    """More than a tile of 63 columns, all in one bin of each angle."""
    rng = np.random.default_rng(0)
    xyz = np.concatenate([rng.uniform(size=(200, 2)), np.zeros((200, 1))], 1).astype(np.float32)
    up = np.tile(np.float32([0, 0, 1]), (200, 1))
    found = jax.jit(functools.partial(fpfh, radius=2.0))(cloud(xyz, up))
    middle = np.isin(np.arange(33), (5, 16, 27))
    expected = np.broadcast_to(np.where(middle, 200.0, 0.0), (200, 33))
    np.testing.assert_allclose(found, expected, rtol=1e-5)  # f32 eps x sums of 200


def test_opposite_faces_of_a_plate_fall_into_the_last_bin_however_it_lies():
    """Half a turn is the edge between the first bin and the last: rounding must not choose."""
    rng = np.random.default_rng(1)
    side = np.where(rng.uniform(size=(N, 1)) < 0.5, -1.0, 1.0)
    xyz = np.concatenate([rng.uniform(size=(N, 2)), 0.1 * side], 1)
    normals = side * [[0.0, 0.0, 1.0]]
    for turn in Rotation.random(10, rng=rng):
        plate = cloud(turn.apply(xyz).astype(np.float32), turn.apply(normals).astype(np.float32))
        found = np.asarray(histograms(plate))
        np.testing.assert_array_equal(found[:, :5], 0)
        assert found[:, 10].min() > 0


def test_sums_and_clouds_without_neighbours():
    xyz, normals = (values.astype(np.float32) for values in points())
    batch = [
        cloud(xyz, normals),
        cloud(1e4 * xyz, normals),  # every point alone
        cloud(0 * xyz, normals),  # all coincident
        cloud(xyz, normals).replace(mask=np.zeros(N, bool)),
    ]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *batch)
    found = jax.jit(jax.vmap(functools.partial(fpfh, radius=RADIUS)))(stacked)
    sums = np.sum(np.reshape(found, (4, N, 3, 11)), axis=-1)
    for case, expected in enumerate((200, 0, 100, 0)):
        np.testing.assert_allclose(sums[case], expected, rtol=1e-5)  # f32 eps x sums


@pytest.mark.skipif(not PARITY.exists(), reason="needs ../shared/parity/open3d.npz")
def test_parity_with_open3d():
    """All 600 rows, once the two bins on either side of half a turn are one.

    The part has flat parallel faces, whose pairs Open3D's rounding scatters over those two.
    """
    with np.load(PARITY) as file:
        known = {name: file[name] for name in file.files if name.startswith("fpfh")}
    points = cloud(*(jnp.float32(known[f"fpfh_{name}"]) for name in ("points", "normals")))
    found = np.array(jax.jit(functools.partial(fpfh, radius=float(known["fpfh_radius"])))(points))
    for values in (found, known["fpfh"]):
        values[:, 0] += values[:, 10]
        values[:, 10] = 0
    np.testing.assert_allclose(found, known["fpfh"], atol=1e-4)  # f32 eps x 200 percent x sums
