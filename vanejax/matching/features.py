"""Point-pair features, which RPM-Net starts from."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vanejax.matching.se3 import safe_sqrt


def angle_between(a: jax.Array, b: jax.Array) -> jax.Array:
    """Angle in radians, [0, pi], between vectors [..., 3]; 0 where either has no length.

    ``atan2(|a x b|, a . b)``, accurate at 0 and pi. The cross product is sanitised before the
    root instead of by an epsilon inside it: with the epsilon a zero vector would give 90 deg.
    """
    a, b = jnp.broadcast_arrays(a, b)
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    cross = safe_sqrt(x * x + y * y + z * z)
    dot = ax * bx + ay * by + az * bz
    # A zero vector may give -0.0 here, and atan2(0, -0.0) is pi.
    return jnp.arctan2(cross, jnp.where(dot == 0, 0.0, dot))


def point_pair_features(
    offset: jax.Array, normal: jax.Array, neighbor_normal: jax.Array
) -> jax.Array:
    """PPF of points and their neighbours: unchanged by any rigid motion of the cloud.

    Args:
      offset: [N, K, 3] f32, neighbour minus point.
      normal, neighbor_normal: [N, 3] and [N, K, 3] f32.

    Returns:
      [N, K, 4] f32: angle(normal, offset), angle(neighbour normal, offset), angle between the
      normals (radians), and the length of the offset; zeros for the point itself.

    Source: Drost et al. (2010), in the order of RPM-Net.
    """
    at_point = jnp.expand_dims(normal, -2)
    length = safe_sqrt(jnp.sum(offset**2, -1))
    angles = [
        angle_between(at_point, offset),
        angle_between(neighbor_normal, offset),
        angle_between(at_point, neighbor_normal),
    ]
    return jnp.stack([*angles, length], -1)
