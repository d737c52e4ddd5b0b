"""The loss of RPM-Net over its iterations, and what vanejax adds to it.

It learns from the pose, and from the correspondences that virtual scans know exactly.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from vanejax.matching import fast_rpmnet
from vanejax.matching.metrics import pose_metrics
from vanejax.matching.rpmnet import Match, RpmNet
from vanejax.pointcloud import PointCloud, squared_distances
from vanejax.rigid import RigidTransform
from vanejax.settings import Settings, factor, not_negative, positive, settings_class
from vanejax.training.gradient_sums import mean_over_pairs, sum_with_gradient
from vanejax.training.pairs import Pair
from vanejax.training.train_step import Metrics, Variables

_Shared = tuple[Variables, jax.Array]  # weights, and the reference's features


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
    ``softmax(-d^2 / (2 sigma^2))`` over the true distances ``d`` to the reference points. ``sigma``
    is in unit-sphere units, about the spacing of the reference. [] f32, mean over source points.
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


@settings_class
class RpmNetLoss(Settings):
    """A `vanejax.training.train_step.Loss` for RPM-Net.

    Attributes:
      iterations: of the network in training.
      discount: weight of an iteration relative to the next; 0 leaves the last alone.
      pose: factor of `pose_loss`; 1 as published.
      inlier: factor of `inlier_loss`; 0.01 as published.
      matching: factor of `matching_loss`; 0 as published.
      matching_sigma: its width, unit-sphere units.
      partner: factor of `partner_loss`; 0 as published.
      pairs_at_once: see `mean_over_pairs`.
    """

    iterations: int = positive(2)
    discount: float = not_negative(0.5)
    pose: float = factor(1.0)
    inlier: float = not_negative(0.01)
    matching: float = factor(0.0)
    matching_sigma: float = positive(0.04)
    partner: float = factor(0.0)
    pairs_at_once: int = positive(1)

    def of_match(self, match: Match, source: Any, pair: Pair) -> tuple[jax.Array, Metrics]:
        """Loss [] of one iteration for one pair, and its parts."""
        truth = pair.target_from_source
        parts = {
            "pose": pose_loss(match.target_from_source, truth, source),
            "inlier": inlier_loss(match, source, pair.target),
        }
        if self.matching:
            parts["matching"] = matching_loss(
                match, source, pair.target, truth, sigma=self.matching_sigma
            )
        if self.partner:
            parts["partner"] = partner_loss(match, source, truth)
        return sum(getattr(self, name) * value for name, value in parts.items()), parts

    def __call__(
        self, model: RpmNet, variables: Variables, pairs: Pair
    ) -> tuple[jax.Array, Metrics]:
        """Mean loss [] of a batch; its mean parts [] and pose error after the last iteration."""
        # once for the batch: the reference is the same for every view
        features = fast_rpmnet.features(model, variables, pairs.target)
        weights = self.discount ** jnp.arange(self.iterations - 1.0, -1.0, -1.0)

        def of_pair(shared: _Shared, pair: Pair) -> tuple[jax.Array, Metrics]:
            source, near = pair.source, fast_rpmnet.neighborhoods(model, pair.source)

            def iteration(
                shared: _Shared, pose: RigidTransform, weight: jax.Array
            ) -> tuple[jax.Array, RigidTransform, Metrics]:
                variables, features = shared
                match = fast_rpmnet.match(
                    model, variables, source, near, pair.target, features, pose
                )
                value, parts = self.of_match(match, source, pair)
                pose = match.target_from_source
                return weight * value, pose, parts | pose_metrics(pose, pair.target_from_source)

            # the published network does not differentiate through the pose either
            init = jax.tree.map(jnp.asarray, RigidTransform.identity())
            total, _, metrics = sum_with_gradient(iteration, shared, init, weights)
            return total, jax.tree.map(lambda leaf: leaf[-1], metrics)

        return mean_over_pairs(
            of_pair, (variables, features), pairs, pairs_at_once=self.pairs_at_once
        )
