"""``vanejax place``: the finished part in a measured blank, so that every face keeps its stock."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from typing import TYPE_CHECKING

from vanejax.cli import workpiece
from vanejax.cli.register import EXIT_CODES, parse_sensor_origin, wants_color
from vanejax.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from vanejax.localization.pose_result import Verdict
    from vanejax.machine.placement import Placement
    from vanejax.machine.pose_record import PoseRecord


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what the command takes."""
    parser.add_argument(
        "scan", metavar="SCAN", help="the scan of the blank: PLY, PCD, XYZ, TXT, CSV or NPZ"
    )
    parser.add_argument(
        "pose",
        metavar="POSE",
        help="the blank's pose: JSON from `vanejax register --json` of this scan and this part",
    )
    workpiece.add_arguments(parser)
    parser.add_argument(
        "--stock",
        required=True,
        metavar="MM",
        help="what every face must keep at least, such as 0.5mm",
    )
    parser.add_argument(
        "--even",
        action="store_true",
        help="the most even stock in place of the largest least stock",
    )
    parser.add_argument(
        "--fixed",
        metavar="AXES",
        default="",
        help="of x,y,z,rx,ry,rz, those along and about which the part may not be moved: the part's "
        "axes as registered, through its centre",
    )
    workpiece.add_scan_units(parser)
    parser.add_argument(
        "--sensor-origin",
        metavar="X,Y,Z",
        default="auto",
        help="where the sensor stood, in mm in the scan's frame, as `vanejax register` was told",
    )
    parser.add_argument(
        "--json", metavar="FILE", help="write the pose here, for `vanejax compensate`"
    )


def run(arguments: argparse.Namespace) -> int:
    """Places, prints and writes; the exit code says the verdict.

    Raises:
      InputError: an argument or a file that cannot be used.
    """
    stock_mm = parse_mm(arguments.stock, option="--stock")
    fixed = [name.strip() for name in arguments.fixed.split(",") if name.strip()]
    origin = parse_sensor_origin(arguments.sensor_origin)
    _check_output(arguments)

    from vanejax.cli.pose_summary import verdict_line
    from vanejax.machine.placement import place
    from vanejax.machine.pose_record import read_record
    from vanejax.scans.scan_file import load_scan

    record = read_record(arguments.pose)
    part = workpiece.load_workpiece(arguments)
    if record.part_sha256 not in (None, part.sha256):
        raise InputError(
            f"{arguments.cad}: is not the part of {arguments.pose} (another sha256); give the CAD "
            "file that was registered"
        )
    scan = load_scan(
        arguments.scan,
        units=arguments.units_scan,
        part_extent_mm=part.extent_mm,
        sensor_origin=origin,
    )
    placement = place(
        [(scan, record.part_from_camera)], part, stock_mm, even=arguments.even, fixed=fixed
    )
    verdict = _verdict(placement, record)
    print(verdict_line(verdict, color=wants_color()))
    print("\n".join(_lines(placement, record)))
    sys.stdout.flush()
    if arguments.json is not None:
        from vanejax.files import write_json
        from vanejax.machine.pose_file import placement_to_dict

        values = placement_to_dict(
            placement,
            verdict,
            scan_name=scan.name,
            part_name=part.name,
            part_sha256=part.sha256,
            even=arguments.even,
            fixed=fixed,
        )
        write_json(arguments.json, values, allow_nan=False)
    return EXIT_CODES[verdict.status]


def parse_mm(text: str, *, option: str) -> float:
    """A length of 0 mm or more from ``0.5mm``.

    Raises:
      InputError: anything else; names the option.
    """
    found = re.fullmatch(r"\s*([\d.e+-]+)\s*mm\s*", text)
    try:
        value = float(found[1]) if found else math.nan
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise InputError(f"{option} {text}: should be a length of 0 or more, such as 0.5mm")
    return value


def _check_output(arguments: argparse.Namespace) -> None:
    """Refuses, before any work, an output that cannot be written or would replace an input."""
    if arguments.json is None:
        return
    from vanejax.files import check_writable

    inputs = {os.path.realpath(path) for path in (arguments.scan, arguments.pose, arguments.cad)}
    if os.path.realpath(arguments.json) in inputs:
        raise InputError(f"--json {arguments.json}: is an input already; choose another name")
    check_writable(arguments.json)


def _verdict(placement: Placement, record: PoseRecord) -> Verdict:
    """Rejected where the stock is short; else what the verdict on the blank's pose doubts of it.

    That the pose may be off by some stock is no doubt here: stock is measured from the points, and
    the pose is where the search for the place starts. That it may be another pose is one.
    """
    from vanejax.localization.pose_result import Verdict

    if not placement.is_feasible:
        return Verdict("rejected", placement.reason)
    blank = record.verdict
    off_at_most = blank is not None and blank.status == "ambiguous" and not record.has_alternatives
    if blank is None or blank.status == "accepted" or off_at_most:
        return Verdict("accepted", placement.reason)
    return Verdict(
        blank.status, f"{placement.reason}; but the blank's pose is {blank.status}: {blank.reason}"
    )


def _lines(placement: Placement, record: PoseRecord) -> list[str]:
    """The figures, and what is not known."""
    import numpy as np

    least = placement.least
    at = ", ".join(f"{value:.1f}" for value in placement.points[least])
    turned = np.degrees(placement.motion[:3])
    lines = [
        f"  least stock  {placement.stock_mm[least]:.3f} mm at ({at}), where the surface looks "
        f"along {placement.least_side}; required {placement.required_mm[least]:g} mm",
        f"  sigma        {placement.margin_sigma_mm:.3f} mm, by the noise of the scan alone",
        f"  seen         {placement.seen_share:.1%} of the surface; elsewhere the stock is unknown",
        f"  moved        {_signed(placement.motion[3:])} mm along x, y, z of the part, "
        f"{_signed(turned)} deg about them",
    ]
    if placement.held_by:
        sides = ", ".join(f"{name} ({share:.0%})" for name, share in placement.held_by)
        lines.append(f"  held by      {sides}")
    if placement.unopposed_share:
        lines.append(
            f"note: the other side of {placement.unopposed_share:.0%} of what was seen is unknown: "
            "there the part was moved no farther than the required stock asks"
        )
    if not placement.converged:
        lines.append("note: the place did not converge; there may be a slightly better one")
    if record.verdict is None:
        lines.append("note: the blank's pose has no verdict: nobody checked it")
    elif record.verdict.status == "ambiguous" and not record.has_alternatives:
        lines.append(
            f"note: the blank's pose is ambiguous: {record.verdict.reason}; the stock is measured "
            "from the points, so that such an error of the pose is not in it"
        )
    return lines


def _signed(values: np.ndarray) -> str:
    return ", ".join(f"{round(float(value), 3) + 0.0:+.3f}" for value in values)
