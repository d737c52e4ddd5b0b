"""Fast global registration: one robust optimisation over matches of features, no closest points."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vanejax.matching.baselines.feature_matches import (
    draw_triangles,
    fpfh_distances,
    nearest_matches,
)
from vanejax.matching.contract import Register, Registration, from_partners, pose_where
from vanejax.matching.procrustes import weighted_procrustes
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform


def fgr(
    *,
    feature_radius: float,
    max_distance: float,
    division: float = 1.4,
    iterations: int = 64,
    num_candidates: int = 10,
    tuple_similarity: float = 0.9,
    max_normal_angle: float = 0.5,
    num_tuples: int = 1000,
    num_trials: int = 100_000,
) -> Register:
    """Fast Global Registration; the guess is used only where nothing is found.

    Matches of features that are mutual and pass the test of tuples, each counted as often as it
    passes, are laid on each other under the Geman-McClure kernel: it starts as wide as the clouds
    and narrows to ``max_distance`` (graduated non-convexity), and the line process
    ``l = (mu / (mu + r^2))^2`` gives the weights of the next step (eq. 6), each the weighted
    Procrustes problem, at whose minimum the paper's one Gauss-Newton step aims.

    Args:
      feature_radius: of an FPFH neighbourhood, in the clouds' unit.
      max_distance: the kernel's last width, delta, in the clouds' unit: what a right match may be
        off.
      division: of mu, the squared width, every four iterations.
      iterations: of weights and motion.
      num_candidates: a match is mutual where each of the two points is among this many of the
        other's most similar; the paper's 1 leaves too few on noisy partial scans.
      tuple_similarity: least ratio of corresponding edges of a tuple; 0.9 in the paper.
      max_normal_angle: of corresponding normals of a tuple, radians; the paper asks nothing, pi.
      num_tuples, num_trials: tuples that count at most, and that are drawn.

    Returns:
      A `Register`. ``converged`` is False where no tuple passed or fewer than three matches lie
      within ``max_distance``; ``rmse`` and ``overlap`` are of the matches, the latter as a share
      of the source's points. Clouds need normals.

    Source: Zhou, Park and Koltun, Fast global registration (2016).
    """

    def register(
        source: PointCloud, target: PointCloud, init: RigidTransform, key: jax.Array
    ) -> Registration:
        distances = fpfh_distances(source, target, radius=feature_radius)
        matches = nearest_matches(distances, num_candidates=num_candidates, mutual=True)
        tuples = draw_triangles(
            key,
            matches,
            source,
            target,
            count=num_trials,
            edge_similarity=tuple_similarity,
            min_edge=2 * max_distance,
            max_normal_angle=max_normal_angle,
        )
        counted = tuples.agrees & (jnp.cumsum(tuples.agrees) <= num_tuples)
        votes = jnp.zeros(matches.mask.shape).at[tuples.rows].add(jnp.float32(counted[:, None]))
        p, q = source.xyz[matches.source], target.xyz[matches.target]

        def squared_residuals(pose: RigidTransform) -> jax.Array:
            return jnp.sum((pose.apply(p) - q) ** 2, -1)

        def step(index: jax.Array, pose: RigidTransform) -> RigidTransform:
            power = (index // 4).astype(p.dtype)
            mu = jnp.maximum(widest * division**-power, max_distance**2)
            line = (mu / (mu + squared_residuals(pose))) ** 2
            return weighted_procrustes(p, q, votes * line)

        # the squared diameter, of which the paper's mu starts
        widest = 4 * jnp.maximum(_squared_radius(source), _squared_radius(target))
        start = weighted_procrustes(p, q, votes)
        pose = jax.lax.fori_loop(0, iterations, step, start)

        inside = (votes > 0) & (squared_residuals(pose) <= max_distance**2)
        converged = (jnp.sum(inside) >= 3) & jnp.all(jnp.isfinite(pose.as_matrix()))
        pose = pose_where(converged, pose, init)
        inside = (votes > 0) & (squared_residuals(pose) <= max_distance**2)
        result = from_partners(
            source,
            pose,
            squared_residuals(pose),
            inside,
            converged=converged,
            iterations=iterations,
        )
        # several matches of one point count once
        points = jnp.zeros(source.mask.shape, bool).at[matches.source].max(inside)
        return result.replace(overlap=jnp.sum(points) / jnp.maximum(jnp.sum(source.mask), 1))

    return register


def _squared_radius(cloud: PointCloud) -> jax.Array:
    """[] largest squared distance of a real point from the real points' mean."""
    real = cloud.mask[:, None]
    center = jnp.sum(cloud.xyz, 0, where=real) / jnp.maximum(jnp.sum(cloud.mask), 1)
    return jnp.max(jnp.sum((cloud.xyz - center[None]) ** 2, -1), where=cloud.mask, initial=0.0)
