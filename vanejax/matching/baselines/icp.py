"""ICP: iterative closest point, to points or to planes, robust and trimmed.

It finds the nearest minimum: start it within a few degrees and a few hundredths of the cloud's
size. Besl and McKay (1992), Chen and Medioni (1992).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vanejax.errors import InputError
from vanejax.matching.contract import Register, Registration, from_partners, pose_where
from vanejax.matching.procrustes import weighted_procrustes
from vanejax.matching.se3 import exp_se3, matmul, rotation_angle
from vanejax.pointcloud import PointCloud, nearest_neighbors
from vanejax.rigid import RigidTransform

METRICS = ("point_to_point", "point_to_plane")
KERNELS = ("none", "huber", "tukey")


class Pairs(NamedTuple):
    """Moved source points and their nearest target points.

    Moved points, partners and the partners' normals [N, 3] f32 in the target's frame; the squared
    distance between the two [N]; kept [N] bool: real, near enough, and not trimmed.
    """

    moved: jax.Array
    partners: jax.Array
    normals: jax.Array
    squared: jax.Array
    kept: jax.Array


class _Search(NamedTuple):
    """Where the loop stands: the pose so far, iterations done, and whether it came to rest."""

    target_from_source: RigidTransform
    iterations: jax.Array
    at_rest: jax.Array
    lost: jax.Array


def icp(
    *,
    metric: str = "point_to_point",
    max_iterations: int = 50,
    max_distance: float,
    kernel: str = "none",
    kernel_width: float | None = None,
    trim: float = 1.0,
    tolerance_rotation_deg: float = 1e-3,
    tolerance_translation: float = 1e-5,
) -> Register:
    """ICP from ``init``; lengths are in the clouds' own unit.

    Converged means that the last update was below both tolerances and that enough pairs hold the
    pose in all six directions: a plane under ``point_to_plane`` or a line under ``point_to_point``
    does not. Overlap is the share of source points whose pair is kept, and rmse the distance of
    these pairs, under both metrics. Without enough pairs the pose stays as it is.

    Args:
      metric: ``point_to_point`` (Besl and McKay, 1992), or ``point_to_plane``: along the target's
        normals (Chen and Medioni, 1992), which needs fewer iterations on smooth surfaces.
      max_iterations: at least 1.
      max_distance: pairs farther apart are left out; inclusive.
      kernel: weight of a pair by its residual, along the normal under ``point_to_plane``: ``none``,
        ``huber`` (1 / residual from the width on) or ``tukey`` (nothing beyond the width).
      kernel_width: of ``huber`` and ``tukey``.
      trim: share of the real source points whose pairs are kept, the nearest ones; in (0, 1].
        Trimmed ICP (Chetverikov et al., 2002).
      tolerance_rotation_deg, tolerance_translation: an update that turns by less, and moves the
        source's centre by less, is at rest.

    Raises:
      InputError: an unknown name, a length that is not positive, a share outside (0, 1].
    """
    if metric not in METRICS:
        raise InputError(f"metric {metric!r} is unknown: choose one of {', '.join(METRICS)}")
    if kernel not in KERNELS:
        raise InputError(f"kernel {kernel!r} is unknown: choose one of {', '.join(KERNELS)}")
    if (kernel == "none") != (kernel_width is None):
        raise InputError(f"kernel {kernel!r} with kernel_width {kernel_width}: give both or none")
    lengths = {
        "max_iterations": max_iterations,
        "max_distance": max_distance,
        "kernel_width": 1.0 if kernel_width is None else kernel_width,
        "tolerance_rotation_deg": tolerance_rotation_deg,
        "tolerance_translation": tolerance_translation,
    }
    for name, value in lengths.items():
        if not value > 0:
            raise InputError(f"{name} is {value}: it must be positive")
    if not 0 < trim <= 1:
        raise InputError(f"trim is {trim}: it must lie in (0, 1]")
    to_plane = metric == "point_to_plane"

    def weigh(pairs: Pairs) -> jax.Array:
        """Weights [N] of the pairs; 0 where not kept."""
        if kernel == "none":
            return pairs.kept.astype(pairs.moved.dtype)
        squared = pairs.squared
        if to_plane:
            squared = _dot(pairs.normals, pairs.moved - pairs.partners) ** 2
        share = jnp.where(pairs.kept, squared, 0.0) / kernel_width**2
        if kernel == "huber":
            weights = jax.lax.rsqrt(jnp.maximum(share, 1.0))
        else:
            weights = jnp.maximum(1.0 - share, 0.0) ** 2
        return jnp.where(pairs.kept, weights, 0.0)

    def enough(weights: jax.Array) -> jax.Array:
        """As many equations as a pose has unknowns, at least: [] bool."""
        return jnp.sum(weights > 0) >= (6 if to_plane else 3)

    def register(
        source: PointCloud, target: PointCloud, init: RigidTransform, key: jax.Array
    ) -> Registration:
        del key  # nothing is random
        source, target = jax.tree.map(jnp.asarray, (source, target))  # a tracer indexes them
        count = jnp.sum(source.mask)
        centre = _mean(source.xyz, source.mask.astype(source.xyz.dtype))

        def pair(pose: RigidTransform) -> Pairs:
            moved = pose.apply(source.xyz)
            nearest, squared = nearest_neighbors(moved, target.xyz, target.mask)
            kept = source.mask & (squared <= max_distance**2)
            if trim < 1:
                ranked = jnp.sort(jnp.where(source.mask, squared, jnp.inf))
                last = jnp.round(trim * count).astype(jnp.int32) - 1
                kept &= squared <= ranked[jnp.maximum(last, 0)]
            return Pairs(moved, target.xyz[nearest], target.normals[nearest], squared, kept)

        def step(search: _Search) -> _Search:
            old = search.target_from_source
            pairs = pair(old)
            weights = weigh(pairs)
            if to_plane:
                new = _plane_update(pairs, weights) @ old
            else:
                new = weighted_procrustes(source.xyz, pairs.partners, weights)
            lost = ~enough(weights)
            new = pose_where(lost, old, new)
            turn = jnp.rad2deg(rotation_angle((new @ old.inverse()).rotation))
            shift = jnp.sum((new.apply(centre[None]) - old.apply(centre[None])) ** 2)
            return _Search(
                target_from_source=new,
                iterations=search.iterations + 1,
                at_rest=(turn < tolerance_rotation_deg) & (shift < tolerance_translation**2),
                lost=lost,
            )

        def unfinished(search: _Search) -> jax.Array:
            return (search.iterations < max_iterations) & ~search.at_rest & ~search.lost

        no = jnp.zeros((), bool)
        start = jax.tree.map(lambda leaf: jnp.asarray(leaf, source.xyz.dtype), init)
        found = jax.lax.while_loop(
            unfinished, step, _Search(start, jnp.zeros((), jnp.int32), at_rest=no, lost=no)
        )
        pairs = pair(found.target_from_source)
        weights = weigh(pairs)
        held = _held_to_planes(pairs, weights) if to_plane else _held_to_points(pairs, weights)
        return from_partners(
            source,
            found.target_from_source,
            pairs.squared,
            pairs.kept,
            converged=found.at_rest & ~found.lost & enough(weights) & held,
            iterations=found.iterations,
        )

    return register


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.sum(a * b, -1)


def _mean(points: jax.Array, weights: jax.Array) -> jax.Array:
    """Weighted mean [3]; zero where nothing has weight."""
    return jnp.sum(weights[:, None] * points, 0) / jnp.maximum(jnp.sum(weights), 1e-6)


def _plane_system(
    pairs: Pairs, weights: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Normal equations [6, 6] and [6] of the distances along the normals, mean per pair.

    They are for (rotation x size, translation) about the pairs' centre [3], in their size []:
    rotation and translation then count alike and hardly mix, or f32 would not hold the system.
    """
    share = weights / jnp.maximum(jnp.sum(weights), 1e-6)
    centre = _mean(pairs.moved, weights)
    arm = pairs.moved - centre[None]
    spread = jnp.sum(share * jnp.sum(arm**2, -1))
    size = jnp.sqrt(jnp.where(spread > 0, spread, 1.0))
    rows = jnp.concatenate([jnp.cross(arm / size, pairs.normals), pairs.normals], -1)
    residuals = _dot(pairs.normals, pairs.partners - pairs.moved)
    left = (share[:, None] * rows).T
    return matmul(left, rows), matmul(left, residuals), centre, size


def _plane_update(pairs: Pairs, weights: jax.Array) -> RigidTransform:
    """One Gauss-Newton step: the motion of the moved source, in the target's frame.

    Damped by 1e-5 of the mean curvature: what nothing holds is rounding divided by rounding.
    """
    matrix, right, centre, size = _plane_system(pairs, weights)
    damping = 1e-5 * jnp.trace(matrix) / 6 + 1e-12
    damped = matrix + damping * jnp.eye(6, dtype=matrix.dtype)
    solution = jnp.linalg.solve(damped, right)
    about_centre = exp_se3(jnp.concatenate([solution[:3] / size, solution[3:]]))
    shift = centre - about_centre.rotate(centre[None])[0] + about_centre.translation
    return RigidTransform(rotation=about_centre.rotation, translation=shift)


def _held_to_planes(pairs: Pairs, weights: jax.Array) -> jax.Array:
    """Whether the normals hold all six directions: [] bool."""
    matrix, *_ = _plane_system(pairs, weights)
    curvature = jnp.linalg.eigvalsh(matrix)
    return curvature[0] > 1e-4 * curvature[-1]  # the damping's own share is 1e-5


def _held_to_points(pairs: Pairs, weights: jax.Array) -> jax.Array:
    """Whether the partners spread in two directions, which fixes a rotation: [] bool."""
    arm = pairs.partners - _mean(pairs.partners, weights)[None]
    left = (weights[:, None] * arm).T
    spread = jnp.linalg.eigvalsh(matmul(left, arm))
    return spread[1] > 1e-6 * spread[2]  # f32 eps x 10
