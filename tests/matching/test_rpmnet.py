"""RPM-Net: the plain form against a numpy twin and the published code, the fast form against it."""

from __future__ import annotations

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from network_clouds import assert_reached_but_no_padding, assert_same, bumpy_sphere, scattered
from published_rpmnet import state_dict
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation

from vanejax.matching import fast_rpmnet
from vanejax.matching.rpmnet import Match, RpmNet
from vanejax.matching.torch_weights import load_state_dict, rpmnet_variables
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

PARITY = Path(__file__).parents[3] / "shared" / "parity"
N, M, K = 40, 50, 5
ROWS = (N + 17, M + 30)  # with padding
EXACT = 1e-9  # f64 eps x the network's condition of about 1e5
MODEL = RpmNet(num_neighbors=K, radius=0.5, sinkhorn_iterations=3)


@functools.cache
def variables(dtype: type = np.float32) -> dict:
    return jax.tree.map(dtype, rpmnet_variables(state_dict()))


def problem() -> tuple[np.ndarray, ...]:
    return bumpy_sphere(N, M)


def cloud(xyz: np.ndarray, normals: np.ndarray, rows: int) -> PointCloud:
    """A cloud whose padding lies scattered among the real points and repeats one of them."""
    (xyz, mask), (normals, _) = (scattered(rows_of, rows, rows_of[3]) for rows_of in (xyz, normals))
    return PointCloud(xyz, normals, mask)


def clouds(dtype: type = np.float32) -> tuple[PointCloud, PointCloud]:
    xyz, normals, *target = (values.astype(dtype) for values in problem())
    return cloud(xyz, normals, ROWS[0]), cloud(*target, ROWS[1])


# ---- the plain form


def twin_mlp(x: np.ndarray, name: str, groups: list[int]) -> np.ndarray:
    """Linear, group norm over all points of the cloud, ReLU; no norm where groups is 0."""
    state = state_dict()
    for layer, count in enumerate(groups):
        weight = state[f"{name}.{3 * layer}.weight"].astype(float)
        x = x @ weight.reshape(weight.shape[:2]).T + state[f"{name}.{3 * layer}.bias"]
        if count:
            parts = np.split(x, count, axis=-1)
            parts = [(part - part.mean()) / np.sqrt(part.var() + 1e-5) for part in parts]
            norm = f"{name}.{3 * layer + 1}"
            x = np.concatenate(parts, -1) * state[f"{norm}.weight"] + state[f"{norm}.bias"]
            x = np.maximum(x, 0)
    return x


def twin_angle(a: np.ndarray, b: np.ndarray) -> float:
    length = np.linalg.norm(a) * np.linalg.norm(b)
    return np.arccos(np.clip(a @ b / length, -1, 1)) if length else 0.0


def twin_features(xyz: np.ndarray, normals: np.ndarray) -> np.ndarray:
    rows = []
    for i, (p, n) in enumerate(zip(xyz, normals, strict=True)):
        near = [j for j in range(len(xyz)) if j != i and np.linalg.norm(xyz[j] - p) <= MODEL.radius]
        row = []
        for j in (near + [i] * K)[:K]:
            offset, other = xyz[j] - p, normals[j]
            angles = (twin_angle(n, offset), twin_angle(other, offset), twin_angle(n, other))
            row.append([*p, *offset, *angles, np.linalg.norm(offset)])
        rows.append(row)
    x = twin_mlp(np.array(rows), "feat_extractor.prepool", [8, 8, 8]).max(axis=1)
    x = twin_mlp(x, "feat_extractor.postpool", [8, 8, 0])
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


@functools.cache
def twin_matches() -> list[dict]:
    """From the paper and the PyTorch layers it names: numpy float64, no padding."""
    xyz, normals, target, target_normals = problem()
    rotation, translation, results = np.eye(3), np.zeros(3), []
    for _ in range(2):
        moved = xyz @ rotation.T + translation
        flags = np.repeat([0.0, 1.0], [N, M])[:, None]
        x = np.concatenate([np.concatenate([moved, target]), flags], -1)
        x = twin_mlp(x, "weights_net.prepool", [8, 8, 8, 8, 16]).max(axis=0)
        x = twin_mlp(x[None], "weights_net.postpool", [16, 16, 0])[0]
        beta, alpha = np.log1p(np.exp(x))
        features = twin_features(moved, normals @ rotation.T), twin_features(target, target_normals)
        squared = np.sum((features[0][:, None] - features[1][None]) ** 2, -1)
        log_m = np.zeros((N + 1, M + 1))
        log_m[:-1, :-1] = -beta * (squared - alpha)
        for _ in range(MODEL.sinkhorn_iterations):
            log_m[:-1] -= scipy.special.logsumexp(log_m[:-1], axis=1, keepdims=True)
            log_m[:, :-1] -= scipy.special.logsumexp(log_m[:, :-1], axis=0, keepdims=True)
        m = np.exp(log_m[:-1, :-1])
        weights = m.sum(axis=1)
        partners = m @ target / (weights[:, None] + 1e-5)
        a, b = (np.average(points, axis=0, weights=weights) for points in (xyz, partners))
        turn, _ = Rotation.align_vectors(partners - b, xyz - a, weights=weights)
        rotation, translation = turn.as_matrix(), b - turn.as_matrix() @ a
        results.append(
            {"rotation": rotation, "translation": translation, "log_assignment": log_m[:-1, :-1]}
            | {"weights": weights, "partners": partners, "alpha": alpha, "beta": beta}
        )
    return results


def plain(variables: dict, source: PointCloud, target: PointCloud, pose: RigidTransform) -> Match:
    return MODEL.apply(variables, source, target, pose, method="match")


def fast(variables: dict, source: PointCloud, target: PointCloud, pose: RigidTransform) -> Match:
    near = fast_rpmnet.neighborhoods(MODEL, source)
    features = fast_rpmnet.features(MODEL, variables, target)
    return fast_rpmnet.match(MODEL, variables, source, near, target, features, pose)


@functools.cache
def iterations(form) -> list[tuple[Match, tuple]]:
    """In float64, two of them: the match, and the gradients for weights, source and target."""

    def total(variables, source_xyz, target_xyz, source, target, pose):
        moved, fixed = source.replace(xyz=source_xyz), target.replace(xyz=target_xyz)
        match = form(variables, moved, fixed, pose)
        pose = jnp.sum(match.target_from_source.as_matrix() ** 3)
        return pose + jnp.sum(jnp.exp(match.log_assignment) ** 2), match

    # XLA without optimisation loses gradients of `jnp.max`, which the fast form does without
    jit = quick_jit if form is fast else jax.jit
    with jax.enable_x64(True):
        step = jit(jax.grad(total, (0, 1, 2), has_aux=True))
        source, target = clouds(np.float64)
        pose, results = RigidTransform.identity(dtype=np.float64), []
        for _ in range(2):
            gradient, match = step(
                variables(np.float64), source.xyz, target.xyz, source, target, pose
            )
            results.append(jax.tree.map(np.asarray, (match, gradient)))
            pose = results[-1][0].target_from_source
    return results


def test_the_plain_form_is_the_numpy_twin():
    """Padded, while the twin knows no padding: padding changes nothing."""
    rows, columns = (points.mask for points in clouds())
    for (match, _), expected in zip(iterations(plain), twin_matches(), strict=True):
        log_assignment = match.log_assignment[rows][:, columns]
        np.testing.assert_allclose(log_assignment, expected["log_assignment"], atol=100 * EXACT)
        found = match.target_from_source._asdict() | {
            "weights": match.weights[rows],
            "partners": match.partners[rows],
            "alpha": match.alpha,
            "beta": match.beta,
        }
        for name, value in found.items():
            np.testing.assert_allclose(value, expected[name], atol=EXACT, rtol=EXACT, err_msg=name)
        np.testing.assert_array_equal(match.weights[~rows], 0)
    # the problem is one in which something happens: some points match, some go to the slack
    first, second = twin_matches()
    assert np.ptp(first["weights"]) > 0.5
    assert np.abs(second["rotation"] - first["rotation"]).max() > 1e-3


def test_the_fast_form_is_the_plain_one():
    """Outputs of every iteration and gradients, in float64, padding masked."""
    rows, columns = (points.mask for points in clouds())
    for (match, slopes), (plain_match, plain_slopes) in zip(
        iterations(fast), iterations(plain), strict=True
    ):
        log_assignment, expected = (
            m.log_assignment[rows][:, columns] for m in (match, plain_match)
        )
        np.testing.assert_allclose(log_assignment, expected, atol=100 * EXACT)  # of about 100
        found, expected = (
            (m.target_from_source, m.partners[rows], m.weights, m.alpha, m.beta)
            for m in (match, plain_match)
        )
        assert_same(found, expected, EXACT)
        assert_same(slopes, plain_slopes, 10 * EXACT)  # of up to 10
        to_weights, *to_clouds = slopes
        assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(to_weights))
        assert_reached_but_no_padding(to_clouds, clouds(), every=True)


def test_a_call_gives_all_iterations():
    with jax.enable_x64(True):
        init = RigidTransform.identity(dtype=np.float64)
        call = quick_jit(MODEL.apply, static_argnums=4)
        found = call(variables(np.float64), *clouds(np.float64), init, 2)
    for match, (expected, _) in zip(found, iterations(plain), strict=True):
        assert_same(match, expected, 100 * EXACT)


def test_both_forms_have_the_published_parameters():
    source, target = clouds()
    init = jax.random.key(0), source, target, RigidTransform.identity()
    made = jax.eval_shape(lambda *args: RpmNet().init(*args, 1), *init)
    assert sum(leaf.size for leaf in jax.tree.leaves(made)) == 905_154
    assert jax.tree.map(np.shape, variables()) == jax.tree.map(lambda leaf: leaf.shape, made)
    # flax refuses parameters of another shape, in the fast form too
    jax.eval_shape(fast, made, source, target, RigidTransform.identity())


@pytest.mark.skipif(
    not (PARITY / "rpmnet_io.npz").exists(), reason="needs ../shared/parity/rpmnet_*.npz"
)
@pytest.mark.parametrize(
    ("form", "pairs"),
    [("fast", (0,)), pytest.param("fast", (1, 2), marks=pytest.mark.slow),
     pytest.param("plain", (0,), marks=pytest.mark.slow)],
)  # fmt: skip
def test_parity_with_the_published_code(form, pairs):
    with np.load(PARITY / "rpmnet_io.npz") as file:
        io = dict(file)
    model = RpmNet(
        num_neighbors=int(io["num_neighbors"]),
        radius=float(io["radius"]),
        sinkhorn_iterations=int(io["num_sinkhorn_iterations"]),
    )
    weights = rpmnet_variables(load_state_dict(PARITY / "rpmnet_weights.npz"))

    @jax.jit
    def step(source, near, target, features, pose):
        if form == "plain":
            return model.apply(weights, source, target, pose, method="match")
        return fast_rpmnet.match(model, weights, source, near, target, features, pose)

    @jax.jit
    def of_cloud(points):
        features = fast_rpmnet.features(model, weights, points)
        return fast_rpmnet.neighborhoods(model, points), features

    for pair in pairs:
        source, target = (
            PointCloud(p[:, :3], p[:, 3:], np.ones(len(p), bool))
            for p in (io["points_src"][pair], io["points_ref"][pair])
        )
        (near, source_features), (_, features) = of_cloud(source), of_cloud(target)
        pose = RigidTransform.identity()
        for index in range(5):
            match = step(source, near, target, features, pose)
            pose = match.target_from_source
            expected = io["transforms"][index, pair]
            np.testing.assert_allclose(pose.as_matrix()[:3], expected, atol=1e-4)
            np.testing.assert_allclose(match.alpha, io["alpha"][index, pair], rtol=1e-3)
            np.testing.assert_allclose(match.beta, io["beta"][index, pair], rtol=1e-4)
            for axis, name in ((1, "src_weights"), (0, "ref_weights")):
                sums = np.exp(match.log_assignment).sum(axis)
                # of the one point that has a neighbour on the rim of the ball; see below
                np.testing.assert_allclose(sums, io[name][index, pair], atol=4e-3)
            if index == 0:
                np.testing.assert_allclose(match.partners, io["weighted_ref_0"][pair], atol=2e-3)
        for name, found in (("feat_ref", features), ("feat_src_0", source_features)):
            # one neighbour on the rim of the ball, in by one rounding and out by another, moves
            # the features of its point; all others agree to f32 eps x 100
            gap = np.abs(found - io[name][pair]).max(axis=1)
            assert np.mean(gap > 2e-5) < 0.01
            assert gap.max() < 0.05


# ---- the method


def test_registration_says_what_it_rests_on():
    register = quick_jit(fast_rpmnet.rpmnet(MODEL, variables(), iterations=1))
    result = register(*clouds(), RigidTransform.identity(), jax.random.key(0))
    expected = twin_matches()[0]
    moved = problem()[0] @ expected["rotation"].T + expected["translation"]
    squared = np.sum((moved - expected["partners"]) ** 2, -1)
    rmse = np.sqrt(np.average(squared, weights=expected["weights"]))
    np.testing.assert_allclose(result.rmse, rmse, rtol=1e-3)  # f32 eps x condition
    np.testing.assert_allclose(result.overlap, expected["weights"].mean(), rtol=1e-3)
    assert result.converged
    assert result.iterations == 1


def test_the_last_match_is_the_last_of_all_and_shares_what_it_is_given():
    source, target = clouds()

    @quick_jit
    def last(variables, source, target):
        near = fast_rpmnet.neighborhoods(MODEL, source)
        features = fast_rpmnet.features(MODEL, variables, target)
        shared = {"near": near, "target_features": features, "iterations": 2}
        init = RigidTransform.identity()
        return fast_rpmnet.last_match(MODEL, variables, source, target, init, **shared)

    found = last(variables(), source, target).target_from_source
    expected = twin_matches()[1]
    # f32 eps x the condition of 1e3
    np.testing.assert_allclose(found.rotation, expected["rotation"], atol=1e-3)
    np.testing.assert_allclose(found.translation, expected["translation"], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("axes", [(1, 1, 0), (1, 0, 0), (0, 0, 0)])
def test_gradients_stay_finite_on_a_plane_a_line_and_a_point(axes):
    source, target = jax.tree.map(jnp.asarray, clouds())
    flat = source.replace(
        xyz=source.xyz * jnp.float32(axes)[None],
        normals=jnp.broadcast_to(jnp.float32([0, 0, 1]), source.xyz.shape),
    )

    def total(variables, xyz):
        match = fast(variables, flat.replace(xyz=xyz), target, RigidTransform.identity())
        return jnp.sum(match.target_from_source.as_matrix() ** 3)

    gradient = jax.jit(jax.grad(total, (0, 1)))(variables(), flat.xyz)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
