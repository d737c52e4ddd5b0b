"""Times of the fine registration, with its peers, and of `register` around it."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Iterator

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from experiments.benchmarks.timing import Bench, Figure, peer
from vanejax.cad import Part
from vanejax.localization import refine, register
from vanejax.localization.residuals import Precision, RayCasting, Residuals
from vanejax.rigid import RigidTransform

SAMPLES = 100_000  # of the CAD surface
REACH_MM, MOST_ITERATIONS = 10.0, 50
OPEN3D_ICP, SMALL_GICP = "Open3D ICP, point to plane", "small_gicp, point to plane"


@dataclasses.dataclass(frozen=True, eq=False)
class CountedRays(RayCasting):
    """A model that remembers how many ``rays`` each call so far asked it to cast."""

    rays: list[int] = dataclasses.field(default_factory=list)

    def residuals(
        self,
        part_from_camera: RigidTransform,
        points: np.ndarray,
        *,
        precision: Precision = "faces",
    ) -> Residuals:
        """See `RayCasting`."""
        self.rays.append(len(part_from_camera.rotation) * len(points))
        return super().residuals(part_from_camera, points, precision=precision)


def bare_scene(part: Part) -> EmbreeScene:
    """Embree's scene of a part about its centre."""
    scene = EmbreeScene(robust=True)
    vertices = (part.mesh.vertices - part.center[None]).astype(np.float32)
    TriangleMesh(scene, vertices, np.ascontiguousarray(part.mesh.faces, np.int32))
    return scene


def bare_rays(
    part: Part, pose: RigidTransform, points: np.ndarray
) -> tuple[EmbreeScene, np.ndarray, np.ndarray]:
    """What Embree alone takes: a scene about the part's centre, origins and directions [N, 3] f32.

    The rays are those of the points of a scan, from just before the part.
    """
    eye = pose.translation - part.center
    directions = pose.rotate(points / np.linalg.norm(points, axis=1, keepdims=True))
    origins = eye + (np.linalg.norm(eye) - 1.1 * part.radius) * directions
    return bare_scene(part), origins.astype(np.float32), directions.astype(np.float32)


def refine_against_casts(bench: Bench) -> Iterator[Figure]:
    """`refine`, compared with the time of Embree alone for as many rays of the same scan."""
    model, points, start = bench.views.model, bench.points, bench.rough
    counted = CountedRays(model.scanner, model.surface, model.sensor_origin)
    refine(counted, points, start)
    rays = sum(counted.rays)
    scene, origins, directions = bare_rays(model.part, start, points)

    def cast() -> None:
        for left in range(rays, 0, -len(origins)):
            scene.run(origins[:left], directions[:left])

    seconds, _ = bench.time(cast)
    note = f"{rays / 1e6:.2f} M rays, {rays / np.median(seconds) / 1e6:.1f} M/s in one thread"
    yield Figure("bare casts of refine", seconds, note=note)
    yield open3d_icp(bench)
    yield small_gicp_icp(bench)
    seconds, result = bench.time(lambda: refine(model, points, start))
    yield Figure(
        "refine",
        seconds,
        peers={OPEN3D_ICP: 1.0, SMALL_GICP: 1.0},
        limits={"bare casts of refine": None},
        goal_s=0.5,
        note=f"{len(points):,} points, {bench.error(result.part_from_camera)}",
    )


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


def register_from(bench: Bench) -> Iterator[Figure]:
    """`register` with and without weights and a rough pose, against `refine`."""
    part, scan = bench.views.part, bench.scan
    seconds, _ = bench.time(lambda: refine(bench.views.model, bench.points, bench.rough))
    yield Figure("refine alone", seconds)
    for name, matcher, init, goal_s in (
        ("register, weights, rough pose", bench.matcher, bench.rough, 1.0),
        ("register, weights, any pose", bench.matcher, None, 10.0),
        ("register, rough pose", None, bench.rough, None),
        ("register, any pose", None, None, None),
    ):
        if "weights" in name and matcher is None:
            yield Figure(name, [], goal_s=goal_s, note="skipped: no --weights")
            continue
        seconds, result = bench.time(
            functools.partial(register, scan, part, weights=matcher, init=init)
        )
        stages = ", ".join(f"{stage} {spent:.2f}" for stage, spent in result.seconds.items())
        note = f"{result.verdict.status}, {bench.error(result.part_from_camera)}; {stages}"
        yield Figure(name, seconds, limits={"refine alone": None}, goal_s=goal_s, note=note)
