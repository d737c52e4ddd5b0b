"""Point-to-plane ICP of other libraries, timed where they are installed."""

from __future__ import annotations

import os

import numpy as np

from experiments.benchmarks.timing import Bench, Figure
from vanejax.rigid import RigidTransform

SAMPLES = 100_000  # of the CAD surface
REACH_MM, MOST_ITERATIONS = 10.0, 50
OPEN3D_ICP, SMALL_GICP = "Open3D ICP, point to plane", "small_gicp, point to plane"


def open3d_icp(bench: Bench) -> Figure:
    """Point-to-plane ICP to samples of the CAD surface; the samples' tree is not timed."""
    try:
        import open3d
    except ImportError as error:
        return Figure(OPEN3D_ICP, [], note=f"skipped: {error}")

    surface, normals, _ = bench.views.part.sample(SAMPLES, seed=0)
    target, source = open3d.geometry.PointCloud(), open3d.geometry.PointCloud()
    target.points = open3d.utility.Vector3dVector(surface)
    target.normals = open3d.utility.Vector3dVector(normals)
    source.points = open3d.utility.Vector3dVector(bench.points)
    method = open3d.pipelines.registration
    seconds, found = bench.time(
        lambda: method.registration_icp(
            source,
            target,
            REACH_MM,
            bench.rough.as_matrix(),
            method.TransformationEstimationPointToPlane(),
            method.ICPConvergenceCriteria(1e-9, 1e-9, MOST_ITERATIONS),
        )
    )
    pose = RigidTransform.from_matrix(np.asarray(found.transformation))
    return Figure(OPEN3D_ICP, seconds, note=bench.error(pose))


def small_gicp_icp(bench: Bench) -> Figure:
    """The same with small_gicp, on all cores; its normals come from the samples around."""
    try:
        import small_gicp
    except ImportError as error:
        return Figure(SMALL_GICP, [], note=f"skipped: {error}")

    surface, _, _ = bench.views.part.sample(SAMPLES, seed=0)
    target = small_gicp.PointCloud(surface)
    tree = small_gicp.KdTree(target)
    small_gicp.estimate_normals(target, tree)
    source = small_gicp.PointCloud(bench.points)
    seconds, found = bench.time(
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
    pose = RigidTransform.from_matrix(np.asarray(found.T_target_source))
    return Figure(SMALL_GICP, seconds, note=bench.error(pose))
