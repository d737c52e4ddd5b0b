"""DCP's loss against the formulas in plain numpy, and a network that learns from it."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.special
from scipy.spatial.transform import Rotation

from vanejax.matching.baselines.dcp import Dcp, Match
from vanejax.matching.metrics import rotation_error_deg
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.training.baseline_losses import DcpLoss, cycle_loss, pose_parts
from vanejax.training.pairs import Pair, PairSampling, draw_pose

N, M, B = 12, 15, 3
MODEL = Dcp(width=16, num_neighbors=4, heads=2, hidden=16)
ALL_PARTS = DcpLoss(rotation=0.7, translation=1.3, cycle=0.1, matching=0.02, matching_sigma=0.2)
# these networks run for milliseconds: a fifth of the time to compile is worth slower code
jit = functools.partial(
    jax.jit,
    compiler_options={"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False},
)


@pytest.fixture
def _double():
    with jax.enable_x64(True):
        yield


def motion(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return RigidTransform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


def points(rows: int, mask: np.ndarray, seed: int, junk: float = 7.0) -> PointCloud:
    xyz = np.random.default_rng(seed).normal(size=(rows, 3))
    xyz[~mask] = junk
    return PointCloud(xyz=xyz, normals=xyz, mask=mask)


def kabsch(a: np.ndarray, b: np.ndarray) -> RigidTransform:
    turn, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
    return RigidTransform(turn.as_matrix(), b.mean(axis=0) - turn.as_matrix() @ a.mean(axis=0))


@pytest.mark.usefixtures("_double")
def test_pose_losses_are_the_papers():
    found, truth = motion(0), motion(1)
    parts = pose_parts(found, truth)
    expected = np.sum((found.rotation.T @ truth.rotation - np.eye(3)) ** 2)
    np.testing.assert_allclose(parts["rotation"], expected, rtol=1e-12)
    expected = np.sum((found.translation - truth.translation) ** 2)
    np.testing.assert_allclose(parts["translation"], expected, rtol=1e-12)
    assert pose_parts(truth, truth) == {"rotation": 0, "translation": 0}


@pytest.mark.usefixtures("_double")
def test_cycle_loss_is_that_of_the_way_there_and_back():
    """With the pointer's columns normalised instead of its rows on the way back."""
    source = points(N, np.arange(N) < 9, seed=2)
    target = points(M, np.arange(M) != 4, seed=3)
    real = source.mask[:, None] & target.mask[None, :]
    scores = np.where(real, np.random.default_rng(4).normal(size=(N, M)), -1e9)
    match = Match(target_from_source=motion(5), scores=jnp.asarray(scores), partners=None)
    inner = scores[source.mask][:, target.mask]
    partners = scipy.special.softmax(inner, axis=0).T @ source.xyz[source.mask]
    back = kabsch(target.xyz[target.mask], partners)
    there = match.target_from_source
    matrix = back.as_matrix() @ there.as_matrix() - np.eye(4)
    found = cycle_loss(match, source, target)
    np.testing.assert_allclose(found, np.sum(matrix**2), rtol=1e-9)


def batch(seed: int = 6) -> Pair:
    masks = np.arange(N)[None, :] < np.array([N, N - 3, 7])[:, None]
    sources = [points(N, mask, seed + index, 0.1) for index, mask in enumerate(masks)]
    truths = [motion(seed + index) for index in range(B)]
    stacked = [jax.tree.map(lambda *leaves: np.stack(leaves), *some) for some in (sources, truths)]
    return Pair(stacked[0], points(M, np.ones(M, bool), seed + B), stacked[1])


def random_variables(pairs: Pair):
    source = jax.tree.map(lambda leaf: leaf[0], pairs.source)
    rng = np.random.default_rng(0)
    made = jax.eval_shape(
        lambda *args: MODEL.init(*args, 1),
        jax.random.key(0),
        source,
        pairs.target,
        RigidTransform.identity(),
    )
    return jax.tree.map(lambda leaf: 0.3 * rng.normal(size=leaf.shape), made)


@pytest.mark.usefixtures("_double")
@pytest.mark.slow
def test_the_batch_is_the_mean_of_its_pairs_in_value_and_gradient():
    """The same in plain reverse mode, one pair after another, and nothing shared."""
    pairs = batch()
    variables = random_variables(pairs)

    @jit
    def of_pair(variables, source, truth):
        def loss(variables):
            (match,) = MODEL.apply(variables, source, pairs.target, RigidTransform.identity(), 1)
            value, parts = ALL_PARTS.of_match(match, Pair(source, pairs.target, truth))
            error = rotation_error_deg(match.target_from_source, truth)
            return value, parts | {"rotation_error_deg": error}

        return jax.value_and_grad(loss, has_aux=True)(variables)

    each = []
    for index in range(B):
        one = (pairs.source, pairs.target_from_source)
        source, truth = jax.tree.map(lambda leaf, index=index: leaf[index], one)
        each.append(of_pair(variables, source, truth))
    (want, want_metrics), want_slopes = jax.tree.map(lambda *leaves: sum(leaves) / B, *each)
    at_once = jit(
        jax.value_and_grad(lambda variables: ALL_PARTS(MODEL, variables, pairs), has_aux=True)
    )
    (value, metrics), slopes = at_once(variables)
    np.testing.assert_allclose(value, want, rtol=1e-9)  # f64 eps x condition
    for name, expected in want_metrics.items():
        np.testing.assert_allclose(metrics[name], expected, rtol=1e-9)
    assert set(metrics) - set(want_metrics) == {"translation_error"}
    parts = ("rotation", "translation", "cycle", "matching")
    total = sum(getattr(ALL_PARTS, name) * metrics[name] for name in parts)
    np.testing.assert_allclose(value, total, rtol=1e-12)
    for a, b in zip(jax.tree.leaves(slopes), jax.tree.leaves(want_slopes), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8 * (1 + np.abs(b).max()))


def test_parts_without_a_factor_are_not_computed():
    pairs = jax.tree.map(lambda leaf: leaf if leaf.dtype == bool else np.float32(leaf), batch())
    variables = jax.tree.map(np.float32, random_variables(pairs))
    made = jax.eval_shape(lambda: DcpLoss()(MODEL, variables, pairs)[1])
    assert set(made) == {"rotation", "translation", "rotation_error_deg", "translation_error"}


@pytest.mark.slow
def test_a_small_network_learns_one_shape():
    """Poses up to 30 deg of one bumpy blob of 96 points: the rotation error falls by half."""
    model = Dcp(width=64, num_neighbors=8, heads=2, hidden=64)
    rng = np.random.default_rng(0)
    xyz = rng.normal(size=(96, 3))
    xyz *= (0.6 + 0.25 * np.sin(4 * xyz[:, :1])) / np.linalg.norm(xyz, axis=1, keepdims=True)
    xyz = jnp.asarray(xyz * [1.0, 0.7, 0.4], jnp.float32)
    target = PointCloud.create(xyz, xyz)
    sampling = PairSampling(max_rotation_deg=30.0, max_translation=0.1)
    loss, optimizer = DcpLoss(matching=0.1, matching_sigma=0.1), optax.adam(1e-3)

    def pairs(key) -> Pair:
        poses = jax.vmap(lambda key: draw_pose(key, sampling))(jax.random.split(key, 4))
        sources = jax.vmap(target.transform)(poses)
        return Pair(source=sources, target=target, target_from_source=poses.inverse())

    @jit
    def train(variables):
        def step(carry, key):
            variables, state = carry
            slopes, metrics = jax.grad(
                lambda variables: loss(model, variables, pairs(key)), has_aux=True
            )(variables)
            updates, state = optimizer.update(slopes, state)
            return (optax.apply_updates(variables, updates), state), metrics["rotation_error_deg"]

        start = (variables, optimizer.init(variables))
        return jax.lax.scan(step, start, jax.random.split(jax.random.key(1), 60))[1]

    init = jit(lambda key: model.init(key, target, target, RigidTransform.identity(), 1))
    errors = np.asarray(train(init(jax.random.key(0))))
    assert np.isfinite(errors).all()
    assert errors[-10:].mean() < 0.5 * errors[:10].mean(), errors
