"""The paper's measures of a registration, and two that do not depend on a choice of axes.

Everything here is unbatched or works over leading axes, pure and JAX, but for `summary`. Poses and
clouds come in one unit, unit-sphere units as a rule, with the part's centre at the origin of the
target's frame; ``unit_mm`` is the length of that unit in mm (the part's radius), and results are
in millimetres and degrees. What is not finite stays not finite: only `summary` leaves it out, and
it says how often.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from vanejax.matching.se3 import euler_xyz_deg, rotation_angle
from vanejax.pointcloud import PointCloud, nearest_neighbors
from vanejax.rigid import RigidTransform


@flax.struct.dataclass
class SurfaceFit:
    """How closely a registered source lies on its reference; [] f32 each, NaN without points.

    Attributes:
      rmse_mm: eq. 1, see `rmse`.
      ffmde_signed_mm: eq. 2 as printed, see `ffmde_signed`.
      ffmde_abs_mm: eq. 2 with absolute values, see `ffmde_abs`.
    """

    rmse_mm: jax.Array
    ffmde_signed_mm: jax.Array
    ffmde_abs_mm: jax.Array


@flax.struct.dataclass
class PoseErrors:
    """What separates a found pose from the true one; leading axes as the poses have them.

    Attributes:
      rotation_deg: [...] see `rotation_error_deg`.
      translation_mm: [...] see `translation_error`.
      rotation_axes_deg: [..., 3] see `rotation_error_axes_deg`.
      translation_axes_mm: [..., 3] see `translation_error_axes`.
    """

    rotation_deg: jax.Array
    translation_mm: jax.Array
    rotation_axes_deg: jax.Array
    translation_axes_mm: jax.Array


def rotation_error_deg(found: RigidTransform, truth: RigidTransform) -> jax.Array:
    """Geodesic angle [...] of ``found @ truth.inverse()`` in degrees, 0 to 180.

    The one angle that turns the true attitude into the found one: no choice of axes in it.
    """
    return jnp.rad2deg(rotation_angle((found @ truth.inverse()).rotation))


def translation_error(found: RigidTransform, truth: RigidTransform) -> jax.Array:
    """Length [...] of the translation of ``found @ truth.inverse()``, in the poses' unit.

    For poses target_from_source this is how far the target frame's origin, the part's centre, ends
    up from where it belongs. The difference of the two poses' own translations (eqs 9 and 11)
    tells the same of the *source* frame's origin, wherever the random pose put it.
    """
    return jnp.linalg.norm((found @ truth.inverse()).translation, axis=-1)


def rotation_error_axes_deg(found: RigidTransform, truth: RigidTransform) -> jax.Array:
    """|R^(k) - Rt^(k)| for k = x, y, z: the terms of eqs 8 and 10, [..., 3] in degrees.

    Euler angles about the fixed x, y and z axes, in this order (`rigid.euler_xyz_deg`), as the
    published RPM-Net's evaluation takes them; the paper does not say. Differences are wrapped, so
    that 179 and -179 deg are 2 deg apart: values from 0 to 180.
    """
    difference = euler_xyz_deg(found.rotation) - euler_xyz_deg(truth.rotation)
    return jnp.abs(jnp.mod(difference + 180.0, 360.0) - 180.0)


def translation_error_axes(found: RigidTransform, truth: RigidTransform) -> jax.Array:
    """|T^(k) - Tt^(k)| for k = x, y, z: the terms of eqs 9 and 11, [..., 3], poses' unit."""
    return jnp.abs(found.translation - truth.translation)


def pose_errors(found: RigidTransform, truth: RigidTransform, *, unit_mm: float) -> PoseErrors:
    """All errors of poses target_from_source whose unit is ``unit_mm`` mm long."""
    return PoseErrors(
        rotation_deg=rotation_error_deg(found, truth),
        translation_mm=unit_mm * translation_error(found, truth),
        rotation_axes_deg=rotation_error_axes_deg(found, truth),
        translation_axes_mm=unit_mm * translation_error_axes(found, truth),
    )


def pose_metrics(found: RigidTransform, truth: RigidTransform) -> dict[str, jax.Array]:
    """Rotation error in degrees and translation error in unit-sphere units, [...] each."""
    return {
        "rotation_error_deg": rotation_error_deg(found, truth),
        "translation_error": translation_error(found, truth),
    }


def mean_per_axis(axis_errors: jax.Array) -> jax.Array:
    """MRE_k (eq. 8) or MTE_k (eq. 9), k = x, y, z: ``sum_i e_i^(k) / N`` over N views.

    Args:
      axis_errors: [V, 3], degrees or mm, of `PoseErrors`.

    Returns:
      [3], same unit.
    """
    return jnp.mean(axis_errors, axis=0)


def mean_per_view(axis_errors: jax.Array) -> jax.Array:
    """MRE_j (eq. 10) or MTE_j (eq. 11): ``sum_k e_j^(k) / 3`` over the axes, for each view j.

    Args:
      axis_errors: [V, 3], degrees or mm, of `PoseErrors`.

    Returns:
      [V], same unit.
    """
    return jnp.mean(axis_errors, axis=-1)


def nearest_offsets(moved: PointCloud, reference: PointCloud) -> tuple[jax.Array, jax.Array]:
    """From each moved source point x_i to its nearest reference point y_i, as in Fig. 2.

    Args:
      moved: [N] source, in the reference's frame.
      reference: [M]; padding is no one's neighbour.

    Returns:
      ``y_i - x_i`` [N, 3] and the unit normals n_i [N, 3] of the y_i; of no meaning where ``moved``
      is padding. Without a reference point the offsets are NaN.
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

    A bias: positive where the source lies inside the part's surface. Errors of opposite sign
    cancel, so that a bad registration can reach zero.
    """
    return _mean(jnp.sum(normals * offsets, axis=-1), mask)


def ffmde_abs(offsets: jax.Array, normals: jax.Array, mask: jax.Array) -> jax.Array:
    """Eq. 2 with ``|n_i . (y_i - x_i)|`` []: the error that the paper's text means; never < 0."""
    return _mean(jnp.abs(jnp.sum(normals * offsets, axis=-1)), mask)


def surface_fit(moved: PointCloud, reference: PointCloud, *, unit_mm: float) -> SurfaceFit:
    """RMSE and FFMDE of a source [N] moved onto a reference [M], one nearest-point search for all.

    Args:
      moved: the source under the found pose.
      reference: with unit normals, in the same frame and unit.
      unit_mm: length of that unit in mm.
    """
    offsets, normals = nearest_offsets(moved, reference)
    return SurfaceFit(
        rmse_mm=unit_mm * rmse(offsets, moved.mask),
        ffmde_signed_mm=unit_mm * ffmde_signed(offsets, normals, moved.mask),
        ffmde_abs_mm=unit_mm * ffmde_abs(offsets, normals, moved.mask),
    )


def summary(values: np.ndarray) -> dict[str, float | int]:
    """Mean, median, p95 and max of the finite values, and how many are not finite.

    Args:
      values: any shape, on the host.

    Returns:
      ``mean``, ``median``, ``p95`` (linear interpolation between ranks), ``max``: floats, NaN if
      nothing is finite; ``non_finite``: int, left out of the other four.
    """
    values = np.asarray(values, np.float64).ravel()
    finite = values[np.isfinite(values)]
    lost = int(values.size - finite.size)
    if not finite.size:
        return dict.fromkeys(("mean", "median", "p95", "max"), float("nan")) | {"non_finite": lost}
    return {
        "mean": float(np.mean(finite)),
        "median": float(np.median(finite)),
        "p95": float(np.percentile(finite, 95)),
        "max": float(np.max(finite)),
        "non_finite": lost,
    }


def _mean(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean [] over ``mask``; NaN, not 0, where nothing is there to average."""
    return jnp.sum(values, where=mask) / jnp.sum(mask)
