"""The command line: ``vanejax register | place | compensate | scan | inspect | export``.

Exit codes: 0 done, and for ``register`` and ``place`` accepted; 3 ambiguous; 4 rejected; 2 where an
argument or a file cannot be used; 1 where the machine failed (a full disk); 130 on Ctrl-C. Errors
are one line.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from vanejax.cli import compensate, export, inspect, place, register, scan
from vanejax.errors import InputError

_EPILOG = """\
examples:
  vanejax register scan.ply part.stl
  vanejax register scan.ply part.stl --weights part.npz --json pose.json --report report.html
  vanejax place scan.ply pose.json part.stl --stock 0.5mm --json placed.json
  vanejax compensate pose.json --camera-pose camera.json --nominal nominal.json --format kuka
  vanejax scan part.stl --out scans --views 12 --noise-mm 0.1
  vanejax inspect scan.ply

exit codes: 0 accepted or done, 3 ambiguous, 4 rejected, 2 bad input
VANEJAX_CACHE_DIR is where compiled programs are kept (~/.cache/vanejax); off keeps none
"""
_COMMANDS = {
    "register": (register, "find a part in a scan, and say whether to trust the pose"),
    "place": (place, "place the finished part in a measured blank, with stock on every face"),
    "compensate": (compensate, "say where a registered part sits in a machine"),
    "scan": (scan, "scan a CAD file virtually from the hemisphere"),
    "inspect": (inspect, "say what a scan or CAD file is"),
    "export": (export, "put a trained network into one file"),
}


class _Parser(argparse.ArgumentParser):
    """One whose errors are one line, as all others are."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see {self.prog} --help")


class _Version(argparse.Action):
    """``--version``, which looks it up only when asked."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib import metadata

        try:
            version = metadata.version("vanejax")
        except metadata.PackageNotFoundError:
            version = "(not installed)"
        print(f"vanejax {version}")
        parser.exit()


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands; the namespace's ``run`` is the command's function."""
    parser = _Parser(
        prog="vanejax",
        description="Where is the part? One scan, one CAD file, one pose, and whether to trust it.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and leave")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, (module, words) in _COMMANDS.items():
        command = commands.add_parser(
            name, help=words, description=f"{words[0].upper()}{words[1:]}.", allow_abbrev=False
        )
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
      argv: the arguments without the program's name; those of the process if not given.

    Returns:
      The exit code; see the module.
    """
    # jaxlib announces things about TPUs and GPUs that are not there
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    try:
        arguments = make_parser().parse_args(_joined(sys.argv[1:] if argv is None else argv))
        return arguments.run(arguments)
    except SystemExit as leave:  # --help and --version
        return int(leave.code or 0)
    except InputError as error:
        return _fail(error, 2)
    except BrokenPipeError:
        # `vanejax ... | head`: nobody reads any more; what is left in the buffer goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", 1)
    except MemoryError:
        return _fail("not enough memory", 1)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)


def _joined(argv: Sequence[str]) -> list[str]:
    """Joins ``--sensor-origin -1,2,3`` by "=": argparse takes ``-1,2,3`` for an option."""
    joined: list[str] = []
    for argument in argv:
        if joined and joined[-1] == "--sensor-origin":
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _fail(message: object, code: int) -> int:
    text = " ".join(str(message).split())
    print(f"vanejax: error: {text}" if code != 130 else f"vanejax: {text}", file=sys.stderr)
    return code
