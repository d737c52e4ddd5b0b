"""The best rigid motion between two point sets, with derivatives that are always finite."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vanejax.matching.se3 import matmul
from vanejax.rigid import RigidTransform


@jax.custom_jvp
def nearest_rotation(matrix: jax.Array) -> jax.Array:
    """The rotation [..., 3, 3] that maximises ``trace(R^T matrix)``: Kabsch's projection on SO(3).

    Its derivative is written out below: that of the SVD is infinite for equal singular values (a
    sphere) and two vanishing ones (a line), where the rotation is well defined or harmless.
    """
    u, _, vt = _rotating_svd(matrix)
    return matmul(u, vt)


@nearest_rotation.defjvp
def _nearest_rotation_jvp(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple:
    """With M = R S, S symmetric with eigenvalues s_i: R^T dR is the skew W with W S + S W = skew.

    In the eigenbasis of S that is W_ij = (R^T dM - dM^T R)_ij / (s_i + s_j); set to zero where the
    rotation is not unique (s_1 = s_2 = 0, or s_2 = -s_3 of a reflection) and the sums vanish.
    """
    (matrix,), (d_matrix,) = primals, tangents
    u, s, vt = _rotating_svd(matrix)
    d = matmul(matmul(jnp.swapaxes(u, -1, -2), d_matrix), jnp.swapaxes(vt, -1, -2))
    skew = d - jnp.swapaxes(d, -1, -2)
    sums = s[..., :, None] + s[..., None, :]
    scale = jnp.finfo(matrix.dtype).eps * 10 * jnp.maximum(s[..., :1, None], 1e-30)
    safe = jnp.abs(sums) > scale
    w = jnp.where(safe, skew / jnp.where(safe, sums, 1.0), 0.0)
    return matmul(u, vt), matmul(matmul(u, w), vt)


def _rotating_svd(matrix: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A singular value decomposition whose ``u @ vt`` turns, the last value with a sign."""
    u, s, vt = jnp.linalg.svd(matrix, full_matrices=False)
    sign = jnp.linalg.det(matmul(u, vt))
    return u.at[..., :, 2].multiply(sign[..., None]), s.at[..., 2].multiply(sign), vt


def weighted_procrustes(source: jax.Array, target: jax.Array, weights: jax.Array) -> RigidTransform:
    """The motion that brings ``source`` nearest to ``target`` in the weighted least-squares sense.

    Args:
      source, target: [..., N, 3] f32, points and their partners.
      weights: [..., N] f32, not negative; zero removes a pair, all zero give the identity.

    Returns:
      target_from_source; its gradients are finite for planar, linear, coincident and mirrored sets.

    Source: Arun, Huang and Blostein (1987); Kabsch (1976); RPM-Net, section 4.3.
    """
    share = weights / jnp.maximum(jnp.sum(weights, -1, keepdims=True), 1e-6)
    share = share[..., None]
    source_mean = jnp.sum(share * source, -2, keepdims=True)
    target_mean = jnp.sum(share * target, -2, keepdims=True)
    left = jnp.swapaxes(share * (target - target_mean), -1, -2)
    rotation = nearest_rotation(matmul(left, source - source_mean))
    moved = matmul(rotation, jnp.swapaxes(source_mean, -1, -2))[..., 0]
    return RigidTransform(rotation=rotation, translation=target_mean[..., 0, :] - moved)
