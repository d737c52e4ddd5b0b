"""Sums and means of losses whose gradients are taken while the loop runs forward."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.training.pairs import Pair

Body = Callable[[Any, Any, Any], tuple[jax.Array, Any, Any]]
OfPair = Callable[[Any, Pair], tuple[jax.Array, dict[str, jax.Array]]]


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def sum_with_gradient(body: Body, shared: Any, carry: Any, xs: Any) -> tuple[jax.Array, Any, Any]:
    """Sums ``value`` of ``value, carry, aux = body(shared, carry, x)`` over the leading axis of xs.

    As `jax.lax.scan`, but differentiable in ``shared`` alone, a pytree of floating point arrays:
    carry, xs and what ``body`` closes over count as constants. The gradient of each turn is taken
    right after its forward pass, while what it needs is still in the caches, and one turn's memory
    serves them all; plain reverse mode would keep the values of every turn until the last has run.

    Returns:
      The sum of the values [], the last carry, and the stacked aux.
    """
    return _forward(body, shared, carry, xs)[0]


def _forward(body: Body, shared: Any, carry: Any, xs: Any) -> tuple:
    # one long vector: a hundred leaves would be added, and compiled, one by one
    flat, unflatten = ravel_pytree(shared)

    def value_and_rest(flat: jax.Array, carry: Any, x: Any) -> tuple[jax.Array, tuple]:
        value, carry, aux = body(unflatten(flat), carry, x)
        return value, (carry, aux)

    with_slope = jax.value_and_grad(value_and_rest, has_aux=True)

    def turn(total: tuple, x: Any) -> tuple:
        value, gradient, carry = total
        (new, (carry, aux)), slope = with_slope(flat, carry, x)
        return (value + new, gradient + slope, carry), aux

    start = (jnp.zeros(()), jnp.zeros_like(flat), carry)
    (value, gradient, carry), aux = jax.lax.scan(turn, start, xs)
    return (value, carry, aux), (gradient, shared)


def _backward(_: Body, saved: tuple, cotangents: tuple) -> tuple:
    gradient, shared = saved
    _, unflatten = ravel_pytree(shared)
    scale, *_ = cotangents  # carry and aux are constants
    return unflatten(scale * gradient), None, None


sum_with_gradient.defvjp(_forward, _backward)


def mean_over_pairs(
    of_pair: OfPair, shared: Any, pairs: Pair, *, pairs_at_once: int = 1
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Mean loss [] and mean metrics [] over a batch that shares its target.

    Args:
      of_pair: ``value, metrics = of_pair(shared, pair)`` for one pair.
      shared: what the mean is differentiable in; see `sum_with_gradient`.
      pairs: sources and labels [B].
      pairs_at_once: how many are computed side by side: 1 suits the caches of a CPU, the whole
        batch a GPU. It should divide the batch, and changes rounding only.
    """
    batch = pairs.source.mask.shape[0]
    at_once = math.gcd(batch, pairs_at_once)

    def of_group(shared: Any, carry: tuple[()], group: tuple) -> tuple[jax.Array, tuple[()], Any]:
        def of_one(source: PointCloud, truth: RigidTransform) -> tuple[jax.Array, Any]:
            return of_pair(shared, Pair(source, pairs.target, truth))

        if at_once == 1:
            value, metrics = of_one(*jax.tree.map(lambda leaf: leaf[0], group))
            return value, carry, metrics
        values, metrics = jax.vmap(of_one)(*group)
        return jnp.sum(values), carry, metrics

    groups = jax.tree.map(
        lambda leaf: leaf.reshape(batch // at_once, at_once, *leaf.shape[1:]),
        (pairs.source, pairs.target_from_source),
    )
    total, _, metrics = sum_with_gradient(of_group, shared, (), groups)
    return total / batch, jax.tree.map(jnp.mean, metrics)
