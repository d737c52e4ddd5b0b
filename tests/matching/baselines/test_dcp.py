"""DCP: its head against plain numpy, padding, order, and the contract."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest
import scipy.special
from network_clouds import (
    assert_reached_but_no_padding,
    assert_same,
    bumpy_sphere,
    cloud,
    pose,
    pose_gradient,
)
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation

from vanejax.matching.baselines.dcp import Dcp, dcp, last_match
from vanejax.rigid import RigidTransform

N = M = 24
MODEL = Dcp(width=32, num_neighbors=5, heads=2, hidden=16)
EXACT = 1e-9  # f64 eps x the network's condition of about 1e5


def problem() -> tuple[np.ndarray, np.ndarray]:
    return bumpy_sphere(N, M, bump=0.2)[::2]


@functools.cache
def exact_variables() -> dict:
    """Random weights whose pointer is neither flat nor a choice of one."""
    rng = np.random.default_rng(1)
    init = jax.random.key(0), *(cloud(points) for points in single(problem())), pose(0)
    made = jax.eval_shape(lambda *args: MODEL.init(*args, 1), *init)
    return jax.tree.map(lambda leaf: 0.7 * rng.normal(size=leaf.shape), made)


def single(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), tree)


@functools.partial(quick_jit, static_argnames="iterations")
def _run(variables, source, target, init, iterations):
    return MODEL.apply(variables, source, target, init, iterations)


def run(variables, source, target, init=None, iterations=1):
    init = RigidTransform(np.eye(3), np.zeros(3)) if init is None else init
    return _run(variables, source, target, init, iterations)


def kabsch(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """target_from_source [4, 4] by scipy."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    turn, _ = Rotation.align_vectors(target - b, source - a)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), b - turn.as_matrix() @ a
    return pose


@pytest.mark.usefixtures("double_precision")
def test_scores_pointer_partners_and_pose_from_the_two_networks():
    """Phi = F + transformer(F, other) both ways, softmax(phi phi^T / sqrt(width)), Kabsch.

    The networks are run without padding.
    """
    xyz, target_xyz = problem()
    source, target = cloud(xyz, N + 9, 50.0), cloud(target_xyz, M + 11, -50.0)

    @quick_jit
    def both(variables, source, target):
        networks = MODEL.bind(variables)
        f, g = (networks.dgcnn(c.xyz, c.mask) for c in (source, target))
        of_source = f + networks.transformer(f, source.mask, g, target.mask)
        return of_source, g + networks.transformer(g, target.mask, f, source.mask)

    of_source, of_target = both(exact_variables(), cloud(xyz), cloud(target_xyz))
    scores = np.asarray(of_source) @ np.asarray(of_target).T / np.sqrt(MODEL.width)
    pointer = scipy.special.softmax(scores, axis=1)
    (found,) = run(exact_variables(), source, target)
    rows, columns = source.mask, target.mask
    np.testing.assert_allclose(found.scores[rows][:, columns], scores, atol=EXACT)
    chosen = np.exp(found.log_assignment)[rows]
    np.testing.assert_allclose(chosen[:, columns], pointer, atol=EXACT)
    np.testing.assert_array_equal(chosen[:, ~columns], 0)
    np.testing.assert_allclose(found.partners[rows], pointer @ target_xyz, atol=EXACT)
    expected = kabsch(xyz, pointer @ target_xyz)
    np.testing.assert_allclose(found.target_from_source.as_matrix(), expected, atol=1e-7)
    # a pointer in which something happens: rows differ, none is flat
    assert np.ptp(pointer, axis=0).max() > 0.1


@pytest.mark.usefixtures("double_precision")
def test_a_second_iteration_and_a_start_elsewhere_are_the_moved_source():
    xyz, target_xyz = problem()
    source, target = cloud(xyz), cloud(target_xyz)
    first, second = run(exact_variables(), source, target, iterations=2)
    pose = first.target_from_source
    moved = cloud(xyz @ np.asarray(pose.rotation).T + np.asarray(pose.translation))
    (rest,) = run(exact_variables(), moved, target)
    total = (rest.target_from_source @ pose).as_matrix()
    np.testing.assert_allclose(second.target_from_source.as_matrix(), total, atol=1e-7)
    (again,) = run(exact_variables(), source, target, jax.tree.map(np.asarray, pose))
    np.testing.assert_allclose(again.target_from_source.as_matrix(), total, atol=1e-7)
    assert np.abs(total - pose.as_matrix()).max() > 1e-3


@pytest.mark.usefixtures("double_precision")
def test_the_last_match_is_the_last_of_all():
    source, target = (cloud(points) for points in problem())
    variables, init = exact_variables(), RigidTransform(np.eye(3), np.zeros(3))
    expected = run(variables, source, target, init, 2)[-1]
    last = quick_jit(functools.partial(last_match, MODEL, iterations=2))
    assert_same(last(variables, source, target, init), expected, 1e-7)


# ---- the contract ----


@functools.cache
def jitted():
    return quick_jit(dcp(MODEL, single(exact_variables())))


def test_registration_says_what_it_rests_on():
    xyz, target_xyz = single(problem())
    source, target = cloud(xyz, N), cloud(target_xyz)
    result = jitted()(source, target, RigidTransform.identity(), jax.random.key(0))
    with jax.enable_x64(True):
        (want,) = run(exact_variables(), *(cloud(points) for points in problem()))
    want = jax.tree.map(np.asarray, want)
    moved = want.target_from_source.apply(problem()[0])
    expected = np.sqrt(np.mean(np.sum(np.square(moved - want.partners), axis=1)))
    np.testing.assert_allclose(result.rmse, expected, rtol=1e-3)  # f32 eps x condition
    assert result.overlap == 1
    assert result.converged


@pytest.mark.parametrize("case", ["no source", "no target", "not finite"])
def test_without_an_answer_the_pose_is_the_initial_one(case):
    xyz, target_xyz = single(problem())
    source, target = cloud(xyz, N), cloud(target_xyz)
    if case == "no source":
        source = source.replace(mask=np.zeros(N, bool))
    if case == "no target":
        target = target.replace(mask=np.zeros(M, bool))
    if case == "not finite":
        source = source.replace(xyz=np.full_like(xyz, np.nan))
    init = pose(0)
    result = jitted()(source, target, init, jax.random.key(0))
    assert not result.converged
    assert result.overlap == (case == "not finite")
    assert np.isfinite(result.rmse)
    assert_same(result.target_from_source, init, 0)


def padded_gradient():
    """Of a pose, for the weights and both padded clouds; and the clouds."""
    xyz, target_xyz = single(problem())
    clouds = cloud(xyz, N + 9, 0.3), cloud(target_xyz, M + 11, 0.3)
    start = RigidTransform.identity()
    return pose_gradient(lambda *pair: MODEL.apply(*pair, start, 1)[0].target_from_source), clouds


def test_gradients_reach_every_weight_and_point_but_no_padding():
    gradient, clouds = padded_gradient()
    to_variables, *to_clouds = gradient(single(exact_variables()), *clouds)
    # a constant added to every key changes no softmax
    weights = {jax.tree_util.keystr(k): w for k, w in jax.tree.leaves_with_path(to_variables)}
    unreached = {name for name, weight in weights.items() if not np.abs(weight).max() > 0}
    assert {name for name in unreached if not name.endswith("['key']['bias']")} == set()
    assert_reached_but_no_padding(to_clouds, clouds, every=True)


@pytest.mark.slow
def test_gradients_stay_finite_on_a_plane_a_line_and_a_point():
    gradient, (source, target) = padded_gradient()
    for axes in ((1, 1, 0), (1, 0, 0), (0, 0, 0)):
        flat = source.replace(xyz=source.xyz * np.float32(axes))
        slopes = gradient(single(exact_variables()), flat, target)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
