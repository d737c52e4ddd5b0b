"""The loss of DCP, and what vanejax may add to it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from vanejax.matching import pose_metrics, weighted_procrustes
from vanejax.matching.baselines.dcp import Dcp, Embedding, Match
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.settings import Settings, factor, not_negative, positive, settings_class
from vanejax.training import loss_terms as losses
from vanejax.training.gradient_sums import mean_over_pairs
from vanejax.training.pairs import Pair
from vanejax.training.train_step import Metrics


def rotation_loss(found: RigidTransform, truth: RigidTransform) -> jax.Array:
    """``|R^T R* - I|^2``, the sum of squared elements [] of one pair.

    Source: DCP, eq. 12. As ``|R* - R|^2``, its equal for rotations, which costs no digits near 0.
    """
    return jnp.sum((truth.rotation - found.rotation) ** 2)


def translation_loss(found: RigidTransform, truth: RigidTransform) -> jax.Array:
    """``|t - t*|^2`` [] of one pair, squared unit-sphere units. Source: DCP, eq. 12."""
    return jnp.sum((found.translation - truth.translation) ** 2)


def source_from_target(match: Match, source: PointCloud, target: PointCloud) -> RigidTransform:
    """The head with the clouds' roles swapped: each target point points at the source."""
    pointer = jax.nn.softmax(match.scores, axis=0).T
    partners = jnp.matmul(pointer, source.xyz, precision=jax.lax.Precision.HIGHEST)
    return weighted_procrustes(target.xyz, partners, target.mask.astype(partners.dtype))


def cycle_loss(match: Match, source: PointCloud, target: PointCloud) -> jax.Array:
    """How far the motions there and back are from cancelling, as the two losses above, [].

    The published code turns the translation by the inverse of the way back; meant, and taken here,
    is the way back itself.
    """
    there_and_back = source_from_target(match, source, target) @ match.target_from_source
    still = jax.tree.map(jnp.asarray, RigidTransform.identity())
    return rotation_loss(there_and_back, still) + translation_loss(there_and_back, still)


@settings_class
class DcpLoss(Settings):
    """The loss of DCP after one iteration, and what vanejax may add to it.

    Attributes:
      rotation: factor of `rotation_loss`; 1 as in the paper, 1/9 in its code, which takes means.
      translation: factor of `translation_loss`; 1 as in the paper, 1/3 in its code.
      cycle: factor of `cycle_loss`; 0 as the published default, 0.1 in its option.
      matching: factor of `losses.matching_loss`; 0 as published.
      matching_sigma: its width, unit-sphere units.
    """

    rotation: float = factor(1.0)
    translation: float = factor(1.0)
    cycle: float = not_negative(0.0)
    matching: float = factor(0.0)
    matching_sigma: float = positive(0.04)

    def of_match(self, match: Match, pair: Pair) -> tuple[jax.Array, Metrics]:
        """Loss [] of one pair, and its parts."""
        truth = pair.target_from_source
        parts = {
            "rotation": rotation_loss(match.target_from_source, truth),
            "translation": translation_loss(match.target_from_source, truth),
        }
        if self.cycle:
            parts["cycle"] = cycle_loss(match, pair.source, pair.target)
        if self.matching:
            parts["matching"] = losses.matching_loss(
                match, pair.source, pair.target, truth, sigma=self.matching_sigma
            )
        return sum(getattr(self, name) * value for name, value in parts.items()), parts

    def __call__(self, model: Dcp, variables: Any, pairs: Pair) -> tuple[jax.Array, Metrics]:
        """Mean loss [] over a batch that shares its target, and mean metrics [].

        Metrics: each part of the loss and the pose error.
        """
        # Once for the batch: the reference is the same for every view.
        embedding = model.apply(variables, pairs.target, method="embed")

        def of_pair(shared: tuple[Any, Embedding], pair: Pair) -> tuple[jax.Array, Metrics]:
            variables, embedding = shared
            init = jax.tree.map(jnp.asarray, RigidTransform.identity())
            match = model.apply(
                variables, pair.source, pair.target, embedding, init, method="match"
            )
            value, parts = self.of_match(match, pair)
            return value, parts | pose_metrics(match.target_from_source, pair.target_from_source)

        return mean_over_pairs(of_pair, (variables, embedding), pairs)
