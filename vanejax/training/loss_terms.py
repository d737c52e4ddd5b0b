"""What RPM-Net learns from: the pose, and the correspondences that virtual scans know exactly."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vanejax.matching.rpmnet import Match
from vanejax.pointcloud import PointCloud, squared_distances
from vanejax.rigid import RigidTransform


def pose_loss(found: RigidTransform, truth: RigidTransform, source: PointCloud) -> jax.Array:
    """Mean absolute difference of coordinates between the source [N] under two motions.

    Source: RPM-Net, section 4.4 (L_reg). [] f32, unit-sphere units.
    """
    gap = jnp.abs(found.apply(source.xyz) - truth.apply(source.xyz))
    mask = source.mask[:, None]
    return jnp.sum(gap, where=mask) / (3 * jnp.maximum(jnp.sum(mask), 1))


def inlier_loss(match: Match, source: PointCloud, target: PointCloud) -> jax.Array:
    """Mean share of each cloud's points that was given to the slack.

    Source: RPM-Net, section 4.4 (L_inlier), without its factor. [] f32.
    """
    assignment = jnp.exp(match.log_assignment)
    total = jnp.zeros(())
    for axis, cloud in ((1, source), (0, target)):
        missing = 1 - jnp.sum(assignment, axis)
        total += jnp.sum(missing, where=cloud.mask) / jnp.maximum(jnp.sum(cloud.mask), 1)
    return total


def matching_loss(
    match: Match,
    source: PointCloud,
    target: PointCloud,
    target_from_source: RigidTransform,
    *,
    sigma: float,
) -> jax.Array:
    """Cross-entropy of the log assignment's rows against the true correspondences.

    A virtual scan knows where each of its points lies on the part: the wanted row is
    ``softmax(-d^2 / (2 sigma^2))`` over the true distances ``d`` to the reference points.

    Args:
      sigma: width of the wanted rows, unit-sphere units; about the spacing of the reference.

    Returns:
      [] f32, mean over source points.
    """
    distances = squared_distances(target_from_source.apply(source.xyz), target.xyz)
    logits = jnp.where(target.mask[None, :], -distances / (2 * sigma**2), -1e9)
    wanted = jax.nn.softmax(logits, axis=1)
    entropy = -jnp.sum(wanted * match.log_assignment, axis=1, where=target.mask[None, :])
    return jnp.sum(entropy, where=source.mask) / jnp.maximum(jnp.sum(source.mask), 1)


def partner_loss(match: Match, source: PointCloud, target_from_source: RigidTransform) -> jax.Array:
    """Mean distance between each soft correspondence and the point's true place.

    [] f32, unit-sphere units. Every point counts alike: the weights that the pose is solved with
    are held constant.
    """
    gap = match.partners - target_from_source.apply(source.xyz)
    squared = jnp.sum(gap**2, -1)
    weights = jax.lax.stop_gradient(match.weights)
    return jnp.sum(weights * jnp.sqrt(squared + 1e-8)) / jnp.maximum(jnp.sum(weights), 1e-6)
