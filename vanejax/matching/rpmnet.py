"""RPM-Net: robust point matching with learned features (Yew and Lee, CVPR 2020).

This is the network as its paper has it, to be read first. In each iteration

1. features ``F`` of the moved source and of the reference come from their neighbourhoods (section
   5.1): a shared MLP over [xyz, offset, point-pair features], the maximum over the neighbours, an
   MLP, unit length;
2. a second network looks at both clouds and predicts ``beta`` and ``alpha`` (section 5.2);
3. the affinity ``-beta (|F_x - F_y|^2 - alpha)`` (eq. 7) becomes a soft assignment ``m`` of
   which rows and columns sum to at most 1 (`sinkhorn`, section 4.1);
4. each source point's partner is the mean of the reference under its row of ``m``, weighted
   Procrustes of all partners gives the motion (eqs 8 and 9).

Training and registration use `vanejax.matching.fast_rpmnet`: the same function of the same
parameters, computed faster. Coordinates are in unit-sphere units of the part.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from vanejax.matching.features import point_pair_features
from vanejax.matching.procrustes import weighted_procrustes
from vanejax.matching.sinkhorn import sinkhorn, soft_correspondences
from vanejax.pointcloud import PointCloud, ball_query
from vanejax.rigid import RigidTransform
from vanejax.settings import Settings, multiple_of, positive, settings_class


@flax.struct.dataclass
class Match:
    """One iteration of RPM-Net.

    Attributes:
      target_from_source: the total motion after this iteration.
      log_assignment: [N, M] f32; its exponential is exactly 0 at padding.
      partners: [N, 3] f32, the soft correspondence of each source point.
      weights: [N] f32, row sums of the assignment; 0 at padding.
      alpha, beta: [] f32, squared feature distance at which a pair is as good as the slack, and
        annealing: how sharply distance counts.
    """

    target_from_source: RigidTransform
    log_assignment: jax.Array
    partners: jax.Array
    weights: jax.Array
    alpha: jax.Array
    beta: jax.Array


class DenseNormRelu(nn.Module):
    """A dense layer on every point, group normalisation over the real points, ReLU."""

    features: int
    num_groups: int = 8

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """From x [N, C] or [N, K, C] with mask [N], at least one True, to [..., features]."""
        x = nn.Dense(self.features, name="dense")(x)
        norm = nn.GroupNorm(
            num_groups=self.num_groups,
            reduction_axes=tuple(range(x.ndim)),
            epsilon=1e-5,  # PyTorch's default
            use_fast_variance=False,
            name="norm",
        )
        real = jnp.broadcast_to(mask.reshape(-1, *(1,) * (x.ndim - 1)), x.shape)
        return nn.relu(norm(x, mask=real))


class FeatureNet(nn.Module):
    """Local features: shared MLP over the neighbours, maximum, MLP, unit length."""

    width: int = 96
    layer: Any = DenseNormRelu

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """From x [N, K, 10] = [xyz, offset, PPF] and mask [N] to [N, width] f32, unit length."""
        for layer, features in enumerate((self.width, self.width, 2 * self.width)):
            x = self.layer(features, name=f"prepool_{layer}")(x, mask)
        return self.postpool(jnp.max(x, axis=1), mask)

    def postpool(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """From the maxima [N, 2 width] to [N, width] f32, unit length."""
        for layer, features in enumerate((2 * self.width, self.width)):
            x = self.layer(features, name=f"postpool_{layer}")(x, mask)
        x = nn.Dense(self.width, name="postpool_2")(x)
        # the length is sanitised, never divided by: at padding it may be 0
        return x * jax.lax.rsqrt(jnp.maximum(jnp.sum(x**2, -1, keepdims=True), 1e-20))


class AnnealingNet(nn.Module):
    """Predicts the annealing parameters from the two clouds as they lie now."""

    layer: Any = DenseNormRelu

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
        """From `both_clouds` to beta [] and alpha [], both positive."""
        for layer, features in enumerate((64, 64, 64, 128)):
            x = self.layer(features, name=f"prepool_{layer}")(x, mask)
        x, real = self.maximum(x, mask), jnp.ones(1, bool)
        for layer, features in enumerate((512, 256)):
            x = self.layer(features, num_groups=16, name=f"postpool_{layer}")(x, real)
        beta, alpha = nn.softplus(nn.Dense(2, name="postpool_2")(x))[0]
        return beta, alpha

    def maximum(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """The last layer of the points, and its maximum over the real ones: [1, 1024]."""
        x = self.layer(1024, num_groups=16, name="prepool_4")(x, mask)
        return jnp.max(x, axis=0, keepdims=True, where=mask[:, None], initial=0.0)


def both_clouds(source: PointCloud, target: PointCloud) -> tuple[jax.Array, jax.Array]:
    """Two clouds as one: [N + M, 4], xyz and a flag of the target's, and mask [N + M]."""
    xyz = jnp.concatenate([source.xyz, target.xyz])
    flags = jnp.concatenate([jnp.zeros_like(source.xyz[:, :1]), jnp.ones_like(target.xyz[:, :1])])
    return jnp.concatenate([xyz, flags], -1), jnp.concatenate([source.mask, target.mask])


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


def neighborhoods(model: RpmNetSettings, cloud: PointCloud) -> jax.Array:
    """Offsets (neighbour minus point) and point-pair features of a cloud [N]: [N, K, 3 + 4].

    No parameters take part, and the point-pair features stay as they are when the cloud moves.
    """
    index = ball_query(
        cloud.xyz, cloud.mask, radius=model.radius, num_neighbors=model.num_neighbors
    )
    offsets = cloud.xyz[index] - cloud.xyz[:, None, :]
    ppf = point_pair_features(offsets, cloud.normals, cloud.normals[index])
    return jnp.concatenate([offsets, ppf], -1)


def match_features(
    source: PointCloud,
    target: PointCloud,
    source_features: jax.Array,
    target_features: jax.Array,
    alpha: jax.Array,
    beta: jax.Array,
    iterations: int,
    normalise: Callable[..., jax.Array],
) -> Match:
    """Steps 3 and 4, from features of unit length, by a form of Sinkhorn and its iterations."""
    # of unit vectors: |f - g|^2 = 2 - 2 f.g
    distances = 2 - 2 * jnp.matmul(source_features, target_features.T)
    log_assignment = normalise(
        -beta * (distances - alpha), source.mask, target.mask, iterations=iterations
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


class RpmNet(nn.Module, RpmNetSettings):
    """RPM-Net for one pair; `jax.vmap` over pairs. Its fields are `RpmNetSettings`."""

    def setup(self) -> None:
        """Names the two networks."""
        self.feature_net = FeatureNet(self.feature_width)
        self.annealing_net = AnnealingNet()

    def features(self, cloud: PointCloud) -> jax.Array:
        """Features [N, feature_width] f32 of a cloud [N]."""
        near = neighborhoods(self, cloud)
        center = jnp.broadcast_to(cloud.xyz[:, None, :], (*near.shape[:2], 3))
        return self.feature_net(jnp.concatenate([center, near], -1), cloud.mask)

    def match(
        self, source: PointCloud, target: PointCloud, target_from_source: RigidTransform
    ) -> Match:
        """One iteration from the pose ``target_from_source``."""
        moved = source.transform(target_from_source)
        beta, alpha = self.annealing_net(*both_clouds(moved, target))
        pair = source, target, self.features(moved), self.features(target)
        return match_features(*pair, alpha, beta, self.sinkhorn_iterations, sinkhorn)

    def __call__(
        self, source: PointCloud, target: PointCloud, init: RigidTransform, iterations: int
    ) -> list[Match]:
        """All iterations from ``init``, the last one last.

        Their number is static; 2 in training, 5 at inference as published.
        """
        matches: list[Match] = []
        for _ in range(iterations):
            # no gradient passes from one iteration to the next, as in the published code
            pose = jax.lax.stop_gradient(matches[-1].target_from_source) if matches else init
            matches.append(self.match(source, target, pose))
        return matches
