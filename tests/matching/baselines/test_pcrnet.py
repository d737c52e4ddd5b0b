"""PCRNet: a slow float64 twin, padding, and the contract."""

from __future__ import annotations

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_clouds import (
    START,
    assert_reached_but_no_padding,
    assert_same,
    cloud,
    pose,
    pose_gradient,
)
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation

from vanejax.matching.baselines.pcrnet import PcrNet, pcrnet

N, M, ROWS = 40, 50, 60  # every cloud has as many rows: each function is compiled once
ITERATIONS = 3
MODEL = PcrNet(head=(32, 16))
KEY = jax.random.key(0)


@functools.cache
def variables() -> dict:
    """Random weights whose answers are far from 0 and from each other."""
    fresh = MODEL.init(KEY, cloud(problem()[0], ROWS), cloud(problem()[1], ROWS), START, 1)
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
    found = run(variables(), cloud(source, ROWS), cloud(target, ROWS), START)
    expected = slow_pcrnet(source, target)
    np.testing.assert_allclose(found.as_matrix(), expected, atol=2e-5)  # f32 eps x 200
    # the problem is one in which something happens, in every iteration
    steps = np.diff([np.eye(4), *expected], axis=0)
    assert np.abs(steps).max(axis=(1, 2)).min() > 0.05
    assert np.abs(expected[-1][:3, :3] - np.eye(3)).max() > 0.1


def test_a_template_that_is_shared_changes_nothing():
    source, target = problem()
    template = MODEL.apply(variables(), cloud(target, ROWS), method="template")
    # what the target is does not matter any more
    shared = run(variables(), cloud(source, ROWS), cloud(source, ROWS), START, template)
    assert_same(shared, run(variables(), cloud(source, ROWS), cloud(target, ROWS), START), 1e-5)


def test_untrained_it_moves_nothing():
    source, target = problem()
    fresh = quick_jit(lambda *clouds: MODEL.init(KEY, *clouds, START, 1))(
        cloud(source, ROWS), cloud(target, ROWS)
    )
    init = pose(2)
    found = run(fresh, cloud(source, ROWS), cloud(target, ROWS), init)
    for step in range(ITERATIONS):
        assert_same(jax.tree.map(lambda leaf, step=step: leaf[step], found), init, 1e-6)


# ---- the contract ----


def test_registration_says_what_it_rests_on():
    source, target = problem()
    result = register(cloud(source, ROWS), cloud(target, ROWS), START, KEY)
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
    found = run(weights, cloud(source, ROWS), cloud(target, ROWS), START)
    product = found.rotation @ jnp.swapaxes(found.rotation, -1, -2)
    np.testing.assert_allclose(product, np.tile(np.eye(3), (ITERATIONS, 1, 1)), atol=2e-6)
    assert (np.abs(found.rotation[0] - np.eye(3)).max() > 0.05) == (scale > 0)


def test_gradients_reach_every_layer_and_no_padding():
    clouds = [cloud(points, ROWS) for points in problem()]
    gradient = pose_gradient(lambda *pair: MODEL.apply(*pair, START, 2))
    to_weights, *to_clouds = gradient(variables(), *clouds)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(to_weights))
    assert_reached_but_no_padding(to_clouds, clouds)
    weights = jax.tree.map(jnp.asarray, variables())
    weights["params"] |= {"pose_kernel": jnp.zeros((16, 7)), "pose_bias": jnp.zeros(7)}
    found = gradient(weights, *clouds)  # a quaternion of no length
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


def test_the_default_is_the_published_size():
    points = cloud(problem()[0], ROWS)
    made = jax.eval_shape(lambda: PcrNet().init(KEY, points, points, START, 1))
    head = (2048, 1024, 1024, 512, 512, 256, 7)
    encoder = (3, 64, 64, 64, 128, 1024)
    dense = sum((a + 1) * b for w in (encoder, head) for a, b in itertools.pairwise(w))
    assert sum(leaf.size for leaf in jax.tree.leaves(made)) == dense
