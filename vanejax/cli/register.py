"""``vanejax register``: one scan, one CAD file, one pose, and whether to trust it."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from vanejax.cli import workpiece
from vanejax.errors import InputError

if TYPE_CHECKING:
    import numpy as np

EXIT_CODES = {"accepted": 0, "ambiguous": 3, "rejected": 4}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what the command takes."""
    parser.add_argument("scan", metavar="SCAN", help="the scan: PLY, PCD, XYZ, TXT, CSV or NPZ")
    workpiece.add_arguments(parser)
    parser.add_argument(
        "--weights",
        metavar="FILE",
        help="a matcher trained for this part, from `vanejax export`, or pretrained: the one that "
        "comes with the package, for the built-in vane; works without",
    )
    workpiece.add_scan_units(parser)
    parser.add_argument(
        "--init",
        metavar="FILE",
        help="a rough pose to start from: JSON with part_from_camera or camera_from_part, such as "
        "--json writes, or the 16 numbers of part_from_camera; mm",
    )
    parser.add_argument(
        "--sensor-origin",
        metavar="X,Y,Z",
        default="auto",
        help="where the sensor stood, in mm in the scan's frame; unknown for merged clouds; "
        "by default the scan's origin",
    )
    parser.add_argument(
        "--segment",
        choices=("auto", "off", "on"),
        default="auto",
        help="take table, clamps and chips out of the scan first: auto (default) does so if "
        "registration of the raw scan fails",
    )
    parser.add_argument(
        "--max-allowance-mm",
        type=float,
        metavar="MM",
        help="the largest uniform stock that a casting may have, 0 for none; by default as much as "
        "the scan shows",
    )
    parser.add_argument(
        "--form-tolerance-mm",
        type=float,
        metavar="MM",
        help="how far the part's surface may be from its CAD model, 95 %% of it; by default only "
        "the scan tells",
    )
    parser.add_argument(
        "--calibration",
        metavar="NAME",
        help="a sensor whose errors of calibration count in sigma: paper_camera",
    )
    parser.add_argument(
        "--tolerance",
        default="1mm,0.5deg",
        metavar="MM,DEG",
        help="what the job needs: a pose whose 95 %% bounds are wider is not accepted (1mm,0.5deg)",
    )
    parser.add_argument(
        "--sensor",
        metavar="NAME",
        help="a stereo camera whose matching window rounds edges off, which is then taken out of "
        "the scan: consumer_depth",
    )
    parser.add_argument(
        "--symmetry",
        metavar="AXIS:DEG,...",
        default="none",
        help="poses that are one: z:180 (the part is the same after a half turn about z of the CAD "
        "frame), z:any (a turned part), several with commas; auto finds it in CAD; none (default)",
    )
    parser.add_argument("--json", metavar="FILE", help="write the pose and all figures here")
    parser.add_argument("--report", metavar="FILE", help="write an HTML report here")
    parser.add_argument("--seed", type=int, default=0, help="of what is drawn at random (0)")
    parser.add_argument("--quiet", action="store_true", help="print the verdict only")


def run(arguments: argparse.Namespace) -> int:
    """Registers, prints and writes; the exit code says the verdict.

    Raises:
      InputError: an argument or a file that cannot be used.
    """
    from vanejax.cli.pose_summary import summary, verdict_line

    started = time.perf_counter()
    origin = parse_sensor_origin(arguments.sensor_origin)
    tolerance_mm, tolerance_deg = parse_mm_deg(arguments.tolerance, option="--tolerance")
    _check_outputs(arguments)

    from vanejax.cad.declared_symmetry import Symmetry
    from vanejax.localization.sensor_calibration import Calibration
    from vanejax.localization.verdict import Limits
    from vanejax.machine.pose_file import read_pose, write_result

    limits = Limits(tolerance_mm=tolerance_mm, tolerance_deg=tolerance_deg)
    symmetry = Symmetry.parse(arguments.symmetry)
    calibration = None
    if arguments.calibration is not None:
        calibration = Calibration.of(arguments.calibration)
    init = None if arguments.init is None else read_pose(arguments.init)

    from vanejax.scans.scan_file import load_scan

    part = workpiece.load_workpiece(arguments, must_be_closed=False)
    scan = load_scan(
        arguments.scan,
        units=arguments.units_scan,
        part_extent_mm=part.extent_mm,
        sensor_origin=origin,
    )
    matcher = None
    if arguments.weights is not None:
        from vanejax import compilation_cache
        from vanejax.training.weight_file import find_weights

        compilation_cache.enable()
        matcher = find_weights(arguments.weights, part)

    from vanejax.localization.registration import register

    prepared = time.perf_counter()
    result = register(
        scan,
        part,
        init=init,
        weights=matcher,
        segment=arguments.segment,
        limits=limits,
        max_allowance_mm=arguments.max_allowance_mm,
        form_tolerance_mm=arguments.form_tolerance_mm,
        calibration=calibration,
        sensor=arguments.sensor,
        symmetry=symmetry,
        seed=arguments.seed,
    )
    ended = time.perf_counter()
    color = wants_color()
    if arguments.quiet:
        print(verdict_line(result.verdict, color=color))
    else:
        seconds = {"start and files": prepared - started, **result.seconds}
        seconds["total"] = ended - started
        calibrated = calibration is not None
        print(summary(result, color=color, seconds=seconds, calibrated=calibrated))
    sys.stdout.flush()
    if arguments.json is not None:
        write_result(
            arguments.json,
            result,
            scan_name=scan.name,
            part_name=part.name,
            part_sha256=part.sha256,
            seed=arguments.seed,
            weights_name=arguments.weights and Path(arguments.weights).name,
            calibration_name=arguments.calibration,
            limits=limits,
        )
    if arguments.report is not None:
        from vanejax.report import write_report

        write_report(arguments.report, result, scan, part, limits=limits)
    return EXIT_CODES[result.verdict.status]


def parse_sensor_origin(text: str) -> str | np.ndarray:
    """``auto`` or ``unknown`` as they are, ``X,Y,Z`` as an array [3] f64, mm.

    Raises:
      InputError: anything else.
    """
    if text in ("auto", "unknown"):
        return text
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise InputError(
            f"--sensor-origin {text}: should be X,Y,Z in mm (such as 0,0,0), auto or unknown"
        )
    import numpy as np

    return np.array(values)


def parse_mm_deg(text: str, *, option: str) -> tuple[float, float]:
    """A length in mm and an angle in degrees from ``0.1mm,0.05deg``.

    Raises:
      InputError: anything else, or one that is not above 0; names the option.
    """
    found = re.fullmatch(r"\s*([\d.e+-]+)\s*mm\s*,\s*([\d.e+-]+)\s*deg\s*", text)
    try:
        values = [float(word) for word in found.groups()] if found else []
    except ValueError:
        values = []
    if len(values) != 2 or not all(0 < value < math.inf for value in values):
        raise InputError(
            f"{option} {text}: should be a length and an angle above 0, such as 0.1mm,0.05deg"
        )
    return values[0], values[1]


def wants_color() -> bool:
    """Whether colours may be printed: to a terminal that takes them, unless NO_COLOR is set."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    return sys.stdout.isatty() and not plain


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Refuses, before any work, outputs that cannot be written or would replace an input."""
    from vanejax.files import check_writable

    taken = {
        os.path.realpath(path): name
        for name, path in (
            ("SCAN", arguments.scan),
            ("CAD", arguments.cad),
            ("--weights", arguments.weights),
        )
        if path is not None
    }
    outputs = (("--json", arguments.json, ()), ("--report", arguments.report, (".html", ".htm")))
    for name, path, suffixes in outputs:
        if path is None:
            continue
        if suffixes and Path(path).suffix.lower() not in suffixes:
            raise InputError(f"{name} {path}: should end in {' or '.join(suffixes)}")
        place = os.path.realpath(path)
        if place in taken:
            raise InputError(f"{name} {path}: is {taken[place]} already; choose another name")
        taken[place] = name
        check_writable(path)
