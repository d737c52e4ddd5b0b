"""The count of operations: that of XLA for a plain stack; PyTorch's for the network is beside."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import pytest

from experiments.benchmarks import flops
from vanejax.matching import RpmNet

WIDTHS, ROWS = (10, 96, 96, 192), 640
MODEL = RpmNet(num_neighbors=32)


def stack(weights: list[jax.Array], x: jax.Array) -> jax.Array:
    for weight in weights:
        x = x @ weight
    return x


def counted(function, *arguments) -> float:
    return jax.jit(function).lower(*arguments).compile().cost_analysis()["flops"]


def test_a_stack_takes_what_xla_counts() -> None:
    x = jnp.ones((ROWS, WIDTHS[0]))
    weights = [jnp.ones(pair) for pair in itertools.pairwise(WIDTHS)]
    forward = flops.dense_flops(ROWS, WIDTHS)
    assert counted(stack, weights, x) == pytest.approx(forward, rel=1e-3)
    # three times, but for the gradient of what the first layer is given
    gradient = jax.grad(lambda weights, x: jnp.sum(stack(weights, x) ** 2))
    wanted = 3 * forward - flops.dense_flops(ROWS, WIDTHS[:2])
    assert counted(gradient, weights, x) == pytest.approx(wanted, rel=0.01)


def test_the_reference_is_paid_once() -> None:
    pair = flops.feature_flops(MODEL, 700) + flops.match_flops(MODEL, 700, 1000)
    assert flops.inference_flops(MODEL, 700, 1000, 5) == 5 * pair + flops.neighbor_flops(700)
    one, two = (flops.step_flops(MODEL, 700, 1000, 2, batch) for batch in (1, 2))
    firsts = 2 * flops.dense_flops(32 * 700, (10, 96)) + 2 * flops.dense_flops(1700, (4, 64))
    assert two - one == 6 * pair - firsts + flops.neighbor_flops(700)
