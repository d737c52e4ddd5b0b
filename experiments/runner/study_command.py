"""What every study's command shares: errors in one line, and what its JSON says beside figures."""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from experiments.runner.evaluation_report import plain
from experiments.runner.machine import report_head
from experiments.runner.stopping import exit_code
from vanejax import compilation_cache
from vanejax.cad import Part
from vanejax.errors import InputError
from vanejax.files import write_json

DIGITS = 6  # significant ones: more of a measured figure is noise


def make_parser(name: str, description: str | None) -> argparse.ArgumentParser:
    """A parser with ``--seed`` and ``--out``, whose help is the module's own words."""
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{name}",
        description=description,
        epilog=f"{compilation_cache.VARIABLE} is where compiled programs are kept "
        "(~/.cache/vanejax); off keeps none",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--seed", type=int, default=0, help="of all that is drawn at random (0)")
    parser.add_argument(
        "--out", type=Path, default=Path("runs") / name, help=f"folder for results (runs/{name})"
    )
    return parser


def run(main: Callable[[argparse.Namespace], object], parser: argparse.ArgumentParser) -> NoReturn:
    """Parses the command line, runs ``main`` and exits with its `exit_code`."""
    settings = parser.parse_args()
    compilation_cache.enable()
    sys.exit(exit_code(lambda: main(settings)))


def header(method: str, settings: argparse.Namespace, part: Part | None = None) -> dict[str, Any]:
    """`report_head` of a study, whose config is its command line."""
    config = {k: str(v) if isinstance(v, Path) else v for k, v in vars(settings).items()}
    return {"method": method} | report_head(part, seed=settings.seed, config=config)


def save(folder: Path, name: str, report: dict[str, Any]) -> dict[str, Any]:
    """Writes ``name``.json; returns what it holds: six digits, and None for what is not finite."""
    report = plain(report, DIGITS)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / f"{name}.json", report)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from error
    return report


def positive_numbers(text: str) -> tuple[float, ...]:
    """Comma-separated numbers above zero, as an argument's type."""
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if not values or not all(0 < value < float("inf") for value in values):
        raise argparse.ArgumentTypeError(f"{text!r} should be numbers above 0, such as 0.1,0.5")
    return values


def count(text: str) -> int:
    """A whole number of at least 1, as an argument's type."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} should be a whole number above 0")
    return int(text)


def spread(seconds: list[float]) -> dict[str, float]:
    """Median, smallest and largest of some times."""
    return {"median": statistics.median(seconds), "min": min(seconds), "max": max(seconds)}


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a text table: cells to the right of columns that are as wide as their widest."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.rjust, row, widths)) for row in rows]
