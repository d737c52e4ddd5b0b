"""Drawing training and test pairs from a scan set, inside a jitted step.

The scans live on the device in unit-sphere units of the part; drawing a pair (subset, noise, pose)
is JAX code driven by a key, so that the same key gives the same pair on any machine.
"""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from vanejax.errors import InputError
from vanejax.matching.se3 import exp_so3
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.settings import Settings, not_negative, positive, settings_class, values_of
from vanejax.training.dataset import ScanSet


@flax.struct.dataclass
class Pair:
    """The unit of data: two clouds in unit-sphere units and the motion between them, the label.

    The source [N] is the scan, moved away from the part; the target [M] is the reference, sampled
    from the CAD part.
    """

    source: PointCloud
    target: PointCloud
    target_from_source: RigidTransform


@flax.struct.dataclass
class ScanBank:
    """A scan set on the device: part frame, unit-sphere units.

    Attributes:
      scans: [V, P] padded clouds.
      source_sizes: [V] i32, points to draw of each view: 1024 X / Y.
      reference: [Y] the thinned CAD surface.
    """

    scans: PointCloud
    source_sizes: jax.Array
    reference: PointCloud

    @property
    def size(self) -> int:
        """V, the number of views."""
        return self.scans.mask.shape[0]

    def draw(self, key: jax.Array, views: jax.Array, sampling: PairSampling) -> Pair:
        """`draw_pairs` of these views [B] i32."""
        return draw_pairs(key, self, views, sampling)


@settings_class
class PairSampling(Settings):
    """How pairs are drawn; the defaults are the paper's (section III.D).

    Attributes:
      num_reference: M, points of the reference; a source has M X / Y.
      num_source: N, rows of every source, and the most points that it has; 0 stands for what the
        view that sees most needs, see `fitted`.
      noise: standard deviation of the Gaussian noise on both clouds, unit-sphere units.
      noise_clip: largest noise per coordinate, unit-sphere units (RPM-Net's jitter).
      max_rotation_deg: the pose's rotation angle is uniform up to here, about a uniform axis.
      max_translation: each coordinate of the translation is uniform in plus or minus this,
        unit-sphere units.
    """

    num_reference: int = positive(1024)
    num_source: int = not_negative(0)
    noise: float = not_negative(0.01)
    noise_clip: float = positive(0.05)
    max_rotation_deg: float = not_negative(45.0)
    max_translation: float = not_negative(0.5)

    def fitted(self, scan_set: ScanSet) -> PairSampling:
        """The same with as many rows as the sources of these scans need, where none are set."""
        rows = self.num_source or int(source_sizes(scan_set, self.num_reference).max())
        return PairSampling(**values_of(PairSampling, self) | {"num_source": rows})


def source_sizes(scan_set: ScanSet, num_reference: int) -> np.ndarray:
    """[V] i32: 1024 X / Y with the paper's 1024 (section III.D), at least 16."""
    wanted = np.rint(num_reference * scan_set.visible_fraction).astype(np.int32)
    return np.minimum(np.maximum(wanted, 16), scan_set.counts)


def make_bank(scan_set: ScanSet, *, num_reference: int) -> ScanBank:
    """Moves scans into the part frame (float64, on the host) and onto the device as float32.

    Raises:
      InputError: the CAD surface has fewer thinned points than ``num_reference``.
    """
    if len(scan_set.reference_points) < num_reference:
        raise InputError(
            f"the thinned CAD surface has {len(scan_set.reference_points)} points, "
            f"{num_reference} are wanted; take a smaller voxel"
        )
    part_from_camera = scan_set.viewpoints.camera_from_part.inverse()
    center, radius = scan_set.center, scan_set.radius_mm
    mask = np.arange(scan_set.points.shape[1])[None, :] < scan_set.counts[:, None]
    xyz = (part_from_camera.apply(scan_set.points.astype(np.float64)) - center) / radius
    normals = part_from_camera.rotate(scan_set.normals.astype(np.float64))
    xyz, normals = (np.where(mask[..., None], rows, 0.0) for rows in (xyz, normals))
    reference = PointCloud.create(
        xyz=jnp.asarray((scan_set.reference_points - center) / radius, jnp.float32),
        normals=jnp.asarray(scan_set.reference_normals, jnp.float32),
    )
    return ScanBank(
        scans=PointCloud(*(jnp.asarray(a, jnp.float32) for a in (xyz, normals)), jnp.asarray(mask)),
        source_sizes=jnp.asarray(source_sizes(scan_set, num_reference)),
        reference=reference,
    )


def draw_subset(key: jax.Array, cloud: PointCloud, size: jax.Array, rows: int) -> PointCloud:
    """``size`` [] different real points of a cloud [P] in random order, padded to ``rows``."""
    order = jax.random.uniform(key, cloud.mask.shape)
    _, index = jax.lax.top_k(jnp.where(cloud.mask, order, -1.0), rows)
    mask = cloud.mask[index] & (jnp.arange(rows) < size)
    xyz, normals = (jnp.where(mask[:, None], a[index], 0.0) for a in (cloud.xyz, cloud.normals))
    return PointCloud(xyz, normals, mask)


def jitter(key: jax.Array, cloud: PointCloud, sampling: PairSampling) -> PointCloud:
    """Adds clipped Gaussian noise to the points; normals stay, as in the paper's protocol."""
    noise = sampling.noise * jax.random.normal(key, cloud.xyz.shape)
    noise = jnp.clip(noise, -sampling.noise_clip, sampling.noise_clip)
    return cloud.replace(xyz=cloud.xyz + jnp.where(cloud.mask[:, None], noise, 0.0))


def draw_pose(key: jax.Array, sampling: PairSampling) -> RigidTransform:
    """A random rigid motion of at most the sampling's rotation and translation."""
    axis_key, angle_key, translation_key = jax.random.split(key, 3)
    axis = jax.random.normal(axis_key, (3,))
    axis = axis / jnp.linalg.norm(axis)
    angle = jnp.deg2rad(sampling.max_rotation_deg) * jax.random.uniform(angle_key)
    limit = sampling.max_translation
    translation = jax.random.uniform(translation_key, (3,), minval=-limit, maxval=limit)
    return RigidTransform(rotation=exp_so3(axis * angle), translation=translation)


def draw_target(key: jax.Array, bank: ScanBank, sampling: PairSampling) -> PointCloud:
    """A noisy reference [M]: one serves a whole batch of views."""
    subset_key, noise_key = jax.random.split(key)
    rows = sampling.num_reference
    subset = draw_subset(subset_key, bank.reference, jnp.asarray(rows), rows)
    return jitter(noise_key, subset, sampling)


def draw_source(
    key: jax.Array, bank: ScanBank, view: jax.Array, sampling: PairSampling
) -> tuple[PointCloud, RigidTransform]:
    """A noisy source [N] of one view, moved by a random pose, and its target_from_source."""
    subset_key, noise_key, pose_key = jax.random.split(key, 3)
    scan = jax.tree.map(lambda leaf: leaf[view], bank.scans)
    subset = draw_subset(subset_key, scan, bank.source_sizes[view], sampling.num_source)
    source_from_target = draw_pose(pose_key, sampling)
    moved = jitter(noise_key, subset, sampling).transform(source_from_target)
    # Padding moves with the rest, then goes back to zero: it must stay finite, nothing more.
    moved = moved.replace(xyz=jnp.where(moved.mask[:, None], moved.xyz, 0.0))
    return moved, source_from_target.inverse()


def draw_pairs(key: jax.Array, bank: ScanBank, views: jax.Array, sampling: PairSampling) -> Pair:
    """A batch: source [B, N] and target_from_source [B], and one target [M] for all of them."""
    target_key, source_key = jax.random.split(key)
    keys = jax.random.split(source_key, views.shape[0])
    draw = jax.vmap(lambda key, view: draw_source(key, bank, view, sampling))
    source, target_from_source = draw(keys, views)
    return Pair(source, draw_target(target_key, bank, sampling), target_from_source)
