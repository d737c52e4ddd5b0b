"""Iterating a network that matches two clouds anew from the pose it found before."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp

from vanejax.rigid import RigidTransform


class Match(Protocol):
    """One iteration: a pytree that knows its pose and how to change it."""

    target_from_source: RigidTransform

    def replace(self, **changes: object) -> Match:
        """The same with other fields."""
        ...


M = TypeVar("M", bound=Match)


def last_iteration(
    match: Callable[[RigidTransform], M], init: RigidTransform, *, iterations: int
) -> M:
    """The last of several matches, each from the pose of the one before.

    A loop, not as many copies of the network to compile.

    Args:
      match: one iteration from a target_from_source.
      init: the pose to start from.
      iterations: static, at least 1.
    """

    def step(before: M, _: None) -> tuple[M, None]:
        return match(before.target_from_source), None

    start = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(match, init)
    )
    start = start.replace(target_from_source=jax.tree.map(jnp.asarray, init))
    return jax.lax.scan(step, start, length=iterations)[0]
