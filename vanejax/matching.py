"""Soft matching: from feature distances to a partial assignment between two clouds."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def log_sinkhorn(
    affinity: jax.Array, source_mask: jax.Array, target_mask: jax.Array, *, iterations: int
) -> jax.Array:
    """Alternating normalisation of rows and columns in the log domain, with slack.

    A slack row and a slack column of affinity 0 take up the points that have no partner; the
    slack itself is never normalised (RPM-Net, section 4.1; Sinkhorn, 1964). Written with the two
    potentials ``u`` and ``v``, so that only [N] and [M] vectors change from round to round:
    ``log P = A - u - v``, ``u = logsumexp_j(A - v, 0)``, ``v = logsumexp_i(A - u, 0)``.

    Args:
      affinity: [N, M] f32, larger for better partners.
      source_mask: [N] bool.
      target_mask: [M] bool.
      iterations: rounds of one row and one column normalisation.

    Returns:
      log assignment [N, M] f32. Its exponential has rows and columns that sum to at most 1. At
      padding it is finite and very negative, its exponential exactly zero.
    """
    real = source_mask[:, None] & target_mask[None, :]
    # exp(-1e9) is exactly 0 in f32, and unlike -inf it never makes a NaN in a gradient.
    affinity = jnp.where(real, affinity, -1e9)
    v = jnp.zeros(affinity.shape[1], affinity.dtype)
    u = jnp.zeros(affinity.shape[0], affinity.dtype)
    for _ in range(iterations):
        u = _logsumexp_with_slack(affinity - v[None, :], axis=1)
        v = _logsumexp_with_slack(affinity - u[:, None], axis=0)
    return affinity - u[:, None] - v[None, :]


def _logsumexp_with_slack(x: jax.Array, axis: int) -> jax.Array:
    """log(1 + sum(exp(x))) along ``axis``, shifted by the largest term."""
    top = jax.lax.stop_gradient(jnp.maximum(jnp.max(x, axis), 0.0))
    shifted = jnp.exp(x - jnp.expand_dims(top, axis))
    return top + jnp.log(jnp.exp(-top) + jnp.sum(shifted, axis))


def soft_correspondences(
    assignment: jax.Array, target_xyz: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The weighted mean partner of each source point, and how much it is to be trusted.

    Args:
      assignment: [N, M] f32, not negative.
      target_xyz: [M, 3] f32.

    Returns:
      partners [N, 3] f32 in the target's frame and weights [N] f32, the row sums.
    """
    weights = jnp.sum(assignment, axis=1)
    # 1e-5 as published: it keeps rows of no weight finite and shrinks weak ones towards 0.
    partners = jnp.matmul(assignment, target_xyz, precision=jax.lax.Precision.HIGHEST)
    return partners / (weights[:, None] + 1e-5), weights
