"""RPM-Net: the published code's numbers, a slow float64 twin, padding, and the contract."""

from __future__ import annotations

import functools
import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.matching.rpmnet import RpmNet, last_match, rpmnet
from vanejax.matching.torch_weights import load_state_dict, rpmnet_variables
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

PARITY = Path(__file__).parents[3] / "shared" / "parity"
N, M, K = 40, 50, 5
EXACT = 1e-9  # f64 eps x the network's condition of about 1e5
WIDTHS = {  # name in the state dict: widths, axes of a weight before and after the pooling
    "feat_extractor": ((10, 96, 96, 192), (192, 192, 96, 96), 4, 3),
    "weights_net": ((4, 64, 64, 64, 128, 1024), (1024, 512, 256, 2), 3, 2),
}


@functools.cache
def state_dict(seed: int = 0) -> dict[str, np.ndarray]:
    """Random weights under PyTorch's names and in its shapes; gains of both signs."""
    rng = np.random.default_rng(seed)
    state = {}
    for net, (before, after, *axes) in WIDTHS.items():
        for label, widths, ndim in (("prepool", before, axes[0]), ("postpool", after, axes[1])):
            for layer, (fan_in, out) in enumerate(itertools.pairwise(widths)):
                name = f"{net}.{label}.{3 * layer}"
                weight = rng.normal(size=(out, fan_in)) / np.sqrt(fan_in)
                state[f"{name}.weight"] = weight.reshape(out, fan_in, *(1,) * (ndim - 2))
                state[f"{name}.bias"] = rng.normal(size=out, scale=0.1)
                if label == "prepool" or layer < 2:
                    norm = f"{net}.{label}.{3 * layer + 1}"
                    gain = 1 + 0.2 * rng.normal(size=out)
                    state[f"{norm}.weight"] = gain * np.where(rng.uniform(size=out) < 0.2, -1, 1)
                    state[f"{norm}.bias"] = rng.normal(size=out, scale=0.3)
    # random features lie 0.003 to 0.2 apart: beta must tell them apart, alpha lie in their midst
    state["weights_net.postpool.6.bias"] = np.array([300.0, -4.0])
    # as the importer keeps them: f32
    return {name: value.astype(np.float32) for name, value in state.items()}


@functools.cache
def random_variables() -> dict:
    return rpmnet_variables(state_dict())


@functools.cache
def exact_variables() -> dict:
    return jax.tree.map(np.float64, random_variables())


@functools.cache
def problem(seed: int = 0) -> tuple[np.ndarray, ...]:
    """Two views of a bumpy sphere: source xyz and normals [N, 3], target's [M, 3]; f64."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(N + M, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    xyz = normals * (0.6 + 0.1 * np.sin(5 * normals[:, :1]))
    turn = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    return xyz[:N] @ turn.T + [0.1, 0, -0.1], normals[:N] @ turn.T, xyz[N:], normals[N:]


def cloud(xyz: np.ndarray, normals: np.ndarray, rows: int | None = None, seed: int = 0):
    """A cloud whose padding lies scattered among the real points and repeats one of them."""
    rows = len(xyz) if rows is None else rows
    place = np.sort(np.random.default_rng(seed).permutation(rows)[: len(xyz)])
    mask = np.isin(np.arange(rows), place)
    padded = [np.repeat(values[3:4], rows, axis=0) for values in (xyz, normals)]
    for full, values in zip(padded, (xyz, normals), strict=True):
        full[place] = values
    return PointCloud(xyz=padded[0], normals=padded[1], mask=mask)


MODEL = RpmNet(num_neighbors=K, radius=0.5, sinkhorn_iterations=3)
WIDE = MODEL.clone(num_neighbors=N + M)


@functools.partial(jax.jit, static_argnames=("model", "iterations"))
def run(model, variables, source, target, iterations=2):
    return model.apply(variables, source, target, RigidTransform.identity(), iterations)


@functools.partial(jax.jit, static_argnames="model")
def features(model, variables, cloud):
    return model.apply(variables, cloud, method="features")


# ---- the slow twin: numpy float64, from the paper and the PyTorch layers it names ----


def slow_mlp(x: np.ndarray, state: dict, name: str, groups: list[int]) -> np.ndarray:
    """Linear, group norm over all points of the cloud, ReLU; no norm where groups is 0."""
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


def slow_angle(a: np.ndarray, b: np.ndarray) -> float:
    length = np.linalg.norm(a) * np.linalg.norm(b)
    return np.arccos(np.clip(a @ b / length, -1, 1)) if length else 0.0


def slow_features(xyz, normals, state, num_neighbors, radius) -> np.ndarray:
    rows = []
    for i, (point, normal) in enumerate(zip(xyz, normals, strict=True)):
        near = [j for j in range(len(xyz)) if j != i and np.linalg.norm(xyz[j] - point) <= radius]
        row = []
        for j in (near + [i] * num_neighbors)[:num_neighbors]:
            offset = xyz[j] - point
            angles = [
                slow_angle(normal, offset),
                slow_angle(normals[j], offset),
                slow_angle(normal, normals[j]),
            ]
            row.append([*point, *offset, *angles, np.linalg.norm(offset)])
        rows.append(row)
    x = slow_mlp(np.array(rows), state, "feat_extractor.prepool", [8, 8, 8]).max(axis=1)
    x = slow_mlp(x, state, "feat_extractor.postpool", [8, 8, 0])
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def slow_rpmnet(source, target, state, model: RpmNet, iterations: int) -> list[dict]:
    (xyz, normals), (target_xyz, target_normals) = source, target
    args = (state, model.num_neighbors, model.radius)
    target_features = slow_features(target_xyz, target_normals, *args)
    rotation, translation, results = np.eye(3), np.zeros(3), []
    for _ in range(iterations):
        moved = xyz @ rotation.T + translation
        found = slow_features(moved, normals @ rotation.T, *args)
        flags = np.repeat([0.0, 1.0], [len(xyz), len(target_xyz)])[:, None]
        x = np.concatenate([np.concatenate([moved, target_xyz]), flags], -1)
        x = slow_mlp(x, state, "weights_net.prepool", [8, 8, 8, 8, 16]).max(axis=0)
        x = slow_mlp(x[None], state, "weights_net.postpool", [16, 16, 0])[0]
        beta, alpha = np.log1p(np.exp(x))
        squared = np.sum((found[:, None] - target_features[None]) ** 2, -1)
        log_p = np.zeros((len(xyz) + 1, len(target_xyz) + 1))
        log_p[:-1, :-1] = -beta * (squared - alpha)
        for _ in range(model.sinkhorn_iterations):
            log_p[:-1] -= scipy.special.logsumexp(log_p[:-1], axis=1, keepdims=True)
            log_p[:, :-1] -= scipy.special.logsumexp(log_p[:, :-1], axis=0, keepdims=True)
        p = np.exp(log_p[:-1, :-1])
        weights = p.sum(axis=1)
        partners = p @ target_xyz / (weights[:, None] + 1e-5)
        a, b = (np.average(points, axis=0, weights=weights) for points in (xyz, partners))
        turn, _ = Rotation.align_vectors(partners - b, xyz - a, weights=weights)
        rotation, translation = turn.as_matrix(), b - turn.as_matrix() @ a
        results.append(
            {"rotation": rotation, "translation": translation, "log_assignment": log_p[:-1, :-1]}
            | {"weights": weights, "partners": partners, "alpha": alpha, "beta": beta}
        )
    return results


@functools.cache
def slow_answer(iterations: int = 2) -> list[dict]:
    xyz, normals, target_xyz, target_normals = problem()
    target = (target_xyz, target_normals)
    return slow_rpmnet((xyz, normals), target, state_dict(), MODEL, iterations)


def assert_matches(found, expected: list[dict], rows=slice(None), columns=slice(None)) -> None:
    for match, want in zip(found, expected, strict=True):
        motion = match.target_from_source
        np.testing.assert_allclose(motion.rotation, want["rotation"], atol=EXACT)
        np.testing.assert_allclose(motion.translation, want["translation"], atol=EXACT)
        np.testing.assert_allclose(match.weights[rows], want["weights"], atol=EXACT)
        np.testing.assert_allclose(match.partners[rows], want["partners"], atol=EXACT)
        log_assignment = match.log_assignment[rows][:, columns]
        np.testing.assert_allclose(log_assignment, want["log_assignment"], atol=100 * EXACT)
        np.testing.assert_allclose((match.alpha, match.beta), (want["alpha"], want["beta"]), EXACT)


@pytest.fixture
def _double():
    with jax.enable_x64(True):
        yield


@pytest.mark.usefixtures("_double")
def test_it_is_the_slow_twin_on_other_inputs_and_another_k():
    """Padded, while the twin knows no padding: any amount of it changes nothing."""
    xyz, normals, target_xyz, target_normals = problem()
    source = cloud(xyz, normals, N + 17, seed=1)
    target = cloud(target_xyz, target_normals, M + 30, seed=2)
    found = run(MODEL, exact_variables(), source, target)
    assert_matches(found, slow_answer(), source.mask, target.mask)
    for match in found:
        np.testing.assert_array_equal(match.weights[~source.mask], 0)
    # the problem is one in which something happens: some points match, some go to the slack
    assert np.ptp(slow_answer()[0]["weights"]) > 0.5
    gap = found[1].target_from_source.as_matrix() - found[0].target_from_source.as_matrix()
    assert np.abs(gap).max() > 1e-3


@pytest.mark.usefixtures("_double")
def test_order_of_points_does_not_matter_where_every_neighbour_fits():
    """With K >= N; below it, the first K by index are other points after a permutation."""
    xyz, normals, target_xyz, target_normals = problem()
    rng = np.random.default_rng(0)
    rows, columns = rng.permutation(N), rng.permutation(M)
    variables = exact_variables()
    plain = run(WIDE, variables, cloud(xyz, normals), cloud(target_xyz, target_normals), 1)
    mixed = run(
        WIDE,
        variables,
        cloud(xyz[rows], normals[rows]),
        cloud(target_xyz[columns], target_normals[columns]),
        1,
    )
    expected = [
        {
            "rotation": match.target_from_source.rotation,
            "translation": match.target_from_source.translation,
            "weights": match.weights[rows],
            "partners": match.partners[rows],
            "log_assignment": match.log_assignment[rows][:, columns],
            "alpha": match.alpha,
            "beta": match.beta,
        }
        for match in plain
    ]
    assert_matches(mixed, expected)


@pytest.mark.usefixtures("_double")
def test_shared_reference_features_and_a_start_elsewhere():
    xyz, normals, target_xyz, target_normals = problem()
    source, target = cloud(xyz, normals), cloud(target_xyz, target_normals)
    shared = features(MODEL, exact_variables(), target)
    expected = slow_features(target_xyz, target_normals, state_dict(), K, MODEL.radius)
    np.testing.assert_allclose(shared, expected, atol=EXACT)
    # started at the first iteration's pose, the first iteration is the second of the other run
    first = jax.tree.map(np.asarray, slow_answer()[0])
    start = RigidTransform(first["rotation"], first["translation"])
    resume = jax.jit(functools.partial(MODEL.apply, exact_variables()), static_argnums=3)
    assert_matches(resume(source, target, start, 1, shared), slow_answer()[1:])


def test_the_last_match_is_the_last_of_all():
    xyz, normals, target_xyz, target_normals = single(*problem())
    source, target = cloud(xyz, normals, N + 5), cloud(target_xyz, target_normals)
    variables, init = random_variables(), RigidTransform.identity()
    expected = run(MODEL, variables, source, target, 3)[-1]
    last = jax.jit(functools.partial(last_match, MODEL, iterations=3))
    found = last(variables, source, target, init)
    shared = last(
        variables,
        source,
        target,
        init,
        near=jax.jit(functools.partial(MODEL.apply, method="neighborhoods"))(variables, source),
        target_features=features(MODEL, variables, target),
    )
    for match in (found, shared):
        for a, b in zip(jax.tree.leaves(match), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3)  # f32 eps x the condition


# ---- the contract ----

REGISTER = rpmnet(MODEL, random_variables(), iterations=1)
jitted = jax.jit(REGISTER)


def single(*arrays: np.ndarray) -> list[np.ndarray]:
    return [array.astype(np.float32) for array in arrays]


def starts(count: int) -> RigidTransform:
    rng = np.random.default_rng(0)
    rotation = Rotation.random(count, rng=rng).as_matrix().astype(np.float32)
    return RigidTransform(rotation, rng.normal(size=(count, 3), scale=0.1).astype(np.float32))


def test_register_under_vmap_is_the_loop():
    xyz, normals, target_xyz, target_normals = single(*problem())
    sizes = (N, N - 7, 12)
    sources = [cloud(xyz[:size], normals[:size], N) for size in sizes]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *sources)
    target = cloud(target_xyz, target_normals)
    inits, keys = starts(3), jax.random.split(jax.random.key(0), 3)
    batched = jax.jit(jax.vmap(REGISTER, in_axes=(0, None, 0, 0)))(batch, target, inits, keys)
    for index in range(3):
        init = jax.tree.map(lambda leaf, index=index: leaf[index], inits)
        one = jitted(sources[index], target, init, keys[index])
        assert one.converged.shape == one.rmse.shape == one.overlap.shape == ()
        assert one.iterations == 1
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(batched), strict=True):
            np.testing.assert_allclose(a, b[index], atol=1e-4)  # f32 eps x the condition of 1e3


def test_registration_says_what_it_rests_on():
    xyz, normals, target_xyz, target_normals = single(*problem())
    source, target = cloud(xyz, normals), cloud(target_xyz, target_normals)
    init, key = RigidTransform.identity(), jax.random.key(0)
    result = jitted(source, target, init, key)
    want = slow_answer()[0]
    moved = problem()[0] @ want["rotation"].T + want["translation"]
    squared = np.sum((moved - want["partners"]) ** 2, -1)
    expected = np.sqrt(np.average(squared, weights=want["weights"]))
    np.testing.assert_allclose(result.rmse, expected, rtol=1e-3)  # f32 eps x condition
    np.testing.assert_allclose(result.overlap, want["weights"].mean(), rtol=1e-3)
    assert result.converged


@pytest.mark.parametrize("case", ["no source", "no target", "nothing", "one point", "coincident"])
def test_degenerate_clouds_give_an_answer_without_nan(case):
    xyz, normals, target_xyz, target_normals = single(*problem())
    source, target = cloud(xyz, normals), cloud(target_xyz, target_normals)
    if case in ("no source", "nothing"):
        source = source.replace(mask=np.zeros(N, bool))
    if case in ("no target", "nothing"):
        target = target.replace(mask=np.zeros(M, bool))
    if case == "one point":
        source = source.replace(mask=np.arange(N) == 3)
    if case == "coincident":
        source = source.replace(xyz=0 * xyz)
    result = jitted(source, target, RigidTransform.identity(), jax.random.key(0))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))
    rotation = result.target_from_source.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=2e-6)  # f32 eps x 20
    if case.startswith("no"):
        assert not result.converged
        assert result.overlap == 0


@functools.cache
def padded_gradient():
    """Gradients of a pose for the weights and both clouds; one iteration: the next is detached."""
    xyz, normals, target_xyz, target_normals = single(*problem())
    source = cloud(xyz, normals, N + 17, seed=1)
    target = cloud(target_xyz, target_normals, M + 30, seed=2)

    @jax.jit
    def gradient(variables, source, target):
        def total(variables, source_xyz, target_xyz):
            moved, fixed = source.replace(xyz=source_xyz), target.replace(xyz=target_xyz)
            matches = run(MODEL, variables, moved, fixed, 1)
            return jnp.sum(matches[-1].target_from_source.as_matrix() ** 3)

        return jax.grad(total, (0, 1, 2))(variables, source.xyz, target.xyz)

    return gradient, source, target


def test_gradients_reach_every_weight_and_point_but_no_padding():
    gradient, source, target = padded_gradient()
    to_variables, *to_clouds = gradient(random_variables(), source, target)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(to_variables))
    for found, mask in zip(to_clouds, (source.mask, target.mask), strict=True):
        np.testing.assert_array_equal(found[~mask], 0)
        assert np.abs(found[mask]).max(axis=1).min() > 0


@pytest.mark.parametrize("axes", [(1, 1, 0), (1, 0, 0), (0, 0, 0)])
def test_gradients_stay_finite_on_a_plane_a_line_and_a_point(axes):
    gradient, source, target = padded_gradient()
    flat = source.replace(
        xyz=source.xyz * np.float32(axes),
        normals=np.broadcast_to(np.float32([0, 0, 1]), source.xyz.shape),
    )
    found = gradient(random_variables(), flat, target)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


# ---- import, and parity with the published code ----


def test_it_has_the_published_number_of_parameters():
    xyz, normals, *_ = single(*problem())
    points = cloud(xyz, normals)
    made = jax.eval_shape(
        lambda *args: RpmNet().init(*args, 1),
        jax.random.key(0),
        points,
        points,
        RigidTransform.identity(),
    )
    assert sum(leaf.size for leaf in jax.tree.leaves(made)) == 905_154
    imported = random_variables()
    assert jax.tree.structure(imported) == jax.tree.structure(made)
    assert jax.tree.map(np.shape, imported) == jax.tree.map(lambda leaf: leaf.shape, made)
    assert {leaf.dtype for leaf in jax.tree.leaves(imported)} == {np.dtype(np.float32)}


def test_import_from_a_file(tmp_path):
    np.savez(tmp_path / "weights.npz", **state_dict())
    variables = rpmnet_variables(load_state_dict(tmp_path / "weights.npz"))
    jax.tree.map(np.testing.assert_array_equal, variables, random_variables())


BIAS = "feat_extractor.prepool.3.bias"
KERNEL = "feat_extractor.prepool.3.weight"
FIRST = "feat_extractor.prepool.0.weight"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({BIAS: None}, BIAS),
        ({"weights_net.postpool.4.weight": None}, "weights_net.postpool.4.weight"),
        ({"classifier.weight": np.zeros(3)}, "classifier.weight"),
        ({FIRST: np.zeros((10, 96, 1, 1))}, FIRST),  # transposed
        ({KERNEL: np.zeros((96, 10, 1, 1))}, KERNEL),
        ({KERNEL: np.zeros((96, 96, 3, 3))}, KERNEL),
        ({KERNEL: np.zeros(96)}, KERNEL),
        ({BIAS: np.zeros(95)}, BIAS),
        ({BIAS: np.zeros(())}, BIAS),
        ({BIAS: np.full(96, np.nan)}, BIAS),
    ],
)
def test_import_refuses_another_model_and_names_what_differs(changes, words):
    state = {name: value for name, value in (state_dict() | changes).items() if value is not None}
    with pytest.raises(InputError, match=words.replace(".", r"\.")):
        rpmnet_variables(state)


needs_parity = pytest.mark.skipif(
    not (PARITY / "rpmnet_io.npz").exists(), reason="needs ../shared/parity/rpmnet_*.npz"
)


@functools.cache
def published() -> tuple[dict[str, np.ndarray], RpmNet, dict]:
    with np.load(PARITY / "rpmnet_io.npz") as file:
        io = dict(file)
    model = RpmNet(
        num_neighbors=int(io["num_neighbors"]),
        radius=float(io["radius"]),
        sinkhorn_iterations=int(io["num_sinkhorn_iterations"]),
    )
    return io, model, rpmnet_variables(load_state_dict(PARITY / "rpmnet_weights.npz"))


@needs_parity
@pytest.mark.parametrize("pair", range(3))
def test_parity_with_the_published_code(pair):
    io, model, variables = published()
    source, target = (
        cloud(points[:, :3], points[:, 3:])
        for points in (io["points_src"][pair], io["points_ref"][pair])
    )
    matches = run(model, variables, source, target, iterations=5)
    for step, match in enumerate(matches):
        found = match.target_from_source.as_matrix()[:3]
        np.testing.assert_allclose(found, io["transforms"][step, pair], atol=1e-4)
        np.testing.assert_allclose(match.alpha, io["alpha"][step, pair], rtol=1e-3)
        np.testing.assert_allclose(match.beta, io["beta"][step, pair], rtol=1e-4)
        for axis, name in ((1, "src_weights"), (0, "ref_weights")):
            sums = np.exp(match.log_assignment).sum(axis)
            # of the one point that has a neighbour on the rim of the ball; see below
            np.testing.assert_allclose(sums, io[name][step, pair], atol=4e-3)
    partners = io["weighted_ref_0"][pair]
    np.testing.assert_allclose(matches[0].partners, partners, atol=2e-3)
    for name, points in (("feat_ref", target), ("feat_src_0", source)):
        found = features(model, variables, points)
        # one neighbour on the rim of the ball, in by one rounding and out by another, moves
        # the features of its point; all others agree to f32 eps x 100
        gap = np.abs(found - io[name][pair]).max(axis=1)
        assert np.mean(gap > 2e-5) < 0.01
        assert gap.max() < 0.05
