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

KEPT_SHARE = 0.7
"""Of a cloud's points, what cropping leaves: the published share."""


@flax.struct.dataclass
class ShapeBank:
    """Shapes on the device, each in a frame of its own and in unit-sphere units.

    Attributes:
      points: [S, P, 3] f32.
      normals: [S, P, 3] f32, unit length.
    """

    points: jax.Array
    normals: jax.Array

    @property
    def size(self) -> int:
        """S, the number of shapes."""
        return self.points.shape[0]

    def draw(self, key: jax.Array, entries: jax.Array, sampling: PairSampling) -> Pair:
        """`draw_shape_pairs` of the first of these shapes [B] i32, with B sources.

        A batch shares its target, so it is of one shape; where entries come in random order, so do
        the shapes.
        """
        return draw_shape_pairs(key, self, entries[0], entries.shape[0], sampling)


def crop(key: jax.Array, cloud: PointCloud, rows: int) -> PointCloud:
    """The ``rows`` real points of a cloud [P] that lie farthest in a random direction.

    This is a cut by a plane: the direction is uniform on the sphere, the plane lies where it leaves
    that many points. They keep their order. Padding is cut first.
    """
    direction = jax.random.normal(key, (3,))
    height = jnp.sum(cloud.xyz * direction[None, :], axis=1)
    _, index = jax.lax.top_k(jnp.where(cloud.mask, height, -jnp.inf), rows)
    # by height they would tell a network of the plane: a neighbourhood is cut by index
    return jax.tree.map(lambda leaf: leaf[jnp.sort(index)], cloud)


def draw_shape_pairs(
    key: jax.Array,
    bank: ShapeBank,
    index: jax.Array,
    batch_size: int,
    sampling: PairSampling,
    *,
    keep: float = KEPT_SHARE,
    crop_target: bool = True,
) -> Pair:
    """A batch of one shape, whose sources share one target; every point is real.

    Args:
      index: [] i32, which shape.
      batch_size: B.
      sampling: ``num_reference`` points are drawn for either cloud, then cropped; ``num_source``
        has no say.
      keep: share of the points that cropping leaves, above 0 and at most 1.
      crop_target: whether the target loses a part too, as published. The crop of the target and of
        every source is its own.

    Returns:
      Pair with source [B, N] and target_from_source [B], and one target [M] for all of them, in
      unit-sphere units: N = round(keep num_reference) (717 of 1024), M the same or num_reference.
      Both in random order: row i of one is not row i of the other.

    Raises:
      InputError: the shapes have fewer points than ``num_reference``, or ``keep`` leaves none.
    """
    whole, held = sampling.num_reference, bank.points.shape[1]
    if held < whole:
        raise InputError(f"the shapes have {held} points each, {whole} are wanted")
    rows = round(keep * whole)
    if not 0 < rows <= whole:
        raise InputError(f"keep={keep} leaves {rows} of {whole} points; take 0 < keep <= 1")
    shape = PointCloud.create(xyz=bank.points[index], normals=bank.normals[index])

    def draw_cloud(key: jax.Array, rows: int) -> PointCloud:
        subset_key, crop_key, noise_key = jax.random.split(key, 3)
        cloud = draw_subset(subset_key, shape, jnp.asarray(whole), whole)
        if rows < whole:
            cloud = crop(crop_key, cloud, rows)
        return jitter(noise_key, cloud, sampling)

    def draw_source(key: jax.Array) -> tuple[PointCloud, RigidTransform]:
        cloud_key, pose_key = jax.random.split(key)
        source_from_target = draw_pose(pose_key, sampling)
        moved = draw_cloud(cloud_key, rows).transform(source_from_target)
        return moved, source_from_target.inverse()

    target_key, source_key = jax.random.split(key)
    source, target_from_source = jax.vmap(draw_source)(jax.random.split(source_key, batch_size))
    return Pair(
        source=source,
        target=draw_cloud(target_key, rows if crop_target else whole),
        target_from_source=target_from_source,
    )
