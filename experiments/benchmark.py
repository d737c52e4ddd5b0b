"""Times of the fine registration, each beside what it is fair to compare it with on this machine.

python -m experiments.benchmark [--only refine,register,command] [--weights FILE] [--repeats 5]

The scan is the guide vane's largest test view at full resolution, with 0.1 mm of white noise; the
rough pose is 5 deg and 5 mm off. Times are medians with their range; a ratio is that to a time of
the same run, so that a slow or a busy machine cancels. Open3D and small_gicp are compared with
where they are installed. Results: a table and benchmark.json in ``--out``.

To add a benchmark, write a function that takes `Bench` and yields `Figure`s, and name it in
`BENCHMARKS`.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from experiments import study
from experiments.other_icp import open3d_icp, small_gicp_icp
from experiments.run_folder import write_json
from experiments.timing import Bench, Figure, summarize, table
from vanejax.errors import InputError
from vanejax.locate import register
from vanejax.part import Part
from vanejax.pose_file import pose_to_dict
from vanejax.refine import refine
from vanejax.residuals import Precision, RayCasting, Residuals
from vanejax.rigid import RigidTransform
from vanejax.scan_file import save_points

LEAST_REPEATS = 5


@dataclasses.dataclass(frozen=True, eq=False)
class CountedRays(RayCasting):
    """A model that remembers how many rays it was asked to cast.

    Attributes:
      rays: of each call so far.
    """

    rays: list[int] = dataclasses.field(default_factory=list)

    def residuals(
        self, part_from_camera: RigidTransform, points: np.ndarray, *, feet: Precision = "faces"
    ) -> Residuals:
        """See `RayCasting`."""
        self.rays.append(len(part_from_camera.rotation) * len(points))
        return super().residuals(part_from_camera, points, feet=feet)


def bare_rays(
    part: Part, pose: RigidTransform, points: np.ndarray
) -> tuple[EmbreeScene, np.ndarray, np.ndarray]:
    """What Embree alone takes: a scene about the part's centre, origins and directions [N, 3] f32.

    The rays are those of the points of a scan, from just before the part.
    """
    scene = EmbreeScene(robust=True)
    vertices = (part.mesh.vertices - part.center[None]).astype(np.float32)
    TriangleMesh(scene, vertices, np.ascontiguousarray(part.mesh.faces, np.int32))
    eye = pose.translation - part.center
    directions = pose.rotate(points / np.linalg.norm(points, axis=1, keepdims=True))
    origins = eye + (np.linalg.norm(eye) - 1.1 * part.radius) * directions
    return scene, origins.astype(np.float32), directions.astype(np.float32)


def refine_against_casts(bench: Bench) -> Iterator[Figure]:
    """`refine`, against the time that Embree alone needs for as many rays of the same scan."""
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
    yield Figure("bare casts", seconds, note=note)
    seconds, found = bench.time(lambda: refine(model, points, start))
    note = f"{len(points):,} points, {bench.error(found.part_from_camera)}"
    yield Figure("refine", seconds, against="bare casts", goal_s=0.5, note=note)
    yield open3d_icp(bench)
    yield small_gicp_icp(bench)


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
        yield Figure(name, seconds, against="refine alone", goal_s=goal_s, note=note)


def command(bench: Bench) -> Iterator[Figure]:
    """`vanejax register` as a process: with an empty compilation cache, then with a full one.

    Against a process that imports JAX and leaves.
    """
    seconds = [_process(["-c", "import jax"]) for _ in range(bench.repeats)]
    yield Figure("python -c 'import jax'", seconds)
    with tempfile.TemporaryDirectory() as folder:
        scan, guess = Path(folder) / "scan.ply", Path(folder) / "guess.json"
        save_points(scan, bench.points)
        write_json(guess, pose_to_dict(bench.rough))
        arguments = ["-m", "vanejax", "register", str(scan), "vane", "--quiet"]
        if bench.weights is not None:
            arguments += ["--weights", str(bench.weights.absolute())]
        for words, more in (("rough pose", ["--init", str(guess)]), ("any pose", [])):
            first, second = [], []
            for repeat in range(bench.repeats):
                cache = str(Path(folder) / f"cache {words} {repeat}")
                for seconds in (first, second):
                    seconds.append(_process([*arguments, *more], VANEJAX_CACHE_DIR=cache))
            with_weights = "" if bench.weights is None else "weights, "
            for run, seconds, goal_s in (("first", first, 8.0), ("second", second, 5.0)):
                yield Figure(
                    f"command, {with_weights}{words}, {run} run",
                    seconds,
                    against="python -c 'import jax'",
                    goal_s=goal_s if words == "rough pose" else None,
                )


def _process(arguments: Sequence[str], **environment: str) -> float:
    """Seconds of a Python process.

    Raises:
      InputError: it ended with neither success nor a verdict.
    """
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - began
    if done.returncode not in (0, 3, 4):
        raise InputError(f"python {' '.join(arguments)} failed: {done.stderr.strip()}")
    return seconds


BENCHMARKS: dict[str, Callable[[Bench], Iterator[Figure]]] = {
    "refine": refine_against_casts,
    "register": register_from,
    "command": command,
}


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """The chosen benchmarks."""
    names = settings.only.split(",") if settings.only else list(BENCHMARKS)
    unknown = sorted(set(names) - set(BENCHMARKS))
    if unknown:
        raise InputError(f"no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}")
    if settings.repeats < LEAST_REPEATS:
        print(f"note: the figures that count are medians of at least {LEAST_REPEATS} repeats")
    bench = Bench(repeats=settings.repeats, seed=settings.seed, weights=settings.weights)
    if bench.matcher is not None:
        bench.matcher.check_part(bench.views.part)
    report = study.header("times, warm", settings, bench.views.part)
    figures: list[Figure] = []
    for name in names:
        print(f"{name} ...", file=sys.stderr)
        figures += BENCHMARKS[name](bench)
    rows = summarize(figures)
    report = study.save(settings.out, "benchmark", report | {"rows": rows})
    print(table(rows))
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("benchmark", __doc__)
    parser.add_argument("--only", help=f"some of {','.join(BENCHMARKS)}")
    parser.add_argument("--weights", type=Path, help="from `vanejax export`, for the guide vane")
    parser.add_argument("--repeats", type=study.count, default=LEAST_REPEATS)
    return parser


if __name__ == "__main__":
    study.run(main, make_parser())
