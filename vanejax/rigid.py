"""Rigid motions: the group SE(3), its exponential, and the best motion between two point sets.

`RigidTransform`, which knows no JAX, is offered here as well. Every function is JAX, pure, and
written for any leading batch shape.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from vanejax.rigid_transform import RigidTransform

__all__ = [
    "RigidTransform",
    "euler_xyz_deg",
    "exp_se3",
    "exp_so3",
    "hat",
    "log_se3",
    "log_so3",
    "nearest_rotation",
    "rotation_angle",
    "vee",
    "weighted_procrustes",
]


def _matmul(a: jax.Array, b: jax.Array) -> jax.Array:
    """Matrix product at full precision: TF32 on a GPU would cost 1e-3 of a coordinate."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def hat(omega: jax.Array) -> jax.Array:
    """The skew matrix [..., 3, 3] with ``hat(a) @ b == cross(a, b)``."""
    x, y, z = omega[..., 0], omega[..., 1], omega[..., 2]
    zero = jnp.zeros_like(x)
    rows = [jnp.stack(r, -1) for r in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return jnp.stack(rows, -2)


def vee(matrix: jax.Array) -> jax.Array:
    """The vector [..., 3] of the skew part of a matrix: ``vee(hat(a)) == a``."""
    skew = 0.5 * (matrix - jnp.swapaxes(matrix, -1, -2))
    return jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)


def _eye_like(matrices: jax.Array) -> jax.Array:
    """Identities in the shape of ``matrices`` [..., 3, 3]."""
    return jnp.broadcast_to(jnp.eye(3, dtype=matrices.dtype), matrices.shape)


def _series(squared: jax.Array, near: jax.Array, far: Any) -> jax.Array:
    """``near`` where the angle is small, else ``far(angle)``, with finite gradients in both."""
    small = squared < 1e-4
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    return jnp.where(small, near, far(angle))


def _exp_coefficients(squared: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """sin(t)/t, (1-cos t)/t^2 and (t - sin t)/t^3 of ``squared`` = t^2; Taylor below 0.01 rad."""
    a = _series(squared, 1 - squared / 6 + squared**2 / 120, lambda t: jnp.sin(t) / t)
    # 1 - cos t = 2 sin^2(t/2): the difference would lose half of float32's digits at 0.01 rad.
    b = _series(squared, 0.5 - squared / 24, lambda t: 0.5 * (jnp.sin(t / 2) / (t / 2)) ** 2)
    c = _series(squared, 1 / 6 - squared / 120, lambda t: (t - jnp.sin(t)) / t**3)
    return a, b, c


def exp_so3(omega: jax.Array) -> jax.Array:
    """Rotation [..., 3, 3] by the axis-angle vector ``omega`` [..., 3] in radians (Rodrigues)."""
    a, b, _ = _exp_coefficients(jnp.sum(omega**2, -1))
    k = hat(omega)
    return _eye_like(k) + a[..., None, None] * k + b[..., None, None] * _matmul(k, k)


def exp_se3(twist: jax.Array) -> RigidTransform:
    """Motion of the twist [..., 6] = (rotation in radians, translation)."""
    omega, upsilon = twist[..., :3], twist[..., 3:]
    a, b, c = _exp_coefficients(jnp.sum(omega**2, -1))
    k = hat(omega)
    k2 = _matmul(k, k)
    eye = _eye_like(k)
    left = eye + b[..., None, None] * k + c[..., None, None] * k2
    return RigidTransform(
        rotation=eye + a[..., None, None] * k + b[..., None, None] * k2,
        translation=_matmul(left, upsilon[..., None])[..., 0],
    )


def log_so3(rotation: jax.Array) -> jax.Array:
    """Axis-angle vector [..., 3] in radians, length at most pi.

    Goes through the unit quaternion, taken from the row that is numerically largest (Shepperd,
    1978): accurate over the whole range, at pi too, where the skew part of the matrix vanishes.
    """
    r = rotation
    d0, d1, d2 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    s = [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]]
    p = [r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]]
    candidates = jnp.stack(
        [
            jnp.stack([1 + d0 + d1 + d2, s[0], s[1], s[2]], -1),
            jnp.stack([s[0], 1 + d0 - d1 - d2, p[0], p[1]], -1),
            jnp.stack([s[1], p[0], 1 - d0 + d1 - d2, p[2]], -1),
            jnp.stack([s[2], p[1], p[2], 1 - d0 - d1 + d2], -1),
        ],
        -2,
    )
    squared = jnp.sum(candidates**2, -1)
    best = jnp.argmax(squared, -1)[..., None, None]
    row = jnp.broadcast_to(best, (*best.shape[:-1], 4))
    q = jnp.take_along_axis(candidates, row, -2)[..., 0, :]
    q = q / jnp.linalg.norm(q, axis=-1, keepdims=True)
    q = jnp.where(q[..., :1] < 0, -q, q)
    squared = jnp.sum(q[..., 1:] ** 2, -1)
    # angle / sin(angle / 2): 2 at zero, sanitised before the root so that its gradient is finite
    small = squared < 1e-12
    sine = jnp.sqrt(jnp.where(small, 1.0, squared))
    scale = jnp.where(small, 2.0, 2 * jnp.arctan2(sine, q[..., 0]) / sine)
    return scale[..., None] * q[..., 1:]


def log_se3(transform: RigidTransform) -> jax.Array:
    """Twist [..., 6] = (rotation in radians, translation); inverse of `exp_se3` below pi."""
    omega = log_so3(transform.rotation)
    squared = jnp.sum(omega**2, -1)
    a, b, _ = _exp_coefficients(squared)
    k = hat(omega)
    # (1 - a / 2b) / t^2, from the inverse of the left Jacobian; its Taylor series near zero
    d = _series(squared, 1 / 12 + squared / 720, lambda t: (1 - 0.5 * a / b) / t**2)
    inverse = _eye_like(k) - 0.5 * k + d[..., None, None] * _matmul(k, k)
    upsilon = _matmul(inverse, transform.translation[..., None])[..., 0]
    return jnp.concatenate([omega, upsilon], -1)


def rotation_angle(rotation: jax.Array) -> jax.Array:
    """Geodesic angle [...] in radians, in [0, pi].

    ``atan2(|vee(R - R^T)|, tr R - 1)``: the arc cosine of the trace reads exactly 0 for every
    angle below 0.02 deg in float32, this form keeps full relative accuracy there.
    """
    skew = 2 * vee(rotation)
    squared = jnp.sum(skew**2, -1)
    zero = squared == 0
    sine = jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))
    return jnp.arctan2(sine, jnp.trace(rotation, axis1=-2, axis2=-1) - 1)


def euler_xyz_deg(rotation: jax.Array) -> jax.Array:
    """Angles [..., 3] in degrees about the fixed axes x, y, z, turned about in this order.

    ``R = Rz(c) Ry(b) Rx(a)`` gives (a, b, c), with a and c in (-180, 180] and b in [-90, 90]:
    scipy's ``as_euler("xyz")``. At b = +-90 deg only the sum or difference of a and c is defined;
    there c is 0.
    """
    r = rotation
    cosine = jnp.hypot(r[..., 0, 0], r[..., 1, 0])
    # below this the matrix's rounding decides the two arc tangents
    locked = cosine < 10 * jnp.finfo(r.dtype).eps
    a = jnp.where(
        locked,
        jnp.arctan2(-r[..., 1, 2], r[..., 1, 1]),
        jnp.arctan2(r[..., 2, 1], r[..., 2, 2]),
    )
    b = jnp.arctan2(-r[..., 2, 0], cosine)
    c = jnp.where(locked, 0.0, jnp.arctan2(r[..., 1, 0], r[..., 0, 0]))
    return jnp.rad2deg(jnp.stack([a, b, c], -1))


@functools.partial(jax.custom_jvp)
def nearest_rotation(matrix: jax.Array) -> jax.Array:
    """The rotation [..., 3, 3] that maximises ``trace(R^T matrix)``: Kabsch's projection on SO(3).

    ``U diag(1, 1, det(U V^T)) V^T`` of the singular value decomposition. Its derivative is written
    out below, since that of the SVD itself is infinite for equal singular values (a sphere) and
    for two vanishing ones (a line), where the rotation is still well defined or harmless.
    """
    u, _, vt = jnp.linalg.svd(matrix, full_matrices=False)
    u = u.at[..., :, 2].multiply(jnp.linalg.det(_matmul(u, vt))[..., None])
    return _matmul(u, vt)


@nearest_rotation.defjvp
def _nearest_rotation_jvp(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple:
    """With M = R S, S symmetric with eigenvalues s_i: R^T dR is the skew W with W S + S W = skew.

    In the eigenbasis of S that is W_ij = (R^T dM - dM^T R)_ij / (s_i + s_j). The sums vanish only
    where the rotation is not unique (s_1 = s_2 = 0, or s_2 = -s_3 of a reflection); the tangent is
    set to zero there.
    """
    (matrix,), (d_matrix,) = primals, tangents
    u, s, vt = jnp.linalg.svd(matrix, full_matrices=False)
    sign = jnp.linalg.det(_matmul(u, vt))
    u = u.at[..., :, 2].multiply(sign[..., None])
    s = s.at[..., 2].multiply(sign)
    rotation = _matmul(u, vt)
    d = _matmul(_matmul(jnp.swapaxes(u, -1, -2), d_matrix), jnp.swapaxes(vt, -1, -2))
    skew = d - jnp.swapaxes(d, -1, -2)
    sums = s[..., :, None] + s[..., None, :]
    scale = jnp.finfo(matrix.dtype).eps * 10 * jnp.maximum(s[..., :1, None], 1e-30)
    safe = jnp.abs(sums) > scale
    w = jnp.where(safe, skew / jnp.where(safe, sums, 1.0), 0.0)
    return rotation, _matmul(_matmul(u, w), vt)


def weighted_procrustes(source: jax.Array, target: jax.Array, weights: jax.Array) -> RigidTransform:
    """The motion that brings ``source`` nearest to ``target`` in the weighted least-squares sense.

    Args:
      source: [..., N, 3] f32.
      target: [..., N, 3] f32, the partner of each source point.
      weights: [..., N] f32, not negative; zero removes a pair. All zero gives a pure translation
        of zero and the identity.

    Returns:
      target_from_source, differentiable with finite gradients for planar, linear, coincident and
      mirrored point sets.

    Source: Arun, Huang and Blostein (1987); Kabsch (1976); RPM-Net, section 4.3.
    """
    share = weights / jnp.maximum(jnp.sum(weights, -1, keepdims=True), 1e-6)
    share = share[..., None]
    source_mean = jnp.sum(share * source, -2, keepdims=True)
    target_mean = jnp.sum(share * target, -2, keepdims=True)
    left = jnp.swapaxes(share * (target - target_mean), -1, -2)
    rotation = nearest_rotation(_matmul(left, source - source_mean))
    moved = _matmul(rotation, jnp.swapaxes(source_mean, -1, -2))[..., 0]
    return RigidTransform(rotation=rotation, translation=target_mean[..., 0, :] - moved)
