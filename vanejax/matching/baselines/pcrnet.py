"""PCRNet: a pose read from two PointNet features (Sarode et al., arXiv:1908.07906, 2019).

The iterative form: one network looks at the source where it lies now and at the template, and
answers with the motion that is left; the next iteration starts from there with the same weights.
Nothing is centred, as published: the network knows the unit-sphere frame it was trained in.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from vanejax.matching.baselines.pointnet import (
    WIDTHS,
    DenseLayers,
    cloud_feature,
    dense_relu,
    register_by_pose,
)
from vanejax.matching.contract import Register
from vanejax.matching.se3 import hat, matmul
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.settings import Settings, bounded, settings_class


@settings_class
class PcrNetSettings(Settings):
    """What a PCRNet is made of: ``head``, the hidden layers' channels, by default as published."""

    head: tuple[int, ...] = bounded(
        (1024, 1024, 512, 512, 256),
        lambda widths: len(widths) > 0 and min(widths) > 0,
        "be positive numbers",
    )


class PcrNet(nn.Module, PcrNetSettings):
    """PCRNet for one pair; `jax.vmap` over pairs. Its fields are `PcrNetSettings`.

    The pose is held constant between iterations when gradients are taken. The dropout that is
    published for noisy data is left out: it needs keys, and the pairs drawn here never repeat.
    """

    def setup(self) -> None:
        """The encoder, the head and its last layer."""
        self.encoder = DenseLayers(WIDTHS)
        self.hidden = DenseLayers((2 * WIDTHS[-1], *self.head))
        self.pose_kernel = self.param("pose_kernel", nn.initializers.zeros, (self.head[-1], 7))
        # translation 0 and quaternion (1, 0, 0, 0): the first answer moves nothing
        self.pose_bias = self.param("pose_bias", lambda _: jnp.eye(7)[3])

    def template(self, target: PointCloud) -> jax.Array:
        """The feature [1024] of a target [M]: once per part."""
        return cloud_feature(self.encoder(), target.xyz, target.mask)

    def __call__(
        self,
        source: PointCloud,
        target: PointCloud,
        init: RigidTransform,
        iterations: int,
        template: jax.Array | None = None,
    ) -> RigidTransform:
        """The total motion after each iteration from ``init``, along a leading axis.

        The number of iterations is static, at least 1; 8 as published. Pairs can share a
        `template`.
        """
        if template is None:
            template = self.template(target)
        encoder, hidden = self.encoder(), self.hidden()

        def iteration(pose: RigidTransform, _: None) -> tuple[RigidTransform, RigidTransform]:
            feature = cloud_feature(encoder, pose.apply(source.xyz), source.mask)
            x = dense_relu(hidden, jnp.concatenate([feature, template])[None, :])
            answer = (x @ self.pose_kernel)[0] + self.pose_bias
            rest = RigidTransform(rotation=_rotation(answer[3:]), translation=answer[:3])
            total = rest @ pose
            return jax.lax.stop_gradient(total), total

        start = jax.tree.map(lambda leaf: jnp.asarray(leaf, source.xyz.dtype), init)
        return jax.lax.scan(iteration, start, length=iterations)[1]


def _rotation(quaternion: jax.Array) -> jax.Array:
    """[3, 3] of a quaternion [4] = (w, x, y, z) of any length; the identity where that is 0."""
    squared = jnp.sum(quaternion**2)
    unit = quaternion * jax.lax.rsqrt(jnp.maximum(squared, 1e-20))
    k = hat(unit[1:])
    square = matmul(k, k)
    return jnp.eye(3, dtype=k.dtype) + 2 * unit[0] * k + 2 * square


def pcrnet(
    model: PcrNet,
    variables: Mapping[str, Any],
    *,
    iterations: int = 8,
    partner_distance: float = 0.1,
) -> Register:
    """A trained PCRNet as a `Register`: source and target in unit-sphere units.

    It has no measure of its own for having converged: an answer counts as such if it is finite and
    brings a source point near the target.

    Args:
      model, variables: the network and its weights.
      iterations: at least 1; 8 as published.
      partner_distance: see `pointnet.register_by_pose`; on the vane, 1 is 73 mm.
    """

    def solve(
        source: PointCloud, target: PointCloud, init: RigidTransform
    ) -> tuple[RigidTransform, jax.Array]:
        poses = model.apply(variables, source, target, init, iterations)
        return jax.tree.map(lambda leaf: leaf[-1], poses), jnp.asarray(True)

    return register_by_pose(solve, iterations=iterations, partner_distance=partner_distance)
