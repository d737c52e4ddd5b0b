"""Time of the virtual scanner: every view, compared with Open3D and with Embree alone."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from embreex.rtcore_scene import EmbreeScene

from experiments.benchmarks.registration import bare_scene
from experiments.benchmarks.timing import Bench, Figure, peer
from experiments.runner import machine
from vanejax.cad import Part
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, scan_views

SAMPLE = 9  # every ninth view stands for all: four azimuths of each elevation
STRIPS = (1 << 12, 1 << 14, 1 << 16)  # rays given to Embree at once; the fastest counts
OPEN3D = "Open3D RaycastingScene"


def scan(bench: Bench) -> Iterator[Figure]:
    """Points, normals, ranges, faces, angles and labels of every view, in memory."""
    views = bench.views
    sample = range(0, len(views.viewpoints), SAMPLE)
    scale = len(views.viewpoints) / len(sample)
    stated = f"{len(sample)} of {len(views.viewpoints)} views, times {scale:g}"
    yield open3d_scan(bench, sample, scale, stated)
    yield bare_casts(bench, sample, scale, stated)
    seconds, scans = bench.time(
        lambda: scan_views(views.part, views.camera, views.viewpoints, progress=False)
    )
    points = sum(len(scan.points) for scan in scans)
    camera = views.camera
    yield Figure(
        f"scan, {len(scans)} views of {camera.width} x {camera.height}",
        seconds,
        peers={OPEN3D: 6.0},
        limits={"bare casts of the scans": 1.5},
        note=f"{points / 1e6:.1f} M points with normals, faces, angles, labels",
    )


@peer(OPEN3D)
def open3d_scan(bench: Bench, sample: range, scale: float, stated: str) -> tuple[list[float], str]:
    """The same with Open3D, which uses all cores for each view."""
    import open3d

    part, camera = bench.views.part, bench.views.camera
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        np.asarray(part.mesh.vertices, np.float32), np.asarray(part.mesh.faces, np.uint32)
    )
    intrinsic = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # its cameras look along +z

    def cast(view: int) -> tuple:
        extrinsic = flip @ bench.views.viewpoints.view(view).as_matrix()
        rays = scene.create_rays_pinhole(intrinsic, extrinsic, camera.width, camera.height)
        answer = scene.cast_rays(rays)
        hit = answer["t_hit"].isfinite()
        seen = rays[hit]
        points = seen[:, :3] + seen[:, 3:] * answer["t_hit"][hit].reshape((-1, 1))
        return points, answer["primitive_normals"][hit], answer["primitive_ids"][hit]

    seconds, counts = bench.time(lambda: [len(cast(view)[0]) for view in sample])
    note = (
        f"rays, casts, points, normals, faces; {stated}; {scale * sum(counts) / 1e6:.1f} M points"
    )
    return [scale * spent for spent in seconds], note


def bare_casts(bench: Bench, sample: range, scale: float, stated: str) -> Figure:
    """Embree alone on the rays that the views need, ready-made, on all cores."""
    views, threads = bench.views, machine.cores()
    scene = bare_scene(views.part)
    rays = [window_rays(views.part, views.camera, views.viewpoints.view(view)) for view in sample]
    count = sum(len(directions) for _, directions in rays)

    def cast(strip: int) -> None:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda view_rays: run_strips(scene, *view_rays, strip), rays))

    seconds = min((bench.time(lambda s=strip: cast(s))[0] for strip in STRIPS), key=np.median)
    rate = count / np.median(seconds) / 1e6
    note = f"{scale * count / 1e6:.0f} M rays, {rate:.1f} M/s in {threads} threads; {stated}"
    return Figure("bare casts of the scans", [scale * spent for spent in seconds], note=note)


def run_strips(
    scene: EmbreeScene, origins: np.ndarray, directions: np.ndarray, strip: int
) -> np.ndarray:
    """The faces [N] that rays [N, 3] f32 meet, some rays at a time."""
    starts = range(0, len(origins), strip)
    return np.concatenate(
        [scene.run(origins[at : at + strip], directions[at : at + strip]) for at in starts]
    )


def window_rays(
    part: Part, camera: Camera, camera_from_part: RigidTransform
) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions [N, 3] f32, about the part's centre, of the rays that a view needs.

    Those are the pixels of the rectangle about the part's projection, and they start just before
    the part. The camera must stand before all of it.
    """
    rotation = np.asarray(camera_from_part.rotation)
    vertices = camera_from_part.apply(np.asarray(part.mesh.vertices))
    pixels = camera.project(vertices)
    last = np.array([camera.width, camera.height]) - 1
    low = np.clip(np.floor(pixels.min(axis=0)), 0, last).astype(int)
    high = np.clip(np.floor(pixels.max(axis=0)), 0, last).astype(int)
    columns, rows = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
    x, y = camera.slopes(columns, rows)
    down = (y[:, None] * rotation[1])[:, None]
    directions = (down + (x[:, None] * rotation[0] - rotation[2])).reshape(-1, 3)
    eye = camera_from_part.inverse().translation - part.center
    origins = eye + (-vertices[:, 2].max() - 1.0) * directions
    return origins.astype(np.float32), directions.astype(np.float32)
