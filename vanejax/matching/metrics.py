"""The paper's measures of a registration, and two that do not depend on a choice of axes.

Poses and clouds come in unit-sphere units, with the part's centre at the origin of the target's
frame; ``unit_mm`` is the part's radius, and results are in mm and degrees. What is not finite stays
so: only `summary` leaves it out. `pose_errors` and `summary` run on the host, the rest in JAX.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.matching.se3 import rotation_angle
from vanejax.pointcloud import PointCloud, nearest_neighbors
from vanejax.rigid import RigidTransform


@flax.struct.dataclass
class SurfaceFit:
    """How closely a registered source lies on its reference; [] f32 each, NaN without points.

    Equation 1 (`rmse`), equation 2 as printed and with absolute values.
    """

    rmse_mm: jax.Array
    ffmde_signed_mm: jax.Array
    ffmde_abs_mm: jax.Array


@flax.struct.dataclass
class PoseErrors:
    """What separates a found pose from the true one; leading axes as the poses have them.

    Attributes:
      rotation_deg, translation_mm: [...] see `rotation_error_deg` and `translation_error`.
      rotation_axes_deg: [..., 3] f64, |R^(k) - Rt^(k)| for k = x, y, z, the terms of eqs 8 and 10.
        Euler angles about the fixed x, y and z axes, in this order, as the published RPM-Net's
        evaluation takes them; the paper does not say. Differences are wrapped: 0 to 180.
      translation_axes_mm: [..., 3] |T^(k) - Tt^(k)|, the terms of eqs 9 and 11.
    """

    rotation_deg: jax.Array
    translation_mm: jax.Array
    rotation_axes_deg: np.ndarray
    translation_axes_mm: jax.Array


def rotation_error_deg(found: RigidTransform, truth: RigidTransform) -> jax.Array:
    """Geodesic angle [...] of ``found @ truth.inverse()`` in degrees, 0 to 180."""
    return jnp.rad2deg(rotation_angle((found @ truth.inverse()).rotation))


def translation_error(found: RigidTransform, truth: RigidTransform) -> jax.Array:
    """Length [...] of the translation of ``found @ truth.inverse()``, in the poses' unit.

    How far the part's centre ends up from where it belongs; the difference of the poses' own
    translations (eqs 9 and 11) tells the same of the *source* frame's origin.
    """
    return jnp.linalg.norm((found @ truth.inverse()).translation, axis=-1)


def pose_metrics(found: RigidTransform, truth: RigidTransform) -> dict[str, jax.Array]:
    """Rotation error in degrees and translation error in unit-sphere units, [...] each."""
    return {
        "rotation_error_deg": rotation_error_deg(found, truth),
        "translation_error": translation_error(found, truth),
    }


def pose_errors(found: RigidTransform, truth: RigidTransform, *, unit_mm: float) -> PoseErrors:
    """All errors of poses target_from_source whose unit is ``unit_mm`` mm long; on the host."""
    errors = _pose_metrics(found, truth)
    turned = _euler_xyz_deg(found.rotation) - _euler_xyz_deg(truth.rotation)
    return PoseErrors(
        rotation_deg=errors["rotation_error_deg"],
        translation_mm=unit_mm * errors["translation_error"],
        rotation_axes_deg=np.abs((turned + 180.0) % 360.0 - 180.0),
        translation_axes_mm=unit_mm * abs(found.translation - truth.translation),
    )


_pose_metrics = jax.jit(pose_metrics)


def _euler_xyz_deg(rotation: jax.Array) -> np.ndarray:
    """Angles [..., 3] f64 in degrees about the fixed axes x, y, z; NaN where not finite."""
    matrices = np.asarray(rotation, np.float64).reshape(-1, 3, 3)
    finite = np.isfinite(matrices).all(axis=(1, 2))
    angles = np.full((len(matrices), 3), np.nan)
    angles[finite] = Rotation.from_matrix(matrices[finite]).as_euler("xyz", degrees=True)
    return angles.reshape(rotation.shape[:-1])


def mean_per_axis(axis_errors: jax.Array) -> jax.Array:
    """MRE_k (eq. 8) or MTE_k (eq. 9), k = x, y, z: mean [3] over the views of errors [V, 3]."""
    return jnp.mean(axis_errors, axis=0)


def mean_per_view(axis_errors: jax.Array) -> jax.Array:
    """MRE_j (eq. 10) or MTE_j (eq. 11) of view j: mean [V] over the axes of errors [V, 3]."""
    return jnp.mean(axis_errors, axis=-1)


def nearest_offsets(moved: PointCloud, reference: PointCloud) -> tuple[jax.Array, jax.Array]:
    """From each moved source point x_i to its nearest reference point y_i, as in Fig. 2.

    From ``moved`` [N] in the frame of ``reference`` [M] to ``y_i - x_i`` [N, 3] and the normals n_i
    [N, 3] of the y_i; of no meaning at padding, offsets are NaN without a reference point.
    """
    # an index has no gradient: this spares the search from being kept for a backward pass
    queries, points = jax.lax.stop_gradient((moved.xyz, reference.xyz))
    nearest, _ = nearest_neighbors(queries, points, reference.mask)
    offsets = reference.xyz[nearest] - moved.xyz
    return jnp.where(jnp.any(reference.mask), offsets, jnp.nan), reference.normals[nearest]


def rmse(offsets: jax.Array, mask: jax.Array) -> jax.Array:
    """Eq. 1: ``sqrt(1/N sum_i |x_i - y_i|^2)`` [] of offsets [N, 3], over ``mask`` [N]."""
    return jnp.sqrt(_mean(jnp.sum(offsets**2, axis=-1), mask))


def ffmde_signed(offsets: jax.Array, normals: jax.Array, mask: jax.Array) -> jax.Array:
    """Eq. 2 as printed: ``1/N sum_i n_i . (y_i - x_i)`` [], face-to-face mean distance error.

    Positive inside the part's surface. Errors of opposite sign cancel: a bad fit can reach zero.
    """
    return _mean(jnp.sum(normals * offsets, axis=-1), mask)


def ffmde_abs(offsets: jax.Array, normals: jax.Array, mask: jax.Array) -> jax.Array:
    """Eq. 2 with ``|n_i . (y_i - x_i)|`` []: the error that the paper's text means; never < 0."""
    return _mean(jnp.abs(jnp.sum(normals * offsets, axis=-1)), mask)


def surface_fit(moved: PointCloud, reference: PointCloud, *, unit_mm: float) -> SurfaceFit:
    """RMSE and FFMDE of a source [N], moved by the found pose, on a reference [M] with normals."""
    offsets, normals = nearest_offsets(moved, reference)
    return SurfaceFit(
        rmse_mm=unit_mm * rmse(offsets, moved.mask),
        ffmde_signed_mm=unit_mm * ffmde_signed(offsets, normals, moved.mask),
        ffmde_abs_mm=unit_mm * ffmde_abs(offsets, normals, moved.mask),
    )


def summary(values: np.ndarray) -> dict[str, float | int]:
    """Measures of the finite values, NaN if there is none, and how many are ``non_finite``."""
    values = np.asarray(values, np.float64).ravel()
    finite = values[np.isfinite(values)]
    some = finite if finite.size else np.array([np.nan])
    return {
        "mean": float(np.mean(some)),
        "median": float(np.median(some)),
        "p95": float(np.percentile(some, 95)),
        "max": float(np.max(some)),
        "non_finite": values.size - finite.size,
    }


def _mean(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean [] over ``mask``; NaN where there is nothing to average."""
    return jnp.sum(values, where=mask) / jnp.sum(mask)
