"""Drawing pairs from generic shapes: what RPM-Net is trained on, to compare with scans of a part.

The protocol is that of Yew and Lee, RPM-Net (CVPR 2020), section 5, for partially visible data:
both clouds are drawn from the same shape on their own, each loses what lies beyond a plane of its
own, and both are noisy. The published code crops before it thins and turns about random Euler
angles; here the clouds are thinned, then cropped, and the pose is that of `pairs.draw_pose`.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

from vanejax.errors import InputError
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.training.pairs import Pair, PairSampling, draw_pose, draw_subset, jitter

KEPT_SHARE = 0.7  # of a cloud's points, what cropping leaves: as published


@flax.struct.dataclass
class ShapeBank:
    """Shapes on the device: points and unit normals [S, P, 3] f32.

    Each has a frame of its own, in unit-sphere units.
    """

    points: jax.Array
    normals: jax.Array

    @property
    def size(self) -> int:
        """S, the number of shapes."""
        return self.points.shape[0]

    def draw(self, key: jax.Array, entries: jax.Array, sampling: PairSampling) -> Pair:
        """A batch of the first of these shapes [B] i32; every point is real.

        A batch shares its target, so it is of one shape; where entries come in random order, so do
        the shapes. Either cloud is ``num_reference`` points of the sampling, cropped; its
        ``num_source`` has no say.

        Returns:
          Pair with source [B, N] and target_from_source [B], and one target [N] for all of them, in
          unit-sphere units, in random order: row i of one is not row i of the other. N is
          0.7 num_reference, rounded: 717 of 1024.

        Raises:
          InputError: the shapes have fewer points than ``num_reference``.
        """
        whole, held = sampling.num_reference, self.points.shape[1]
        if held < whole:
            raise InputError(f"the shapes have {held} points each, {whole} are wanted")
        rows = round(KEPT_SHARE * whole)
        shape = PointCloud.create(xyz=self.points[entries[0]], normals=self.normals[entries[0]])

        def draw_cloud(key: jax.Array) -> PointCloud:
            subset_key, crop_key, noise_key = jax.random.split(key, 3)
            cloud = draw_subset(subset_key, shape, jnp.asarray(whole), whole)
            return jitter(noise_key, crop(crop_key, cloud, rows), sampling)

        def draw_source(key: jax.Array) -> tuple[PointCloud, RigidTransform]:
            cloud_key, pose_key = jax.random.split(key)
            source_from_target = draw_pose(pose_key, sampling)
            moved = draw_cloud(cloud_key).transform(source_from_target)
            return moved, source_from_target.inverse()

        target_key, source_key = jax.random.split(key)
        keys = jax.random.split(source_key, entries.shape[0])
        source, target_from_source = jax.vmap(draw_source)(keys)
        return Pair(source, draw_cloud(target_key), target_from_source)


def crop(key: jax.Array, cloud: PointCloud, rows: int) -> PointCloud:
    """The ``rows`` real points of a cloud [P] on one side of a plane, in their order.

    Its direction is uniform on the sphere; it lies where it leaves that many. Padding is cut first.
    """
    direction = jax.random.normal(key, (3,))
    height = jnp.sum(cloud.xyz * direction[None, :], axis=1)
    _, index = jax.lax.top_k(jnp.where(cloud.mask, height, -jnp.inf), rows)
    # by height they would tell a network of the plane: a neighbourhood is cut by index
    return jax.tree.map(lambda leaf: leaf[jnp.sort(index)], cloud)
