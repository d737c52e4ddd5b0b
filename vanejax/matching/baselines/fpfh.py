"""Fast point feature histograms, by which SAC-IA and FGR match points."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from vanejax.matching.se3 import matmul
from vanejax.pointcloud import PointCloud, squared_distances

_BINS = 11  # of each angle
_BLOCK = 32  # rows compared at a time: [32, 4096] stays in a core's cache
_HALF_TURN_EDGES = [math.cos((2 * k + 1) * math.pi / _BINS) for k in range(_BINS // 2)]


def fpfh(cloud: PointCloud, *, radius: float) -> jax.Array:
    """Fast point feature histograms: unchanged by any rigid motion of the cloud.

    Three angles of Darboux's frame between a point and each of its neighbours fall into 11 bins
    each, in percent of the neighbours (SPFH). The neighbours' histograms, weighted by 1 /
    distance^2 and scaled to a sum of 100 per angle, are added to the point's own, as Open3D does;
    but half a turn, as of opposite faces of a plate, is always the last bin of the first angle.

    Args:
      cloud: [N] with unit normals; padding is no one's neighbour.
      radius: inclusive, in the cloud's unit; several times the distance between points.

    Returns:
      [N, 33] f32, percent: sums of 200 over each angle's bins, or of 100 where all neighbours
      coincide with the point; 0 at padding and where a point has no neighbour.

    Source: Rusu, Blodow and Beetz (2009); the layout and the angles' order are Open3D's.
    """
    count = cloud.mask.shape[0]
    place = jnp.arange(count, dtype=jnp.int32)
    short = -count % _BLOCK
    blocks = jax.tree.map(
        lambda rows: jnp.pad(rows, ((0, short), *((0, 0),) * (rows.ndim - 1))).reshape(
            -1, _BLOCK, *rows.shape[1:]
        ),
        (cloud, place),
    )

    def neighbors(rows: PointCloud, places: jax.Array) -> tuple[jax.Array, jax.Array]:
        squared = squared_distances(rows.xyz, cloud.xyz)
        other = rows.mask[:, None] & cloud.mask[None, :] & (places[:, None] != place[None, :])
        return squared, (squared <= radius**2) & other

    def simple(block: tuple[PointCloud, jax.Array]) -> jax.Array:
        _, near = neighbors(*block)
        counts = [_histogram(bins, near) for bins in _darboux_bins(block[0], cloud)]
        share = 100.0 / jnp.maximum(jnp.sum(near, 1, dtype=jnp.int32), 1)
        return jnp.concatenate(counts, 1) * share[:, None]

    def weighted(block: tuple[PointCloud, jax.Array]) -> jax.Array:
        squared, near = neighbors(*block)
        # a weight of nearly coincident points must not outgrow f32
        floor = jnp.maximum(squared, 1e-12 * radius**2)
        weights = jnp.where(near & (squared > 0), radius**2 / floor, 0.0)
        return matmul(weights, own)

    own = jax.lax.map(simple, blocks).reshape(-1, 3 * _BINS)[:count]
    around = jax.lax.map(weighted, blocks).reshape(-1, 3, _BINS)[:count]
    total = jnp.sum(around, -1, keepdims=True)
    around = around * (100.0 / jnp.where(total > 0, total, 1.0))
    return around.reshape(count, 3 * _BINS) + own


def _darboux_bins(rows: PointCloud, cloud: PointCloud) -> list[jax.Array]:
    """Bins [B, N] i32, 0 to 10, of the three angles between ``rows`` [B] and ``cloud`` [N]."""
    (ax, ay, az), (bx, by, bz), (dx, dy, dz) = (
        [rows.normals[:, None, k] for k in range(3)],
        [cloud.normals[None, :, k] for k in range(3)],
        [cloud.xyz[None, :, k] - rows.xyz[:, None, k] for k in range(3)],
    )
    squared = dx * dx + dy * dy + dz * dz
    inverse = jax.lax.rsqrt(jnp.where(squared > 0, squared, 1.0))
    at_a = (ax * dx + ay * dy + az * dz) * inverse
    at_b = (bx * dx + by * dy + bz * dz) * inverse
    cosine = ax * bx + ay * by + az * bz
    cross = (ay * bz - az * by) * dx + (az * bx - ax * bz) * dy + (ax * by - ay * bx) * dz
    # the frame's origin is the point whose normal lies nearer to the line between the two
    swap = jnp.abs(at_a) < jnp.abs(at_b)
    phi = jnp.where(swap, -at_b, at_a)
    sine_squared = (1 - phi) * (1 + phi)
    # no frame along the normal itself, nor between coincident points: all angles 0, as in Open3D
    void = (sine_squared < 4e-7) | (squared == 0)  # f32 eps x 4
    scale = jax.lax.rsqrt(jnp.where(void, 1.0, sine_squared))
    alpha = cross * inverse * scale
    y = (jnp.where(swap, -at_a, at_b) - cosine * phi) * scale
    length = jnp.sqrt(cosine * cosine + y * y)
    # theta = atan2(y, cosine): how many of the edges at 1, 3, ... 9 elevenths of pi it is past
    past = sum((cosine <= edge * length).astype(jnp.int32) for edge in _HALF_TURN_EDGES)
    theta_bin = 5 + jnp.where(y > -1e-4 * length, past, -past)  # f32 eps x 1e3 at the half turn
    bins = [theta_bin, *(_bin_of_cosine(value) for value in (alpha, phi))]
    return [jnp.where(void, 5, index) for index in bins]


def _bin_of_cosine(cosine: jax.Array) -> jax.Array:
    """The bin i32, 0 to 10, of a value in [-1, 1]."""
    return jnp.clip((0.5 * _BINS * (cosine + 1)).astype(jnp.int32), 0, _BINS - 1)


def _histogram(bins: jax.Array, near: jax.Array) -> jax.Array:
    """How many of the ``near`` [B, N] fall into each bin: [B, 11] i32.

    One sum counts several bins, six bits of an i32 each, which hold a tile's 63 columns: half the
    time of one sum per bin.
    """
    short = -bins.shape[1] % 63
    tiles = jnp.pad(jnp.where(near, bins, _BINS), ((0, 0), (0, short)), constant_values=_BINS)
    tiles = tiles.reshape(bins.shape[0], -1, 63)
    counts = []
    for first in range(0, _BINS, 4):
        width = min(4, _BINS - first)
        digit = tiles - first
        valid = (digit >= 0) & (digit < width)
        packed = jnp.sum(jnp.where(valid, 1 << jnp.clip(6 * digit, 0, 18), 0), axis=2)
        counts += [jnp.sum((packed >> 6 * k) & 63, axis=1) for k in range(width)]
    return jnp.stack(counts, axis=1)
