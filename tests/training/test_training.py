"""The training step as a pure function of its state; schedule, batches, average, donation."""

from __future__ import annotations

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from vanejax.matching import fast_rpmnet
from vanejax.matching.rpmnet import Match
from vanejax.matching.se3 import exp_se3, rotation_angle
from vanejax.pointcloud import PointCloud
from vanejax.training import rpmnet_loss as losses
from vanejax.training import train_step as training
from vanejax.training.pairs import Pair, PairSampling, ScanBank
from vanejax.training.rpmnet_loss import RpmNetLoss
from vanejax.training.train_step import (
    OptimizerSettings,
    init_state,
    make_optimizer,
    make_train_step,
    views_of_step,
)


class Twist(nn.Module):
    """Stands for the network where only the step counts: its answer is its one parameter."""

    def setup(self):
        self.twist = self.param("twist", nn.initializers.normal(0.1), (6,))

    def features(self, target):
        return jnp.zeros((target.xyz.shape[0], 8))

    def match(self, source, near, target, target_features, pose):
        """The first answer is one twist, the next, which starts there, two, and so on."""
        done = rotation_angle(pose.rotation) / jnp.linalg.norm(self.twist[:3])
        size = 1 + jax.lax.stop_gradient(jnp.round(done))
        return make_match(source, target, size * self.twist)

    def __call__(self, source, target, init, iterations):
        return self.match(source, None, target, None, init)


@pytest.fixture(autouse=True)
def _twist_stands_for_the_fast_form(monkeypatch):
    def called(name):
        return lambda model, variables, *args: model.apply(variables, *args, method=name)

    for name in ("features", "match"):
        monkeypatch.setattr(fast_rpmnet, name, called(name))
    monkeypatch.setattr(fast_rpmnet, "neighborhoods", lambda model, source: source.xyz[:, None])


def make_match(source: PointCloud, target: PointCloud, twist: jax.Array) -> Match:
    """A match in which everything depends on the twist."""
    rows, columns = source.xyz.shape[0], target.xyz.shape[0]
    return Match(
        target_from_source=exp_se3(twist),
        log_assignment=jnp.full((rows, columns), -5.0 + twist[0]),
        partners=exp_se3(2 * twist).apply(source.xyz),
        weights=jnp.ones(rows),
        alpha=jnp.ones(()),
        beta=jnp.ones(()),
    )


SAMPLING = PairSampling(num_reference=24, num_source=16)
MODEL = Twist()
OPTIMIZER = make_optimizer(
    OptimizerSettings(learning_rate=1e-3, steps=100, warmup_steps=0, clip_norm=1.0)
)
LOSS = RpmNetLoss(iterations=1, matching=0.05, partner=0.5)
DECAY = 0.3


@functools.cache
def bank() -> ScanBank:
    """Five views of a bumpy sphere, 16 to 20 points each, and its surface."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(5 * 20 + 30, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    xyz = normals * (0.7 + 0.3 * np.sin(4 * normals[:, :1]))
    mask = np.arange(20)[None, :] < np.array([16, 17, 18, 19, 20])[:, None]
    scans = PointCloud(
        xyz=jnp.asarray(xyz[:100].reshape(5, 20, 3) * mask[..., None]),
        normals=jnp.asarray(normals[:100].reshape(5, 20, 3)),
        mask=jnp.asarray(mask),
    )
    reference = PointCloud.create(jnp.asarray(xyz[100:]), jnp.asarray(normals[100:]))
    return ScanBank(scans=scans, source_sizes=jnp.array([12, 13, 14, 15, 16]), reference=reference)


step = make_train_step(MODEL, OPTIMIZER, LOSS, SAMPLING, batch_size=2, seed=7, average_decay=DECAY)


@functools.cache
def first_state():
    return on_host(init_state(MODEL, OPTIMIZER, bank(), SAMPLING, seed=7))


def start():
    """The first state on the device, to be donated."""
    return jax.tree.map(jnp.array, first_state())


def on_host(tree):
    """A copy that donation cannot take away."""
    return jax.tree.map(np.array, tree)


@functools.cache
def run(steps: int = 4):
    """States on the host, the first one first, and the metrics of each step."""
    state = start()
    states, metrics = [on_host(state)], []
    for _ in range(steps):
        state, measured = step(state, bank())
        states.append(on_host(state))
        metrics.append(on_host(measured))
    return states, metrics


def assert_bit_equal(a, b) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_a_run_is_a_function_of_its_seed():
    states, metrics = run()
    state = init_state(MODEL, OPTIMIZER, bank(), SAMPLING, seed=7)
    assert_bit_equal(on_host(state), states[0])
    for expected, measured in zip(states[1:], metrics, strict=True):
        state, again = step(state, bank())
        assert_bit_equal(on_host(state), expected)
        assert_bit_equal(on_host(again), measured)
    other = init_state(MODEL, OPTIMIZER, bank(), SAMPLING, seed=8)
    twists = [state.variables["params"]["twist"] for state in (other, states[0])]
    assert np.abs(np.subtract(*twists)).max() > 0.01


def test_each_step_draws_anew():
    """The same weights and, in a bank of one view five times over, the same views too."""
    same = jax.tree.map(lambda leaf: jnp.repeat(leaf[:1], 5, axis=0), bank().scans)
    sizes = jnp.repeat(bank().source_sizes[:1], 5)
    alike = bank().replace(scans=same, source_sizes=sizes)
    errors = []
    for number in (2, 3):
        state = start().replace(step=jnp.asarray(number, jnp.int32))
        errors.append(float(step(state, alike)[1]["rotation_error_deg"]))
    assert abs(errors[0] - errors[1]) > 0.1


def test_the_step_moves_the_weights_counts_and_reports():
    states, metrics = run()
    assert [int(state.step) for state in states] == [0, 1, 2, 3, 4]
    twists = [state.variables["params"]["twist"] for state in states]
    assert np.abs(np.diff(twists, axis=0)).min() > 0
    names = {"pose", "inlier", "matching", "partner", "rotation_error_deg", "translation_error"}
    for measured in metrics:
        assert set(measured) == names | {"loss", "gradient_norm"}
        assert all(np.isfinite(value) and value.shape == () for value in measured.values())
        parts = sum(getattr(LOSS, name) * measured[name] for name in ("pose", "inlier"))
        parts += 0.05 * measured["matching"] + 0.5 * measured["partner"]
        # one iteration, so the last one's parts are all; f32 eps x 50
        np.testing.assert_allclose(measured["loss"], parts, rtol=1e-5)


def test_the_state_is_donated():
    state = start()
    step(state, bank())
    for leaf in jax.tree.leaves((state.variables, state.average, state.opt_state)):
        assert leaf.is_deleted()
    assert not bank().scans.xyz.is_deleted()  # the bank serves the next step


def test_the_average_follows_the_weights_and_forgets_its_start():
    states, _ = run()
    average = jax.tree.map(np.float64, states[0].average)
    assert_bit_equal(states[0].average, states[0].variables)
    for index, state in enumerate(states[1:]):
        decay = min(DECAY, (1 + index) / (10 + index))
        average = jax.tree.map(
            lambda old, new, decay=decay: decay * old + (1 - decay) * new, average, state.variables
        )
        jax.tree.map(  # f32 eps x weights of 1
            lambda a, b: np.testing.assert_allclose(a, b, atol=3e-7), state.average, average
        )
    # both branches were taken
    assert 1 / 10 < DECAY < 4 / 13


@pytest.mark.parametrize(("batch_size", "num_views"), [(2, 5), (4, 6), (7, 3)])
def test_every_epoch_visits_each_view_once(batch_size, num_views):
    views = jax.jit(
        jax.vmap(
            lambda step, key: views_of_step(key, step, batch_size=batch_size, num_views=num_views),
            in_axes=(0, None),
        )
    )
    steps = jnp.arange(6 * num_views)
    order = np.asarray(views(steps, jax.random.key(0)))
    assert order.shape == (6 * num_views, batch_size)
    epochs = order.reshape(-1, num_views)
    for epoch in epochs:
        assert sorted(epoch.tolist()) == list(range(num_views))
    assert len({tuple(epoch.tolist()) for epoch in epochs}) > 1  # each in an order of its own
    assert (np.asarray(views(steps, jax.random.key(1))) != order).any()


def test_the_schedule_warms_up_and_decays():
    """Under a constant gradient Adam's update is the learning rate itself."""
    optimizer = make_optimizer(
        OptimizerSettings(
            learning_rate=0.1, steps=40, warmup_steps=10, clip_norm=5.0, final_fraction=0.25
        )
    )
    weights = jnp.zeros(2)
    state, rates = optimizer.init(weights), []
    update = jax.jit(optimizer.update)
    for _ in range(45):
        updates, state = update(jnp.array([1.0, -2.0]), state, weights)
        np.testing.assert_allclose(updates[0], -updates[1], rtol=1e-4)  # sign only
        rates.append(float(-updates[0]))
    t = np.arange(45)
    cosine = 0.5 * (1 + np.cos(np.pi * np.clip((t - 10) / 30, 0, 1)))
    expected = 0.1 * np.where(t < 10, t / 10, 0.25 + 0.75 * cosine)
    np.testing.assert_allclose(rates, expected, atol=1e-5)  # Adam's epsilon, f32 moments


def test_a_warm_up_longer_than_the_run_is_no_error():
    optimizer = make_optimizer(
        OptimizerSettings(learning_rate=0.1, steps=3, warmup_steps=10, clip_norm=1.0)
    )
    state = optimizer.init(jnp.zeros(2))
    for _ in range(3):  # the whole run is warm-up: steps grow and stay finite
        update, state = optimizer.update(jnp.ones(2), state, jnp.zeros(2))
    assert (update < 0).all()
    assert jnp.isfinite(update).all()


def test_gradients_are_clipped_by_their_global_norm():
    """A spike of 1e6 leaves the moments as its unit vector would."""
    optimizer = make_optimizer(
        OptimizerSettings(learning_rate=0.1, steps=10, warmup_steps=0, clip_norm=1.0)
    )
    direction = {"a": jnp.array([0.6, 0.0]), "b": jnp.array(0.8)}
    states = []
    for scale in (1.0, 1e6):
        spike = jax.tree.map(lambda leaf, scale=scale: scale * leaf, direction)
        _, state = optimizer.update(spike, optimizer.init(direction), direction)
        states.append(optax.tree.get(state, "mu"))
    np.testing.assert_allclose(*states, rtol=1e-5)  # f32 eps x 50
    np.testing.assert_allclose(states[0], [0.1 * 0.6, 0, 0.1 * 0.8], rtol=1e-5)  # Adam's 1 - b1


def test_the_loss_discounts_early_iterations_and_shares_the_reference():
    rng = np.random.default_rng(0)
    xyz = jnp.asarray(rng.uniform(0.5, 1, size=(2, 6, 3)), jnp.float32)
    target = PointCloud.create(xyz[0, :4], xyz[0, :4])
    truth = exp_se3(jnp.asarray(rng.normal(size=(2, 6)) * 0.1, jnp.float32))
    twist = jnp.asarray(rng.normal(size=6) * 0.2, jnp.float32)
    calls = []

    class Watched:
        """The model as the loss sees it."""

        def apply(self, variables, *args, method=None):
            calls.append(method)
            if method == "match":
                np.testing.assert_array_equal(args[3].shape, (4, 8))
            return Twist().apply(variables, *args, method=method)

    loss = RpmNetLoss(
        iterations=3,
        discount=0.4,
        pose=2.0,
        inlier=0.3,
        matching=0.5,
        matching_sigma=0.2,
        partner=0.7,
    )
    pairs = Pair(source=PointCloud.create(xyz, xyz), target=target, target_from_source=truth)
    found, metrics = loss(Watched(), {"params": {"twist": twist}}, pairs)
    assert calls.count("features") == 1

    totals, last = [], []
    for index in range(2):
        source = PointCloud.create(xyz[index], xyz[index])
        true = jax.tree.map(lambda leaf, index=index: leaf[index], truth)
        total = 0.0
        for weight, size in ((0.16, 1), (0.4, 2), (1.0, 3)):
            match = make_match(source, target, size * twist)
            parts = [
                2.0 * losses.pose_loss(match.target_from_source, true, source),
                0.3 * losses.inlier_loss(match, source, target),
                0.5 * losses.matching_loss(match, source, target, true, sigma=0.2),
                0.7 * losses.partner_loss(match, source, true),
            ]
            total += weight * sum(map(float, parts))
        totals.append(total)
        last.append(float(parts[0]) / 2.0)
    np.testing.assert_allclose(found, np.mean(totals), rtol=1e-5)  # f32 eps x 50
    np.testing.assert_allclose(metrics["pose"], np.mean(last), rtol=1e-5)


@pytest.mark.slow
def test_quick_compilation_changes_rounding_only(monkeypatch):
    """And is left alone where XLA knows no such option."""
    arguments = (MODEL, OPTIMIZER, LOSS, SAMPLING)
    settings = {"batch_size": 2, "seed": 7, "average_decay": DECAY}
    expected, metrics = step(start(), bank())
    for known in (True, False):
        if not known:
            monkeypatch.setattr(training, "_knows", lambda options: False)
        quick = make_train_step(*arguments, **settings, quick_compilation=True)
        found, same = quick(start(), bank())
        for a, b in zip(
            jax.tree.leaves((found, same)), jax.tree.leaves((expected, metrics)), strict=True
        ):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)  # f32 eps x 100
    monkeypatch.undo()
    assert not training._knows({"xla_there_is_no_such_option": True})
    assert training._knows({})
