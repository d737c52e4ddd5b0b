"""Matches of two clouds by their features, and triangles of matches that a motion can explain."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vanejax.matching.baselines.fpfh import fpfh
from vanejax.matching.se3 import matmul
from vanejax.pointcloud import PointCloud

_EXACT = jax.lax.Precision.HIGHEST
_FAR = 1e9  # feature distance of padding: above any real one, and finite


class Matches(NamedTuple):
    """Pairs of a source and a target point that look alike, in P rows.

    Indices ``source`` and ``target`` [P] i32; ``mask`` [P] bool is False where a row is no match.
    """

    source: jax.Array
    target: jax.Array
    mask: jax.Array


class Triangles(NamedTuple):
    """Three matches each: rows [T, 3] i32 of the matches, and whether one motion explains them."""

    rows: jax.Array
    agrees: jax.Array


def feature_distances(
    source: jax.Array, target: jax.Array, source_mask: jax.Array, target_mask: jax.Array
) -> jax.Array:
    """``sum (sqrt(a) - sqrt(b))^2`` [N, M] f32 of histograms [N, C] and [M, C], not negative.

    Squared Hellinger distances, up to a factor: on noisy clouds half as many again of the nearest
    features are right as with ``sum (a - b)^2``, in which the few full bins drown the others
    (RootSIFT: Arandjelovic and Zisserman, 2012). Padding is far from everything.
    """
    a, b = jnp.sqrt(jnp.maximum(source, 0.0)), jnp.sqrt(jnp.maximum(target, 0.0))
    squared = jnp.sum(a**2, -1)[:, None] + jnp.sum(b**2, -1)[None, :]
    squared = squared - 2 * matmul(a, b.T)
    return jnp.where(source_mask[:, None] & target_mask[None, :], squared, _FAR)


def fpfh_distances(source: PointCloud, target: PointCloud, *, radius: float) -> jax.Array:
    """[N, M] `feature_distances` of two clouds' FPFH of this radius, in the clouds' unit."""
    features = (fpfh(cloud, radius=radius) for cloud in (source, target))
    return feature_distances(*features, source.mask, target.mask)


def nearest_matches(distances: jax.Array, *, num_candidates: int, mutual: bool) -> Matches:
    """Each source point with the K target points of the nearest features, at most all M.

    Args:
      distances: [N, M] f32 from `feature_distances`.
      num_candidates: K.
      mutual: keep only where the source point is among the target point's own K nearest as well.

    Returns:
      P = N K matches, those of one source point beside each other, the nearest first.
    """
    n, m = distances.shape
    k = min(num_candidates, m)
    negative, target = jax.lax.top_k(-distances, k)
    mask = negative > -_FAR
    if mutual:
        # what a target point's K-th nearest reaches
        back = jax.lax.top_k(-distances.T, min(num_candidates, n))[0][:, -1]
        mask &= negative >= back[target]
    source = jnp.broadcast_to(jnp.arange(n, dtype=jnp.int32)[:, None], (n, k))
    return Matches(source=source.reshape(-1), target=target.reshape(-1), mask=mask.reshape(-1))


def draw_triangles(
    key: jax.Array,
    matches: Matches,
    source: PointCloud,
    target: PointCloud,
    *,
    count: int,
    edge_similarity: float,
    min_edge: float,
    max_normal_angle: float,
) -> Triangles:
    """Random triples of matches, and which of them are triangles that one motion explains.

    The test of RANSAC on features (Rusu et al., 2009) and of FGR (Zhou et al., 2016, section 3.2)
    asks that corresponding edges be equally long. Here also the three normals must come to agree
    under the motion that lays one triangle on the other: a mirrored triangle fails, and most of
    those whose edges agree by chance.

    Args:
      matches: [P]; few or none are allowed.
      source, target: [N] and [M], what the matches point to.
      count: T.
      edge_similarity: least ratio of the shorter to the longer of two corresponding edges.
      min_edge: least edge of both triangles, in the clouds' unit.
      max_normal_angle: largest angle of corresponding normals, in radians.
    """
    real = jnp.sum(matches.mask)
    first_real = jnp.argsort(~matches.mask, stable=True)
    drawn = jax.random.uniform(key, (count, 3)) * real
    place = jnp.clip(drawn.astype(jnp.int32), 0, jnp.maximum(real - 1, 0))
    rows = first_real[place].astype(jnp.int32)
    a, b = matches.source[rows], matches.target[rows]
    source_frames, source_edges = _frames(source.xyz[a])
    target_frames, target_edges = _frames(target.xyz[b])
    shorter = jnp.minimum(source_edges, target_edges)
    longer = jnp.maximum(source_edges, target_edges)
    agrees = jnp.all((shorter >= edge_similarity * longer) & (shorter > min_edge), -1)
    # components in the triangle's own frame: equal where the motion turns one normal on the other
    cosine = jnp.sum(
        jnp.einsum("tki,tij->tkj", source.normals[a], source_frames, precision=_EXACT)
        * jnp.einsum("tki,tij->tkj", target.normals[b], target_frames, precision=_EXACT),
        -1,
    )
    agrees &= jnp.all(cosine >= jnp.cos(max_normal_angle), -1)
    return Triangles(rows=rows, agrees=agrees & (real >= 3))


def _frames(corners: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Axes as columns [T, 3, 3] and edges [T, 3] of triangles [T, 3, 3]; zeros if degenerate."""
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    bc = corners[:, 2] - corners[:, 1]
    edges = jnp.sqrt(jnp.stack([jnp.sum(edge**2, -1) for edge in (ab, ac, bc)], -1))
    x, z = _unit(ab), _unit(jnp.cross(ab, ac))
    return jnp.stack([x, jnp.cross(z, x), z], -1), edges


def _unit(vectors: jax.Array) -> jax.Array:
    squared = jnp.sum(vectors**2, -1, keepdims=True)
    zero = squared < 1e-20
    return jnp.where(zero, 0.0, vectors / jnp.sqrt(jnp.where(zero, 1.0, squared)))
