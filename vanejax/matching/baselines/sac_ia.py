"""Sample consensus initial alignment: a pose from local features alone, whatever the guess."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from vanejax.matching.baselines.feature_matches import (
    Matches,
    draw_triangles,
    fpfh_distances,
    nearest_matches,
)
from vanejax.matching.contract import Register, Registration, from_partners, pose_where
from vanejax.matching.procrustes import weighted_procrustes
from vanejax.matching.se3 import exp_so3, hat, matmul
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

T = TypeVar("T")
_EXACT = jax.lax.Precision.HIGHEST
_TANGENTIAL = 0.01  # weight of a residual along the surface: a plane alone leaves sliding free
_DAMPING = 1e-4
_FAR = 1e6  # squared distance to padding, in squares of max_distance
_TILE = 32
_POSES_AT_ONCE = 8  # their N x M distances together fit the cache


def sac_ia(
    *,
    feature_radius: float,
    max_distance: float,
    num_hypotheses: int = 100_000,
    num_candidates: int = 3,
    edge_similarity: float = 0.9,
    max_normal_angle: float = 0.5,
    num_scored: int = 256,
    num_refined: int = 8,
    refinements: int = 10,
) -> Register:
    """SAC-IA on FPFH, every hypothesis at once; the guess is used only where nothing is found.

    Triples of source points are matched at random with target points of similar features. Of the
    triples that form congruent triangles, ``num_scored`` give a pose each, which is scored by how
    many source points come to lie on the target, their normals agreeing. The best are refined,
    each by point-to-plane steps on all points, and the best of these is the answer: a wrong pose
    in which a part resembles itself, as when turned by 180 degrees, betrays itself only there.

    Args:
      feature_radius: of an FPFH neighbourhood, in the clouds' unit (0.3 to 0.5 for the vane).
      max_distance: farthest partner, in the clouds' unit; about the spacing of the target's points.
      num_hypotheses: triples drawn.
      num_candidates: among this many of the most similar target points one is drawn.
      edge_similarity: least ratio of corresponding edges of the two triangles.
      max_normal_angle: largest angle between corresponding normals, in radians.
      num_scored, num_refined: of the congruent triples, and of the scored ones, at most.
      refinements: point-to-plane steps; 0 gives the pose of the best triple.

    Returns:
      A `Register`. ``converged`` is False where no triple was congruent or fewer than three source
      points found a partner; ``rmse`` is of the distances of the partners, ``iterations`` is
      ``refinements``. Clouds need normals.

    Source: Rusu, Blodow and Beetz, Fast point feature histograms (2009), section IV, with the
    rejection by edges of the Point Cloud Library and Open3D.
    """

    def register(
        source: PointCloud, target: PointCloud, init: RigidTransform, key: jax.Array
    ) -> Registration:
        distances = fpfh_distances(source, target, radius=feature_radius)
        matches = nearest_matches(distances, num_candidates=num_candidates, mutual=False)
        triangles = draw_triangles(
            key,
            matches,
            source,
            target,
            count=num_hypotheses,
            edge_similarity=edge_similarity,
            min_edge=2 * max_distance,  # shorter edges say little about the rotation
            max_normal_angle=max_normal_angle,
        )
        surface = _surface(target, max_distance)
        found, first = jax.lax.top_k(
            triangles.agrees.astype(jnp.int32), min(num_scored, num_hypotheses)
        )
        poses = _poses_of(matches, triangles.rows[first], source, target)
        score = _in_batches(lambda pose: jnp.sum(_closeness(pose, source, surface)), poses)
        _, best = jax.lax.top_k(jnp.where(found > 0, score, -1.0), min(num_refined, *score.shape))
        poses, found = jax.tree.map(lambda leaf: leaf[best], (poses, found > 0))
        poses = jax.lax.fori_loop(
            0,
            refinements,
            lambda _, poses: _in_batches(lambda pose: _refined(pose, source, surface), poses),
            poses,
        )
        finite = jnp.all(jnp.isfinite(poses.as_matrix()), (-1, -2))
        closeness = _in_batches(lambda pose: _closeness(pose, source, surface), poses)
        score = jnp.where(found & finite, jnp.sum(closeness, -1), -1.0)
        winner = jnp.argmax(score)
        converged = (score[winner] > 0) & (jnp.sum(closeness[winner] > 0) >= 3)
        pose = pose_where(converged, jax.tree.map(lambda leaf: leaf[winner], poses), init)
        moved = source.transform(pose)
        squared = jnp.sum((moved.xyz - target.xyz[_nearest(moved, surface)]) ** 2, -1)
        partnered = _closeness(pose, source, surface) > 0
        return from_partners(
            source, pose, squared, partnered, converged=converged, iterations=refinements
        )

    return register


class _Surface(NamedTuple):
    """The target [M], made ready for many searches of the nearest point.

    Nearest in position and normal at once, ``|p - q|^2 + d^2 |n_p - n_q|^2`` with d the largest
    distance of a partner, so that the two sides of a thin wall stay apart. With points a about its
    mean, where ``|b|^2 - 2 a.b`` loses nothing, ``rows @ (a, 1)`` is the squared distance less
    |a|^2: rows [tiles x _TILE, 7].
    """

    cloud: PointCloud
    center: jax.Array
    rows: jax.Array
    max_distance: jax.Array


def _surface(target: PointCloud, max_distance: float) -> _Surface:
    real = target.mask[:, None]
    center = jnp.sum(target.xyz, 0, where=real) / jnp.maximum(jnp.sum(target.mask), 1)
    reach = jnp.asarray(max_distance, target.xyz.dtype)
    b = jnp.concatenate([target.xyz - center[None], reach * target.normals], -1)
    b = jnp.where(real, b, 0.0)
    size = jnp.where(real, jnp.sum(b**2, -1, keepdims=True), _FAR * reach**2)
    rows = jnp.concatenate([-2 * b, size], -1)
    spare = ((0, -rows.shape[0] % _TILE), (0, 0))
    rows = jnp.pad(rows, spare).at[target.mask.size :, 6].set(_FAR * reach**2)
    return _Surface(cloud=target, center=center, rows=rows, max_distance=reach)


def _squared(moved: PointCloud, surface: _Surface) -> tuple[jax.Array, jax.Array]:
    """[rows, N] squared distances less a part [N] that is the same for all rows, and that part.

    Points run along the second axis: the least over the first takes a tenth of the time.
    """
    a = [moved.xyz - surface.center[None], surface.max_distance * moved.normals]
    a = jnp.concatenate([*a, jnp.ones((moved.mask.size, 1))], -1)
    return matmul(surface.rows, a.T), jnp.sum(a[:, :6] ** 2, -1)


def _closeness(pose: RigidTransform, source: PointCloud, surface: _Surface) -> jax.Array:
    """[N] ``1 - (distance / max_distance)^2``, at least 0; 0 at padding."""
    table, own = _squared(source.transform(pose), surface)
    closeness = 1 - (jnp.min(table, 0) + own) / surface.max_distance**2
    return jnp.where(source.mask, jnp.clip(closeness, 0.0, 1.0), 0.0)


def _nearest(moved: PointCloud, surface: _Surface) -> jax.Array:
    """[N] index of the nearest target point.

    The least over tiles first, then one tile again: an argmin over all takes four times as long.
    """
    table, _ = _squared(moved, surface)
    tiles = table.reshape(-1, _TILE, table.shape[1])
    tile = jnp.argmin(jnp.min(tiles, 1), 0)
    inside = jnp.take_along_axis(tiles, tile[None, None, :], 0)[0]
    # a tile of spare rows wins only where nothing is real
    return jnp.minimum(tile * _TILE + jnp.argmin(inside, 0), surface.cloud.mask.size - 1)


def _poses_of(
    matches: Matches, rows: jax.Array, source: PointCloud, target: PointCloud
) -> RigidTransform:
    """[S] motions that lay triangles [S, 3] of matches on each other."""
    corners = source.xyz[matches.source[rows]], target.xyz[matches.target[rows]]
    return weighted_procrustes(*corners, jnp.ones(rows.shape))


def _refined(pose: RigidTransform, source: PointCloud, surface: _Surface) -> RigidTransform:
    """One Gauss-Newton step of the partners' distances, along their normals above all."""
    moved = source.transform(pose)
    index = _nearest(moved, surface)
    partners, normals = surface.cloud.xyz[index], surface.cloud.normals[index]
    away = jnp.sum((moved.xyz - partners) ** 2, -1)
    away += surface.max_distance**2 * jnp.sum((moved.normals - normals) ** 2, -1)
    weights = jnp.maximum(1 - away / surface.max_distance**2, 0.0)
    weights = jnp.where(source.mask & surface.cloud.mask[index], weights, 0.0)
    share = weights / jnp.maximum(jnp.sum(weights), 1e-6)
    # about the points' own mean, where rotation and translation hardly mix
    center = jnp.sum(share[:, None] * moved.xyz, 0)
    turn, eye = -hat(moved.xyz - center[None]), jnp.eye(3)[None]
    jacobian = jnp.concatenate([turn, jnp.broadcast_to(eye, turn.shape)], -1)
    along = normals[:, :, None] * normals[:, None, :]
    information = share[:, None, None] * (along + _TANGENTIAL * eye)
    weighted = jnp.einsum("nij,njk->nik", information, jacobian, precision=_EXACT)
    hessian = jnp.einsum("nij,nik->jk", jacobian, weighted, precision=_EXACT)
    gradient = jnp.einsum("nij,ni->j", weighted, moved.xyz - partners, precision=_EXACT)
    # holds what the points leave free (on a line, at one point); lengths in units of max_distance
    damping = jnp.repeat(jnp.stack([surface.max_distance**2, jnp.ones(())]), 3)
    delta = -jnp.linalg.solve(hessian + _DAMPING * jnp.diag(damping), gradient)
    rotation = exp_so3(delta[:3])
    shift = center + delta[3:] - matmul(rotation, center)
    return RigidTransform(rotation=rotation, translation=shift) @ pose


def _in_batches(function: Callable[[RigidTransform], T], poses: RigidTransform) -> T:
    """``function`` of every pose [S], a few at a time: S x N x M distances would be much memory."""
    return jax.lax.map(function, poses, batch_size=_POSES_AT_ONCE)
