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
from vanejax.matching.rpmnet import Match, RpmNet, both_clouds, match_features, neighborhoods
from vanejax.matching.se3 import matmul
from vanejax.matching.sinkhorn import log_sinkhorn
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform


def features(model: RpmNet, variables: Mapping[str, Any], cloud: PointCloud) -> jax.Array:
    """Features [M, feature_width] of a cloud: for the reference, once per part."""
    unturned = jnp.eye(3, dtype=cloud.xyz.dtype)
    return _features(model, variables, cloud, neighborhoods(model, cloud), unturned)


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

    Args:
      model, variables: the network and its weights.
      source: [N] points.
      near: [N, K, 7] f32 of the source, from `neighborhoods`.
      target: [M] points, the reference.
      target_features: [M, feature_width] f32, from `features`.
      target_from_source: the pose to start from.
    """
    moved = source.replace(xyz=target_from_source.apply(source.xyz))
    source_features = _features(model, variables, moved, near, target_from_source.rotation)
    beta, alpha = _AnnealingNet().apply(
        {"params": variables["params"]["annealing_net"]}, *both_clouds(moved, target)
    )
    features = source_features, target_features
    return match_features(
        source, target, *features, alpha, beta, model.sinkhorn_iterations, log_sinkhorn
    )


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


def _features(
    model: RpmNet,
    variables: Mapping[str, Any],
    cloud: PointCloud,
    near: jax.Array,
    rotation: jax.Array,
) -> jax.Array:
    """Features [N, width] of a cloud that was moved after its neighbourhoods were found."""
    net, params = _FeatureNet(model.feature_width), variables["params"]["feature_net"]
    return net.apply({"params": params}, cloud.xyz, near, rotation, cloud.mask)


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


class _FeatureNet(nn.Module):
    """`vanejax.matching.rpmnet.FeatureNet` of neighbourhoods that turn with the cloud."""

    width: int

    @nn.compact
    def __call__(
        self, xyz: jax.Array, near: jax.Array, rotation: jax.Array, mask: jax.Array
    ) -> jax.Array:
        """From xyz [N, 3] as it lies now and near [N, K, 7] as found before it turned."""
        x = _NeighborhoodLayer(self.width, name="prepool_0")(xyz, near, rotation, mask)
        x = DenseNormRelu(self.width, name="prepool_1")(x, mask)
        x = DenseNormReluMax(2 * self.width, name="prepool_2")(x, mask)
        x = DenseNormRelu(2 * self.width, name="postpool_0")(x, mask)
        x = DenseNormRelu(self.width, name="postpool_1")(x, mask)
        x = nn.Dense(self.width, name="postpool_2")(x)
        # Padding may be exactly zero here; its length is sanitised, never divided by.
        squared = jnp.sum(x**2, -1, keepdims=True)
        return x * jax.lax.rsqrt(jnp.maximum(squared, 1e-20))


class _AnnealingNet(nn.Module):
    """`vanejax.matching.rpmnet.AnnealingNet`, the maximum fused with the layer before it."""

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
        """From `both_clouds` to (beta [], alpha [])."""
        for index, features in enumerate((64, 64, 64, 128)):
            x = DenseNormRelu(features, name=f"prepool_{index}")(x, mask)
        x = DenseNormReluCloudMax(1024, num_groups=16, name="prepool_4")(x, mask)[None, :]
        one = jnp.ones((1,), bool)
        x = DenseNormRelu(512, num_groups=16, name="postpool_0")(x, one)
        x = DenseNormRelu(256, num_groups=16, name="postpool_1")(x, one)
        beta, alpha = nn.softplus(nn.Dense(2, name="postpool_2")(x))[0]
        return beta, alpha
