"""Each loss against its formula in plain loops, and its gradient at padding."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vanejax.matching.procrustes import weighted_procrustes
from vanejax.matching.rpmnet import Match
from vanejax.matching.se3 import exp_se3
from vanejax.matching.sinkhorn import soft_correspondences
from vanejax.pointcloud import PointCloud
from vanejax.training import rpmnet_loss as losses

pytestmark = pytest.mark.usefixtures("double_precision")
N, M = 5, 7
SIGMA = 0.3
SOURCE_MASK, TARGET_MASK = np.arange(N) < 4, np.arange(M) != 2
EXACT = 1e-12  # f64 eps x a sum of N x M terms
LOSSES = {
    "pose": lambda match, source, target, truth: losses.pose_loss(
        match.target_from_source, truth, source
    ),
    "inlier": lambda match, source, target, truth: losses.inlier_loss(match, source, target),
    "matching": lambda *args: losses.matching_loss(*args, sigma=SIGMA),
    "partner": lambda match, source, target, truth: losses.partner_loss(match, source, truth),
}


def make_match(log_assignment, source, target, motion=None) -> Match:
    """A match with this assignment; its motion follows from it unless given."""
    partners, weights = soft_correspondences(jnp.exp(log_assignment), target.xyz)
    return Match(
        target_from_source=motion or weighted_procrustes(source.xyz, partners, weights),
        log_assignment=log_assignment,
        partners=partners,
        weights=weights,
        alpha=jnp.ones(()),
        beta=jnp.ones(()),
    )


def problem(seed: int = 0, junk: float = 7.0):
    """Masked clouds whose padding lies at ``junk``, a true motion and a random assignment."""
    rng = np.random.default_rng(seed)
    source_xyz, target_xyz = rng.normal(size=(N, 3)), rng.normal(size=(M, 3))
    log_assignment = np.log(rng.uniform(0.01, 0.14, (N, M)))
    source_xyz[~SOURCE_MASK], target_xyz[~TARGET_MASK] = junk, -junk
    log_assignment[~SOURCE_MASK] = log_assignment[:, ~TARGET_MASK] = -1e9  # as log_sinkhorn does
    source = PointCloud(xyz=source_xyz, normals=source_xyz, mask=SOURCE_MASK)
    target = PointCloud(xyz=target_xyz, normals=target_xyz, mask=TARGET_MASK)
    truth = exp_se3(jnp.array([0.2, -0.4, 0.3, 0.1, 0.5, -0.2]))
    return jnp.asarray(log_assignment), source, target, truth


def by_loop(name: str, match: Match, source, target, truth) -> float:
    """The formulas of the docstrings, one real point at a time."""
    true = source.xyz @ np.asarray(truth.rotation).T + np.asarray(truth.translation)
    rows, columns = np.flatnonzero(source.mask), np.flatnonzero(target.mask)
    assignment = np.exp(np.asarray(match.log_assignment))
    if name == "pose":
        motion = match.target_from_source
        found = source.xyz @ np.asarray(motion.rotation).T + np.asarray(motion.translation)
        return np.mean([abs(found[i][k] - true[i][k]) for i in rows for k in range(3)])
    if name == "inlier":
        row_slack = [1 - sum(assignment[i, j] for j in columns) for i in rows]
        column_slack = [1 - sum(assignment[i, j] for i in rows) for j in columns]
        return np.mean(row_slack) + np.mean(column_slack)
    if name == "matching":
        total = 0.0
        for i in rows:
            near = [
                np.exp(-np.sum((true[i] - target.xyz[j]) ** 2) / (2 * SIGMA**2)) for j in columns
            ]
            for share, j in zip(near / np.sum(near), columns, strict=True):
                total -= share * float(match.log_assignment[i, j])
        return total / len(rows)
    gaps = [np.linalg.norm(match.partners[i] - true[i]) for i in rows]
    return np.average(gaps, weights=np.asarray(match.weights)[rows])


@pytest.mark.parametrize("name", LOSSES)
def test_value_is_the_formula_over_real_points(name):
    log_assignment, source, target, truth = problem()
    match = make_match(log_assignment, source, target)
    found = LOSSES[name](match, source, target, truth)
    assert found.shape == ()
    # 1e-8 under the root of partner_loss: half of it over gaps of about 1
    atol = 1e-7 if name == "partner" else EXACT
    np.testing.assert_allclose(found, by_loop(name, match, source, target, truth), atol=atol)


@pytest.mark.parametrize("name", LOSSES)
def test_padding_counts_for_nothing_and_gets_no_gradient(name):
    values = []
    for junk in (0.0, 1e3):
        log_assignment, source, target, truth = problem(junk=junk)

        @jax.jit
        def loss(log_assignment, source_xyz, source=source, target=target, truth=truth):
            moved = source.replace(xyz=source_xyz)
            match = make_match(log_assignment, moved, target)
            return LOSSES[name](match, moved, target, truth)

        value, (to_assignment, to_xyz) = jax.value_and_grad(loss, (0, 1))(
            log_assignment, source.xyz
        )
        values.append(value)
        np.testing.assert_array_equal(to_assignment[~SOURCE_MASK], 0)
        np.testing.assert_array_equal(to_assignment[:, ~TARGET_MASK], 0)
        np.testing.assert_array_equal(to_xyz[~SOURCE_MASK], 0)
        assert np.isfinite(to_assignment).all()
        assert np.isfinite(to_xyz).all()
    np.testing.assert_allclose(*values, atol=EXACT)


@pytest.mark.parametrize("name", LOSSES)
def test_nothing_to_learn_from_is_zero_or_finite(name):
    log_assignment, source, target, truth = problem()
    none = source.replace(mask=np.zeros(N, bool)), target.replace(mask=np.zeros(M, bool))

    @jax.jit
    def loss(log_assignment):
        match = make_match(log_assignment, *none)
        return LOSSES[name](match, *none, truth)

    value, gradient = jax.value_and_grad(loss)(0 * log_assignment - 1e9)
    assert value == 0
    assert np.isfinite(gradient).all()
