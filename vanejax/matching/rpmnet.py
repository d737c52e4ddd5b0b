"""RPM-Net: robust point matching with learned features (Yew and Lee, CVPR 2020).

Each iteration extracts features from the moved source, matches them to the reference's by a
sinkhorn-normalised soft assignment with slack, and solves a weighted Procrustes problem for the
total motion. What does not change is computed once: the reference's features, and the source's
neighbours and point-pair features, which no rigid motion touches.

Coordinates are in unit-sphere units: the part's centre is the origin, its radius is 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from vanejax.matching.contract import Register, Registration
from vanejax.matching.features import point_pair_features
from vanejax.matching.iteration import last_iteration
from vanejax.matching.layers import (
    DenseNormRelu,
    DenseNormReluCloudMax,
    DenseNormReluMax,
    GroupNorm,
    Linear,
    norm_relu,
)
from vanejax.matching.procrustes import weighted_procrustes
from vanejax.matching.sinkhorn import log_sinkhorn, soft_correspondences
from vanejax.matching.torch_weights import (
    rpmnet_variables as variables_from_torch,  # noqa: F401  # the name of older scripts
)
from vanejax.pointcloud import PointCloud, ball_query
from vanejax.rigid import RigidTransform
from vanejax.settings import Settings, multiple_of, positive, settings_class


@flax.struct.dataclass
class Match:
    """One iteration of RPM-Net.

    Attributes:
      target_from_source: the total motion after this iteration.
      log_assignment: [N, M] f32.
      partners: [N, 3] f32, the soft correspondence of each source point.
      weights: [N] f32, row sums of the assignment; 0 at padding.
      alpha: [] f32, squared feature distance at which a pair is as good as the slack.
      beta: [] f32, annealing: how sharply distance counts.
    """

    target_from_source: RigidTransform
    log_assignment: jax.Array
    partners: jax.Array
    weights: jax.Array
    alpha: jax.Array
    beta: jax.Array


class NeighborhoodLayer(nn.Module):
    """`DenseNormRelu` of ``[xyz, turned offset, ppf]``; what is turned is the kernel."""

    features: int

    @nn.compact
    def __call__(
        self, xyz: jax.Array, near: jax.Array, rotation: jax.Array, mask: jax.Array
    ) -> jax.Array:
        """From xyz [N, 3], near [N, K, 7], rotation [3, 3] and mask [N] to [N, K, features]."""
        kernel, bias = Linear(self.features, name="dense")(10)
        exact = jax.lax.Precision.HIGHEST  # as wherever points are turned
        of_offset = jnp.matmul(rotation.T, kernel[3:6], precision=exact)
        turned = jnp.concatenate([kernel[:3], of_offset, kernel[6:]])
        center = jnp.broadcast_to(xyz[:, None, :], (*near.shape[:2], 3))
        norm = GroupNorm(self.features, num_groups=8, name="norm")
        return norm_relu(jnp.concatenate([center, near], -1), turned, bias, norm, mask)


class FeatureNet(nn.Module):
    """Local features: shared MLP over neighbours, max, MLP, unit length."""

    width: int = 96

    @nn.compact
    def __call__(
        self, xyz: jax.Array, near: jax.Array, rotation: jax.Array, mask: jax.Array
    ) -> jax.Array:
        """Features of a cloud that was moved after its neighbourhoods were found.

        Args:
          xyz: [N, 3] f32, where its points lie now.
          near: [N, K, 7] f32, as `RpmNet.neighborhoods` found them.
          rotation: [3, 3] f32, by which the cloud has turned since.
          mask: [N] bool.

        Returns:
          [N, width] f32, unit length.
        """
        x = NeighborhoodLayer(self.width, name="prepool_0")(xyz, near, rotation, mask)
        x = DenseNormRelu(self.width, name="prepool_1")(x, mask)
        x = DenseNormReluMax(2 * self.width, name="prepool_2")(x, mask)
        x = DenseNormRelu(2 * self.width, name="postpool_0")(x, mask)
        x = DenseNormRelu(self.width, name="postpool_1")(x, mask)
        x = nn.Dense(self.width, name="postpool_2")(x)
        # Padding may be exactly zero here; its length is sanitised, never divided by.
        squared = jnp.sum(x**2, -1, keepdims=True)
        return x * jax.lax.rsqrt(jnp.maximum(squared, 1e-20))


class AnnealingNet(nn.Module):
    """Predicts the annealing parameters from the two clouds as they lie now."""

    @nn.compact
    def __call__(
        self, source: jax.Array, target: jax.Array, mask: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """From source [N, 3], target [M, 3] and mask [N + M] to (beta [], alpha [])."""
        flags = [jnp.zeros_like(source[:, :1]), jnp.ones_like(target[:, :1])]
        x = jnp.concatenate([jnp.concatenate([source, target]), jnp.concatenate(flags)], -1)
        for index, features in enumerate((64, 64, 64, 128)):
            x = DenseNormRelu(features, name=f"prepool_{index}")(x, mask)
        x = DenseNormReluCloudMax(1024, num_groups=16, name="prepool_4")(x, mask)[None, :]
        one = jnp.ones((1,), bool)
        x = DenseNormRelu(512, num_groups=16, name="postpool_0")(x, one)
        x = DenseNormRelu(256, num_groups=16, name="postpool_1")(x, one)
        beta, alpha = nn.softplus(nn.Dense(2, name="postpool_2")(x))[0]
        return beta, alpha


@settings_class
class RpmNetSettings(Settings):
    """What an RPM-Net is made of.

    Attributes:
      num_neighbors: K, the paper's k.
      radius: of the neighbourhood, unit-sphere units.
      sinkhorn_iterations: rounds of normalisation.
      feature_width: channels of a feature; the normalisation has 8 groups of them.
    """

    num_neighbors: int = positive(32)
    radius: float = positive(0.3)
    sinkhorn_iterations: int = positive(5)
    feature_width: int = multiple_of(8, 96)


class RpmNet(RpmNetSettings, nn.Module):
    """RPM-Net for one pair; `jax.vmap` over pairs. Its fields are `RpmNetSettings`."""

    def setup(self) -> None:
        """Names the two networks."""
        self.feature_net = FeatureNet(self.feature_width)
        self.annealing_net = AnnealingNet()

    def neighborhoods(self, cloud: PointCloud) -> jax.Array:
        """Offsets (neighbour minus point) and point-pair features of a cloud [N]: [N, K, 3 + 4].

        No parameters take part, and the point-pair features stay as they are when the cloud moves.
        """
        index = ball_query(
            cloud.xyz, cloud.mask, radius=self.radius, num_neighbors=self.num_neighbors
        )
        offsets = cloud.xyz[index] - cloud.xyz[:, None, :]
        ppf = point_pair_features(offsets, cloud.normals, cloud.normals[index])
        return jnp.concatenate([offsets, ppf], -1)

    def features(self, cloud: PointCloud) -> jax.Array:
        """Features [M, feature_width] of a cloud: for the reference, once per part."""
        unturned = jnp.eye(3, dtype=cloud.xyz.dtype)
        return self.feature_net(cloud.xyz, self.neighborhoods(cloud), unturned, cloud.mask)

    def match(
        self,
        source: PointCloud,
        near: jax.Array,
        target: PointCloud,
        target_features: jax.Array,
        target_from_source: RigidTransform,
    ) -> Match:
        """One iteration from the pose ``target_from_source``, which is held constant."""
        moved = target_from_source.apply(source.xyz)
        features = self.feature_net(moved, near, target_from_source.rotation, source.mask)
        both = jnp.concatenate([source.mask, target.mask])
        beta, alpha = self.annealing_net(moved, target.xyz, both)
        # Features have unit length: |f - g|^2 = 2 - 2 f.g
        distances = 2.0 - 2.0 * jnp.matmul(features, target_features.T)
        log_assignment = log_sinkhorn(
            -beta * (distances - alpha),
            source.mask,
            target.mask,
            iterations=self.sinkhorn_iterations,
        )
        partners, weights = soft_correspondences(jnp.exp(log_assignment), target.xyz)
        return Match(
            target_from_source=weighted_procrustes(source.xyz, partners, weights),
            log_assignment=log_assignment,
            partners=partners,
            weights=weights,
            alpha=alpha,
            beta=beta,
        )

    def __call__(
        self,
        source: PointCloud,
        target: PointCloud,
        init: RigidTransform,
        iterations: int,
        target_features: jax.Array | None = None,
    ) -> list[Match]:
        """All iterations from ``init``, the last one last, to look at; `last_match` is faster.

        Args:
          source: [N] points.
          target: [M] points, the reference.
          init: target_from_source to start from.
          iterations: static; 2 in training, 5 at inference as published.
          target_features: [M, feature_width] from `features`, to share them between pairs.
        """
        if target_features is None:
            target_features = self.features(target)
        near = self.neighborhoods(source)
        matches: list[Match] = []
        pose = init
        for _ in range(iterations):
            matches.append(self.match(source, near, target, target_features, pose))
            pose = jax.lax.stop_gradient(matches[-1].target_from_source)
        return matches


def last_match(
    model: RpmNet,
    variables: Mapping[str, Any],
    source: PointCloud,
    target: PointCloud,
    init: RigidTransform,
    *,
    iterations: int,
    near: jax.Array | None = None,
    target_features: jax.Array | None = None,
) -> Match:
    """The last of several iterations; see `last_iteration`.

    Args:
      model, variables: the network and its weights.
      source: [N] points.
      target: [M] points, the reference.
      init: target_from_source to start from.
      iterations: static, at least 1.
      near: [N, K, 7] from `RpmNet.neighborhoods`, where several starts share them.
      target_features: [M, feature_width] from `RpmNet.features`, where several pairs share them.
    """
    if near is None:
        near = model.apply(variables, source, method=RpmNet.neighborhoods)
    if target_features is None:
        target_features = model.apply(variables, target, method=RpmNet.features)

    def match(pose: RigidTransform) -> Match:
        return model.apply(
            variables, source, near, target, target_features, pose, method=RpmNet.match
        )

    return last_iteration(match, init, iterations=iterations)


def rpmnet(model: RpmNet, variables: Mapping[str, Any], *, iterations: int = 5) -> Register:
    """A trained RPM-Net as a `Register`: source and target in unit-sphere units."""

    def register(
        source: PointCloud, target: PointCloud, init: RigidTransform, key: jax.Array
    ) -> Registration:
        del key  # nothing here is random
        match = last_match(model, variables, source, target, init, iterations=iterations)
        return registration_from_match(source, match, iterations)

    return register


def registration_from_match(source: PointCloud, match: Match, iterations: int) -> Registration:
    """The common result type from the last iteration of RPM-Net."""
    residual = match.target_from_source.apply(source.xyz) - match.partners
    total = jnp.maximum(jnp.sum(match.weights), 1e-9)
    squared = jnp.sum(match.weights * jnp.sum(residual**2, -1)) / total
    overlap = jnp.sum(match.weights) / jnp.maximum(jnp.sum(source.mask), 1)
    finite = jnp.all(jnp.isfinite(match.target_from_source.as_matrix()))
    return Registration(
        target_from_source=match.target_from_source,
        converged=finite & (overlap > 1e-3),
        iterations=jnp.asarray(iterations, jnp.int32),
        rmse=jnp.sqrt(squared),
        overlap=overlap,
    )
