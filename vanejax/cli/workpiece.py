"""The argument that names a part: a CAD file, or the built-in guide vane."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vanejax.cad.part import Part

BUILT_IN = "vane"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds CAD and ``--units-cad``."""
    parser.add_argument(
        "cad",
        metavar="CAD",
        help="the part: STL, OBJ, PLY, GLB or STEP; or the word vane for the built-in guide vane",
    )
    add_units(parser)


def add_units(parser: argparse.ArgumentParser) -> None:
    """Adds ``--units-cad`` alone, for a command to which the part is an option."""
    parser.add_argument(
        "--units-cad",
        metavar="UNIT",
        default="mm",
        help="unit of the numbers in CAD: mm (default), cm, m, in, ft or um",
    )


def add_scan_units(parser: argparse.ArgumentParser) -> None:
    """Adds ``--units-scan``, for a command that takes a SCAN."""
    parser.add_argument(
        "--units-scan",
        metavar="UNIT",
        default="auto",
        help="unit of the numbers in SCAN: auto (default), mm, cm, m, in, ft or um",
    )


def load_workpiece(arguments: argparse.Namespace, *, must_be_closed: bool = True) -> Part:
    """The part that CAD and ``--units-cad`` name.

    Raises:
      InputError: as `vanejax.cad.part.load_part`.
    """
    if arguments.cad == BUILT_IN and not Path(arguments.cad).exists():
        from vanejax.cad.parametric_vane import guide_vane

        return guide_vane()
    from vanejax.cad.part import load_part

    return load_part(arguments.cad, units=arguments.units_cad, must_be_closed=must_be_closed)
