"""Times of vanejax, compared with other programs and with the limits of this machine.

python -m experiments.benchmark [--only scan,step,refine] [--weights FILE] [--repeats 5] [--large]

A time is compared with peers, other programs that do the same, and with limits, the least that it
could take here: Embree's casts alone, or the arithmetic at the rate of a large matrix product. All
are measured in the same run, so that a slow or busy machine cancels in the ratios. Times are
medians with their range. Open3D, small_gicp and PyTorch come with `pip install '.[peers]'`; without
them their times are skipped. Results: a table and benchmark.json in ``--out``.

To add a benchmark, write a function that takes `Bench` and yields `Figure`s or `Series`, and name
it in `BENCHMARKS`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmarks.compilation import compilation
from experiments.benchmarks.evaluation import evaluation
from experiments.benchmarks.network import inference, step
from experiments.benchmarks.processes import command, start
from experiments.benchmarks.registration import refine_against_casts, register_from
from experiments.benchmarks.scaling import Series, scaling, scaling_table, summarize_scaling
from experiments.benchmarks.scanning import scan
from experiments.benchmarks.timing import Bench, Figure, summarize, table
from experiments.runner import machine
from experiments.runner import study_command as study
from vanejax.errors import InputError

LEAST_REPEATS = 5

BENCHMARKS: dict[str, Callable[[Bench], Iterator[Figure | Series]]] = {
    "scan": scan,
    "step": step,
    "inference": inference,
    "compile": compilation,
    "evaluate": evaluation,
    "start": start,
    "refine": refine_against_casts,
    "register": register_from,
    "command": command,
    "scaling": scaling,
}


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """The chosen benchmarks."""
    names = settings.only.split(",") if settings.only else list(BENCHMARKS)
    unknown = sorted(set(names) - set(BENCHMARKS))
    if unknown:
        raise InputError(f"no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}")
    if settings.repeats < LEAST_REPEATS:
        print(f"note: the figures that count are medians of at least {LEAST_REPEATS} repeats")
    bench = Bench(settings.repeats, settings.seed, settings.weights, settings.large)
    report = study.header("times, warm", settings, bench.views.part)
    rates = machine.flops_per_second(LEAST_REPEATS)
    report["machine"]["matmul_flops_per_second"] = float(np.median(rates))
    report["versions"] |= machine.versions(machine.PEERS)
    figures: list[Figure | Series] = []
    for name in names:
        print(f"{name} ...", file=sys.stderr)
        figures += BENCHMARKS[name](bench)
    rows = summarize([figure for figure in figures if isinstance(figure, Figure)])
    scaling_rows = summarize_scaling([series for series in figures if isinstance(series, Series)])
    report = study.save(settings.out, "benchmark", report | {"rows": rows, "scaling": scaling_rows})
    print(headline(report))
    if rows:
        print(table(rows))
    if scaling_rows:
        print(scaling_table(scaling_rows))
    return report


def headline(report: dict[str, Any]) -> str:
    """The machine and the versions, in words."""
    facts = report["machine"]
    installed = [f"{name} {version}" for name, version in report["versions"].items() if version]
    half = len(installed) // 2
    return (
        f"{facts['cpu']}, {facts['cores']} cores, "
        f"{facts['matmul_flops_per_second'] / 1e9:.0f} GFLOP/s in a large f32 product, load "
        f"{facts['load']:.1f} at the start\n{', '.join(installed[:half])}\n"
        f"{', '.join(installed[half:])}\n"
    )


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("benchmark", __doc__)
    parser.add_argument("--only", help=f"some of {','.join(BENCHMARKS)}")
    parser.add_argument(
        "--weights", type=Path, help="from `vanejax export`, for the guide vane; or pretrained"
    )
    parser.add_argument("--repeats", type=study.count, default=LEAST_REPEATS)
    parser.add_argument(
        "--large", action="store_true", help="scaling: up to 10 M faces and points, for minutes"
    )
    return parser


if __name__ == "__main__":
    study.run(main, make_parser())
