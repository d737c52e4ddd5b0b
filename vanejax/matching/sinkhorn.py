"""Sinkhorn: from the affinity of all pairs to a soft assignment between two clouds."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vanejax.matching.se3 import matmul

# A round changes the sums by a factor of at most N + 1, so that this many stay within f32's range.
_ROUNDS = 5


def sinkhorn(
    affinity: jax.Array, source_mask: jax.Array, target_mask: jax.Array, *, iterations: int
) -> jax.Array:
    """Alternating normalisation of the rows and the columns of ``exp(affinity)``, with slack.

    A slack row and a slack column of affinity 0 take up the points that have no partner; the slack
    itself is never normalised. In logarithms, as published (RPM-Net; Sinkhorn, 1964).

    Args:
      affinity: [N, M] f32, larger for better partners.
      source_mask, target_mask: [N] and [M] bool.
      iterations: rounds of one row and one column normalisation.

    Returns:
      log assignment [N, M] f32. Its exponential has rows and columns that sum to at most 1; at
      padding it is finite and very negative, its exponential exactly zero.
    """
    # exp(-1e9) is exactly 0 in f32, and unlike -inf it never makes a NaN in a gradient.
    affinity = jnp.where(source_mask[:, None] & target_mask[None, :], affinity, -1e9)
    log_m = jnp.pad(affinity, ((0, 1), (0, 1)))
    for _ in range(iterations):
        rows = log_m[:-1]
        log_m = log_m.at[:-1].set(rows - jax.nn.logsumexp(rows, axis=1, keepdims=True))
        columns = log_m[:, :-1]
        log_m = log_m.at[:, :-1].set(columns - jax.nn.logsumexp(columns, axis=0, keepdims=True))
    return log_m[:-1, :-1]


def log_sinkhorn(
    affinity: jax.Array, source_mask: jax.Array, target_mask: jax.Array, *, iterations: int
) -> jax.Array:
    """`sinkhorn`, with N x M exponentials once for several rounds instead of twice for each.

    In logarithms the rounds are ``u_i = log(1 + sum_j exp(A_ij - v_j))`` and
    ``v_j = log(1 + sum_i exp(A_ij - u_i))``, with ``A - u - v`` as the answer. Here
    ``E = exp(A - u - v)`` is taken now and then, and a sum is the product of E with a vector.
    """
    affinity = jnp.where(source_mask[:, None] & target_mask[None, :], affinity, -1e9)
    # the largest entry of each row becomes 1: what underflows is nothing beside the slack.
    u = jax.lax.stop_gradient(jnp.maximum(jnp.max(affinity, axis=1), 0.0))
    v = jnp.zeros_like(affinity[0])
    for first in range(0, iterations, _ROUNDS):
        scaled = jnp.exp(affinity - u[:, None] - v[None, :])
        row_slack, column_slack, columns = jnp.exp(-u), jnp.exp(-v), jnp.ones_like(v)
        for _ in range(min(_ROUNDS, iterations - first)):
            rows = row_slack + matmul(scaled, 1 / columns)
            columns = column_slack + matmul(1 / rows, scaled)
        u, v = u + jnp.log(rows), v + jnp.log(columns)
    return affinity - u[:, None] - v[None, :]


def soft_correspondences(
    assignment: jax.Array, target_xyz: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The weighted mean partner of each source point, and how much it is to be trusted.

    From an assignment [N, M] f32, not negative, and target_xyz [M, 3] f32 to partners [N, 3] f32 in
    the target's frame and weights [N] f32, the row sums.
    """
    weights = jnp.sum(assignment, axis=1)
    # 1e-5 as published: it keeps rows of no weight finite and shrinks weak ones towards 0
    return matmul(assignment, target_xyz) / (weights[:, None] + 1e-5), weights
