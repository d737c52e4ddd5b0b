"""The layers against PyTorch's dense, group norm and ReLU written out in numpy float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vanejax.models.layers import DenseNormRelu, DenseNormReluMax, dense_max

N, K, C, FEATURES = 7, 5, 6, 16
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
@pytest.mark.parametrize("shape", [(N, C), (N, K, C), (1, C)])
def test_dense_norm_relu_is_torch_s(shape, num_groups):
    x = cloud(*shape)
    found = run(DenseNormRelu(FEATURES, num_groups), parameters(), x, np.ones(shape[0], bool))
    np.testing.assert_allclose(found, torch_layer(x, parameters(), num_groups), atol=EXACT)


@pytest.mark.parametrize("num_groups", [1, 8, FEATURES])
@pytest.mark.parametrize("shape", [(N, C), (N, K, C)])
def test_dense_norm_relu_max_is_torch_s(shape, num_groups):
    x = cloud(*shape)
    found = run(DenseNormReluMax(FEATURES, num_groups), parameters(), x, np.ones(shape[:-1], bool))
    expected = torch_layer(x, parameters(), num_groups).max(axis=-2)
    assert found.shape == (*shape[:-2], FEATURES)
    # the variance is a difference of moments of inputs up to 10: eps x 100 x 16
    np.testing.assert_allclose(found, expected, atol=10 * EXACT)


def test_single_precision_agrees_too():
    """The moments of the narrow input lose few digits, even beside a bias of 3."""
    params = jax.tree.map(np.float32, parameters())
    x = cloud(N, K, C).astype(np.float32)
    for layer, mask, reduce in (
        (DenseNormRelu(FEATURES), np.ones(N, bool), lambda y: y),
        (DenseNormReluMax(FEATURES), np.ones((N, K), bool), lambda y: y.max(axis=1)),
    ):
        with jax.enable_x64(False):
            found = run(layer, params, x, mask)
        assert found.dtype == jnp.float32
        expected = reduce(torch_layer(x.astype(float), parameters(), 8))
        np.testing.assert_allclose(found, expected, atol=2e-5)  # f32 eps x 160


def scattered(x: np.ndarray, mask: np.ndarray, junk: float) -> np.ndarray:
    """The rows of x at the True places of a larger mask, ``junk`` elsewhere."""
    padded = np.full((*mask.shape, x.shape[-1]), junk)
    padded[mask] = x.reshape(-1, x.shape[-1])
    return padded


@pytest.mark.parametrize("junk", [0.0, 1e4])
@pytest.mark.parametrize("padding", [1, 20])
def test_padding_changes_nothing_and_has_no_gradient(padding, junk):
    rng = np.random.default_rng(padding)
    mask = rng.permutation(np.arange(N + padding) < N)
    rows = mask[:, None] & np.ones((1, K), bool)
    x = cloud(N, K, C)
    padded = scattered(x, rows, junk)
    for layer, given, expected in (
        (DenseNormRelu(FEATURES), mask, torch_layer(x, parameters(), 8)),
        (DenseNormReluMax(FEATURES), rows, torch_layer(x, parameters(), 8).max(axis=1)),
    ):
        variables = {"params": parameters()}

        @jax.jit
        def both(padded, layer=layer, variables=variables, given=given):
            def total(padded):
                y = layer.apply(variables, padded, given)
                return jnp.sum(jnp.where(jnp.expand_dims(mask, range(1, y.ndim)), y, 0) ** 2), y

            return jax.value_and_grad(total, has_aux=True)(padded)

        (_, found), gradient = both(padded)
        np.testing.assert_allclose(found[mask], expected, atol=10 * EXACT)
        assert np.isfinite(found).all()
        np.testing.assert_array_equal(gradient[~mask], 0)
        assert np.abs(gradient[mask]).max() > 0
        if isinstance(layer, DenseNormReluMax):
            np.testing.assert_array_equal(found[~mask], 0)


def test_the_fused_layer_has_the_gradient_of_its_parts():
    """Through the max, the moments, and gains of both signs."""
    x, rows = cloud(N, K, C), np.ones((N, K), bool)

    def fused(params, x):
        y = DenseNormReluMax(FEATURES).apply({"params": params}, x, rows)
        return jnp.sum(jnp.sin(y))

    def plain(params, x):
        y = DenseNormRelu(FEATURES).apply({"params": params}, x, rows[:, 0])
        return jnp.sum(jnp.sin(jnp.max(y, axis=1)))

    args = (parameters(), x)
    found = jax.jit(jax.grad(fused, (0, 1)))(*args)
    expected = jax.jit(jax.grad(plain, (0, 1)))(*args)
    # eps x 1e4: inputs of 10 squared, and a dense bias whose gradient cancels to zero
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-11), found, expected)


@pytest.mark.parametrize("points", [1, 37, 90])  # below, across and over several chunks
def test_dense_max_is_the_maximum_of_the_product(points):
    """In f32 at the network's own widths: its gradient finds the winners by recomputing them."""
    rng = np.random.default_rng(points)
    x = rng.normal(size=(points, 32, 96)).astype(np.float32)
    kernel = rng.normal(size=(96, 192)).astype(np.float32) / 10
    mask = rng.uniform(size=(points, 32)) < 0.8
    mask[0] = False
    x[-1, 1] = x[-1, 0]  # equal maxima
    weights = rng.normal(size=(points, 192)).astype(np.float32) * mask.any(axis=1, keepdims=True)

    def plain(x, kernel):
        product = jnp.where(mask[..., None], jnp.matmul(x, kernel), -1e30)
        return jnp.max(product, axis=1)

    def pulled(function):
        def pull(x, kernel):
            top, vjp = jax.vjp(function, x, kernel)
            return top, vjp(weights.astype(top.dtype))

        return jax.jit(pull)

    with jax.enable_x64(False):
        top, (d_x, d_kernel) = pulled(lambda x, kernel: dense_max(x, kernel, mask))(x, kernel)
    # the winner of the f32 product is that of the f64 product unless two lie within 1e-6
    want, (want_x, want_kernel) = pulled(plain)(x.astype(float), kernel.astype(float))
    np.testing.assert_allclose(top, want, rtol=1e-5, atol=1e-5)  # f32 eps x 96 terms
    np.testing.assert_array_equal(d_x[~mask], 0)
    np.testing.assert_allclose(d_x, want_x, atol=1e-4)  # f32 eps x 192 terms of up to 1
    np.testing.assert_allclose(d_kernel, want_kernel, atol=1e-3)  # and of 90 points


def test_an_empty_cloud_stays_finite():
    x = np.zeros((N, K, C))
    for layer, mask in (
        (DenseNormRelu(FEATURES), np.zeros(N, bool)),
        (DenseNormReluMax(FEATURES), np.zeros((N, K), bool)),
    ):
        gradient = jax.jit(
            jax.grad(lambda p, layer=layer, mask=mask: layer.apply({"params": p}, x, mask).sum())
        )(parameters())
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
