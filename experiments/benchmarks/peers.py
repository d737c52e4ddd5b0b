"""Peers of the fine registration: point-to-plane ICP of other libraries."""

from __future__ import annotations

import os

import numpy as np

from experiments.benchmarks.timing import Bench, peer
from vanejax.rigid import RigidTransform

SAMPLES = 100_000  # of the CAD surface
REACH_MM, MOST_ITERATIONS = 10.0, 50
OPEN3D_ICP, SMALL_GICP = "Open3D ICP, point to plane", "small_gicp, point to plane"


@peer(OPEN3D_ICP)
def open3d_icp(bench: Bench) -> tuple[list[float], str]:
    """Point-to-plane ICP to samples of the CAD surface; the samples' tree is not timed."""
    import open3d

    surface, normals, _ = bench.views.part.sample(SAMPLES, seed=0)
    target, source = open3d.geometry.PointCloud(), open3d.geometry.PointCloud()
    target.points = open3d.utility.Vector3dVector(surface)
    target.normals = open3d.utility.Vector3dVector(normals)
    source.points = open3d.utility.Vector3dVector(bench.points)
    method = open3d.pipelines.registration
    seconds, result = bench.time(
        lambda: method.registration_icp(
            source,
            target,
            REACH_MM,
            bench.rough.as_matrix(),
            method.TransformationEstimationPointToPlane(),
            method.ICPConvergenceCriteria(1e-9, 1e-9, MOST_ITERATIONS),
        )
    )
    return seconds, bench.error(RigidTransform.from_matrix(np.asarray(result.transformation)))


@peer(SMALL_GICP)
def small_gicp_icp(bench: Bench) -> tuple[list[float], str]:
    """The same with small_gicp, on all cores; its normals come from the samples around."""
    import small_gicp

    surface, _, _ = bench.views.part.sample(SAMPLES, seed=0)
    target = small_gicp.PointCloud(surface)
    tree = small_gicp.KdTree(target)
    small_gicp.estimate_normals(target, tree)
    source = small_gicp.PointCloud(bench.points)
    seconds, result = bench.time(
        lambda: small_gicp.align(
            target,
            source,
            tree,
            bench.rough.as_matrix(),
            registration_type="PLANE_ICP",
            max_correspondence_distance=REACH_MM,
            num_threads=os.cpu_count(),
            max_iterations=MOST_ITERATIONS,
            rotation_epsilon=1e-6,
            translation_epsilon=1e-5,
        )
    )
    return seconds, bench.error(RigidTransform.from_matrix(np.asarray(result.T_target_source)))
