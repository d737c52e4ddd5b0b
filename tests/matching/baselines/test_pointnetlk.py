"""PointNetLK: the published code's numbers, a slow float64 twin, padding, and the contract."""

from __future__ import annotations

import functools
import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
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

from vanejax.errors import InputError
from vanejax.matching.baselines.pointnet import WIDTHS, register_by_pose
from vanejax.matching.baselines.pointnetlk import PointNetLK, pointnetlk
from vanejax.matching.torch_weights import convert_state_dict, load_state_dict, pointnetlk_variables

PARITY = Path(__file__).parents[4] / "shared" / "parity"
N, M, ROWS = 40, 50, 60  # every cloud has as many rows: each function is compiled once
DELTA = 0.01


@functools.cache
def state_dict() -> dict[str, np.ndarray]:
    """Random weights under PyTorch's names and in its shapes; gains of both signs."""
    rng = np.random.default_rng(0)
    state = {"dt": np.full((1, 6), DELTA)}
    for index, (fan_in, out) in enumerate(itertools.pairwise(WIDTHS), start=1):
        convolution, norm = (f"feature_model.{kind}{index}" for kind in ("conv", "bn"))
        state[f"{convolution}.weight"] = rng.normal(size=(out, fan_in, 1)) * np.sqrt(2 / fan_in)
        state[f"{convolution}.bias"] = rng.normal(size=out, scale=0.1)
        gain = 1 + 0.2 * rng.normal(size=out)
        state[f"{norm}.weight"] = gain * np.where(rng.uniform(size=out) < 0.2, -1, 1)
        state[f"{norm}.bias"] = rng.normal(size=out, scale=0.1)
        state[f"{norm}.running_mean"] = rng.normal(size=out, scale=0.1)
        state[f"{norm}.running_var"] = rng.uniform(0.5, 1.5, size=out)
        state[f"{norm}.num_batches_tracked"] = np.array(7)
    return state


@functools.cache
def variables() -> dict:
    return pointnetlk_variables(state_dict())


@functools.cache
def problem() -> tuple[np.ndarray, np.ndarray]:
    """Two samples of one lopsided shape, the first moved: [N, 3] and [M, 3], f32."""
    rng = np.random.default_rng(0)
    xyz = rng.normal(size=(N + M, 3))
    xyz *= [0.9, 0.6, 0.35] / np.linalg.norm(xyz, axis=-1, keepdims=True)
    xyz *= 1 + 0.25 * np.sin(4 * xyz[:, :1] + 1)
    turn = Rotation.from_rotvec([0.1, -0.15, 0.1]).as_matrix()
    return np.float32(xyz[:N] @ turn.T + [0.1, 0, -0.1]), np.float32(xyz[N:])


@functools.partial(quick_jit, static_argnames=("model", "iterations"))
def run(model, weights, source, target, init, iterations=4):
    return model.apply(weights, source, target, init, iterations)


MODEL = PointNetLK()
KEY = jax.random.key(0)
describe = quick_jit(functools.partial(MODEL.apply, method="template"))
register = quick_jit(pointnetlk(MODEL, variables(), iterations=4))


@quick_jit
def judge(source, target, found, init, settled):
    answer = register_by_pose(lambda *_: (found, settled), iterations=4, partner_distance=0.1)
    return answer(source, target, init, KEY)


# ---- the slow twin: numpy float64, from the paper and the PyTorch layers it names ----


def slow_feature(xyz: np.ndarray) -> np.ndarray:
    """Convolution, batch norm in evaluation and ReLU, five times; then the maximum."""
    x, state = np.asarray(xyz, np.float64), state_dict()
    for index in range(1, 6):
        convolution, norm = (f"feature_model.{kind}{index}" for kind in ("conv", "bn"))
        x = x @ state[f"{convolution}.weight"][:, :, 0].T + state[f"{convolution}.bias"]
        x = x - state[f"{norm}.running_mean"]
        x = x / np.sqrt(state[f"{norm}.running_var"] + 1e-5)
        x = np.maximum(x * state[f"{norm}.weight"] + state[f"{norm}.bias"], 0)
    return x.max(axis=0)


def slow_exp(twist: np.ndarray) -> np.ndarray:
    (a, b, c), v = twist[:3], twist[3:]
    return scipy.linalg.expm([[0, -c, b, v[0]], [c, 0, -a, v[1]], [-b, a, 0, v[2]], [0, 0, 0, 0]])


def slow_move(matrix: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return xyz @ matrix[:3, :3].T + matrix[:3, 3]


def slow_pointnetlk(
    source: np.ndarray, target: np.ndarray, iterations: int, origin: str
) -> list[np.ndarray]:
    """Total motions [4, 4] after each iteration."""
    source, target = np.float64(source), np.float64(target)
    target_mean = target.mean(axis=0)
    source_mean = source.mean(axis=0) if origin == "means" else target_mean
    template, source = target - target_mean, source - source_mean
    feature = slow_feature(template)
    moved = (slow_move(slow_exp(-DELTA * axis), template) for axis in np.eye(6))
    jacobian = np.array([(feature - slow_feature(points)) / DELTA for points in moved])
    there, back = (slow_exp(np.r_[0, 0, 0, shift]) for shift in (target_mean, -source_mean))
    inverse, total, totals = np.linalg.pinv(jacobian.T), np.eye(4), []
    for _ in range(iterations):
        step = -inverse @ (slow_feature(slow_move(total, source)) - feature)
        total = slow_exp(step) @ total
        totals.append(there @ total @ back)
    return totals


@pytest.mark.parametrize("origin", ["means", "target"])
def test_it_is_the_slow_twin_whatever_the_padding(origin):
    source, target = problem()
    model = PointNetLK(origin=origin)
    found = run(model, variables(), cloud(source, ROWS), cloud(target, ROWS), START)
    expected = slow_pointnetlk(source, target, 4, origin)
    # f32 eps x the condition of the differences, 1 / delta, and of the pseudo-inverse
    np.testing.assert_allclose(found.target_from_source.as_matrix(), expected, atol=2e-4)
    # the problem is one in which something happens, and not all of it in the first step
    assert np.abs(expected[0] - np.eye(4)).max() > 0.05
    assert np.abs(expected[3] - expected[0]).max() > 0.01


def test_the_residual_is_what_the_steps_came_from():
    source, target = problem()
    found = run(MODEL, variables(), cloud(source, ROWS), cloud(target, ROWS), START)
    centered = source - source.mean(axis=0), target - target.mean(axis=0)
    expected = slow_feature(centered[0]) - slow_feature(centered[1])
    np.testing.assert_allclose(found.residual[0], expected, atol=2e-5)  # f32 eps x 100
    template = describe(variables(), cloud(target, ROWS))
    steps = -found.residual @ template.twist_from_feature.T
    np.testing.assert_allclose(found.twist, steps, atol=1e-5)


# ---- laws ----


def test_a_rigid_copy_about_the_template_is_found():
    """The same points, turned a little: Lucas-Kanade holds its own with any weights."""
    _, target = problem()
    truth = pose(1, 0.03)
    pair = cloud(truth.inverse().apply(target), ROWS), cloud(target, ROWS)
    result = register(*pair, START, KEY)
    np.testing.assert_allclose(
        result.target_from_source.as_matrix(), truth.as_matrix(), atol=1e-3
    )  # the basin's bottom is exact; the differences' step is 0.01
    assert result.converged
    assert result.rmse < 1e-3
    assert result.overlap == 1
    # the first step, from 3 deg, is still long
    eager = quick_jit(pointnetlk(MODEL, variables(), iterations=1))
    assert not eager(*pair, START, KEY).converged


# ---- the contract ----


@pytest.mark.parametrize("case", ["settled", "moving", "not finite", "nowhere near"])
def test_it_converges_where_it_settles_on_a_finite_pose_near_the_target(case):
    _, target = problem()
    found, init = pose(1, 0.0), pose(2)
    if case == "not finite":
        found = found.replace(translation=np.full(3, np.nan, np.float32))
    if case == "nowhere near":
        found = found.replace(translation=np.full(3, 9, np.float32))
    source = cloud(pose(1, 0.0).inverse().apply(target), ROWS)
    result = judge(source, cloud(target, ROWS), found, init, jnp.asarray(case != "moving"))
    assert result.converged == (case == "settled")
    assert_same(result.target_from_source, init if case == "not finite" else found, 0)
    assert np.isfinite(result.rmse)
    assert case == "not finite" or result.overlap == (case != "nowhere near")


def test_gradients_reach_every_layer_and_no_padding():
    clouds = [cloud(points, ROWS) for points in problem()]
    gradient = pose_gradient(lambda *pair: MODEL.apply(*pair, START, 2).target_from_source)
    to_weights, *to_clouds = gradient(variables(), *clouds)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(to_weights))
    assert_reached_but_no_padding(to_clouds, clouds)
    for axes in ((1, 1, 0), (0, 0, 0)):
        flat = (c.replace(xyz=c.xyz * jnp.float32([axes])) for c in clouds)
        found = gradient(variables(), *flat)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


# ---- import, and parity with the published code ----


def test_imported_weights_are_those_of_the_model():
    points = cloud(problem()[0], ROWS)
    made = jax.eval_shape(lambda: MODEL.init(KEY, points, points, START, 1))
    assert jax.tree.structure(variables()) == jax.tree.structure(made)
    assert jax.tree.map(np.shape, variables()) == jax.tree.map(lambda leaf: leaf.shape, made)
    assert {leaf.dtype for leaf in jax.tree.leaves(variables())} == {np.dtype(np.float32)}


BIAS = "feature_model.conv3.bias"
KERNEL = "feature_model.conv4.weight"
VARIANCE = "feature_model.bn2.running_var"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({BIAS: None}, BIAS),
        ({VARIANCE: None}, VARIANCE),
        ({"classifier.weight": np.zeros(3)}, "classifier.weight"),
        ({KERNEL: np.zeros((64, 128, 1))}, KERNEL),  # transposed
        ({KERNEL: np.zeros((128, 64, 3))}, KERNEL),
        ({KERNEL: np.zeros(128)}, KERNEL),
        ({BIAS: np.zeros(63)}, BIAS),
        ({BIAS: np.full(64, np.nan)}, BIAS),
        ({VARIANCE: np.full(64, -1.0)}, VARIANCE),
        ({"dt": None}, "dt"),
        ({"dt": np.full((1, 6), 0.02)}, "dt"),
    ],
)
def test_import_refuses_another_model_and_names_what_differs(changes, words):
    state = {name: value for name, value in (state_dict() | changes).items() if value is not None}
    with pytest.raises(InputError, match=words.replace(".", r"\.")):
        pointnetlk_variables(state)


def test_a_state_dict_is_converted_once_without_the_count_of_batches(tmp_path):
    state = {name: value for name, value in state_dict().items() if "num_batches" not in name}
    np.savez(tmp_path / "a.npz", **state)
    assert convert_state_dict(tmp_path / "a.npz", tmp_path / "a.safetensors")[0] == "PointNetLK"
    converted = pointnetlk_variables(load_state_dict(tmp_path / "a.safetensors"))
    jax.tree.map(np.testing.assert_array_equal, converted, variables())


@pytest.mark.skipif(
    not (PARITY / "pointnetlk.npz").exists(), reason="needs ../shared/parity/pointnetlk.npz"
)
def test_parity_with_the_published_weights():
    with np.load(PARITY / "pointnetlk.npz") as file:
        io = dict(file)
    weights = pointnetlk_variables(
        {name[2:]: value for name, value in io.items() if name.startswith("w:")}
    )
    for pair in range(3):
        source, target = (cloud(io[name][pair], 1024) for name in ("source", "template"))
        feature = describe(weights, target).feature
        # f32 eps x 100 on features up to 6
        np.testing.assert_allclose(feature, io["template_feature"][pair], atol=1e-4)
        found = run(MODEL, weights, source, target, START, 10).target_from_source.as_matrix()
        for count in (1, 2, 10):
            expected = io[f"est_T_{count}"][pair]
            np.testing.assert_allclose(found[count - 1], expected, atol=1e-4)  # measured: 6e-6
