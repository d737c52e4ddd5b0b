"""Point clouds with a fixed number of rows: padding and neighbours."""

from __future__ import annotations

import flax.struct
import jax
import jax.numpy as jnp

from vanejax.rigid import RigidTransform


@flax.struct.dataclass
class PointCloud:
    """Points with unit normals; rows past the real ones are padding.

    Attributes:
      xyz: [..., N, 3] f32, finite in every row (padding repeats real points or is zero).
      normals: [..., N, 3] f32, unit length in real rows.
      mask: [..., N] bool, False at padding.
    """

    xyz: jax.Array
    normals: jax.Array
    mask: jax.Array

    @classmethod
    def create(cls, xyz: jax.Array, normals: jax.Array) -> PointCloud:
        """A cloud in which every row is real: xyz and normals [..., N, 3]."""
        return cls(xyz=xyz, normals=normals, mask=jnp.ones(xyz.shape[:-1], bool))

    def transform(self, target_from_source: RigidTransform) -> PointCloud:
        """Moves the points and turns the normals."""
        return self.replace(
            xyz=target_from_source.apply(self.xyz), normals=target_from_source.rotate(self.normals)
        )


def squared_distances(a: jax.Array, b: jax.Array) -> jax.Array:
    """[N, M] squared distances between a [N, 3] and b [M, 3].

    Sums squared differences, one coordinate at a time: ``|a|^2 + |b|^2 - 2ab`` would lose
    millimetres on clouds far from the origin, and this form fuses without an [N, M, 3] array.
    """
    total = jnp.zeros((), a.dtype)
    for axis in range(3):
        total = total + (a[:, None, axis] - b[None, :, axis]) ** 2
    return total


def nearest_neighbors(
    queries: jax.Array, xyz: jax.Array, mask: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The nearest point of a cloud to each query; of several, the first by index.

    In blocks of queries, so that memory stays small. Over tiles of points only the least distance
    is kept, and the one winning tile of each query is searched again for the index: an argmin over
    everything takes ten times as long.

    Args:
      queries: [N, 3] f32, finite, below 1e18.
      xyz: [M, 3] f32, in the same frame and unit.
      mask: [M] bool; padding is no one's neighbour.

    Returns:
      indices [N] i32 and squared distances [N] f32; 0 and infinity where no point is real.
    """
    count, block, tile = queries.shape[0], 128, 64
    if xyz.shape[0] == 0:
        return jnp.zeros(count, jnp.int32), jnp.full(count, jnp.inf, queries.dtype)
    far = jnp.where(mask[:, None], xyz, 1e18)  # its square is still finite
    far = jnp.pad(far, ((0, -xyz.shape[0] % tile), (0, 0)), constant_values=1e18)
    tiles = far.reshape(-1, tile, 3)

    def search(some: jax.Array) -> tuple[jax.Array, jax.Array]:
        least = jnp.min(squared_distances(far, some).reshape(-1, tile, block), axis=1)
        winner = jnp.argmin(least, axis=0).astype(jnp.int32)
        offsets = tiles[winner] - some[:, None, :]
        squared = jnp.sum(offsets**2, axis=-1)
        within = jnp.argmin(squared, axis=1).astype(jnp.int32)
        return winner * tile + within, jnp.min(squared, axis=1)

    blocks = jnp.pad(queries, ((0, -count % block), (0, 0))).reshape(-1, block, 3)
    index, squared = (found.reshape(-1)[:count] for found in jax.lax.map(search, blocks))
    some = jnp.any(mask)
    return jnp.where(some, index, 0), jnp.where(some, squared, jnp.inf)


def ball_query(xyz: jax.Array, mask: jax.Array, *, radius: float, num_neighbors: int) -> jax.Array:
    """The first ``num_neighbors`` other points by index within ``radius``.

    This is RPM-Net's neighbourhood: in index order, not the nearest; the point itself is left out
    and then fills the places that are left over where there are fewer neighbours.

    Args:
      xyz: [N, 3] f32, in the unit of ``radius``.
      mask: [N] bool; padding is no one's neighbour.
      radius: inclusive.
      num_neighbors: K.

    Returns:
      indices [N, K] i32.
    """
    itself = jnp.arange(xyz.shape[0], dtype=jnp.int32)
    other = mask[None, :] & (itself[:, None] != itself[None, :])
    inside = (squared_distances(xyz, xyz) <= radius**2) & other
    # The j-th neighbour is where the running count first reaches j: no sort of N x N needed.
    running = jnp.cumsum(inside, axis=1, dtype=jnp.int32)
    wanted = jnp.arange(1, num_neighbors + 1, dtype=jnp.int32)
    found = jax.vmap(lambda row: jnp.searchsorted(row, wanted))(running)
    return jnp.where(found < xyz.shape[0], found.astype(jnp.int32), itself[:, None])
