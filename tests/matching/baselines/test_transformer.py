"""The transformer against the published formulas in float64 loops, and padding."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from network_clouds import scattered

from vanejax.matching.baselines.transformer import LayerNorm, Transformer, attention

pytestmark = pytest.mark.usefixtures("double_precision")
N, M, WIDTH, HEADS, HIDDEN = 7, 9, 16, 4, 24
EXACT = 1e-11  # f64 eps x three sublayers' condition of about 1e4
MODEL = Transformer(width=WIDTH, heads=HEADS, hidden=HIDDEN)


@pytest.fixture(scope="module")
def clouds() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return rng.normal(size=(N, WIDTH)), rng.normal(size=(M, WIDTH))


@pytest.fixture(scope="module")
def params(clouds) -> dict:
    x, y = clouds
    rng = np.random.default_rng(0)
    made = jax.eval_shape(MODEL.init, jax.random.key(0), x, np.ones(N, bool), y, np.ones(M, bool))
    return jax.tree.map(lambda leaf: 0.4 * rng.normal(size=leaf.shape), made)["params"]


run = jax.jit(lambda params, *args: MODEL.apply({"params": params}, *args))


def slow_attention(q, k, v) -> np.ndarray:
    """One head, one query at a time."""
    rows = []
    for query in q:
        weights = scipy.special.softmax([query @ key / np.sqrt(len(query)) for key in k])
        rows.append(sum(weight * value for weight, value in zip(weights, v, strict=True)))
    return np.array(rows)


def slow_norm(x, p) -> np.ndarray:
    spread = x.std(axis=-1, keepdims=True, ddof=1) + 1e-6
    return p["scale"] * (x - x.mean(axis=-1, keepdims=True)) / spread + p["bias"]


def dense(x, p) -> np.ndarray:
    return x @ p["kernel"] + p["bias"]


def slow_heads(x, memory, p) -> np.ndarray:
    q, k, v = dense(x, p["query"]), dense(memory, p["key"]), dense(memory, p["value"])
    parts = [slow_attention(q[:, h], k[:, h], v[:, h]) for h in np.split(np.arange(WIDTH), HEADS)]
    return dense(np.concatenate(parts, axis=1), p["out"])


def slow_feed_forward(x, p) -> np.ndarray:
    return dense(np.maximum(dense(x, p["in"]), 0), p["out"])


def slow_transformer(x, y, p) -> np.ndarray:
    """decoder(x, encoder(y)), in the order of the published code."""
    norms = [p[f"encoder_norms_{i}"] for i in range(3)]
    inner = slow_norm(y, norms[0])
    y = y + slow_heads(inner, inner, p["encoder_attention"])
    y = y + slow_feed_forward(slow_norm(y, norms[1]), p["encoder_feed_forward"])
    memory = slow_norm(y, norms[2])
    norms = [p[f"decoder_norms_{i}"] for i in range(4)]
    inner = slow_norm(x, norms[0])
    x = x + slow_heads(inner, inner, p["decoder_attention"])
    x = x + slow_heads(slow_norm(x, norms[1]), memory, p["cross_attention"])
    x = x + slow_feed_forward(slow_norm(x, norms[2]), p["decoder_feed_forward"])
    return slow_norm(x, norms[3])


def test_attention_to_large_scores_and_to_nothing_is_finite():
    q = np.full((N, HEADS, 5), 1e3)
    k = np.random.default_rng(4).normal(size=(M, HEADS, 5)) * 1e3
    none = np.zeros(M, bool)
    for mask in (~none, none):
        found, slope = jax.value_and_grad(lambda k, mask=mask: jnp.sum(attention(q, k, k, mask)))(
            jnp.asarray(k)
        )
        assert np.isfinite(found)
        assert np.isfinite(slope).all()


def test_layer_norm_of_a_row_without_spread_is_its_bias():
    p = {"scale": np.arange(4.0), "bias": np.arange(4.0) + 1}

    def total(x):
        return jnp.sum(LayerNorm().apply({"params": p}, x) ** 2)

    x = np.full((2, 4), 3.0)
    np.testing.assert_array_equal(LayerNorm().apply({"params": p}, x), [p["bias"]] * 2)
    assert np.isfinite(jax.grad(total)(x)).all()


@pytest.mark.parametrize("junk", [0.0, 1e3])
def test_it_is_the_slow_twin_whatever_the_padding(params, clouds, junk):
    (x, x_mask), (y, y_mask) = (scattered(cloud, len(cloud) + 5, junk) for cloud in clouds)
    found = run(params, x, x_mask, y, y_mask)
    np.testing.assert_allclose(found[x_mask], slow_transformer(*clouds, params), atol=EXACT)
    assert np.isfinite(found).all()
