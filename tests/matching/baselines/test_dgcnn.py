"""DGCNN against a slow float64 twin, its neighbours against sorting, and padding."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from network_clouds import scattered

from vanejax.matching.baselines.dgcnn import Dgcnn, neighbor_graph

pytestmark = pytest.mark.usefixtures("double_precision")
N, K = 30, 6
EXACT = 1e-10  # f64 eps x five layers' condition of about 1e5
MODEL = Dgcnn(width=32, num_neighbors=K, edge_widths=(16, 16, 32, 64))


@pytest.fixture(scope="module")
def params() -> dict:
    """Random weights, gains of both signs."""
    rng = np.random.default_rng(0)
    made = jax.eval_shape(MODEL.init, jax.random.key(0), np.zeros((N, 3)), np.ones(N, bool))
    return jax.tree.map(lambda leaf: 0.5 * rng.normal(size=leaf.shape), made)["params"]


@pytest.fixture(scope="module")
def xyz() -> np.ndarray:
    return np.random.default_rng(1).normal(size=(N, 3))


run = jax.jit(lambda params, xyz, mask: MODEL.apply({"params": params}, xyz, mask))


def slow_layer(x: np.ndarray, layer: dict) -> np.ndarray:
    """Convolution of width 1, group norm of 8 groups over all of the cloud, ReLU."""
    y = x @ layer["dense"]["kernel"] + layer["dense"]["bias"]
    for group in np.split(np.arange(y.shape[-1]), 8):
        part = y[..., group]
        y[..., group] = (part - part.mean()) / np.sqrt(part.var() + 1e-5)
    return np.maximum(y * layer["norm"]["scale"] + layer["norm"]["bias"], 0)


def slow_dgcnn(xyz: np.ndarray, params: dict, k: int) -> np.ndarray:
    """The graph once; edges (neighbour, point); the maximum after each layer; all side by side."""
    edges = []
    for point in xyz:
        near = np.argsort(np.linalg.norm(xyz - point, axis=1))[:k]
        edges.append([[*xyz[j], *point] for j in near])
    x, tops = np.array(edges), []
    for layer in range(4):
        x = slow_layer(x, params[f"edge_{layer}"])
        tops.append(x.max(axis=1))
    return slow_layer(np.concatenate(tops, axis=1), params["point"])


@pytest.mark.parametrize("junk", [0.0, 1e3])
def test_it_is_the_slow_twin_whatever_the_padding(params, xyz, junk):
    full, mask = scattered(xyz, N + 13, junk)
    found = run(params, full, mask)
    np.testing.assert_allclose(found[mask], slow_dgcnn(xyz, params, K), atol=EXACT)
    assert np.isfinite(found).all()


def test_neighbours_are_the_nearest_real_points_itself_first(xyz):
    full, mask = scattered(xyz, N + 13, 0.0)
    found = np.asarray(neighbor_graph(full, mask, num_neighbors=K))
    real = np.flatnonzero(mask)
    for i in range(len(full)):
        distances = np.linalg.norm(full[real] - full[i], axis=1)
        np.testing.assert_array_equal(found[i], real[np.argsort(distances)[:K]])
    np.testing.assert_array_equal(found[mask][:, 0], real)


def test_a_point_fills_the_places_for_which_there_are_no_neighbours(xyz):
    mask = np.isin(np.arange(N), (3, 7))
    found = np.asarray(neighbor_graph(xyz, mask, num_neighbors=K))
    np.testing.assert_array_equal(found[3], [3, 7, 3, 3, 3, 3])
    np.testing.assert_array_equal(found[7], [7, 3, 7, 7, 7, 7])
    alone = neighbor_graph(xyz, np.zeros(N, bool), num_neighbors=K)
    np.testing.assert_array_equal(alone, np.repeat(np.arange(N)[:, None], K, axis=1))


def test_a_cloud_of_fewer_rows_than_neighbours(params, xyz):
    few = xyz[:4]
    found = run(params, few, np.ones(4, bool))
    np.testing.assert_allclose(found, slow_dgcnn(few, params, 4), atol=EXACT)
