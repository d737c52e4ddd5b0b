"""What PointNetLK and PCRNet learn from: slow twins, gradients, and that both do learn."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial.transform import Rotation

from vanejax.matching.baselines.pcrnet import PcrNet
from vanejax.matching.baselines.pointnetlk import PointNetLK
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.training import loss_terms as losses
from vanejax.training.baseline_losses import PcrNetLoss, PointNetLKLoss, chamfer_loss, matrix_loss
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


def random_pose(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    return RigidTransform(jnp.float32(turn), jnp.float32(rng.normal(size=3)))


# ---- the parts ----


def test_matrix_loss_is_the_formula():
    found, truth = random_pose(0), random_pose(1)
    rest = np.linalg.inv(found.as_matrix()) @ np.asarray(truth.as_matrix())
    expected = np.linalg.norm(rest - np.eye(4)) ** 2
    np.testing.assert_allclose(matrix_loss(found, truth), expected, rtol=1e-5)
    assert matrix_loss(truth, truth) < 1e-10


def test_chamfer_loss_goes_one_way_over_real_points():
    rng = np.random.default_rng(2)
    found, xyz, target = random_pose(0), rng.normal(size=(N, 3)), rng.normal(size=(M, 3))
    moved = np.float32(xyz[:20]) @ np.asarray(found.rotation).T
    moved = moved + np.asarray(found.translation)[None]
    squared = np.sum((moved[:, None] - target[None, :30]) ** 2, -1)
    result = chamfer_loss(found, cloud(xyz, 20), cloud(target, 30))
    np.testing.assert_allclose(result, squared.min(axis=1).mean(), rtol=1e-5)
    # a part of the target that no source point is near to costs nothing
    seen = chamfer_loss(found, cloud(xyz, 20), cloud(np.float32(moved), 20))
    assert seen < 1e-10


# ---- the whole ----


def plain(name: str, weights: dict, pairs: Pair) -> tuple[jax.Array, dict]:
    """Pair by pair and iteration by iteration, nothing shared, from the docstrings."""
    model, loss = CASES[name]
    total, metrics = 0.0, []
    for index in range(B):
        source, truth = jax.tree.map(
            lambda leaf, index=index: leaf[index], (pairs.source, pairs.target_from_source)
        )
        steps = model.apply(weights, source, pairs.target, START, loss.iterations)
        for step in range(loss.iterations):
            one = jax.tree.map(lambda leaf, step=step: leaf[step], steps)
            if name == "PCRNet":
                pose = one
                parts = {
                    "pose": losses.pose_loss(pose, truth, source),
                    "chamfer": chamfer_loss(pose, source, pairs.target),
                }
            else:
                pose = one.target_from_source
                parts = {
                    "matrix": matrix_loss(pose, truth),
                    "residual": jnp.mean(one.residual**2),
                }
            value = sum(getattr(loss, part) * parts[part] for part in parts)
            total += loss.discount ** (loss.iterations - 1 - step) * value / B
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
    once = type(loss)(**(vars(loss) | {"iterations": 1}))
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "loss", "batch", "steps", "rate"),
    [
        (PointNetLK(), PointNetLKLoss(iterations=3, pairs_at_once=4), 4, 60, 1e-3),
        (PcrNet(head=(256, 128)), PcrNetLoss(iterations=2, pairs_at_once=16), 16, 200, 3e-3),
    ],
)
def test_training_halves_the_rotation_error(model, loss, batch, steps, rate):
    optimizer = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adam(optax.cosine_decay_schedule(rate, steps))
    )

    def step(carry, key):
        weights, state = carry
        pairs = draw(key, batch)
        (_, metrics), gradients = jax.value_and_grad(
            lambda weights: loss(model, weights, pairs), has_aux=True
        )(weights)
        updates, state = optimizer.update(gradients, state, weights)
        return (optax.apply_updates(weights, updates), state), metrics["rotation_error_deg"]

    weights = fresh_variables(model)
    keys = jax.random.split(jax.random.key(2), steps)
    _, errors = jax.jit(lambda carry: jax.lax.scan(step, carry, keys))(
        (weights, optimizer.init(weights))
    )
    assert errors[-20:].mean() < 0.5 * errors[:5].mean()
