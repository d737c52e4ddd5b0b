"""Time of an evaluation: 54 test views registered, measured and reported, each in a new process.

python -m experiments.benchmarks.evaluation SCANS.npz

prints the seconds as JSON; the weights are random, which costs as much as trained ones.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from experiments import evaluate
from experiments.benchmarks.flops import feature_flops, inference_flops
from experiments.benchmarks.network import arithmetic
from experiments.benchmarks.processes import first_and_later, measured
from experiments.benchmarks.timing import Bench, Figure
from experiments.configs.vane import get_config
from experiments.runner import evaluation_pictures as pictures
from experiments.runner.evaluation_report import table
from vanejax import compilation_cache
from vanejax.training import ScanSet, load_scan_set, make_bank, make_scan_set


def evaluation(bench: Bench) -> Iterator[Figure]:
    """The default recipe's, with an empty compilation cache, then with a full one."""
    scans = test_scans(bench)
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/scans.npz"
        scans.save(path)
        call = functools.partial(measured, "evaluation", path)
        first, later = first_and_later(bench.repeats, call)
    config = get_config()
    model, sources = config.make_network().model, config.pair_sampling(scans).num_source
    targets, iterations = config.data.num_reference, config.model.test_iterations
    flops = inference_flops(model, sources, targets, iterations) + feature_flops(model, targets)
    limit = "arithmetic of an evaluation"
    yield arithmetic(bench, limit, len(scans) * flops)
    for turn, times in (("first", first), ("later", later)):
        middle = sorted(times, key=lambda entry: entry["figures"])[len(times) // 2]
        yield Figure(
            f"evaluation, {len(scans)} views, {turn} process",
            [entry["figures"] for entry in times],
            limits={limit: None},
            goal_s=10.0,
            note=f"registrations, metrics, report; of which registering {middle['alone']:.2f} s",
        )
        yield Figure(
            f"evaluation with pictures, {turn} process",
            [entry["figures"] + entry["pictures"] for entry in times],
        )


def test_scans(bench: Bench) -> ScanSet:
    """The paper's test views of the guide vane."""
    views = bench.views.viewpoints
    return make_scan_set(
        bench.views.part,
        bench.views.camera,
        views.select(views.is_test),
        voxel_mm=get_config().data.voxel_mm,
        progress=False,
    )


def measure(scans: ScanSet) -> dict[str, float]:
    """Seconds in this process: of the figures, of the registrations alone, of the pictures."""
    config = get_config()
    bank = make_bank(scans, num_reference=config.data.num_reference)
    variables = config.initial_state(bank, config.pair_sampling(scans)).variables
    part = config.make_part()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        began = time.perf_counter()
        results = evaluate.registered(config, scans, variables, progress=False)
        print(table(evaluate.report_of(config, scans, results)))
        reported = time.perf_counter()
        pictures.draw(results, scans, part, config.make_camera(), (), Path(folder))
        drawn = time.perf_counter()
    return {
        "figures": reported - began,
        "alone": float(results.time_s.sum()),
        "pictures": drawn - reported,
    }


if __name__ == "__main__":
    compilation_cache.enable()
    print(json.dumps(measure(load_scan_set(sys.argv[1]))))
