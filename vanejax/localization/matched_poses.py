"""Rough poses from a trained RPM-Net: from one guess, or from rotations that cover SO(3)."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.localization.fine_registration import subset
from vanejax.matching.fast_rpmnet import features, last_match, neighborhoods
from vanejax.matching.rpmnet import RpmNet
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.scans.measured_scan import MeasuredScan
from vanejax.scans.normals import estimate_normals
from vanejax.scans.voxels import voxel_thin
from vanejax.training.weight_file import TrainedMatcher

# Hypotheses that are vmapped together. A CPU gains nothing from it (measured: 0.83 s for 60 one by
# one, 0.95 s by fours) and compiles longer; an accelerator takes them all.
AT_ONCE_ON_ACCELERATOR = 60
THINNED_FROM = 60_000  # points: thinning more of them takes longer and changes nothing


def icosahedral_rotations() -> np.ndarray:
    """[60, 3, 3]: the rotations of the icosahedron; every rotation is within 44.5 deg of one."""
    return Rotation.create_group("I").as_matrix()


def match_poses(
    matcher: TrainedMatcher,
    scan: MeasuredScan,
    guesses: RigidTransform,
    *,
    iterations: int,
    seed: int = 0,
) -> RigidTransform:
    """What the network makes of H guesses of part_from_camera, all in one compiled call.

    The scan is prepared as in training: thinned to the matcher's voxels, then ``num_reference
    X / Y`` of its X points drawn, with the Y thinned points of the part.

    Args:
      matcher: trained for the part.
      scan: in mm; its normals are estimated where it has none, or no sensor to orient them.
      guesses: [H, 3, 3] and [H, 3] mm.
      iterations: of the network.
      seed: of the draws.

    Returns:
      part_from_camera, [H, 3, 3] and [H, 3] f64, mm; the guess where the network's answer is not
      finite.
    """
    source, middle = _source(matcher, scan, seed)
    target = _reference(matcher, seed)
    radius = matcher.radius_mm
    # unit-sphere units: source (p - middle) / radius, target (x - center) / radius
    shift = guesses.translation + guesses.rotation @ middle - matcher.center
    inits = RigidTransform(
        jnp.asarray(guesses.rotation, jnp.float32), jnp.asarray(shift / radius, jnp.float32)
    )
    at_once = None if jax.default_backend() == "cpu" else AT_ONCE_ON_ACCELERATOR  # None: one by one
    matched = jax.device_get(
        _match(matcher.model, iterations, at_once, matcher.variables, source, target, inits)
    )
    # float32 rotations are orthonormal to 1e-7 only
    u, _, vt = np.linalg.svd(np.nan_to_num(np.asarray(matched.rotation, np.float64)))
    rotation = u @ vt
    translation = radius * np.asarray(matched.translation, np.float64)
    translation = translation + matcher.center - rotation @ middle
    finite = np.isfinite(matched.rotation).all(axis=(1, 2)) & (np.linalg.det(rotation) > 0)
    finite &= np.isfinite(matched.translation).all(axis=1)
    return RigidTransform(
        np.where(finite[:, None, None], rotation, guesses.rotation),
        np.where(finite[:, None], translation, guesses.translation),
    )


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _match(
    model: RpmNet,
    iterations: int,
    at_once: int | None,
    variables: Any,
    source: PointCloud,
    target: PointCloud,
    inits: RigidTransform,
) -> RigidTransform:
    """target_from_source [H] from each of ``inits`` [H].

    What does not change with the pose is computed once for all.
    """
    near = neighborhoods(model, source)
    target_features = features(model, variables, target)

    def match(init: RigidTransform) -> RigidTransform:
        return last_match(
            model,
            variables,
            source,
            target,
            init,
            iterations=iterations,
            near=near,
            target_features=target_features,
        ).target_from_source

    return jax.lax.map(match, inits, batch_size=at_once)


def _source(
    matcher: TrainedMatcher, scan: MeasuredScan, seed: int
) -> tuple[PointCloud, np.ndarray]:
    """The scan as the network takes it [num_source], and what its coordinates are about [3]."""
    kept = subset(scan.points, THINNED_FROM, seed)
    points = scan.points[kept]
    thinned = voxel_thin(points, voxel_mm=matcher.voxel_mm)
    sampling = matcher.sampling
    wanted = round(sampling.num_reference * len(thinned) / len(matcher.reference_points))
    chosen = thinned[subset(thinned, int(np.clip(wanted, 16, sampling.num_source)), seed + 1)]
    if scan.normals is None or scan.sensor_origin is None:
        normals = estimate_normals(points, sensor_origin=scan.sensor_origin, at=chosen)
    else:
        normals = scan.normals[kept[chosen]]
    middle = points[chosen].mean(axis=0)
    rows = sampling.num_source
    xyz, unit = np.zeros((rows, 3), np.float32), np.zeros((rows, 3), np.float32)
    xyz[: len(chosen)] = (points[chosen] - middle) / matcher.radius_mm
    unit[: len(chosen)] = normals
    mask = np.arange(rows) < len(chosen)
    return PointCloud(jnp.asarray(xyz), jnp.asarray(unit), jnp.asarray(mask)), middle


def _reference(matcher: TrainedMatcher, seed: int) -> PointCloud:
    """The part as the network takes it: [num_reference] points of its thinned surface."""
    chosen = subset(matcher.reference_points, matcher.sampling.num_reference, seed)
    xyz = (matcher.reference_points[chosen] - matcher.center) / matcher.radius_mm
    return PointCloud.create(
        jnp.asarray(xyz, jnp.float32), jnp.asarray(matcher.reference_normals[chosen], jnp.float32)
    )
