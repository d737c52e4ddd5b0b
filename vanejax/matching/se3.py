"""The group SE(3) in JAX: exponential, logarithm, angles; any leading batch shape."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from vanejax.rigid import RigidTransform


def matmul(a: jax.Array, b: jax.Array) -> jax.Array:
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
    return _eye_like(k) + a[..., None, None] * k + b[..., None, None] * matmul(k, k)


def exp_se3(twist: jax.Array) -> RigidTransform:
    """Motion of the twist [..., 6] = (rotation in radians, translation)."""
    omega, upsilon = twist[..., :3], twist[..., 3:]
    a, b, c = _exp_coefficients(jnp.sum(omega**2, -1))
    k = hat(omega)
    k2 = matmul(k, k)
    eye = _eye_like(k)
    left = eye + b[..., None, None] * k + c[..., None, None] * k2
    return RigidTransform(
        rotation=eye + a[..., None, None] * k + b[..., None, None] * k2,
        translation=matmul(left, upsilon[..., None])[..., 0],
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
    inverse = _eye_like(k) - 0.5 * k + d[..., None, None] * matmul(k, k)
    upsilon = matmul(inverse, transform.translation[..., None])[..., 0]
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
