"""How the costs grow: with faces, pixels, measured points, and the sizes of the network."""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import manifold3d
import numpy as np
import trimesh

from experiments.benchmarks.network import registering, training
from experiments.benchmarks.scaling_series import Series
from experiments.benchmarks.timing import NOISE_MM, Bench
from experiments.benchmarks.vane_pairs import VanePairs
from experiments.runner.vane_views import VaneViews, with_noise
from vanejax.cad.part import Part, load_part
from vanejax.localization.fine_registration import refine
from vanejax.localization.registration import register
from vanejax.scanner.virtual_scanner import Scanner
from vanejax.scans.measured_scan import MeasuredScan
from vanejax.scans.scan_file import load_scan, save_points


@dataclasses.dataclass(frozen=True)
class Sizes:
    """What the series run over; the defaults are those of every run.

    Attributes:
      edge_pieces: into which each edge of the vane's 22,976 faces is cut.
      resolutions: of the camera, per side.
      points: of the scan.
      network_points: of the source and of the reference.
      neighbors: of the network.
      batches: of training.
    """

    edge_pieces: tuple[int, ...] = (1, 2, 4)
    resolutions: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0)
    points: tuple[int, ...] = (10_000, 30_000, 100_000, 300_000)
    network_points: tuple[int, ...] = (256, 512, 1024)
    neighbors: tuple[int, ...] = (16, 32, 64)
    batches: tuple[int, ...] = (1, 2, 4)


# to 10,132,416 faces, 84 M pixels, 10 M points: minutes
LARGE = Sizes(
    edge_pieces=(1, 2, 4, 7, 12, 21),
    resolutions=(0.25, 0.5, 1.0, 2.0, 4.0, 8.0),
    points=(10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 10_000_000),
    network_points=(256, 512, 1024, 2048, 4096),
    neighbors=(16, 32, 64, 128),
    batches=(1, 2, 4, 8, 16),
)


def scaling(bench: Bench, sizes: Sizes | None = None) -> Iterator[Series]:
    """All series."""
    sizes = sizes or (LARGE if bench.large else Sizes())
    yield from over_faces(bench, sizes.edge_pieces)
    yield over_resolution(bench, sizes.resolutions)
    yield from over_points(bench, sizes.points)
    yield from over_network(bench, sizes)


def over_faces(bench: Bench, edge_pieces: tuple[int, ...]) -> Iterator[Series]:
    """Reading, setting up, scanning and registering one part of more and more faces."""
    camera, pose = bench.views.camera, bench.views.viewpoints.view(bench.view)
    counts: list[int] = []
    seconds: dict[str, list[list[float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "part.stl"
        for pieces in edge_pieces:
            part = refined(bench.views.part, pieces)
            part.export(path)
            scanner = Scanner(part)
            counts.append(len(part.mesh.faces))
            runs: dict[str, Callable[[], Any]] = {
                "load a binary STL": functools.partial(load_part, path, units="mm"),
                "set up the scanner": functools.partial(Scanner, part),
                "one scan, faces": functools.partial(scanner.scan, camera, pose),
                "register from a rough pose, faces": functools.partial(
                    register, bench.scan, part, init=bench.rough
                ),
            }
            for name, run in runs.items():
                seconds.setdefault(name, []).append(bench.time_sparingly(run))
    for name, times in seconds.items():
        yield Series(name, "faces", counts, times)


def refined(part: Part, pieces: int) -> Part:
    """The same surface with each edge cut in pieces: ``pieces**2`` times the faces."""
    if pieces == 1:
        return part
    # copies: the part's arrays are read-only, which manifold3d does not take
    mesh = manifold3d.Mesh64(
        np.array(part.mesh.vertices, np.float64), np.array(part.mesh.faces, np.uint64)
    )
    finer = manifold3d.Manifold(mesh).refine(pieces).to_mesh64()
    vertices, faces = np.asarray(finer.vert_properties)[:, :3], np.asarray(finer.tri_verts)
    mesh = trimesh.Trimesh(vertices, faces.astype(np.int64), process=False)
    mesh.mutable = False
    return dataclasses.replace(part, mesh=mesh, notes=())


def over_resolution(bench: Bench, resolutions: tuple[float, ...]) -> Series:
    """One scan with more and more pixels."""
    scanner, pose = bench.views.model.scanner, bench.views.viewpoints.view(bench.view)
    cameras = [bench.views.camera.scaled(factor) for factor in resolutions]
    seconds = [
        bench.time_sparingly(functools.partial(scanner.scan, camera, pose)) for camera in cameras
    ]
    return Series(
        "one scan, pixels", "pixels", [camera.width * camera.height for camera in cameras], seconds
    )


def over_points(bench: Bench, counts: tuple[int, ...]) -> Iterator[Series]:
    """Reading, refining and registering more and more measured points of one view."""
    part, start = bench.views.part, bench.rough
    seconds: dict[str, list[list[float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.ply"
        for count in counts:
            points = measured_points(bench, count)
            save_points(path, points)
            scan = MeasuredScan(points, None, np.zeros(3), f"{count} points")
            runs: dict[str, Callable[[], Any]] = {
                "read a scan, points": functools.partial(load_scan, path),
                "refine, points": functools.partial(refine, bench.views.model, points, start),
                "register from a rough pose, points": functools.partial(
                    register, scan, part, init=start
                ),
            }
            for name, run in runs.items():
                seconds.setdefault(name, []).append(bench.time_sparingly(run))
    for name, times in seconds.items():
        yield Series(name, "points", counts, times)


def measured_points(bench: Bench, count: int) -> np.ndarray:
    """[count, 3] f64, mm: points of the largest view with noise, at a resolution that has them."""
    camera, rng = bench.views.camera, np.random.default_rng(bench.seed)
    factor = 1.05 * np.sqrt(count / len(bench.points))
    views = VaneViews(camera=camera.scaled(factor)) if factor > 1 else bench.views
    points = views.points(bench.view)
    chosen = np.sort(rng.permutation(len(points))[:count])
    return with_noise(points[chosen], NOISE_MM, rng)


def over_network(bench: Bench, sizes: Sizes) -> Iterator[Series]:
    """RPM-Net of more and more points, neighbours and pairs."""
    for name, unit, values, make, prepare in (
        (
            "inference, points of each cloud",
            "points",
            sizes.network_points,
            lambda size: VanePairs(sources=size, targets=size),
            registering,
        ),
        (
            "inference, neighbours",
            "neighbours",
            sizes.neighbors,
            lambda size: VanePairs(neighbors=size),
            registering,
        ),
        (
            "training step, pairs of a batch",
            "pairs",
            sizes.batches,
            lambda size: VanePairs(batch=size),
            training,
        ),
    ):
        # the first run compiles, so that it never counts
        seconds = [bench.time(prepare(make(value)))[0] for value in values]
        yield Series(name, unit, values, seconds)
