"""Point-pair features: exact at the point itself, and smooth; `test_rpmnet` has their twin."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from vanejax.matching.features import angle_between, point_pair_features

angle_between = jax.jit(angle_between)
point_pair_features = jax.jit(point_pair_features)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def neighborhoods(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets [N, K, 3], normals [N, 3] and neighbours' normals [N, K, 3]; f64."""
    rng = np.random.default_rng(seed)
    offset = rng.normal(size=(9, 4, 3), scale=0.2)
    return offset, unit(rng.normal(size=(9, 3))), unit(rng.normal(size=(9, 4, 3)))


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.7, np.pi / 2, 3.0, np.pi - 1e-3, np.pi])
def test_angle_between_is_accurate_over_the_whole_range(angle):
    rng = np.random.default_rng(0)
    for scale in (1e-3, 1.0, 1e3):
        frame = Rotation.random(rng=rng).as_matrix()
        a = 0.5 * frame[0]
        b = scale * (np.cos(angle) * frame[0] + np.sin(angle) * frame[1])
        a32, b32 = a.astype(np.float32), b.astype(np.float32)
        # rounding the vectors turns them by f32 eps; that is the input's, not the function's
        sine = np.linalg.norm(np.cross(a32.astype(float), b32.astype(float)))
        exact = np.arctan2(sine, np.dot(a32.astype(float), b32.astype(float)))
        np.testing.assert_allclose(exact, angle, atol=2e-7)
        np.testing.assert_allclose(angle_between(a32, b32), exact, atol=4e-7)  # f32 eps of pi


def test_the_point_itself_has_exactly_zero_features():
    """Padding of the neighbourhood with itself; an epsilon in a root would give 90 degrees."""
    _, normals, _ = neighborhoods()
    normals = np.concatenate([normals, -np.eye(3), [[-0.0, 0.0, -1.0]]]).astype(np.float32)
    for zero in (0.0, -0.0):
        offset = np.full((len(normals), 2, 3), zero, np.float32)
        own = np.repeat(normals[:, None], 2, axis=1)
        found = np.array(point_pair_features(offset, normals, own))
        found[..., 2][np.abs(found[..., 2]) < 2e-7] = 0  # n x n by fused multiply-add: f32 eps
        np.testing.assert_array_equal(found, 0)


def test_gradients_are_right_and_finite_where_there_is_no_angle():
    inputs = neighborhoods()
    with jax.enable_x64(True):
        check_grads(point_pair_features, inputs, order=1, modes=["fwd", "rev"], eps=1e-5)
    up = np.array([0, 0, 1], np.float32)
    gradient = jax.jit(jax.grad(lambda *args: jnp.sum(point_pair_features(*args)), (0, 1, 2)))
    # the point itself, a neighbour along the normal, one against it, and normals of no length
    for offset in (0 * up, up, -up):
        for normal in (up, -up, 0 * up):
            for found in gradient(offset[None, None], up[None], normal[None, None]):
                assert np.isfinite(found).all()
