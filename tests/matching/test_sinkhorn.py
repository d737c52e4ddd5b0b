"""Sinkhorn with slack against the published algorithm in plain numpy, and its laws."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from jax.test_util import check_grads

from vanejax.matching.sinkhorn import log_sinkhorn, soft_correspondences

pytestmark = pytest.mark.usefixtures("double_precision")
ROUNDS = 5
N, M = 6, 9


@functools.partial(jax.jit, static_argnames="iterations")
def log_assignment(affinity, source_mask=None, target_mask=None, iterations=ROUNDS):
    rows, columns = affinity.shape
    source_mask = jnp.ones(rows, bool) if source_mask is None else source_mask
    target_mask = jnp.ones(columns, bool) if target_mask is None else target_mask
    return log_sinkhorn(affinity, source_mask, target_mask, iterations=iterations)


mass_gradient = jax.jit(jax.grad(lambda a: jnp.sum(jnp.exp(log_assignment(a)))))


def affinities(scale: float = 3.0, seed: int = 0) -> np.ndarray:
    return scale * np.random.default_rng(seed).normal(size=(N, M))


def sinkhorn_by_loop(affinity: np.ndarray, rounds: int) -> np.ndarray:
    """The padded matrix, its rows and columns normalised in turn, never those of the slack."""
    padded = np.zeros((len(affinity) + 1, affinity.shape[1] + 1))
    padded[:-1, :-1] = affinity
    for _ in range(rounds):
        for i in range(len(affinity)):
            padded[i] -= scipy.special.logsumexp(padded[i])
        for j in range(affinity.shape[1]):
            padded[:, j] -= scipy.special.logsumexp(padded[:, j])
    return padded[:-1, :-1]


@pytest.mark.parametrize("rounds", [1, 2, 5])
@pytest.mark.parametrize("scale", [0.1, 3.0, 300.0])
def test_log_sinkhorn_is_the_loop(rounds, scale):
    affinity = affinities(scale)
    found = log_assignment(affinity, iterations=rounds)
    expected = sinkhorn_by_loop(affinity, rounds)
    np.testing.assert_allclose(found, expected, atol=1e-14 * max(scale, 1) * 30)  # f64 eps x sums


def test_padding_is_not_there():
    affinity = affinities()
    rows, columns = [0, 2, 3, 7], [1, 2, 4, 5, 8, 9, 10]
    junk = np.full((9, 12), 1e4)
    junk[np.ix_(rows, columns)] = affinity[:4, :7]
    source_mask, target_mask = np.isin(np.arange(9), rows), np.isin(np.arange(12), columns)
    found = np.asarray(log_assignment(junk, source_mask, target_mask))
    expected = log_assignment(affinity[:4, :7])
    np.testing.assert_allclose(found[np.ix_(rows, columns)], expected, atol=1e-13)  # sums' order
    real = source_mask[:, None] & target_mask[None, :]
    assert np.isfinite(found).all()
    assert (np.exp(found[~real]) == 0).all()

    gradient = jax.grad(
        lambda a: jnp.sum(jnp.exp(log_assignment(a, source_mask, target_mask)) ** 2)
    )(junk)
    np.testing.assert_array_equal(gradient[~real], 0)
    assert np.abs(gradient[real]).min() > 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("level", [1e4, -1e4, "both"])
def test_extreme_affinities_stay_finite(level, dtype):
    affinity = affinities(1e4) if level == "both" else affinities() + level
    affinity = affinity.astype(dtype)
    assert np.isfinite(mass_gradient(affinity)).all()
    # f32 eps x 1e4 is how well the logarithms are known
    assignment = np.exp(log_assignment(affinity))
    for axis in (0, 1):
        assert assignment.sum(axis).max() <= 1 + 30 * 1e4 * np.finfo(dtype).eps


def test_nothing_to_match():
    none = np.zeros(N, bool)
    found, gradient = jax.value_and_grad(
        lambda a: jnp.sum(jnp.exp(log_assignment(a, none, np.ones(M, bool))))
    )(affinities())
    assert found == 0
    np.testing.assert_array_equal(gradient, 0)


def test_gradients():
    check_grads(log_assignment, (affinities(),), order=1, modes=["fwd", "rev"])
    xyz = np.random.default_rng(2).normal(size=(M, 3))
    assignment = np.exp(affinities()) / M
    check_grads(jax.jit(soft_correspondences), (assignment, xyz), order=1, modes=["fwd", "rev"])


def test_soft_correspondences_are_weighted_means():
    rng = np.random.default_rng(0)
    assignment, xyz = rng.uniform(size=(N, M)), rng.normal(size=(M, 3))
    assignment[2] = 0
    partners, weights = soft_correspondences(assignment, xyz)
    np.testing.assert_allclose(weights, assignment.sum(axis=1), atol=1e-14)
    for i in np.delete(np.arange(N), 2):
        mean = np.average(xyz, axis=0, weights=assignment[i])
        np.testing.assert_allclose(partners[i], mean, rtol=2e-5)  # the published 1e-5
    np.testing.assert_array_equal(partners[2], 0)
