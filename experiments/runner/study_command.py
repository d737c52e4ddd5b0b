"""What every study's command shares: errors in one line, and what its JSON says beside figures."""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from experiments.runner.evaluation_report import plain
from experiments.runner.run_folder import git_commit, versions
from vanejax import compilation_cache
from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.files import write_json


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
    """Parses the command line, runs ``main`` and exits: 0, or 2 where the input is at fault.

    Compiled programs are kept: `vanejax.compilation_cache`.
    """
    # jaxlib announces things about TPUs and GPUs that are not there
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    settings = parser.parse_args()
    compilation_cache.enable()
    try:
        main(settings)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    sys.exit(0)


def header(method: str, settings: argparse.Namespace, part: Part | None = None) -> dict[str, Any]:
    """What was run, on what, from which source: the first entries of a study's JSON."""
    config = {k: str(v) if isinstance(v, Path) else v for k, v in vars(settings).items()}
    named = None if part is None else {"name": part.name, "sha256": part.sha256}
    return {
        "method": method,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "machine": {
            "processor": platform.machine(),
            "cores": os.cpu_count(),
            "load": os.getloadavg()[0],
        },
        "commit": git_commit(),
        "versions": versions(),
        "python": platform.python_version(),
        "part": named,
        "seed": settings.seed,
        "config": config,
    }


def save(folder: Path, name: str, report: dict[str, Any]) -> dict[str, Any]:
    """Writes ``name``.json; returns what it holds: six digits, and None for what is not finite.

    Raises:
      InputError: the folder cannot be written.
    """
    report = _rounded(plain(report))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / f"{name}.json", report)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from error
    return report


def _rounded(value: Any) -> Any:
    """The same with six significant digits: more of a measured figure is noise."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {name: _rounded(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return value


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
    ordered = sorted(seconds)
    half = len(ordered) // 2
    median = ordered[half] if len(ordered) % 2 else 0.5 * (ordered[half - 1] + ordered[half])
    return {"median": median, "min": ordered[0], "max": ordered[-1]}
