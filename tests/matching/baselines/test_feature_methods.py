"""SAC-IA and FGR: their matches and triangles against slow loops, and what refinement adds.

What both promise as methods is asked in `test_contract`.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick_jit import quick_jit
from registration_contract import NUM_SOURCE, NUM_TARGET, clouds
from scipy.spatial.transform import Rotation

from vanejax.matching.baselines.feature_matches import (
    Matches,
    draw_triangles,
    feature_distances,
    nearest_matches,
)
from vanejax.matching.baselines.fgr import fgr
from vanejax.matching.baselines.sac_ia import sac_ia
from vanejax.matching.metrics import rotation_error_deg
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

KEY = jax.random.key(0)
SAC_IA = {"feature_radius": 0.5, "max_distance": 0.1, "num_hypotheses": 4000}
FGR = {"feature_radius": 0.5, "max_distance": 0.05, "num_trials": 20_000}


@functools.cache
def problem() -> tuple[PointCloud, PointCloud, RigidTransform]:
    """Noisy points of one side of the vane, turned by any angle, and target_from_source."""
    source, target = clouds()
    rng = np.random.default_rng(1)
    noise = jnp.asarray(rng.normal(size=source.xyz.shape, scale=0.01), jnp.float32)
    rotation = Rotation.random(rng=rng).as_matrix().astype(np.float32)
    motion = RigidTransform(rotation, rng.normal(size=3).astype(np.float32))
    return source.replace(xyz=source.xyz + noise).transform(motion), target, motion.inverse()


def error_deg(register) -> float:
    source, target, truth = problem()
    result = quick_jit(register)(source, target, RigidTransform.identity(), KEY)
    return float(rotation_error_deg(result.target_from_source, truth))


@pytest.mark.slow
def test_refinement_improves_on_the_best_triple() -> None:
    rough, refined = (error_deg(sac_ia(**SAC_IA, refinements=count)) for count in (0, 10))
    assert refined < 0.7 * rough < 15


@pytest.mark.slow
def test_the_kernel_narrows_to_the_last_width() -> None:
    """Without graduation, the wide kernel of the start, the outliers pull the answer away."""
    everything = {"tuple_similarity": 0.0, "max_normal_angle": 3.2}
    wide = error_deg(fgr(**FGR, **everything, division=1.0))
    narrow = error_deg(fgr(**FGR, **everything))
    assert narrow < 0.3 * wide


def slow_matches(distances: np.ndarray, k: int, mutual: bool) -> set[tuple[int, int]]:
    rows = np.argsort(distances, axis=1)[:, :k]
    columns = np.argsort(distances, axis=0)[:k].T
    pairs = {(i, j) for i, row in enumerate(rows) for j in row if distances[i, j] < 1e8}
    return {(i, j) for i, j in pairs if not mutual or i in columns[j]}


@pytest.mark.parametrize("mutual", [False, True])
@pytest.mark.parametrize("k", [1, 4, 50])
def test_matches_are_those_of_the_slow_loop(k: int, mutual: bool) -> None:
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


def test_triangles_are_judged_as_by_the_slow_loop() -> None:
    source, target, truth = jax.tree.map(np.asarray, problem())
    distances = np.linalg.norm(truth.apply(source.xyz)[:, None] - target.xyz[None], axis=-1)
    nearest = np.where(target.mask, distances, np.inf).argmin(axis=1)[:NUM_SOURCE]
    rng = np.random.default_rng(0)
    wrong = rng.uniform(size=NUM_SOURCE) < 0.3
    partner = np.where(wrong, rng.integers(0, NUM_TARGET, NUM_SOURCE), nearest).astype(np.int32)
    mask = rng.uniform(size=NUM_SOURCE) < 0.8
    matches = Matches(np.arange(NUM_SOURCE, dtype=np.int32), partner, mask)
    found = draw_triangles(
        KEY,
        jax.tree.map(jnp.asarray, matches),
        *problem()[:2],
        count=2000,
        edge_similarity=0.85,
        min_edge=0.1,
        max_normal_angle=0.6,
    )
    assert mask[found.rows].all()
    assert len(np.unique(found.rows)) > 0.95 * mask.sum()  # 6000 draws reach all of them
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


def test_a_mirrored_cloud_has_no_congruent_triangles() -> None:
    _, target = clouds()
    mirror = jnp.float32([[-1, 1, 1]])
    mirrored = target.replace(xyz=target.xyz * mirror, normals=target.normals * mirror)
    every = jnp.arange(NUM_TARGET, dtype=jnp.int32)
    matches = Matches(every, every, jnp.ones(NUM_TARGET, bool))
    settings = {"count": 2000, "edge_similarity": 0.9, "min_edge": 0.3, "max_normal_angle": 0.3}
    own = draw_triangles(KEY, matches, target, target, **settings)
    other = draw_triangles(KEY, matches, target, mirrored, **settings)
    assert np.mean(own.agrees) > 0.5
    # only those seen along their plane's normal look the same from both sides
    assert np.mean(other.agrees) < 0.1 * np.mean(own.agrees)
