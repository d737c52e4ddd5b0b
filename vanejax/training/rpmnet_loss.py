"""The loss of RPM-Net over its iterations, and what vanejax adds to it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from vanejax.matching import fast_rpmnet
from vanejax.matching.metrics import pose_metrics
from vanejax.matching.rpmnet import Match, RpmNet
from vanejax.rigid import RigidTransform
from vanejax.settings import Settings, factor, not_negative, positive, settings_class
from vanejax.training import loss_terms as losses
from vanejax.training.gradient_sums import mean_over_pairs, sum_with_gradient
from vanejax.training.pairs import Pair
from vanejax.training.train_step import Metrics, Variables

_Shared = tuple[Variables, jax.Array]  # weights, and the reference's features


@settings_class
class RpmNetLoss(Settings):
    """A `vanejax.training.train_step.Loss` for RPM-Net.

    Attributes:
      iterations: of the network in training.
      discount: weight of an iteration relative to the next.
      pose: factor of `losses.pose_loss`; 1 as published.
      inlier: factor of `losses.inlier_loss`; 0.01 as published.
      matching: factor of `losses.matching_loss`; 0 as published.
      matching_sigma: its width, unit-sphere units.
      partner: factor of `losses.partner_loss`; 0 as published.
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
        parts = {"pose": losses.pose_loss(match.target_from_source, truth, source)}
        parts["inlier"] = losses.inlier_loss(match, source, pair.target)
        if self.matching:
            parts["matching"] = losses.matching_loss(
                match, source, pair.target, truth, sigma=self.matching_sigma
            )
        if self.partner:
            parts["partner"] = losses.partner_loss(match, source, truth)
        return sum(getattr(self, name) * value for name, value in parts.items()), parts

    def __call__(
        self, model: RpmNet, variables: Variables, pairs: Pair
    ) -> tuple[jax.Array, Metrics]:
        """Mean loss [] over a batch that shares its target, and mean metrics [].

        Metrics: each part of the loss and the pose error, all after the last iteration.
        """
        # Once for the batch: the reference is the same for every view.
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
