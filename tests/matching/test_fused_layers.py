"""The layers against PyTorch's dense, group norm and ReLU written out in numpy float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from vanejax.matching.fused_layers import (
    DenseNormRelu,
    DenseNormReluCloudMax,
    DenseNormReluMax,
    cloud_max,
    neighbor_sums,
    product,
    product_moments,
)

N, K, C, WIDE, FEATURES = 7, 5, 6, 12, 16
EXACT = 1e-12  # f64 eps x a sum of 100 terms x the scale of the norm


@pytest.fixture(autouse=True)
def _double_precision():
    with jax.enable_x64(True):
        yield


def parameters(channels: int = C, seed: int = 0) -> dict:
    """Gains of both signs; a bias far off zero, which the norm must take out again."""
    rng = np.random.default_rng(seed)
    return {
        "dense": {
            "kernel": rng.normal(size=(channels, FEATURES)),
            "bias": 3 + rng.normal(size=FEATURES),
        },
        "norm": {"scale": rng.normal(size=FEATURES), "bias": rng.normal(size=FEATURES)},
    }


def torch_layer(x: np.ndarray, params: dict, num_groups: int) -> np.ndarray:
    """Conv1d(1) or Conv2d(1), GroupNorm, ReLU of one cloud x [..., C], as PyTorch defines them."""
    y = x @ params["dense"]["kernel"] + params["dense"]["bias"]
    for group in np.split(np.arange(FEATURES), num_groups):
        part = y[..., group]
        y[..., group] = (part - part.mean()) / np.sqrt(part.var() + 1e-5)  # biased variance
    return np.maximum(y * params["norm"]["scale"] + params["norm"]["bias"], 0)


def cloud(*shape: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape) * np.geomspace(0.1, 10, shape[-1])


def run(layer, params, x, mask):
    return jax.jit(layer.apply)({"params": params}, x, mask)


@pytest.mark.parametrize("num_groups", [1, 8, FEATURES])
@pytest.mark.parametrize("shape", [(N, C), (N, K, C), (1, C), (N, K, WIDE), (N, WIDE), (1, WIDE)])
def test_dense_norm_relu_is_torch_s(shape, num_groups):
    """Narrow inputs go through their moments, wide ones do not."""
    x, params = cloud(*shape), parameters(shape[-1])
    found = run(DenseNormRelu(FEATURES, num_groups), params, x, np.ones(shape[0], bool))
    # the variance is a difference of moments of inputs up to 10: eps x 100 x 16
    np.testing.assert_allclose(found, torch_layer(x, params, num_groups), atol=10 * EXACT)


@pytest.mark.parametrize("num_groups", [1, 8, FEATURES])
@pytest.mark.parametrize(
    ("layer", "shape"), [(DenseNormReluCloudMax, (N, C)), (DenseNormReluMax, (N, K, C))]
)
def test_dense_norm_relu_max_is_torch_s(layer, shape, num_groups):
    x = cloud(*shape)
    found = run(layer(FEATURES, num_groups), parameters(), x, np.ones(N, bool))
    expected = torch_layer(x, parameters(), num_groups).max(axis=-2)
    assert found.shape == (*shape[:-2], FEATURES)
    # the variance is a difference of moments of inputs up to 10: eps x 100 x 16
    np.testing.assert_allclose(found, expected, atol=10 * EXACT)


def test_single_precision_agrees_too():
    """The moments of the narrow input lose few digits, even beside a bias of 3."""
    params = jax.tree.map(np.float32, parameters())
    x = cloud(N, K, C).astype(np.float32)
    for layer, reduce in (
        (DenseNormRelu(FEATURES), lambda y: y),
        (DenseNormReluMax(FEATURES), lambda y: y.max(axis=1)),
    ):
        with jax.enable_x64(False):
            found = run(layer, params, x, np.ones(N, bool))
        assert found.dtype == jnp.float32
        expected = reduce(torch_layer(x.astype(float), parameters(), 8))
        np.testing.assert_allclose(found, expected, atol=2e-5)  # f32 eps x 160


LAYERS = (  # with the shape of an input, and what a layer does to all activations
    (DenseNormRelu(FEATURES), (N, K, C), lambda y: y),
    (DenseNormRelu(FEATURES), (N, K, WIDE), lambda y: y),
    (DenseNormReluMax(FEATURES), (N, K, C), lambda y: y.max(axis=1)),
    (DenseNormReluCloudMax(FEATURES), (N, C), lambda y: y.max(axis=0)),
)


def scattered(x: np.ndarray, mask: np.ndarray, junk: float) -> np.ndarray:
    """The rows of x at the True places of a larger mask, ``junk`` elsewhere."""
    padded = np.full((*mask.shape, x.shape[-1]), junk)
    padded[mask] = x.reshape(-1, x.shape[-1])
    return padded


def test_padding_changes_nothing_and_has_no_gradient():
    mask = np.random.default_rng(20).permutation(np.arange(N + 20) < N)
    for layer, shape, reduce in LAYERS:
        x, params = cloud(*shape), parameters(shape[-1])
        rows = jnp.broadcast_to(
            jnp.expand_dims(mask, range(1, x.ndim - 1)), (len(mask), *shape[1:-1])
        )
        padded = scattered(x, np.asarray(rows), 1e4)
        real = ... if isinstance(layer, DenseNormReluCloudMax) else np.flatnonzero(mask)

        def total(padded, layer=layer, params=params, real=real):
            y = layer.apply({"params": params}, padded, mask)
            return jnp.sum(y[real] ** 2), y

        (_, found), gradient = jax.jit(jax.value_and_grad(total, has_aux=True))(padded)
        expected = reduce(torch_layer(x, params, 8))
        np.testing.assert_allclose(found[real], expected, atol=10 * EXACT)
        assert np.isfinite(found).all()
        np.testing.assert_array_equal(gradient[~mask], 0)
        assert np.abs(gradient[mask]).max() > 0


@pytest.mark.parametrize("fused", [DenseNormReluMax, DenseNormReluCloudMax])
def test_the_fused_layer_has_the_gradient_of_its_parts(fused):
    """Through the max, the moments, and gains of both signs."""
    x = cloud(N, K, WIDE) if fused is DenseNormReluMax else cloud(N, WIDE)
    mask = np.ones(N, bool)

    def found(params, x):
        return jnp.sum(jnp.sin(fused(FEATURES).apply({"params": params}, x, mask)))

    def plain(params, x):
        y = DenseNormRelu(FEATURES).apply({"params": params}, x, mask)
        return jnp.sum(jnp.sin(jnp.max(y, axis=-2)))

    args = (parameters(WIDE), x)
    # eps x 1e4: inputs of 10 squared, and a dense bias whose gradient cancels to zero
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-11),
        jax.jit(jax.grad(found, (0, 1)))(*args),
        jax.jit(jax.grad(plain, (0, 1)))(*args),
    )


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(N, C), (N, K, C), (N, WIDE)])
def test_gradients_of_a_layer_are_those_of_finite_differences(shape):
    mask = np.arange(N) < N - 2
    params, x = parameters(shape[-1]), cloud(*shape)

    def smooth(params, x):
        y = DenseNormRelu(FEATURES).apply({"params": params}, x, mask)
        return jnp.sum(jnp.sin(y[: N - 2]))

    check_grads(smooth, (params, x), order=1, modes=["rev"], atol=1e-5, rtol=1e-5)


def test_the_product_has_the_gradient_of_a_product():
    rng = np.random.default_rng(0)
    check_grads(product, (rng.normal(size=(N, K, C)), rng.normal(size=(C, 4))), 1, ["rev"])


def test_moments_of_a_product_are_those_of_its_rows():
    rng = np.random.default_rng(0)
    x, kernel, mask = cloud(N, K, C), rng.normal(size=(C, 9)), np.arange(N) != 3
    rows = (x[mask] @ kernel).reshape(-1, 9)
    mean, variance = jax.jit(product_moments)(x, kernel, mask)
    np.testing.assert_allclose(mean, rows.mean(axis=0), atol=EXACT)
    np.testing.assert_allclose(variance, rows.var(axis=0), atol=100 * EXACT)  # of about 100


def test_equal_maxima_share_the_gradient():
    """As `jnp.max` does: neighbourhoods are filled up with copies of a point."""
    y = np.random.default_rng(0).normal(size=(N, K, C))
    y[:, 3] = y[:, 1]
    y[2] = 1.5
    weights = np.random.default_rng(1).normal(size=(2, N, C))

    def pulled(function):
        return jax.jit(jax.grad(lambda y: sum(map(jnp.vdot, function(y), weights))))(y)

    found = pulled(neighbor_sums)
    np.testing.assert_allclose(found, pulled(lambda y: (y.max(1), (y * y).sum(1))), atol=EXACT)


def test_the_maximum_of_a_cloud_and_its_gradient():
    rng = np.random.default_rng(0)
    x, kernel, mask = rng.normal(size=(N, C)), rng.normal(size=(C, 9)), np.arange(N) != 3

    def plain(x, kernel):
        return jnp.max(jnp.where(mask[:, None], x @ kernel, -jnp.inf), axis=0)

    def pulled(function):
        top, pull = jax.vjp(function, x, kernel)
        return top, *pull(jnp.arange(1.0, 10.0))

    for found, expected in zip(
        pulled(lambda x, kernel: cloud_max(x, kernel, mask)), pulled(plain), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=EXACT)


def test_an_empty_cloud_stays_finite():
    for layer, shape, _ in LAYERS:

        def total(params, layer=layer, shape=shape):
            y = layer.apply({"params": params}, np.zeros(shape), np.zeros(N, bool))
            return jnp.sum(y)

        gradient = jax.jit(jax.grad(total))(parameters(shape[-1]))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
