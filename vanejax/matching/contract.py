"""What every registration algorithm takes and gives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import flax.struct
import jax
import jax.numpy as jnp

from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform


@flax.struct.dataclass
class Registration:
    """The result of a registration; a batch is a leading axis.

    Attributes:
      target_from_source: the total motion, the initial guess included.
      converged: [] bool; False also where the answer is not finite or rests on no points.
      iterations: [] i32, iterations done.
      rmse: [] f32, weighted, of moved source points to their partners, in the clouds' unit.
      overlap: [] f32, share of the source points that found a partner, 0 to 1.
    """

    target_from_source: RigidTransform
    converged: jax.Array
    iterations: jax.Array
    rmse: jax.Array
    overlap: jax.Array


class Register(Protocol):
    """One pair in, one pose out: pure, jit-able and vmap-able."""

    def __call__(
        self, source: PointCloud, target: PointCloud, init: RigidTransform, key: jax.Array
    ) -> Registration:
        """Finds target_from_source, starting at ``init``."""


def chain(coarse: Register, fine: Register) -> Register:
    """``fine`` starting where ``coarse`` ended; iterations add up, the rest is the second's."""

    def register(
        source: PointCloud, target: PointCloud, init: RigidTransform, key: jax.Array
    ) -> Registration:
        coarse_key, fine_key = jax.random.split(key)
        first = coarse(source, target, init, coarse_key)
        second = fine(source, target, first.target_from_source, fine_key)
        return second.replace(iterations=first.iterations + second.iterations)

    return register


def from_partners(
    source: PointCloud,
    target_from_source: RigidTransform,
    squared: jax.Array,
    weights: jax.Array,
    *,
    converged: jax.Array,
    iterations: int | jax.Array,
) -> Registration:
    """The result of a method whose source points have partners, each with a weight.

    Args:
      source: [N] points.
      target_from_source: the answer.
      squared: [N] f32, squared distances of moved points to partners; any where the weight is 0.
      weights: [N] f32 or bool, 0 to 1; 0 at padding.
      converged: [] bool.
      iterations: done.
    """
    total = jnp.sum(weights).astype(squared.dtype)
    squared = jnp.where(weights > 0, weights * squared, 0.0)
    return Registration(
        target_from_source=target_from_source,
        converged=converged,
        iterations=jnp.asarray(iterations, jnp.int32),
        rmse=jnp.sqrt(jnp.sum(squared) / jnp.maximum(total, 1e-9)),
        overlap=total / jnp.maximum(jnp.sum(source.mask), 1),
    )


def pose_where(
    condition: jax.Array, pose: RigidTransform, otherwise: RigidTransform
) -> RigidTransform:
    """``pose`` where the condition [] holds."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), pose, otherwise)


Iteration = TypeVar("Iteration", bound=Any)  # a flax dataclass with ``target_from_source``


def last_iteration(
    iterate: Callable[[RigidTransform], Iteration], init: RigidTransform, *, iterations: int
) -> Iteration:
    """The last of several iterations (static, at least 1), each from the pose of the one before.

    A loop, not as many copies of the network to compile.
    """
    start = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(iterate, init)
    )
    start = start.replace(target_from_source=jax.tree.map(jnp.asarray, init))
    step = lambda before, _: (iterate(before.target_from_source), None)  # noqa: E731
    return jax.lax.scan(step, start, length=iterations)[0]
