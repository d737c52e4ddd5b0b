"""Times of whole processes: how the command starts, and how it registers."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from experiments.benchmarks.timing import Bench, Figure
from vanejax.errors import InputError
from vanejax.files import write_json
from vanejax.machine.pose_file import pose_to_dict
from vanejax.scans import save_points

T = TypeVar("T")


def start(bench: Bench) -> Iterator[Figure]:
    """How long it takes until anything can happen."""
    for name, arguments, goal_s in (
        ("python -c pass", ["-c", "pass"], None),
        ("python -c 'import vanejax'", ["-c", "import vanejax"], 0.5),
        ("vanejax --help", ["-m", "vanejax", "--help"], 1.0),
    ):
        run(arguments)  # reads the files into memory
        seconds = [run(arguments) for _ in range(bench.repeats)]
        limits = {} if goal_s is None else {"python -c pass": None}
        yield Figure(name, seconds, limits=limits, goal_s=goal_s)


def command(bench: Bench) -> Iterator[Figure]:
    """`vanejax register` as a process, with an empty and a full cache; against JAX's import."""
    seconds = [run(["-c", "import jax"]) for _ in range(bench.repeats)]
    yield Figure("python -c 'import jax'", seconds)
    with tempfile.TemporaryDirectory() as folder:
        scan, guess = Path(folder) / "scan.ply", Path(folder) / "guess.json"
        save_points(scan, bench.points)
        write_json(guess, pose_to_dict(bench.rough))
        arguments = ["-m", "vanejax", "register", str(scan), "vane", "--quiet"]
        if bench.weights is not None:
            arguments += ["--weights", str(bench.weights.absolute())]
        for words, more in (("rough pose", ["--init", str(guess)]), ("any pose", [])):
            runs = first_and_later(bench.repeats, functools.partial(run, [*arguments, *more]))
            with_weights = "" if bench.weights is None else "weights, "
            for turn, seconds, goal_s in zip(("first", "second"), runs, (8.0, 5.0), strict=True):
                yield Figure(
                    f"command, {with_weights}{words}, {turn} run",
                    seconds,
                    limits={"python -c 'import jax'": None},
                    goal_s=goal_s if words == "rough pose" else None,
                )


def first_and_later(repeats: int, call: Callable[..., T]) -> tuple[list[T], list[T]]:
    """What a process gives with an empty compilation cache, and once more with the full one."""
    first, later = [], []
    with tempfile.TemporaryDirectory() as folder:
        for repeat in range(repeats):
            for results in (first, later):
                results.append(call(VANEJAX_CACHE_DIR=f"{folder}/{repeat}"))
    return first, later


def measured(module: str, *arguments: str, **environment: str) -> dict[str, float]:
    """The JSON that a module of the benchmarks prints, run as a process."""
    words = ["-m", f"experiments.benchmarks.{module}", *arguments]
    return json.loads(output(words, TF_CPP_MIN_LOG_LEVEL="3", **environment))


def run(arguments: Sequence[str], **environment: str) -> float:
    """Seconds of a Python process; errors as of `output`."""
    began = time.perf_counter()
    output(arguments, **environment)
    return time.perf_counter() - began


def output(arguments: Sequence[str], **environment: str) -> str:
    """What a Python process prints; InputError if it ended with neither success nor a verdict."""
    done = subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode not in (0, 3, 4):
        raise InputError(f"python {' '.join(arguments)} failed: {done.stderr.strip()}")
    return done.stdout
