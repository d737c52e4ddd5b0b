"""What the learned baselines learn from: slow twins, gradients, and that all of them do learn."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from scipy.spatial.transform import Rotation

from vanejax.matching.baselines.dcp import Dcp, Match
from vanejax.matching.baselines.pcrnet import PcrNet
from vanejax.matching.baselines.pointnetlk import PointNetLK
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.training import rpmnet_loss as losses
from vanejax.training.baseline_losses import (
    DcpLoss,
    PcrNetLoss,
    PointNetLKLoss,
    chamfer_loss,
    cycle_loss,
    matrix_loss,
    pose_parts,
)
from vanejax.training.pairs import Pair, PairSampling, draw_pose

B, N, M = 4, 32, 40
START = RigidTransform.identity()
CASES = {  # two pairs side by side, and then the other two
    "PointNetLK": (
        PointNetLK(),
        PointNetLKLoss(iterations=3, discount=0.7, residual=0.3, pairs_at_once=2),
    ),
    "PCRNet": (
        PcrNet(head=(64, 32)),
        PcrNetLoss(iterations=3, discount=0.7, chamfer=0.5, pairs_at_once=2),
    ),
    "DCP": (
        Dcp(width=16, num_neighbors=4, heads=2, hidden=16),
        DcpLoss(rotation=0.7, translation=1.3, cycle=0.1, matching=0.02, matching_sigma=0.2),
    ),
}


def cloud(xyz: np.ndarray, real: int) -> PointCloud:
    """The first ``real`` rows count; what lies behind them is far away."""
    mask = np.broadcast_to(np.arange(xyz.shape[-2]) < real, xyz.shape[:-1])
    xyz = jnp.asarray(np.where(mask[..., None], xyz, 30.0), jnp.float32)
    return PointCloud(xyz=xyz, normals=xyz, mask=jnp.asarray(mask))


@functools.partial(jax.jit, static_argnames="count")
def draw(key: jax.Array, count: int = B) -> Pair:
    """One lopsided shape, moved by up to 30 deg, with padding in every cloud."""
    xyz = np.random.default_rng(0).normal(size=(M, 3))
    xyz *= [0.9, 0.6, 0.35] / np.linalg.norm(xyz, axis=-1, keepdims=True)
    xyz *= 1 + 0.25 * np.sin(4 * xyz[:, :1] + 1)
    sampling = PairSampling(max_rotation_deg=30.0, max_translation=0.2)
    truth = jax.vmap(lambda key: draw_pose(key, sampling))(jax.random.split(key, count))
    target = cloud(xyz, M - 5)
    source = cloud(np.broadcast_to(xyz[:N], (count, N, 3)), N - 5)
    return Pair(
        source=source.replace(xyz=truth.inverse().apply(source.xyz)),
        target=target,
        target_from_source=truth,
    )


def fresh_variables(model) -> dict:
    pairs = draw(jax.random.key(0))
    source = jax.tree.map(lambda leaf: leaf[0], pairs.source)
    return jax.jit(lambda key: model.init(key, source, pairs.target, START, 1))(jax.random.key(0))


@functools.cache
def variables(name: str) -> dict:
    """Random weights, all of them far from 0."""
    leaves, tree = jax.tree.flatten(fresh_variables(CASES[name][0]))
    rng = np.random.default_rng(0)
    leaves = [leaf + jnp.float32(rng.normal(size=leaf.shape, scale=0.02)) for leaf in leaves]
    return jax.tree.unflatten(tree, leaves)


@functools.partial(jax.jit, static_argnames=("model", "loss"))
def value_and_grad(model, loss, weights, pairs):
    return jax.value_and_grad(lambda weights: loss(model, weights, pairs), has_aux=True)(weights)


def motion(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return RigidTransform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


# ---- the parts ----


@pytest.mark.usefixtures("double_precision")
def test_pose_losses_are_the_formulas():
    found, truth = motion(0), motion(1)
    parts = pose_parts(found, truth)
    expected = np.sum((found.rotation.T @ truth.rotation - np.eye(3)) ** 2)
    np.testing.assert_allclose(parts["rotation"], expected, rtol=1e-12)
    expected = np.sum((found.translation - truth.translation) ** 2)
    np.testing.assert_allclose(parts["translation"], expected, rtol=1e-12)
    assert pose_parts(truth, truth) == {"rotation": 0, "translation": 0}
    rest = np.linalg.inv(found.as_matrix()) @ truth.as_matrix()
    expected = np.linalg.norm(rest - np.eye(4)) ** 2
    np.testing.assert_allclose(matrix_loss(found, truth), expected, rtol=1e-12)
    assert matrix_loss(truth, truth) < 1e-20


@pytest.mark.usefixtures("double_precision")
def test_cycle_loss_is_that_of_the_way_there_and_back():
    """With the pointer's columns normalised instead of its rows on the way back."""
    rng = np.random.default_rng(2)
    source, target = cloud(rng.normal(size=(N, 3)), 9), cloud(rng.normal(size=(M, 3)), 11)
    scores = np.where(np.outer(source.mask, target.mask), rng.normal(size=(N, M)), -1e9)
    match = Match(target_from_source=motion(5), scores=jnp.asarray(scores), partners=None)
    partners = scipy.special.softmax(scores[:9, :11], axis=0).T @ np.asarray(source.xyz[:9])
    real = np.asarray(target.xyz[:11])
    turn, _ = Rotation.align_vectors(partners - partners.mean(axis=0), real - real.mean(axis=0))
    turn = turn.as_matrix()
    back = RigidTransform(turn, partners.mean(axis=0) - turn @ real.mean(axis=0))
    matrix = back.as_matrix() @ match.target_from_source.as_matrix() - np.eye(4)
    # the clouds are f32
    np.testing.assert_allclose(cycle_loss(match, source, target), np.sum(matrix**2), rtol=1e-5)


def test_chamfer_loss_goes_one_way_over_real_points():
    rng = np.random.default_rng(2)
    found, xyz, target = motion(0), rng.normal(size=(N, 3)), rng.normal(size=(M, 3))
    found = jax.tree.map(jnp.float32, found)
    moved = np.asarray(found.apply(np.float32(xyz[:20])))
    squared = np.sum((moved[:, None] - target[None, :30]) ** 2, -1)
    result = chamfer_loss(found, cloud(xyz, 20), cloud(target, 30))
    np.testing.assert_allclose(result, squared.min(axis=1).mean(), rtol=1e-5)
    # a part of the target that no source point is near to costs nothing
    assert chamfer_loss(found, cloud(xyz, 20), cloud(moved, 20)) < 1e-10


# ---- the whole ----


def parts_of(name: str, weights: dict, pair: Pair) -> list[tuple[RigidTransform, dict]]:
    """Pose and parts of the loss after each iteration for one pair, from the docstrings."""
    model, loss = CASES[name]
    source, target, truth = pair.source, pair.target, pair.target_from_source
    if name == "DCP":
        (match,) = model.apply(weights, source, target, START, 1)
        return [(match.target_from_source, loss.of_match(match, pair)[1])]
    steps = model.apply(weights, source, target, START, loss.iterations)
    found = []
    for index in range(loss.iterations):
        step = jax.tree.map(lambda leaf, index=index: leaf[index], steps)
        if name == "PCRNet":
            pose = step
            parts = {"pose": losses.pose_loss(pose, truth, source)}
            parts["chamfer"] = chamfer_loss(pose, source, target)
        else:
            pose = step.target_from_source
            parts = {"matrix": matrix_loss(pose, truth), "residual": jnp.mean(step.residual**2)}
        found.append((pose, parts))
    return found


def plain(name: str, weights: dict, pairs: Pair) -> tuple[jax.Array, dict]:
    """Pair by pair and iteration by iteration, nothing shared."""
    loss, total, metrics = CASES[name][1], 0.0, []
    for index in range(B):
        source, truth = jax.tree.map(
            lambda leaf, index=index: leaf[index], (pairs.source, pairs.target_from_source)
        )
        found = parts_of(name, weights, Pair(source, pairs.target, truth))
        for left, (_, parts) in enumerate(reversed(found)):
            value = sum(getattr(loss, part) * parts[part] for part in parts)
            total += (loss.discount**left if left else 1.0) * value / B
        pose, parts = found[-1]
        rest = Rotation.from_matrix(pose.rotation) * Rotation.from_matrix(truth.rotation).inv()
        metrics.append(parts | {"rotation_error_deg": np.degrees(rest.magnitude())})
    return total, {part: np.mean([one[part] for one in metrics]) for part in metrics[0]}


@pytest.fixture(scope="module", params=CASES)
def outcome(request):
    """Name, pairs, and the loss with its gradients."""
    model, loss = CASES[request.param]
    pairs = draw(jax.random.key(1))
    return request.param, pairs, value_and_grad(model, loss, variables(request.param), pairs)


@pytest.mark.slow
def test_the_loss_is_its_slow_twin(outcome):
    name, pairs, ((value, metrics), _) = outcome
    expected, parts = plain(name, variables(name), pairs)
    np.testing.assert_allclose(value, expected, rtol=1e-3)  # f32 eps x the Jacobian's condition
    assert set(metrics) == {*parts, "translation_error"}
    for part, mean in parts.items():
        np.testing.assert_allclose(metrics[part], mean, rtol=2e-3)


@pytest.mark.slow
def test_gradients_tell_how_the_loss_grows(outcome):
    """One iteration, where no pose is held constant: the template's part counts as well."""
    name, pairs, _ = outcome
    model, loss = CASES[name]
    once = type(loss)(**(vars(loss) | ({} if name == "DCP" else {"iterations": 1})))
    weights = variables(name)
    (value, _), gradients = value_and_grad(model, once, weights, pairs)
    squared = sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradients))
    step = 0.002 * value / squared  # the loss should fall by 0.2 %
    ahead, behind = (
        value_and_grad(
            model, once, jax.tree.map(lambda w, g, s=s: w + s * step * g, weights, gradients), pairs
        )[0][0]
        for s in (1.0, -1.0)
    )
    np.testing.assert_allclose((ahead - behind) / (2 * step * squared), 1.0, atol=0.05)  # kinks


@pytest.mark.parametrize("name", CASES)
def test_parts_without_a_factor_are_not_computed(name):
    """Nothing is compiled."""
    model, loss = CASES[name]

    def metrics() -> dict:
        pairs = draw(jax.random.key(0))
        source = jax.tree.map(lambda leaf: leaf[0], pairs.source)
        weights = model.init(jax.random.key(0), source, pairs.target, START, 1)
        return type(loss)()(model, weights, pairs)[1]

    parts = {"PointNetLK": {"matrix"}, "PCRNet": {"pose"}, "DCP": {"rotation", "translation"}}
    made = jax.eval_shape(metrics)
    assert set(made) == parts[name] | {"rotation_error_deg", "translation_error"}
