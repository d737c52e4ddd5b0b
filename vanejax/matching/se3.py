"""The group SE(3) in JAX: exponential and angle; any leading batch shape."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from vanejax.rigid import RigidTransform


def matmul(a: jax.Array, b: jax.Array) -> jax.Array:
    """Matrix product at full precision: TF32 on a GPU would cost 1e-3 of a coordinate."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def safe_sqrt(squared: jax.Array) -> jax.Array:
    """The root of what is not negative; its gradient at 0 is 0, not infinite."""
    zero = squared == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def hat(omega: jax.Array) -> jax.Array:
    """The skew matrix [..., 3, 3] with ``hat(a) @ b == cross(a, b)``."""
    x, y, z = omega[..., 0], omega[..., 1], omega[..., 2]
    zero = jnp.zeros_like(x)
    rows = [jnp.stack(r, -1) for r in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return jnp.stack(rows, -2)


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


def rotation_angle(rotation: jax.Array) -> jax.Array:
    """Geodesic angle [...] in radians, in [0, pi].

    ``atan2(|v|, tr R - 1)`` with v the vector of ``R - R^T``: the arc cosine of the trace reads
    exactly 0 for every angle below 0.02 deg in float32, this form keeps full relative accuracy.
    """
    r = rotation
    skew = [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]]
    sine = safe_sqrt(jnp.sum(jnp.stack(skew, -1) ** 2, -1))
    return jnp.arctan2(sine, jnp.trace(rotation, axis1=-2, axis2=-1) - 1)
