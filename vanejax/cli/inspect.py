"""``vanejax inspect``: what a file is."""

from __future__ import annotations

import argparse
import json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what the command takes."""
    parser.add_argument("file", metavar="FILE", help="a scan or a CAD file")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Prints what the file is.

    Raises:
      InputError: it cannot be read.
    """
    from vanejax.cli.inspection import inspect

    inspection = inspect(arguments.file)
    print(json.dumps(inspection.to_dict(), indent=2) if arguments.json else inspection.text())
    return 0
