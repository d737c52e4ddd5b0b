"""PCRNet: a slow float64 twin, padding, and the contract."""

from __future__ import annotations

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation

from vanejax.matching.baselines.pcrnet import PcrNet, pcrnet
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

N, M, ROWS = 40, 50, 60  # every cloud has as many rows: each function is compiled once
ITERATIONS = 3
MODEL = PcrNet(head=(32, 16))
KEY = jax.random.key(0)
START = jax.tree.map(jnp.asarray, RigidTransform.identity())


@functools.cache
def variables() -> dict:
    """Random weights whose answers are far from 0 and from each other."""
    fresh = MODEL.init(KEY, cloud(problem()[0]), cloud(problem()[1]), START, 1)
    leaves, tree = jax.tree.flatten(fresh)
    rng = np.random.default_rng(0)
    leaves = [leaf + jnp.float32(rng.normal(size=leaf.shape, scale=0.02)) for leaf in leaves]
    return jax.tree.unflatten(tree, leaves)


@functools.cache
def problem() -> tuple[np.ndarray, np.ndarray]:
    """Two clouds [N, 3] and [M, 3], f32."""
    rng = np.random.default_rng(0)
    xyz = rng.normal(size=(N + M, 3), scale=0.4)
    return np.float32(xyz[:N] + np.float32([0.2, 0, -0.1])), np.float32(xyz[N:])


def cloud(xyz: np.ndarray) -> PointCloud:
    """A cloud whose padding lies far away, scattered among the real points."""
    place = np.sort(np.random.default_rng(0).permutation(ROWS)[: len(xyz)])
    padded = np.full((ROWS, 3), 30.0, np.float32)
    padded[place] = xyz
    mask = np.isin(np.arange(ROWS), place)
    return PointCloud(xyz=jnp.asarray(padded), normals=jnp.asarray(padded), mask=jnp.asarray(mask))


def pose(seed: int, size: float = 1.0) -> RigidTransform:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(size * rng.normal(size=3)).as_matrix()
    return RigidTransform(np.float32(turn), np.float32(rng.normal(size=3, scale=0.3)))


@quick_jit
def run(weights, source, target, init, template=None):
    return MODEL.apply(weights, source, target, init, ITERATIONS, template=template)


register = quick_jit(pcrnet(MODEL, variables(), iterations=ITERATIONS))


# ---- the slow twin: numpy float64, from the paper ----


def slow_mlp(name: str, x: np.ndarray) -> np.ndarray:
    layers = variables()["params"][name]
    for index in range(len(layers) // 2):
        kernel, bias = (np.float64(layers[f"{kind}_{index}"]) for kind in ("kernel", "bias"))
        x = np.maximum(x @ kernel + bias, 0)
    return x


def slow_pcrnet(source: np.ndarray, target: np.ndarray) -> list[np.ndarray]:
    """Total motions [4, 4] after each iteration."""
    params = variables()["params"]
    total, totals, moved = np.eye(4), [], np.float64(source)
    for _ in range(ITERATIONS):
        features = [slow_mlp("encoder", points).max(axis=0) for points in (moved, target)]
        x = slow_mlp("hidden", np.concatenate(features))
        answer = x @ np.float64(params["pose_kernel"]) + params["pose_bias"]
        step = np.eye(4)
        step[:3, 3], (w, x, y, z) = answer[:3], answer[3:]
        step[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
        moved = moved @ step[:3, :3].T + step[:3, 3]
        total = step @ total
        totals.append(total)
    return totals


def test_it_is_the_slow_twin_whatever_the_padding():
    source, target = problem()
    found = run(variables(), cloud(source), cloud(target), START)
    expected = slow_pcrnet(source, target)
    np.testing.assert_allclose(found.as_matrix(), expected, atol=2e-5)  # f32 eps x 200
    # the problem is one in which something happens, in every iteration
    steps = np.diff([np.eye(4), *expected], axis=0)
    assert np.abs(steps).max(axis=(1, 2)).min() > 0.05
    assert np.abs(expected[-1][:3, :3] - np.eye(3)).max() > 0.1


def assert_same(found, expected, atol: float) -> None:
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=atol)


def test_a_template_that_is_shared_changes_nothing():
    source, target = problem()
    template = MODEL.apply(variables(), cloud(target), method="template")
    # what the target is does not matter any more
    shared = run(variables(), cloud(source), cloud(source), START, template)
    assert_same(shared, run(variables(), cloud(source), cloud(target), START), 1e-5)


def test_untrained_it_moves_nothing():
    source, target = problem()
    fresh = quick_jit(lambda *clouds: MODEL.init(KEY, *clouds, START, 1))(
        cloud(source), cloud(target)
    )
    init = pose(2)
    found = run(fresh, cloud(source), cloud(target), init)
    for step in range(ITERATIONS):
        assert_same(jax.tree.map(lambda leaf, step=step: leaf[step], found), init, 1e-6)


# ---- laws ----


# ---- the contract ----


def test_registration_says_what_it_rests_on():
    source, target = problem()
    result = register(cloud(source), cloud(target), START, KEY)
    expected = slow_pcrnet(source, target)[-1]
    np.testing.assert_allclose(result.target_from_source.as_matrix(), expected, atol=2e-5)
    moved = source @ expected[:3, :3].T + expected[:3, 3]
    nearest = np.linalg.norm(moved[:, None] - target[None], axis=-1).min(axis=1)
    near = nearest <= 0.1
    assert 0 < near.sum() < N
    assert result.converged
    np.testing.assert_allclose(result.overlap, near.mean(), atol=1e-6)
    np.testing.assert_allclose(result.rmse, np.sqrt(np.mean(nearest[near] ** 2)), atol=1e-4)


@pytest.mark.parametrize("scale", [1e-3, 0.0])
def test_a_quaternion_of_any_length_is_a_rotation(scale):
    source, target = problem()
    weights = jax.tree.map(jnp.asarray, variables())
    for name in ("pose_kernel", "pose_bias"):
        weights["params"][name] = scale * weights["params"][name]
    found = run(weights, cloud(source), cloud(target), START)
    product = found.rotation @ jnp.swapaxes(found.rotation, -1, -2)
    np.testing.assert_allclose(product, np.tile(np.eye(3), (ITERATIONS, 1, 1)), atol=2e-6)
    assert (np.abs(found.rotation[0] - np.eye(3)).max() > 0.05) == (scale > 0)


def test_gradients_reach_every_layer_and_no_padding():
    clouds = [cloud(points) for points in problem()]

    @quick_jit
    def gradient(weights, *clouds):
        def total(weights, *places):
            moved = (c.replace(xyz=xyz) for c, xyz in zip(clouds, places, strict=True))
            return jnp.sum(MODEL.apply(weights, *moved, START, 2).as_matrix() ** 3)

        return jax.grad(total, (0, 1, 2))(weights, *(c.xyz for c in clouds))

    to_weights, *to_clouds = gradient(variables(), *clouds)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(to_weights))
    for found, given in zip(to_clouds, clouds, strict=True):
        np.testing.assert_array_equal(found[~given.mask], 0)
        assert np.abs(found[given.mask]).max() > 0
    weights = jax.tree.map(jnp.asarray, variables())
    weights["params"] |= {"pose_kernel": jnp.zeros((16, 7)), "pose_bias": jnp.zeros(7)}
    found = gradient(weights, *clouds)  # a quaternion of no length
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


def test_the_default_is_the_published_size():
    points = cloud(problem()[0])
    made = jax.eval_shape(lambda: PcrNet().init(KEY, points, points, START, 1))
    head = (2048, 1024, 1024, 512, 512, 256, 7)
    encoder = (3, 64, 64, 64, 128, 1024)
    dense = sum((a + 1) * b for w in (encoder, head) for a, b in itertools.pairwise(w))
    assert sum(leaf.size for leaf in jax.tree.leaves(made)) == dense
