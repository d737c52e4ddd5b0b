"""PointNetLK: Lucas and Kanade's algorithm on PointNet features (Aoki et al., CVPR 2019).

The inverse compositional form: how the template's feature changes with its pose is found once, and
every iteration turns the difference of the two clouds' features into a step of the source. All
lengths are in unit-sphere units of the part.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from vanejax.matching.baselines.pointnet import (
    WIDTHS,
    DenseLayers,
    cloud_feature,
    register_by_pose,
)
from vanejax.matching.contract import Register
from vanejax.matching.se3 import exp_se3, matmul
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.settings import Settings, not_negative, one_of, positive, settings_class


class Template(NamedTuple):
    """What does not change while sources are aligned to one target.

    The mean [3] of its points, about which it is described, its feature [C], and the Jacobian's
    pseudo-inverse [6, C], f32.
    """

    mean: jax.Array
    feature: jax.Array
    twist_from_feature: jax.Array


class LucasKanadeSteps(NamedTuple):
    """All iterations of PointNetLK, along a leading axis I.

    Attributes:
      target_from_source: [I] the total motion after each.
      twist: [I, 6] f32, the step taken: rotation in radians, translation.
      residual: [I, C] f32, feature of the source before the step minus the template's.
    """

    target_from_source: RigidTransform
    twist: jax.Array
    residual: jax.Array


@settings_class
class PointNetLKSettings(Settings):
    """What a PointNetLK is made of.

    Attributes:
      delta: step of the Jacobian's differences: radians, and the clouds' unit.
      damping: added to the normal equations' diagonal, relative to its mean.
      origin: what both clouds are centred on. "means", as published: each on its own mean, so that
        only the rotation of ``init`` counts; the mean of a partial scan is a guess that the
        iterations have to undo. "target": both on the target's mean.
    """

    delta: float = positive(0.01)
    damping: float = not_negative(1e-6)
    origin: str = one_of("means", "target")


class PointNetLK(nn.Module, PointNetLKSettings):
    """PointNetLK for one pair; `jax.vmap` over pairs. Its fields are `PointNetLKSettings`.

    The pose is held constant between iterations when gradients are taken, as in RPM-Net; the
    published code differentiates through all of them.
    """

    def setup(self) -> None:
        """The encoder."""
        self.encoder = DenseLayers(WIDTHS)

    def template(self, target: PointCloud) -> Template:
        """Describes a target [M]: once per part, seven passes of the encoder.

        Column k of the Jacobian is ``(phi(P) - phi(exp(-delta e_k) P)) / delta``.
        """
        layers = self.encoder()
        mean = _mean(target.xyz, target.mask)
        centered = target.xyz - mean[None, :]
        feature = cloud_feature(layers, centered, target.mask)

        def column(twist: jax.Array) -> jax.Array:
            moved = exp_se3(-twist).apply(centered)
            return (feature - cloud_feature(layers, moved, target.mask)) / self.delta

        # one after the other: a pass fits the caches, six side by side do not
        columns = jax.lax.map(column, self.delta * jnp.eye(6, dtype=feature.dtype))
        normal = matmul(columns, columns.T)
        # of no weight where the Jacobian has full rank; without it, no answer where it has not
        ridge = self.damping * jnp.trace(normal) / 6 + 1e-12
        factor = jax.scipy.linalg.cho_factor(normal + ridge * jnp.eye(6, dtype=normal.dtype))
        return Template(mean, feature, jax.scipy.linalg.cho_solve(factor, columns))

    def __call__(
        self,
        source: PointCloud,
        target: PointCloud,
        init: RigidTransform,
        iterations: int,
        template: Template | None = None,
    ) -> LucasKanadeSteps:
        """All iterations (static, at least 1) from ``init``; pairs can share a `template`."""
        if template is None:
            template = self.template(target)
        layers = self.encoder()
        moved = init.apply(source.xyz)
        mean = _mean(moved, source.mask) if self.origin == "means" else template.mean
        centered = moved - mean[None, :]
        eye = jnp.eye(3, dtype=moved.dtype)
        template_from_target = RigidTransform(rotation=eye, translation=-template.mean)
        source_from_init = RigidTransform(rotation=eye, translation=-mean) @ init

        def iteration(
            template_from_source: RigidTransform, _: None
        ) -> tuple[RigidTransform, LucasKanadeSteps]:
            moved = template_from_source.apply(centered)
            residual = cloud_feature(layers, moved, source.mask) - template.feature
            twist = -matmul(template.twist_from_feature, residual)
            pose = exp_se3(twist) @ template_from_source
            total = template_from_target.inverse() @ pose @ source_from_init
            return jax.lax.stop_gradient(pose), LucasKanadeSteps(total, twist, residual)

        start = RigidTransform(rotation=eye, translation=jnp.zeros_like(mean))
        return jax.lax.scan(iteration, start, length=iterations)[1]


def _mean(xyz: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean [3] of the real points of xyz [N, 3]; 0 where there are none."""
    return jnp.sum(xyz, 0, where=mask[:, None]) / jnp.maximum(jnp.sum(mask), 1)


def pointnetlk(
    model: PointNetLK,
    variables: Mapping[str, Any],
    *,
    iterations: int = 10,
    tolerance: float = 1e-2,
    partner_distance: float = 0.1,
) -> Register:
    """A trained PointNetLK as a `Register`: source and target in unit-sphere units.

    Args:
      model, variables: the network and its weights.
      iterations: at least 1; 10 as published.
      tolerance: it has converged where the last step's twist is shorter (radians and the clouds'
        unit).
      partner_distance: see `pointnet.register_by_pose`; on the vane, 1 is 73 mm.
    """

    def solve(
        source: PointCloud, target: PointCloud, init: RigidTransform
    ) -> tuple[RigidTransform, jax.Array]:
        steps = model.apply(variables, source, target, init, iterations)
        last = jax.tree.map(lambda leaf: leaf[-1], steps)
        return last.target_from_source, jnp.linalg.norm(last.twist) < tolerance

    return register_by_pose(solve, iterations=iterations, partner_distance=partner_distance)
