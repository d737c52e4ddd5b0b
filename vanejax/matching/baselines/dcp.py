"""DCP: Deep Closest Point v2 (Wang and Solomon, ICCV 2019), in unit-sphere units of the part.

Features of both clouds (`Dgcnn`), made to depend on each other by a transformer, point each source
point softly at the target; the rigid motion is the least-squares fit to where they point, every
point counting alike. There is no slack: each source point has a partner, whether it has one or not.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from vanejax.errors import InputError
from vanejax.matching.baselines.dgcnn import Dgcnn
from vanejax.matching.baselines.transformer import Encoded, Transformer
from vanejax.matching.contract import (
    Register,
    Registration,
    from_partners,
    last_iteration,
    pose_where,
)
from vanejax.matching.procrustes import weighted_procrustes
from vanejax.matching.se3 import matmul
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.settings import Settings, positive, settings_class


class Embedding(NamedTuple):
    """A cloud as far as it depends on no other: features [N, width] f32 of `Dgcnn`, and encoded."""

    features: jax.Array
    encoded: Encoded


@flax.struct.dataclass
class Match:
    """One iteration of DCP.

    Attributes:
      target_from_source: the total motion after this iteration.
      scores: [N, M] f32, how well source and target points agree; -1e9 at padding of either.
      partners: [N, 3] f32, where each source point points at; of no meaning at padding.
    """

    target_from_source: RigidTransform
    scores: jax.Array
    partners: jax.Array

    @property
    def log_assignment(self) -> jax.Array:
        """Log of the pointer [N, M]: the exponentials of a real row sum to 1."""
        return jax.nn.log_softmax(self.scores, axis=1)


@settings_class
class DcpSettings(Settings):
    """What a DCP is made of; the defaults are as published.

    Attributes:
      width: channels of a feature.
      num_neighbors: K of the graph, the point itself counted.
      heads: of every attention; divides ``width``.
      hidden: channels inside a feed-forward layer.
    """

    width: int = positive(512)
    num_neighbors: int = positive(20)
    heads: int = positive(4)
    hidden: int = positive(1024)

    def check(self, path: str = "") -> None:
        """As `Settings.check`; the heads divide the width."""
        super().check(path)
        if self.width % self.heads:
            raise InputError(
                f"{path}.width={self.width} must be a multiple of {path}.heads={self.heads}"
            )


class Dcp(nn.Module, DcpSettings):
    """DCP for one pair; `jax.vmap` over pairs. Its fields are `DcpSettings`."""

    def setup(self) -> None:
        """Names the two networks."""
        self.dgcnn = Dgcnn(self.width, self.num_neighbors)
        self.transformer = Transformer(self.width, self.heads, self.hidden)

    def embed(self, cloud: PointCloud) -> Embedding:
        """All that a cloud [N] brings to a match: for the reference, once per part."""
        features = self.dgcnn(cloud.xyz, cloud.mask)
        return Embedding(features, self.transformer.encode(features, cloud.mask))

    def match(
        self,
        source: PointCloud,
        target: PointCloud,
        target_embedding: Embedding,
        target_from_source: RigidTransform,
    ) -> Match:
        """One iteration from the pose ``target_from_source``, which is held constant."""
        moved = source.replace(xyz=target_from_source.apply(source.xyz))
        of_source, of_target = self.embed(moved), target_embedding
        decode = self.transformer.decode
        from_source = of_source.features + decode(of_source.encoded, of_target.encoded, target.mask)
        from_target = of_target.features + decode(of_target.encoded, of_source.encoded, source.mask)
        scores = jnp.matmul(from_source * self.width**-0.5, from_target.T)
        real = source.mask[:, None] & target.mask[None, :]
        scores = jnp.where(real, scores, -1e9)
        partners = matmul(jax.nn.softmax(scores, axis=1), target.xyz)
        weights = source.mask.astype(partners.dtype)
        return Match(weighted_procrustes(source.xyz, partners, weights), scores, partners)

    def __call__(
        self, source: PointCloud, target: PointCloud, init: RigidTransform, iterations: int
    ) -> list[Match]:
        """All iterations from ``init``, the last one last, to look at; `last_match` is faster.

        Their number is static; 1 as published.
        """
        target_embedding = self.embed(target)
        matches: list[Match] = []
        for _ in range(iterations):
            pose = jax.lax.stop_gradient(matches[-1].target_from_source) if matches else init
            matches.append(self.match(source, target, target_embedding, pose))
        return matches


def last_match(
    model: Dcp,
    variables: Mapping[str, Any],
    source: PointCloud,
    target: PointCloud,
    init: RigidTransform,
    *,
    iterations: int,
) -> Match:
    """The last of several iterations, at least 1."""
    target_embedding = model.apply(variables, target, method="embed")

    def match(pose: RigidTransform) -> Match:
        return model.apply(variables, source, target, target_embedding, pose, method="match")

    return last_iteration(match, init, iterations=iterations)


def dcp(model: Dcp, variables: Mapping[str, Any], *, iterations: int = 1) -> Register:
    """A trained DCP as a `Register`: source and target in unit-sphere units.

    ``init`` is the answer where a cloud is empty or the network's answer is not finite.
    """

    def register(
        source: PointCloud, target: PointCloud, init: RigidTransform, key: jax.Array
    ) -> Registration:
        del key  # nothing here is random
        match = last_match(model, variables, source, target, init, iterations=iterations)
        both = jnp.any(source.mask) & jnp.any(target.mask)
        converged = both & jnp.all(jnp.isfinite(match.target_from_source.as_matrix()))
        pose = pose_where(converged, match.target_from_source, init)
        residual = jnp.where(converged, pose.apply(source.xyz) - match.partners, 0.0)
        squared, weights = jnp.sum(residual**2, -1), source.mask & both
        return from_partners(
            source, pose, squared, weights, converged=converged, iterations=iterations
        )

    return register
