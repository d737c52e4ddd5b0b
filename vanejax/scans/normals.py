"""Surface normals of a cloud: the direction in which each neighbourhood is thinnest."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from vanejax.errors import InputError

NEIGHBOR_CHOICES = (16, 32, 64, 128, 256, 512)

_TREE_POINTS = 1_000_000  # a tree of ten million takes seconds, and the neighbours are near enough
_PROBES = 256
_WANTED_TILT_DEG = 1.25
_BLOCK = 4096
_SMALL_BLOCK = 512
# squared ratios of the neighbourhood's three widths
_LINE = 1e-4
_LUMP = 0.25


def estimate_normals(
    points: np.ndarray,
    *,
    sensor_origin: np.ndarray | None,
    num_neighbors: int | None = None,
    at: np.ndarray | None = None,
) -> np.ndarray:
    """Unit normals [n, 3] f32 of a cloud: principal components of neighbours (Hoppe et al. 1992).

    Normals face the sensor. Where its place is unknown they face away from the mean of all points,
    which is outward on a convex part only: do not trust their sign then. Of clouds with more than
    a million points, neighbours are sought among a million drawn at random.

    Args:
      points: [N, 3] float, mm, finite.
      sensor_origin: [3] mm, in the frame of the points; None if unknown.
      num_neighbors: K. None takes the fewest of `NEIGHBOR_CHOICES` with which noise turns the
        normals by less than 1.25 deg, found at some of the points: noisy and dense scans need more.
      at: [n] integer, indices of the points whose normals are wanted; None for all.

    Arrays of other shapes, values that are not finite, and no points raise InputError.
    """
    points = np.asarray(points)
    if points.shape[1:] != (3,) or points.dtype.kind not in "fiu" or not len(points):
        raise InputError(
            f"normals need points [N, 3] in mm, got shape {list(points.shape)}, {points.dtype}"
        )
    if num_neighbors is not None and num_neighbors < 3:
        raise InputError(f"num_neighbors must be at least 3, a plane's points, got {num_neighbors}")
    at = np.arange(len(points)) if at is None else np.asarray(at)
    outside = at.size and (at.dtype.kind not in "iu" or at.min() < 0 or at.max() >= len(points))
    if at.ndim != 1 or outside:
        raise InputError(f"at must hold indices below {len(points)}, got {at.dtype} {at.shape}")
    queries = points[at.astype(np.int64)].astype(np.float64)
    cloud = _thinned(points).astype(np.float64)
    if not (np.isfinite(cloud).all() and np.isfinite(queries).all()):
        raise InputError("normals need finite points; clean the scan first")
    mean = cloud.mean(axis=0)
    sides = queries - mean if sensor_origin is None else np.asarray(sensor_origin) - queries
    # median splits cost more than they save on clouds of a surface
    tree = cKDTree(cloud, balanced_tree=False, compact_nodes=False)
    if num_neighbors is None:
        num_neighbors = _enough_neighbors(tree, cloud)
    blocks = [slice(i, i + _BLOCK) for i in range(0, max(len(queries), 1), _BLOCK)]
    return np.concatenate(
        [_planes_at(tree, cloud, queries[b], sides[b], num_neighbors)[0] for b in blocks]
    )


def _thinned(points: np.ndarray) -> np.ndarray:
    """At most about a million of the points.

    At random: every k-th pixel of an organised scan would be a few of its columns.
    """
    if len(points) <= _TREE_POINTS:
        return points
    rng = np.random.default_rng(0)
    return points[rng.random(len(points), np.float32) < _TREE_POINTS / len(points)]


def _enough_neighbors(tree: cKDTree, cloud: np.ndarray) -> int:
    """The fewest of `NEIGHBOR_CHOICES` that average the noise out, or the best there is."""
    probes = np.random.default_rng(0).choice(
        len(cloud), min(_PROBES, len(cloud)), replace=False, shuffle=False
    )
    queries = cloud[probes]
    tilts = {}
    for count in NEIGHBOR_CHOICES:
        if tilts and count > len(cloud) // 4:  # no longer a neighbourhood
            break
        _, reliable, tilt = _planes_at(tree, cloud, queries, np.ones_like(queries), count)
        tilts[count] = np.degrees(np.median(tilt[reliable])) if reliable.any() else np.inf
        if tilts[count] < _WANTED_TILT_DEG:
            return count
    return min(tilts, key=tilts.get)


def _planes_at(
    tree: cKDTree, cloud: np.ndarray, queries: np.ndarray, sides: np.ndarray, num_neighbors: int
) -> tuple[np.ndarray, ...]:
    """What `_fit_planes` says, [n, ...] each, at n <= _BLOCK queries."""
    size = _SMALL_BLOCK if len(queries) <= _SMALL_BLOCK else _BLOCK
    count = min(num_neighbors, len(cloud))
    offsets = np.zeros((size, num_neighbors, 3), np.float32)
    # about the query, in float64: far from the origin float32 has no digits left
    index = tree.query(queries, range(1, count + 1), workers=-1)[1]
    offsets[: len(queries), :count] = cloud[index] - queries[:, None]
    toward = np.zeros((size, 3), np.float32)
    toward[: len(queries)] = sides
    planes = _fit_planes(offsets, np.arange(num_neighbors) < count, toward)
    return tuple(np.asarray(values)[: len(queries)] for values in planes)


@jax.jit
def _fit_planes(
    offsets: jax.Array, mask: jax.Array, toward: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Planes through B neighbourhoods of K points, from offsets [B, K, 3] f32, mm, where ``mask``.

    Returns:
      normals [B, 3] on the side ``toward`` [B, 3]; reliable [B], False where the neighbours lie on
      a line, at one place, or are a lump; standard error of the normal's direction in its worse
      axis [B], rad: of n points with variances a < b < c along the axes, sqrt(a / (n b)).
    """
    mask = mask[None, :, None]
    number = jnp.sum(mask)
    # by size: squares of 1e-25 mm and of 1e25 mm both leave float32
    size = jnp.max(jnp.abs(offsets), axis=(1, 2))
    scaled = offsets / jnp.where(size > 0, size, 1.0)[:, None, None]
    mean = jnp.sum(scaled, axis=1, keepdims=True, where=mask) / number
    centered = jnp.where(mask, scaled - mean, 0.0)
    highest = jax.lax.Precision.HIGHEST
    moments = jnp.einsum("bki,bkj->bij", centered, centered, precision=highest) / number
    variance, axes = jnp.linalg.eigh(moments)
    variance = jnp.maximum(variance, 0.0)
    normals = axes[:, :, 0]
    side = jnp.sum(normals * toward, axis=-1, keepdims=True)
    normals = jnp.where(side < 0, -normals, normals)
    reliable = (variance[:, 1] > _LINE * variance[:, 2]) & (variance[:, 0] < _LUMP * variance[:, 1])
    across = jnp.where(variance[:, 1] > 0, variance[:, 1], 1.0)
    tilt = jnp.sqrt(variance[:, 0] / (number * across))
    return normals, reliable, tilt
