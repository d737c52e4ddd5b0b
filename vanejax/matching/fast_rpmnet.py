"""RPM-Net as training and registration run it: the function of `RpmNet`, computed faster.

What does not change is computed once: the reference's features, and the source's neighbours and
point-pair features, which no rigid motion touches. Layers, normalisation and maxima are fused
(`vanejax.matching.fused_layers`). Unlike the plain form it stays finite for clouds without points.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from vanejax.matching.contract import Register, Registration, from_partners, last_iteration
from vanejax.matching.fused_layers import (
    DenseNormRelu,
    DenseNormReluCloudMax,
    DenseNormReluMax,
    NormedLayer,
    norm_relu,
)
from vanejax.matching.rpmnet import (
    AnnealingNet,
    FeatureNet,
    Match,
    RpmNet,
    both_clouds,
    match_features,
    neighborhoods,
)
from vanejax.matching.se3 import matmul
from vanejax.matching.sinkhorn import log_sinkhorn
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform


def features(
    model: RpmNet,
    variables: Mapping[str, Any],
    cloud: PointCloud,
    near: jax.Array | None = None,
    rotation: jax.Array | None = None,
) -> jax.Array:
    """Features [M, feature_width] of a cloud: for the reference, once per part.

    Where the cloud was turned after its neighbourhoods ``near`` were found, by ``rotation``.
    """
    near = neighborhoods(model, cloud) if near is None else near
    rotation = jnp.eye(3, dtype=cloud.xyz.dtype) if rotation is None else rotation
    net, params = _FeatureNet(model.feature_width), variables["params"]["feature_net"]
    return net.apply({"params": params}, cloud.xyz, near, rotation, cloud.mask)


def match(
    model: RpmNet,
    variables: Mapping[str, Any],
    source: PointCloud,
    near: jax.Array,
    target: PointCloud,
    target_features: jax.Array,
    target_from_source: RigidTransform,
) -> Match:
    """One iteration from the pose ``target_from_source``.

    From a source [N] with its `neighborhoods` ``near`` [N, K, 7] and a target [M] with its
    `features` [M, feature_width], f32.
    """
    moved = source.replace(xyz=target_from_source.apply(source.xyz))
    source_features = features(model, variables, moved, near, target_from_source.rotation)
    beta, alpha = _AnnealingNet().apply(
        {"params": variables["params"]["annealing_net"]}, *both_clouds(moved, target)
    )
    pair = source, target, source_features, target_features
    return match_features(*pair, alpha, beta, model.sinkhorn_iterations, log_sinkhorn)


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
    """The last of several iterations, at least 1; see `match`.

    Several starts can share ``near``, and several pairs ``target_features``.
    """
    near = neighborhoods(model, source) if near is None else near
    if target_features is None:
        target_features = features(model, variables, target)
    return last_iteration(
        lambda pose: match(model, variables, source, near, target, target_features, pose),
        init,
        iterations=iterations,
    )


def rpmnet(model: RpmNet, variables: Mapping[str, Any], *, iterations: int = 5) -> Register:
    """A trained RPM-Net as a `Register`: source and target in unit-sphere units."""

    def register(
        source: PointCloud, target: PointCloud, init: RigidTransform, key: jax.Array
    ) -> Registration:
        del key  # nothing here is random
        match = last_match(model, variables, source, target, init, iterations=iterations)
        pose, weights = match.target_from_source, match.weights
        squared = jnp.sum((pose.apply(source.xyz) - match.partners) ** 2, -1)
        finite = jnp.all(jnp.isfinite(pose.as_matrix()))
        result = from_partners(
            source, pose, squared, weights, converged=finite, iterations=iterations
        )
        return result.replace(converged=finite & (result.overlap > 1e-3))

    return register


class _NeighborhoodLayer(NormedLayer):
    """`DenseNormRelu` of ``[xyz, turned offset, ppf]``; what is turned is the kernel."""

    @nn.compact
    def __call__(
        self, xyz: jax.Array, near: jax.Array, rotation: jax.Array, mask: jax.Array
    ) -> jax.Array:
        """From xyz [N, 3], near [N, K, 7], rotation [3, 3] and mask [N] to [N, K, features]."""
        kernel, bias, norm = self.parts(10)
        turned = jnp.concatenate([kernel[:3], matmul(rotation.T, kernel[3:6]), kernel[6:]])
        center = jnp.broadcast_to(xyz[:, None, :], (*near.shape[:2], 3))
        return norm_relu(jnp.concatenate([center, near], -1), turned, bias, norm, mask)


class _FeatureNet(FeatureNet):
    """`FeatureNet` of neighbourhoods that turn with the cloud."""

    layer: Any = DenseNormRelu

    @nn.compact
    def __call__(
        self, xyz: jax.Array, near: jax.Array, rotation: jax.Array, mask: jax.Array
    ) -> jax.Array:
        """From xyz [N, 3] as it lies now and near [N, K, 7] as found before it turned."""
        x = _NeighborhoodLayer(self.width, name="prepool_0")(xyz, near, rotation, mask)
        x = DenseNormRelu(self.width, name="prepool_1")(x, mask)
        x = DenseNormReluMax(2 * self.width, name="prepool_2")(x, mask)
        return self.postpool(x, mask)


class _AnnealingNet(AnnealingNet):
    """`AnnealingNet`, the maximum fused with the layer before it."""

    layer: Any = DenseNormRelu

    def maximum(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        return DenseNormReluCloudMax(1024, num_groups=16, name="prepool_4")(x, mask)[None, :]
