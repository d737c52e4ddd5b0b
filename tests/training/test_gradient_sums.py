"""The loop that takes its gradient as it runs, against the same loop in plain reverse mode."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vanejax.training.gradient_sums import sum_with_gradient

EXACT = 1e-6  # f32 eps x 10


def body(shared, carry, x):
    """Every part of it counts: two leaves, the carry, and something on the side."""
    value = jnp.sum(jnp.sin(shared["a"] * x) * carry) + shared["b"] ** 2
    return value, carry + jnp.cos(x), {"twice": 2 * value}


def plain(shared, carry, xs):
    total, aux = 0.0, []
    for x in xs:
        value, carry, twice = body(shared, carry, x)
        total += value
        aux.append(twice["twice"])
    return total, carry, {"twice": jnp.stack(aux)}


@pytest.fixture
def arguments():
    rng = np.random.default_rng(0)
    shared = {"a": jnp.asarray(rng.normal(size=3), jnp.float32), "b": jnp.float32(0.7)}
    return shared, jnp.ones(3), jnp.asarray(rng.normal(size=(4, 3)), jnp.float32)


def test_the_gradient_is_that_of_the_loop_in_reverse(arguments):
    """Scaled by what comes after, and with the value, the carry and what stands on the side."""
    shared, *rest = arguments

    def loss(function):
        def of(shared):
            total, carry, aux = function(shared, *rest)
            return jnp.tanh(0.1 * total), (carry, aux)

        return jax.value_and_grad(of, has_aux=True)

    found = jax.jit(loss(lambda *args: sum_with_gradient(body, *args)))(shared)
    expected = loss(plain)(shared)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=EXACT), found, expected)


def test_loops_nest_and_batch(arguments):
    """As a batch of pairs whose iterations are a loop of their own does."""
    shared, carry, xs = arguments

    def pair(shared, carry, x):
        total, _, aux = sum_with_gradient(body, shared, carry, jnp.stack([x, 2 * x]))
        return total, carry, aux["twice"]

    def batch(shared):
        totals = jax.vmap(
            lambda x: sum_with_gradient(pair, shared, carry, jnp.stack([x, x + 1]))[0]
        )(xs)
        return jnp.sum(totals * jnp.arange(1.0, 5.0))

    def slow(shared):
        total = 0.0
        for weight, x in zip((1.0, 2.0, 3.0, 4.0), xs, strict=True):
            for y in (x, x + 1):
                total += weight * plain(shared, carry, jnp.stack([y, 2 * y]))[0]
        return total

    found, expected = jax.jit(jax.value_and_grad(batch))(shared), jax.value_and_grad(slow)(shared)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), found, expected)


def test_only_what_is_shared_is_differentiated(arguments):
    shared, carry, xs = arguments
    gradient = jax.jit(jax.grad(lambda c, x: sum_with_gradient(body, shared, c, x)[0], (0, 1)))(
        carry, xs
    )
    assert not any(np.any(leaf) for leaf in gradient)
