"""What the learned baselines are trained with: the losses of DCP, PointNetLK and PCRNet.

PointNetLK and PCRNet hold the pose constant between their iterations, so that each iteration learns
to make the best of where it starts; their losses are sums over the iterations, of which the last
counts most.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from vanejax.matching import pose_metrics, weighted_procrustes
from vanejax.matching.baselines.dcp import Dcp, Embedding, Match
from vanejax.matching.baselines.pcrnet import PcrNet
from vanejax.matching.baselines.pointnetlk import LucasKanadeSteps, PointNetLK
from vanejax.matching.metrics import nearest_offsets
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.settings import Settings, factor, not_negative, positive, settings_class
from vanejax.training.gradient_sums import mean_over_pairs
from vanejax.training.pairs import Pair
from vanejax.training.rpmnet_loss import matching_loss, pose_loss
from vanejax.training.train_step import Metrics, Variables


def pose_parts(found: RigidTransform, truth: RigidTransform) -> Metrics:
    """``|R^T R* - I|^2`` and ``|t - t*|^2``, sums of squared elements [] of one pair.

    Source: DCP, eq. 12. The first as ``|R* - R|^2``, its equal for rotations, which costs no digits
    near 0.
    """
    return {
        "rotation": jnp.sum((truth.rotation - found.rotation) ** 2),
        "translation": jnp.sum((found.translation - truth.translation) ** 2),
    }


def cycle_loss(match: Match, source: PointCloud, target: PointCloud) -> jax.Array:
    """How far the motions there and back are from cancelling, the sum [] of `pose_parts`.

    On the way back each target point points at the source. The published code turns the translation
    by the inverse of the way back; meant, and taken here, is the way back itself.
    """
    pointer = jax.nn.softmax(match.scores, axis=0).T
    partners = jnp.matmul(pointer, source.xyz, precision=jax.lax.Precision.HIGHEST)
    back = weighted_procrustes(target.xyz, partners, target.mask.astype(partners.dtype))
    still = jax.tree.map(jnp.asarray, RigidTransform.identity())
    parts = pose_parts(back @ match.target_from_source, still)
    return parts["rotation"] + parts["translation"]


@settings_class
class DcpLoss(Settings):
    """The loss of DCP after one iteration, and what vanejax may add to it.

    Attributes:
      rotation: factor in `pose_parts`; 1 as in the paper, 1/9 in its code, which takes means.
      translation: factor in `pose_parts`; 1 as in the paper, 1/3 in its code.
      cycle: factor of `cycle_loss`; 0 as the published default, 0.1 in its option.
      matching: factor of `matching_loss`; 0 as published.
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
        parts = pose_parts(match.target_from_source, truth)
        if self.cycle:
            parts["cycle"] = cycle_loss(match, pair.source, pair.target)
        if self.matching:
            parts["matching"] = matching_loss(
                match, pair.source, pair.target, truth, sigma=self.matching_sigma
            )
        return sum(getattr(self, name) * value for name, value in parts.items()), parts

    def __call__(self, model: Dcp, variables: Any, pairs: Pair) -> tuple[jax.Array, Metrics]:
        """Mean loss [] of a batch, its mean parts [] and pose error."""
        # once for the batch: the reference is the same for every view
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


@settings_class
class _IterationsLoss(Settings):
    """The discounted sum of the parts of a loss over the iterations of a network."""

    iterations: int = positive(10)
    discount: float = not_negative(0.5)
    pairs_at_once: int = positive(1)

    def of_iterations(self, steps: Any, pair: Pair) -> tuple[RigidTransform, Metrics]:
        """The poses [I] that a network found for one pair, and the parts [I] of the loss."""
        raise NotImplementedError

    def __call__(
        self, model: PointNetLK | PcrNet, variables: Variables, pairs: Pair
    ) -> tuple[jax.Array, Metrics]:
        """Mean loss [] of a batch; its mean parts [] and pose error after the last iteration."""
        # once for the batch: PointNetLK's takes seven passes of the encoder and a pseudo-inverse
        template = model.apply(variables, pairs.target, method="template")
        last = jnp.arange(self.iterations - 1.0, -1.0, -1.0)

        def of_pair(shared: Any, pair: Pair) -> tuple[jax.Array, Metrics]:
            variables, template = shared
            start = pair.source, pair.target, RigidTransform.identity()
            steps = model.apply(variables, *start, self.iterations, template=template)
            poses, parts = self.of_iterations(steps, pair)
            per_iteration = sum(getattr(self, name) * value for name, value in parts.items())
            total = jnp.sum(self.discount**last * per_iteration)
            pose, parts = jax.tree.map(lambda leaf: leaf[-1], (poses, parts))
            return total, parts | pose_metrics(pose, pair.target_from_source)

        return mean_over_pairs(
            of_pair, (variables, template), pairs, pairs_at_once=self.pairs_at_once
        )


@settings_class
class PointNetLKLoss(_IterationsLoss):
    """A `vanejax.training.train_step.Loss` for PointNetLK.

    Published: the matrix loss after the last iteration, with gradients through all of them, and in
    the code the sum of squares of the last residual. Here each iteration counts, and the residual
    is a mean, left out by default: that of a partial scan is not 0 at the true pose.

    Attributes:
      iterations, discount, pairs_at_once: as of `RpmNetLoss`; 10 iterations as published.
      matrix: factor of `matrix_loss`; 1 as published.
      residual: factor of the mean square of the features' residual.
    """

    matrix: float = factor(1.0)
    residual: float = factor(0.0)

    def of_iterations(self, steps: LucasKanadeSteps, pair: Pair) -> tuple[RigidTransform, Metrics]:
        """Poses [I] and parts [I]."""
        poses = steps.target_from_source
        parts = {"matrix": jax.vmap(matrix_loss, (0, None))(poses, pair.target_from_source)}
        if self.residual:
            parts["residual"] = jnp.mean(steps.residual**2, axis=-1)
        return poses, parts


@settings_class
class PcrNetLoss(_IterationsLoss):
    """A `vanejax.training.train_step.Loss` for PCRNet.

    Published: the earth mover's distance between the moved source and the template, or Chamfer's,
    after the last iteration, no pose. Both take the whole template to be seen: the half of
    Chamfer's that goes from the template to a partial scan pulls the scan over what it never saw.
    Here that half is left out; and since the true pose is known, it can be learned from directly.

    Attributes:
      iterations, discount, pairs_at_once: as of `RpmNetLoss`; 8 iterations as published.
      pose: factor of `pose_loss`; 0 as published.
      chamfer: factor of `chamfer_loss`.
    """

    iterations: int = positive(8)
    pose: float = factor(1.0)
    chamfer: float = factor(0.0)

    def of_iterations(self, steps: RigidTransform, pair: Pair) -> tuple[RigidTransform, Metrics]:
        """Poses [I] and parts [I]."""
        pose = jax.vmap(pose_loss, (0, None, None))
        parts = {"pose": pose(steps, pair.target_from_source, pair.source)}
        if self.chamfer:
            chamfer = jax.vmap(chamfer_loss, (0, None, None))
            parts["chamfer"] = chamfer(steps, pair.source, pair.target)
        return steps, parts


def matrix_loss(found: RigidTransform, truth: RigidTransform) -> jax.Array:
    """``|found^-1 truth - I|^2`` [], the squared Frobenius norm of a 4 x 4 matrix.

    Source: PointNetLK, section 3.3. Radians and the unit of the poses are added up.
    """
    rest = (found.inverse() @ truth).as_matrix()
    return jnp.sum((rest - jnp.eye(4, dtype=rest.dtype)) ** 2)


def chamfer_loss(found: RigidTransform, source: PointCloud, target: PointCloud) -> jax.Array:
    """Mean squared distance from the moved source [N] to the nearest points of the target [M].

    [] f32, unit-sphere units squared: one half of Chamfer's distance. The target is not empty.
    """
    offsets, _ = nearest_offsets(source.transform(found), target)
    squared = jnp.sum(offsets**2, axis=-1)
    return jnp.sum(squared, where=source.mask) / jnp.maximum(jnp.sum(source.mask), 1)
