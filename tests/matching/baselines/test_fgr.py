"""FGR: what it finds, the laws of its answer, degenerate clouds."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vanejax.matching.baselines.fgr import fgr
from vanejax.matching.se3 import rotation_angle
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

N = 260
SETTINGS = {"feature_radius": 0.35, "max_distance": 0.05, "num_trials": 20_000}
REGISTER = jax.jit(fgr(**SETTINGS))
KEY = jax.random.key(0)


@jax.jit
def lumps(directions: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Points and outward normals of a body without symmetry in these directions, [K, 3] each."""

    def level(point: jax.Array) -> jax.Array:
        x, y, z = point / jnp.linalg.norm(point)
        bumps = 0.2 * jnp.sin(4 * x + 1) + 0.15 * jnp.cos(5 * y) * z + 0.1 * jnp.sin(6 * z + 2 * y)
        return jnp.linalg.norm(point) - 0.6 - bumps

    xyz = (1.0 - jax.vmap(level)(directions))[:, None] * directions
    normals = jax.vmap(jax.grad(level))(xyz)
    return xyz, normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)


def motion(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng).as_matrix().astype(np.float32)
    return RigidTransform(rotation, rng.normal(size=3).astype(np.float32))


@functools.cache
def problem() -> tuple[PointCloud, PointCloud, RigidTransform]:
    """The same points twice, noisy, moved and mixed, a fifth of them elsewhere in the target."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(N + N // 5, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    body = PointCloud.create(*lumps(directions))
    body = jax.tree.map(np.asarray, body)
    target = jax.tree.map(lambda leaf: leaf[:N], body)
    noise = rng.normal(size=(N, 3), scale=0.003).astype(np.float32)
    rows = rng.permutation(np.arange(N // 5, N + N // 5))
    source = jax.tree.map(lambda leaf: leaf[rows], body)
    source = source.replace(xyz=source.xyz + noise).transform(motion(2))
    return jax.tree.map(np.asarray, source), target, motion(2).inverse()


@functools.cache
def answer():
    source, target, _ = problem()
    return REGISTER(source, target, RigidTransform.identity(), KEY)


def assert_same(a: RigidTransform, b: RigidTransform, deg: float, shift: float) -> None:
    center = problem()[0].xyz.mean(axis=0)[None]
    assert np.rad2deg(rotation_angle((a @ b.inverse()).rotation)) < deg
    assert np.linalg.norm(a.apply(center) - b.apply(center)) < shift


def test_it_finds_any_pose():
    found = answer()
    # noise of 0.003 over some hundred matches, besides neighbours that pass for partners
    assert_same(found.target_from_source, problem()[2], deg=2.0, shift=0.02)
    assert found.converged
    assert found.iterations == 64
    assert 0.2 < found.overlap <= 0.85
    assert 0 < found.rmse < SETTINGS["max_distance"]


def test_the_guess_does_not_matter_where_something_is_found():
    source, target, _ = problem()
    elsewhere = REGISTER(source, target, motion(5), KEY)
    jax.tree.map(np.testing.assert_array_equal, elsewhere, answer())


def test_moving_both_clouds_conjugates_the_answer():
    source, target, _ = problem()
    a, b = motion(7), motion(8)
    moved = REGISTER(source.transform(a), target.transform(b), RigidTransform.identity(), KEY)
    # rounding puts a few pairs into other bins, so that a few other tuples pass
    found = b.inverse() @ moved.target_from_source @ a
    assert_same(found, answer().target_from_source, deg=1.0, shift=0.01)


def test_swapping_the_clouds_gives_the_inverse():
    source, target, truth = problem()
    found = REGISTER(target, source, RigidTransform.identity(), KEY).target_from_source
    assert_same(found.inverse(), truth, deg=2.0, shift=0.02)


def test_padding_does_not_matter():
    """Behind the real points: the same tuples are drawn, and sums differ by rounding alone."""
    padded = [
        PointCloud(
            xyz=np.concatenate([cloud.xyz, cloud.xyz[:40] + np.float32(0.03)]),
            normals=np.concatenate([cloud.normals, cloud.normals[:40]]),
            mask=np.arange(N + 40) < N,
        )
        for cloud in problem()[:2]
    ]
    found = REGISTER(*padded, RigidTransform.identity(), KEY)
    assert_same(found.target_from_source, answer().target_from_source, deg=0.05, shift=1e-3)
    np.testing.assert_allclose(found.overlap, answer().overlap, atol=0.02)


def test_the_kernel_narrows_to_the_last_width():
    """Without graduation, the wide kernel of the start, the outliers pull the answer away."""
    source, target, truth = problem()
    wide = jax.jit(fgr(**SETTINGS, division=1.0, tuple_similarity=0.0, max_normal_angle=3.2))
    narrow = jax.jit(fgr(**SETTINGS, tuple_similarity=0.0, max_normal_angle=3.2))
    errors = []
    for register in (wide, narrow):
        found = register(source, target, RigidTransform.identity(), KEY).target_from_source
        errors.append(np.rad2deg(rotation_angle((found @ truth.inverse()).rotation)))
    assert errors[1] < 0.3 * errors[0]


def test_vmap_is_the_loop():
    source, target, _ = problem()
    keys = jax.random.split(KEY, 2)
    batched = jax.jit(jax.vmap(REGISTER, in_axes=(None, None, None, 0)))(
        source, target, RigidTransform.identity(), keys
    )
    one = REGISTER(source, target, RigidTransform.identity(), keys[1])
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(batched), strict=True):
        np.testing.assert_allclose(a, b[1], atol=1e-4)  # f32 eps x 64 steps


@pytest.mark.parametrize(
    "case", ["no source", "no target", "nothing", "one point", "coincident", "line", "plane"]
)
def test_degenerate_clouds_give_an_answer_without_nan(case):
    source, target, _ = problem()
    if case in ("no source", "nothing"):
        source = source.replace(mask=np.zeros(N, bool))
    if case in ("no target", "nothing"):
        target = target.replace(mask=np.zeros(N, bool))
    if case == "one point":
        source = source.replace(mask=np.arange(N) == 3)
    up = np.float32([0, 0, 1])
    if case in ("coincident", "line", "plane"):
        axes = {"coincident": 0 * up, "line": up[::-1], "plane": 1 - up}[case]
        source, target = (
            cloud.replace(xyz=cloud.xyz * axes, normals=np.broadcast_to(up, cloud.xyz.shape))
            for cloud in (source, target)
        )
    init = motion(4)
    found = REGISTER(source, target, init, KEY)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    rotation = found.target_from_source.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=2e-6)  # f32 eps x 20
    if case != "plane":  # on which any slide fits
        assert not found.converged
        jax.tree.map(np.testing.assert_array_equal, found.target_from_source, init)
