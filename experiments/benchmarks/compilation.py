"""Time to compile the step of training, each time in a new process.

python -m experiments.benchmarks.compilation

prints the seconds to trace and to compile as JSON; `VANEJAX_CACHE_DIR` is where programs are kept.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from experiments.benchmarks.processes import output
from experiments.timing import Bench, Figure
from experiments.vane_pairs import VanePairs
from vanejax import compilation_cache

NEAR_ZERO_S = 1.0  # a later process traces the step again, which no cache spares


def compilation(bench: Bench) -> Iterator[Figure]:
    """The step of training: with an empty compilation cache, then with a full one."""
    cold, cached = [], []
    with tempfile.TemporaryDirectory() as folder:
        for repeat in range(bench.repeats):
            cache = str(Path(folder) / str(repeat))
            for times in (cold, cached):
                text = output(
                    ["-m", "experiments.benchmarks.compilation"],
                    VANEJAX_CACHE_DIR=cache,
                    TF_CPP_MIN_LOG_LEVEL="3",
                )
                times.append(json.loads(text))
    for name, times, goal_s in (
        ("compilation of a step, first process", cold, 8.0),
        ("compilation of a step, later process", cached, NEAR_ZERO_S),
    ):
        seconds = [entry["trace"] + entry["compile"] for entry in times]
        middle = sorted(times, key=lambda entry: entry["compile"])[len(times) // 2]
        note = f"of which tracing {middle['trace']:.2f} s, XLA {middle['compile']:.2f} s"
        yield Figure(name, seconds, goal_s=goal_s, note=note)


def measure() -> dict[str, float]:
    """Seconds to trace and to compile the step in this process."""
    pairs = VanePairs()
    step, state, bank = pairs.train_step(), pairs.state(), pairs.bank
    began = time.perf_counter()
    lowered = step.lower(state, bank)
    traced = time.perf_counter()
    lowered.compile()
    return {"trace": traced - began, "compile": time.perf_counter() - traced}


if __name__ == "__main__":
    compilation_cache.enable()
    print(json.dumps(measure()))
