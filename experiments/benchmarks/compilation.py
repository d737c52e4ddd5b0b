"""Time to compile the step of training, each time in a new process.

python -m experiments.benchmarks.compilation

prints the seconds to trace and to compile as JSON; `VANEJAX_CACHE_DIR` is where programs are kept.
"""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Iterator

from experiments.benchmarks.network import VanePairs
from experiments.benchmarks.processes import first_and_later, measured
from experiments.benchmarks.timing import Bench, Figure
from vanejax import compilation_cache

NEAR_ZERO_S = 1.0


def compilation(bench: Bench) -> Iterator[Figure]:
    """The step of training: with an empty compilation cache, then with a full one.

    A later process traces the step again, which no cache spares: that stands by itself.
    """
    cold, cached = first_and_later(bench.repeats, functools.partial(measured, "compilation"))
    yield Figure("tracing of a step, every process", [entry["trace"] for entry in cold + cached])
    first = [entry["trace"] + entry["compile"] for entry in cold]
    note = "traced and compiled"
    yield Figure("compilation of a step, first process", first, goal_s=8.0, note=note)
    later = [entry["compile"] for entry in cached]
    note = "read from the cache, besides tracing"
    yield Figure("compilation of a step, later process", later, goal_s=NEAR_ZERO_S, note=note)


def measure() -> dict[str, float]:
    """Seconds to trace and to compile the step in this process."""
    pairs = VanePairs()
    step, state, bank = pairs.config.train_step(pairs.sampling), pairs.state(), pairs.bank
    began = time.perf_counter()
    lowered = step.lower(state, bank)
    traced = time.perf_counter()
    lowered.compile()
    return {"trace": traced - began, "compile": time.perf_counter() - traced}


if __name__ == "__main__":
    compilation_cache.enable()
    print(json.dumps(measure()))
