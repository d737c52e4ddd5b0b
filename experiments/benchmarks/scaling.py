"""How the costs grow: with faces, pixels, measured points, and the sizes of the network."""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import manifold3d
import numpy as np
import trimesh

from experiments.benchmarks.network import VanePairs, registering, training
from experiments.benchmarks.timing import NOISE_MM, Bench, spread_cells
from experiments.runner import study_command as study
from experiments.runner.vane_views import VaneViews, with_noise
from vanejax.cad import Part, load_part
from vanejax.localization import refine, register
from vanejax.scanner import Scanner
from vanejax.scans import MeasuredScan, load_scan, save_points


@dataclasses.dataclass(frozen=True)
class Series:
    """The times of one operation (``seconds`` of each repeat) at ascending ``sizes``."""

    name: str
    unit: str
    sizes: Sequence[float]
    seconds: Sequence[Sequence[float]]


@dataclasses.dataclass(frozen=True)
class Sizes:
    """What the series run over."""

    edge_pieces: tuple[int, ...] = (1, 2, 4)  # of each edge of the vane's 22,976 faces
    resolutions: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0)  # of the camera, per side
    points: tuple[int, ...] = (10_000, 30_000, 100_000, 300_000)
    network_points: tuple[int, ...] = (256, 512, 1024)
    neighbors: tuple[int, ...] = (16, 32, 64)
    batches: tuple[int, ...] = (1, 2, 4)


FITTED = 3  # the largest sizes: in small ones the fixed costs prevail
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
    yield from over_resolution(bench, sizes.resolutions)
    yield from over_points(bench, sizes.points)
    yield from over_network(bench, sizes)


def over(
    bench: Bench,
    unit: str,
    sizes: Sequence[float],
    runs_of: Callable[[Any], Mapping[str, Callable[[], Any]]],
) -> Iterator[Series]:
    """A series for each of the runs that there are of every size."""
    seconds: dict[str, list[list[float]]] = {}
    for size in sizes:
        for name, run in runs_of(size).items():
            seconds.setdefault(name, []).append(bench.time_sparingly(run))
    for name, times in seconds.items():
        yield Series(name, unit, sizes, times)


def over_faces(bench: Bench, edge_pieces: tuple[int, ...]) -> Iterator[Series]:
    """Reading, setting up, scanning and registering one part of more and more faces."""
    camera, pose = bench.views.camera, bench.views.viewpoints.view(bench.view)
    pieces_of = {len(bench.views.part.mesh.faces) * pieces**2: pieces for pieces in edge_pieces}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "part.stl"

        def runs_of(faces: int) -> dict[str, Callable[[], Any]]:
            part = refined(bench.views.part, pieces_of[faces])
            part.export(path)
            return {
                "load a binary STL": functools.partial(load_part, path, units="mm"),
                "set up the scanner": functools.partial(Scanner, part),
                "one scan, faces": functools.partial(Scanner(part).scan, camera, pose),
                "register from a rough pose, faces": functools.partial(
                    register, bench.scan, part, init=bench.rough
                ),
            }

        yield from over(bench, "faces", list(pieces_of), runs_of)


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


def over_resolution(bench: Bench, resolutions: tuple[float, ...]) -> Iterator[Series]:
    """One scan with more and more pixels."""
    scanner, pose = bench.views.model.scanner, bench.views.viewpoints.view(bench.view)
    cameras = [bench.views.camera.scaled(factor) for factor in resolutions]
    seconds = [
        bench.time_sparingly(functools.partial(scanner.scan, camera, pose)) for camera in cameras
    ]
    pixels = [camera.width * camera.height for camera in cameras]
    yield Series("one scan, pixels", "pixels", pixels, seconds)


def over_points(bench: Bench, counts: tuple[int, ...]) -> Iterator[Series]:
    """Reading, refining and registering more and more measured points of one view."""
    part, start = bench.views.part, bench.rough
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.ply"

        def runs_of(count: int) -> dict[str, Callable[[], Any]]:
            points = measured_points(bench, count)
            save_points(path, points)
            scan = MeasuredScan(points, None, np.zeros(3), f"{count} points")
            return {
                "read a scan, points": functools.partial(load_scan, path),
                "refine, points": functools.partial(refine, bench.views.model, points, start),
                "register from a rough pose, points": functools.partial(
                    register, scan, part, init=start
                ),
            }

        yield from over(bench, "points", counts, runs_of)


def measured_points(bench: Bench, count: int) -> np.ndarray:
    """[count, 3] f64, mm: points of the largest view with noise, at a resolution that has them."""
    camera, rng = bench.views.camera, np.random.default_rng(bench.seed)
    factor = 1.05 * np.sqrt(count / len(bench.points))
    views = VaneViews(camera=camera.scaled(factor)) if factor > 1 else bench.views
    points = views.points(bench.view)
    chosen = np.sort(rng.permutation(len(points))[:count])
    return with_noise(points[chosen], NOISE_MM, rng)


def over_network(bench: Bench, sizes: Sizes) -> Iterator[Series]:
    """RPM-Net of more and more points, neighbours and pairs; the first run of each compiles."""
    for name, unit, values, run_of in (
        (
            "inference, points of each cloud",
            "points",
            sizes.network_points,
            lambda size: registering(VanePairs(sources=size, targets=size)),
        ),
        (
            "inference, neighbours",
            "neighbours",
            sizes.neighbors,
            lambda size: registering(VanePairs(neighbors=size)),
        ),
        (
            "training step, pairs of a batch",
            "pairs",
            sizes.batches,
            lambda size: training(VanePairs(batch=size)),
        ),
    ):
        yield Series(name, unit, values, [bench.time(run_of(size))[0] for size in values])


def exponent(sizes: Sequence[float], seconds: Sequence[float]) -> float | None:
    """The slope of log time over log size at the largest sizes: 1 is linear; None for one size."""
    if len(sizes) < 2:
        return None
    x, y = (np.log(values[-FITTED:]) for values in (sizes, seconds))
    return float(np.polyfit(x, y, 1)[0])


def summarize_scaling(series: Sequence[Series]) -> list[dict[str, Any]]:
    """For JSON: each size with its times, and the exponent of the medians."""
    rows = []
    for entry in series:
        points = [
            {"size": size, "seconds": study.spread(list(seconds)), "repeats": len(seconds)}
            for size, seconds in zip(entry.sizes, entry.seconds, strict=True)
        ]
        power = exponent(entry.sizes, [point["seconds"]["median"] for point in points])
        rows.append({"name": entry.name, "unit": entry.unit, "points": points, "exponent": power})
    return rows


def scaling_table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as aligned text."""
    lines = [f"{'scaling':<46}{'median (s)':>11}{'min - max':>20}"]
    for row in rows:
        power = "" if row["exponent"] is None else f": grows as size^{row['exponent']:.2f}"
        lines.append(f"{row['name']}{power}")
        for point in row["points"]:
            size = f"{point['size']:,.0f} {row['unit']}"
            lines.append(f"{size:>46}{spread_cells(point['seconds'])}")
    return "\n".join(lines)
