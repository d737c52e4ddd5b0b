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
    neighbor_sums,
    product,
)

pytestmark = pytest.mark.usefixtures("double_precision")
N, K, C, WIDE, FEATURES = 7, 5, 6, 12, 16
EXACT = 1e-12  # f64 eps x a sum of 100 terms x the scale of the norm


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


LAYERS = [  # with the shape of an input, and what a layer does to all activations
    # narrow inputs go through their moments, wide ones do not
    *((DenseNormRelu, (*rows, width), lambda y: y)
      for rows in ((N,), (N, K), (1,)) for width in (C, WIDE)),
    (DenseNormReluMax, (N, K, C), lambda y: y.max(axis=1)),
    (DenseNormReluCloudMax, (N, C), lambda y: y.max(axis=0)),
]  # fmt: skip


@pytest.mark.parametrize(
    ("num_groups", "dtype", "atol"),
    [
        # the variance is a difference of moments of inputs up to 10: eps x 100 x 16
        *((count, np.float64, 10 * EXACT) for count in (1, 8, FEATURES)),
        (8, np.float32, 2e-5),
    ],
)
@pytest.mark.parametrize(("layer", "shape", "reduce"), LAYERS)
def test_a_layer_is_torch_s_and_padding_has_no_gradient(
    layer, shape, reduce, num_groups, dtype, atol
):
    mask = np.random.default_rng(20).permutation(np.arange(shape[0] + 20) < shape[0])
    x, params = jax.tree.map(dtype, (cloud(*shape), parameters(shape[-1])))
    padded = np.full((len(mask), *shape[1:]), 1e4, dtype)
    padded[mask] = x
    real = ... if layer is DenseNormReluCloudMax else np.flatnonzero(mask)

    def total(padded):
        y = layer(FEATURES, num_groups).apply({"params": params}, padded, mask)
        return jnp.sum(y[real] ** 2), y

    with jax.enable_x64(dtype is np.float64):
        (_, found), gradient = jax.jit(jax.value_and_grad(total, has_aux=True))(padded)
    assert found.dtype == dtype
    exact = jax.tree.map(np.float64, (x, params))
    np.testing.assert_allclose(found[real], reduce(torch_layer(*exact, num_groups)), atol=atol)
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


def test_an_empty_cloud_stays_finite():
    for layer, shape, _ in LAYERS:

        def total(params, layer=layer, shape=shape):
            y = layer(FEATURES).apply({"params": params}, np.zeros(shape), np.zeros(N, bool))
            return jnp.sum(y)

        gradient = jax.jit(jax.grad(total))(parameters(shape[-1]))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
