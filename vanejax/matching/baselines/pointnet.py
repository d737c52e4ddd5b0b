"""PointNet: one feature for a whole cloud, and what is made of it (Qi et al., CVPR 2017).

The points pass through the same dense layers, and the maximum over the real ones is the cloud's
feature. No layer is normalised: a batch's statistics would mix pairs and see padding. The layers
are handed out as arrays, so that a loop over iterations can be one `jax.lax.scan`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp

from vanejax.matching.contract import Register, Registration, from_partners, pose_where
from vanejax.matching.fused_layers import cloud_max, product
from vanejax.pointcloud import PointCloud, squared_distances
from vanejax.rigid import RigidTransform

Layers = list[tuple[jax.Array, jax.Array]]  # kernels [C, C'] and biases [C'], first to last

WIDTHS = (3, 64, 64, 64, 128, 1024)  # of the encoder of PointNetLK and PCRNet


class DenseLayers(nn.Module):
    """The parameters of dense layers with ReLU, under He's initialisation (He et al., 2015).

    ``widths`` are the channels of the input, then of every layer.
    """

    widths: tuple[int, ...] = WIDTHS

    @nn.compact
    def __call__(self) -> Layers:
        """Kernels and biases, f32."""
        return [
            (
                self.param(f"kernel_{index}", nn.initializers.he_normal(), shape),
                self.param(f"bias_{index}", _uniform, shape),
            )
            for index, shape in enumerate(itertools.pairwise(self.widths))
        ]


def _uniform(key: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """Biases [C'], uniform in plus or minus 1 / sqrt(C), PyTorch's default.

    Without any, every feature of a fresh network would grow in proportion to the cloud, its kinks
    all at the origin: blind to much of the shape, it learns rotations later.
    """
    limit = shape[0] ** -0.5
    return jax.random.uniform(key, shape[1:], minval=-limit, maxval=limit)


def dense_relu(layers: Layers, x: jax.Array) -> jax.Array:
    """Dense layers with ReLU after each, from x [N, C] to [N, C']."""
    for kernel, bias in layers:
        x = nn.relu(product(x, kernel) + bias[None, :])
    return x


def cloud_feature(layers: Layers, xyz: jax.Array, mask: jax.Array) -> jax.Array:
    """The feature [C'] of a cloud xyz [N, 3] with mask [N]; 0 where no point is real."""
    # A GPU's TF32 would drown the differences of features that PointNetLK's Jacobian is made of.
    with jax.default_matmul_precision("highest"):
        kernel, bias = layers[-1]
        # the last ReLU and bias are monotone: only the maximum has to pass them
        return nn.relu(cloud_max(dense_relu(layers[:-1], xyz), kernel, mask) + bias)


def register_by_pose(
    solve: Callable[[PointCloud, PointCloud, RigidTransform], tuple[RigidTransform, jax.Array]],
    *,
    iterations: int,
    partner_distance: float,
) -> Register:
    """A method that knows no correspondences: a point's partner is the nearest target point.

    Args:
      solve: from source, target and init to the answer and whether it has settled on it. ``init``
        is the answer instead where it is not finite or a cloud is empty.
      iterations: done.
      partner_distance: partners lie within it, in the clouds' unit.
    """

    def register(
        source: PointCloud, target: PointCloud, init: RigidTransform, key: jax.Array
    ) -> Registration:
        del key  # nothing here is random
        found, settled = solve(source, target, init)
        known = jnp.all(jnp.isfinite(found.as_matrix())) & jnp.any(source.mask)
        known &= jnp.any(target.mask)
        pose = pose_where(known, found, init)
        squared = squared_distances(pose.apply(source.xyz), target.xyz)
        nearest = jnp.min(squared, axis=1, where=target.mask[None, :], initial=jnp.inf)
        partnered = source.mask & (nearest <= partner_distance**2)
        converged = known & settled & jnp.any(partnered)
        return from_partners(
            source, pose, nearest, partnered, converged=converged, iterations=iterations
        )

    return register
