"""SAC-IA: its matches and triangles against slow loops, laws of the answer, degenerate clouds."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vanejax.matching.baselines.feature_matches import (
    Matches,
    draw_triangles,
    feature_distances,
    nearest_matches,
)
from vanejax.matching.baselines.sac_ia import sac_ia
from vanejax.matching.se3 import rotation_angle
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

N, M = 220, 320
SETTINGS = {"feature_radius": 0.35, "max_distance": 0.12, "num_hypotheses": 5000}
REGISTER = jax.jit(sac_ia(**SETTINGS, num_scored=48, num_refined=4))
KEY = jax.random.key(0)


@jax.jit
def lumps(directions: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Points and outward normals of a body without symmetry in these directions, [K, 3] each."""

    def level(point: jax.Array) -> jax.Array:
        x, y, z = point / jnp.linalg.norm(point)
        bumps = 0.2 * jnp.sin(4 * x + 1) + 0.15 * jnp.cos(5 * y) * z + 0.1 * jnp.sin(6 * z + 2 * y)
        return jnp.linalg.norm(point) - 0.6 - bumps

    radius = -jax.vmap(level)(directions) + 1.0
    xyz = radius[:, None] * directions
    normals = jax.vmap(jax.grad(level))(xyz)
    return xyz, normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)


def motion(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng).as_matrix().astype(np.float32)
    return RigidTransform(rotation, rng.normal(size=3).astype(np.float32))


@functools.cache
def problem() -> tuple[PointCloud, PointCloud, RigidTransform]:
    """One side of the body, moved by any motion, all of it, and target_from_source."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(2 * N + M, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    side = directions[M:][np.argsort(directions[M:] @ np.float32([0.6, 0.0, -0.8]))[-N:]]
    target = PointCloud.create(*lumps(directions[:M]))
    source_from_target = motion(2)
    source = PointCloud.create(*lumps(rng.permutation(side))).transform(source_from_target)
    return *jax.tree.map(np.asarray, (source, target)), source_from_target.inverse()


@functools.cache
def answer():
    source, target, _ = problem()
    return REGISTER(source, target, RigidTransform.identity(), KEY)


def apart(a: RigidTransform, b: RigidTransform, center: np.ndarray) -> tuple[float, float]:
    """Degrees between two motions, and how far apart they carry a point."""
    turn = np.rad2deg(rotation_angle((a @ b.inverse()).rotation))
    return float(turn), float(np.linalg.norm(a.apply(center[None]) - b.apply(center[None])))


def assert_same(a: RigidTransform, b: RigidTransform, deg: float, shift: float) -> None:
    turn, moved = apart(a, b, problem()[0].xyz.mean(axis=0))
    assert turn < deg
    assert moved < shift


# ---- the answer ----


def test_it_finds_a_part_of_the_body_from_any_pose():
    source, target, truth = problem()
    found = answer()
    # two samplings of a smooth body, 0.1 between the points: their faceting is below a degree
    assert_same(found.target_from_source, truth, deg=1.5, shift=0.02)
    assert found.converged
    assert found.overlap > 0.8
    moved = found.target_from_source.apply(source.xyz)
    nearest = np.linalg.norm(moved[:, None] - target.xyz[None], axis=-1).min(axis=1)
    assert abs(float(found.rmse) - np.sqrt(np.mean(nearest**2))) < 0.01


def test_refinement_improves_on_the_best_triple():
    source, target, truth = problem()
    coarse = jax.jit(sac_ia(**SETTINGS, num_scored=48, num_refined=4, refinements=0))
    rough = coarse(source, target, RigidTransform.identity(), KEY)
    assert rough.iterations == 0
    center = source.xyz.mean(axis=0)
    before, _ = apart(rough.target_from_source, truth, center)
    after, _ = apart(answer().target_from_source, truth, center)
    assert after < 0.7 * before < 15


def test_the_guess_does_not_matter_where_something_is_found():
    source, target, _ = problem()
    elsewhere = REGISTER(source, target, motion(5), KEY)
    jax.tree.map(np.testing.assert_array_equal, elsewhere, answer())


def test_moving_both_clouds_conjugates_the_answer():
    source, target, _ = problem()
    a, b = motion(7), motion(8)
    moved = REGISTER(source.transform(a), target.transform(b), RigidTransform.identity(), KEY)
    # rounding puts a few pairs into other bins, so that other triples win; the minimum is the same
    found = b.inverse() @ moved.target_from_source @ a
    assert_same(found, answer().target_from_source, deg=0.2, shift=0.003)


@functools.cache
def padded() -> list[PointCloud]:
    """Both clouds in another order, with rows of no meaning among the real ones."""
    rng = np.random.default_rng(3)
    clouds = []
    for cloud in problem()[:2]:
        rows = rng.permutation(np.resize(np.arange(len(cloud.xyz)), M + 60))
        mask = np.isin(np.arange(M + 60), np.unique(rows, return_index=True)[1])
        # near the surface, where it would count if it could
        shell = cloud.xyz[rows] + np.float32(0.03) * cloud.normals[rows]
        xyz = np.where(mask[:, None], cloud.xyz[rows], shell)
        clouds.append(PointCloud(xyz, cloud.normals[rows], mask))
    return clouds


def test_order_and_padding_do_not_matter():
    found = REGISTER(*padded(), RigidTransform.identity(), KEY)
    # other triples are drawn; their refinement ends in the same minimum
    assert_same(found.target_from_source, answer().target_from_source, deg=0.2, shift=0.003)
    np.testing.assert_allclose(found.overlap, answer().overlap, atol=0.02)


def test_swapping_the_clouds_gives_the_inverse():
    source, target = padded()
    found = REGISTER(target, source, RigidTransform.identity(), KEY)
    # the whole onto a part: what the part lacks finds no partner, but for its rim
    assert_same(found.target_from_source.inverse(), problem()[2], deg=3.0, shift=0.04)
    assert found.overlap < 0.8


def test_vmap_is_the_loop():
    source, target, _ = problem()
    keys = jax.random.split(KEY, 2)
    batched = jax.jit(jax.vmap(REGISTER, in_axes=(None, None, None, 0)))(
        source, target, RigidTransform.identity(), keys
    )
    one = REGISTER(source, target, RigidTransform.identity(), keys[1])
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(batched), strict=True):
        np.testing.assert_allclose(a, b[1], atol=2e-3)  # as above: rounding, then the same minimum


@pytest.mark.parametrize(
    "case", ["no source", "no target", "nothing", "one point", "coincident", "line", "plane"]
)
def test_degenerate_clouds_give_an_answer_without_nan(case):
    source, target, _ = problem()
    if case in ("no source", "nothing"):
        source = source.replace(mask=np.zeros(N, bool))
    if case in ("no target", "nothing"):
        target = target.replace(mask=np.zeros(M, bool))
    if case == "one point":
        source = source.replace(mask=np.arange(N) == 3)
    up = np.float32([0, 0, 1])
    if case in ("coincident", "line", "plane"):
        axes = {"coincident": 0 * up, "line": up[::-1], "plane": 1 - up}[case]
        source, target = (
            cloud.replace(xyz=cloud.xyz * axes, normals=np.broadcast_to(up, cloud.xyz.shape))
            for cloud in (source, target)
        )
    init = motion(4)
    found = REGISTER(source, target, init, KEY)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    rotation = found.target_from_source.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=2e-6)  # f32 eps x 20
    if case != "plane":  # on which any slide fits
        assert not found.converged
        jax.tree.map(np.testing.assert_array_equal, found.target_from_source, init)


# ---- matches and triangles ----


def slow_matches(distances: np.ndarray, k: int, mutual: bool) -> set[tuple[int, int]]:
    rows = np.argsort(distances, axis=1)[:, :k]
    columns = np.argsort(distances, axis=0)[:k].T
    pairs = {(i, j) for i, row in enumerate(rows) for j in row if distances[i, j] < 1e8}
    return {(i, j) for i, j in pairs if not mutual or i in columns[j]}


@pytest.mark.parametrize("mutual", [False, True])
@pytest.mark.parametrize("k", [1, 4, 50])
def test_matches_are_those_of_the_slow_loop(k, mutual):
    rng = np.random.default_rng(0)
    source, target = (rng.gamma(1.0, size=(rows, 33)).astype(np.float32) for rows in (30, 20))
    masks = [np.arange(30) % 7 != 0, np.arange(20) % 5 != 0]
    distances = feature_distances(source, target, *masks)
    expected = np.sum((np.sqrt(source)[:, None] - np.sqrt(target)[None]) ** 2, -1)
    real = masks[0][:, None] & masks[1][None]
    np.testing.assert_allclose(distances[real], expected[real], rtol=1e-5)  # f32 eps x 33 terms
    found = nearest_matches(distances, num_candidates=k, mutual=mutual)
    rows = np.stack([found.source, found.target], 1)[np.asarray(found.mask)]
    assert {tuple(row) for row in rows.tolist()} == slow_matches(np.asarray(distances), k, mutual)


def slow_agrees(a, a_normals, b, b_normals, similarity, min_edge, max_angle) -> bool:
    for i, j in ((0, 1), (0, 2), (1, 2)):
        lengths = np.linalg.norm(a[i] - a[j]), np.linalg.norm(b[i] - b[j])
        if min(lengths) < similarity * max(lengths) or min(lengths) <= min_edge:
            return False

    def frame(corners: np.ndarray) -> np.ndarray:
        x, along = corners[1] - corners[0], corners[2] - corners[0]
        z = np.cross(x, along)
        axes = [x, np.cross(z, x), z]
        return np.stack([axis / np.linalg.norm(axis) for axis in axes], 1)

    turn = frame(b) @ frame(a).T
    return bool((np.sum((a_normals @ turn.T) * b_normals, -1) >= np.cos(max_angle)).all())


def test_triangles_are_judged_as_by_the_slow_loop():
    source, target, truth = problem()
    nearest = np.linalg.norm(truth.apply(source.xyz)[:, None] - target.xyz[None], axis=-1).argmin(
        axis=1
    )
    rng = np.random.default_rng(0)
    wrong = rng.uniform(size=N) < 0.3
    partner = np.where(wrong, rng.integers(0, M, N), nearest).astype(np.int32)
    mask = rng.uniform(size=N) < 0.8
    matches = Matches(np.arange(N, dtype=np.int32), partner, mask)
    found = draw_triangles(
        KEY,
        jax.tree.map(jnp.asarray, matches),
        *jax.tree.map(jnp.asarray, (source, target)),
        count=2000,
        edge_similarity=0.85,
        min_edge=0.1,
        max_normal_angle=0.6,
    )
    assert mask[found.rows].all()
    used = np.unique(found.rows)
    assert len(used) > 0.95 * mask.sum()  # 6000 draws reach all of 176
    expected = [
        slow_agrees(
            source.xyz[rows], source.normals[rows],
            target.xyz[partner[rows]], target.normals[partner[rows]], 0.85, 0.1, 0.6,
        )
        for rows in np.asarray(found.rows)
        if len(set(rows.tolist())) == 3
    ]  # fmt: skip
    distinct = np.array([len(set(rows)) == 3 for rows in np.asarray(found.rows).tolist()])
    assert not np.asarray(found.agrees)[~distinct].any()
    # an edge or a normal on the limit falls to either side by rounding
    assert np.mean(np.asarray(found.agrees)[distinct] != expected) < 1e-3
    assert 0.05 < np.mean(expected) < 0.95


def test_a_mirrored_cloud_has_no_congruent_triangles():
    _, target, _ = problem()
    mirror = np.float32([-1, 1, 1])
    mirrored = target.replace(xyz=target.xyz * mirror, normals=target.normals * mirror)
    every = np.arange(M, dtype=np.int32)
    matches = jax.tree.map(jnp.asarray, Matches(every, every, np.ones(M, bool)))
    clouds = jax.tree.map(jnp.asarray, (target, mirrored))
    settings = {"count": 2000, "edge_similarity": 0.9, "min_edge": 0.3, "max_normal_angle": 0.3}
    own = draw_triangles(KEY, matches, clouds[0], clouds[0], **settings)
    other = draw_triangles(KEY, matches, *clouds, **settings)
    assert np.mean(own.agrees) > 0.5
    # only those seen along their plane's normal look the same from both sides
    assert np.mean(other.agrees) < 0.1 * np.mean(own.agrees)
