"""``vanejax compensate``: where the part sits in the machine, for its controller."""

from __future__ import annotations

import argparse
import os
import sys
from typing import TYPE_CHECKING

from vanejax.cli import cut_summary, workpiece
from vanejax.cli.register import EXIT_CODES, parse_mm_deg
from vanejax.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from vanejax.cad.part import Part
    from vanejax.machine.controllers import Compensation
    from vanejax.machine.pose_record import PoseRecord
    from vanejax.machine.tool_path import ToolPath
    from vanejax.rigid import RigidTransform

FORMATS = ("matrix", "kuka", "iso", "heidenhain", "siemens")
COMPENSATION_FORMATS = ("matrix", "kuka")  # the others say work frames only
_FRAME_HELP = "JSON, 16 numbers, or a frame of KUKA, ISO, Heidenhain or Siemens; mm, deg"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what the command takes."""
    parser.add_argument(
        "pose", metavar="POSE", help="the pose: JSON from `vanejax register --json`"
    )
    parser.add_argument(
        "--camera-pose",
        metavar="FILE",
        help="machine_from_camera, from the calibration of the sensor: "
        f"{_FRAME_HELP}; without it the scan is taken to be in the machine's frame",
    )
    parser.add_argument(
        "--camera-sigma",
        metavar="MM,DEG",
        help="standard deviation of the camera's place in the machine, along and about each axis "
        "at the camera's origin, such as 0.02mm,0.01deg; without it the place is taken as exact",
    )
    parser.add_argument(
        "--nominal",
        metavar="FILE",
        help=f"machine_from_part as the program presumes it: {_FRAME_HELP}",
    )
    parser.add_argument(
        "--format", choices=(*FORMATS, "all"), default="all", help="for which controller (all)"
    )
    parser.add_argument(
        "--accept-verdict",
        choices=("accepted", "ambiguous", "rejected"),
        default="accepted",
        help="the worst verdict that is taken (accepted)",
    )
    parser.add_argument(
        "--tool-path",
        metavar="CSV",
        help="points x,y,z[,i,j,k] in mm, with the tool's axis, to move to where the part is",
    )
    parser.add_argument(
        "--path-frame",
        choices=("part", "machine"),
        default="part",
        help="of --tool-path: the part's (default), or the machine's as the program has it",
    )
    parser.add_argument("--out", metavar="CSV", help="write the moved path here, machine frame")
    parser.add_argument(
        "--part",
        dest="cad",
        metavar="CAD",
        help="the part: its size tells what rounding costs, its surface whether the path is on "
        "it; or the word vane for the built-in guide vane",
    )
    workpiece.add_units(parser)
    parser.add_argument(
        "--tolerance-mm",
        type=float,
        default=0.05,
        metavar="MM",
        help="of the path from the part's surface (0.05)",
    )
    parser.add_argument(
        "--max-uncertainty-mm",
        type=float,
        metavar="MM",
        help="the largest 95 %% bound that is taken, of the tool tip, or without a path of the "
        "part; by default what the verdict asked of the pose, else 1",
    )


def run(arguments: argparse.Namespace) -> int:
    """Prints the work frame and the compensation, and moves the path.

    A pose that was not accepted is refused with the exit code of its verdict, one that is not known
    well enough where it matters with that of an ambiguous one.

    Raises:
      InputError: an argument or a file that cannot be used.
    """
    _check(arguments)

    from vanejax.machine.controllers import Compensation
    from vanejax.machine.pose_record import read_record
    from vanejax.machine.tool_path import compensate, read_tool_path

    record = read_record(arguments.pose)
    code = _refusal(record, arguments)
    if code:
        return code
    machine_from_camera, machine_from_part, compensation = _frames(record, arguments)
    part = _part(record, arguments)
    path = moved = None
    if arguments.tool_path is not None:
        path = read_tool_path(arguments.tool_path)
        known = compensation or Compensation(machine_from_part, machine_from_part)
        moved = compensate(path, known, frame=arguments.path_frame)
    places = _places(record, arguments, machine_from_camera, machine_from_part, part, moved)
    if places and (reason := _too_uncertain(places[-1], record, arguments)):
        print(f"vanejax: refused: {reason}", file=sys.stderr)
        return EXIT_CODES["ambiguous"]
    lines = _work_frame(machine_from_part, arguments.format, part)
    if compensation is not None:
        lines += _compensation(compensation, arguments.format, part)
    if path is not None:
        lines += _tool_path(arguments, path, moved, machine_from_part, compensation, part)
    if places:
        exact = arguments.camera_pose is not None and arguments.camera_sigma is None
        lines += cut_summary.place_lines(places, record, camera_is_exact=exact)
    if record.form is not None:
        lines += cut_summary.form_lines(record.form, None if part is None else part.radius)
    print("\n".join(lines + [f"note: {note}" for note in _notes(record, arguments)]))
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Refuses, before any work, options that do not go together and outputs that cannot be."""
    if (arguments.tool_path is None) != (arguments.out is None):
        raise InputError("--tool-path and --out go together: what to move, and where to write it")
    if arguments.path_frame == "machine" and arguments.nominal is None:
        raise InputError(
            "--path-frame machine needs --nominal: where the program presumes the part"
        )
    if not 0 < arguments.tolerance_mm < float("inf"):
        raise InputError(f"--tolerance-mm {arguments.tolerance_mm}: should be more than 0")
    most = arguments.max_uncertainty_mm
    if most is not None and not 0 < most < float("inf"):
        raise InputError(f"--max-uncertainty-mm {most}: should be more than 0")
    if arguments.camera_sigma is not None:
        parse_mm_deg(arguments.camera_sigma, option="--camera-sigma")
        if arguments.camera_pose is None:
            raise InputError("--camera-sigma needs --camera-pose: where the camera is")
    if arguments.out is None:
        return
    from vanejax.files import check_writable

    names = ("pose", "camera_pose", "nominal", "tool_path", "cad")
    inputs = (getattr(arguments, name) for name in names)
    if os.path.realpath(arguments.out) in {os.path.realpath(path) for path in inputs if path}:
        raise InputError(f"--out {arguments.out}: is an input already; choose another name")
    check_writable(arguments.out)


def _refusal(record: PoseRecord, arguments: argparse.Namespace) -> int:
    """The exit code with which a pose is not taken, said on stderr; 0 where it is."""
    order = list(EXIT_CODES)  # from the best to the worst
    verdict = record.verdict
    if verdict is None or order.index(verdict.status) <= order.index(arguments.accept_verdict):
        return 0
    print(
        f"vanejax: refused: {arguments.pose} is {verdict.status}: {verdict.reason}; scan and "
        "register again, or, where you know by other means that the pose is right, "
        f"--accept-verdict {verdict.status}",
        file=sys.stderr,
    )
    return EXIT_CODES[verdict.status]


def _frames(
    record: PoseRecord, arguments: argparse.Namespace
) -> tuple[RigidTransform | None, RigidTransform, Compensation | None]:
    """machine_from_camera if given, the work frame, and the compensation if there is a nominal."""
    from vanejax.machine.controllers import Compensation, read_frame

    machine_from_part = record.part_from_camera.inverse()
    machine_from_camera = None
    if arguments.camera_pose is not None:
        machine_from_camera = read_frame(arguments.camera_pose, target="machine", source="camera")
        machine_from_part = machine_from_camera @ machine_from_part
    compensation = None
    if arguments.nominal is not None:
        nominal = read_frame(arguments.nominal, target="machine", source="part")
        compensation = Compensation(machine_from_part, nominal)
    return machine_from_camera, machine_from_part, compensation


def _part(record: PoseRecord, arguments: argparse.Namespace) -> Part | None:
    """That of ``--part``, if the pose is one of it."""
    if arguments.cad is None:
        return None
    part = workpiece.load_workpiece(arguments, must_be_closed=False)
    if record.part_sha256 not in (None, part.sha256):
        raise InputError(
            f"--part {arguments.cad}: is not the part of {arguments.pose} (another sha256); "
            "give the CAD file that was registered"
        )
    return part


def _places(
    record: PoseRecord,
    arguments: argparse.Namespace,
    machine_from_camera: RigidTransform | None,
    machine_from_part: RigidTransform,
    part: Part | None,
    path: ToolPath | None,
) -> list[cut_summary.Place]:
    """How well the part and the tool tip are known; none where the pose's error is not."""
    if record.covariance is None:
        if arguments.max_uncertainty_mm is not None:
            raise InputError(
                f"--max-uncertainty-mm: {arguments.pose} has no covariance; write it again with "
                "`vanejax register --json`"
            )
        return []
    camera = None
    if arguments.camera_sigma is not None:
        from vanejax.machine.motion_covariance import MotionCovariance

        mm, deg = parse_mm_deg(arguments.camera_sigma, option="--camera-sigma")
        origin = machine_from_camera.translation
        camera = MotionCovariance.alike(origin, sigma_mm=mm, sigma_deg=deg)
    return cut_summary.places(record.covariance, camera, machine_from_part, part, path)


def _too_uncertain(
    place: cut_summary.Place, record: PoseRecord, arguments: argparse.Namespace
) -> str | None:
    """Why a place is not known well enough; None where it is."""
    from vanejax.localization.verdict import Limits

    most_mm = arguments.max_uncertainty_mm or record.tolerance_mm or Limits().tolerance_mm
    return cut_summary.refusal(place, most_mm, record.form)


def _notes(record: PoseRecord, arguments: argparse.Namespace) -> list[str]:
    """What was assumed, and what is not known."""
    notes = []
    if record.verdict is None:
        notes.append("the pose has no verdict: nobody checked it")
    elif record.verdict.status != "accepted":
        notes.append(f"the pose is {record.verdict.status}: {record.verdict.reason}")
        notes.append(
            "what the verdict doubts is not in the uncertainty: the pose may be off by more"
        )
    if arguments.camera_pose is None:
        notes.append("the scan's frame is taken to be the machine's (no --camera-pose)")
    return [*notes, *cut_summary.notes(record)]


def _work_frame(machine_from_part: RigidTransform, chosen: str, part: Part | None) -> list[str]:
    import numpy as np

    from vanejax.machine.controllers import rounding_error_mm
    from vanejax.machine.frame_notation import NOTATIONS

    lines = ["work frame: machine_from_part, where the part sits in the machine"]
    for name in FORMATS if chosen == "all" else (chosen,):
        notation = NOTATIONS[name]
        lines += ["", f"{notation.title}: {notation.formula}"]
        text = notation.write(machine_from_part)
        lines += [f"  {line}" for line in text.splitlines()]
        if part is not None:
            farthest = float(np.linalg.norm(part.mesh.vertices, axis=1).max())
            off = rounding_error_mm(notation.read(text), machine_from_part, farthest)
            lines.append(f"  rounding: at most {off:.1e} mm")
    return lines


def _compensation(compensation: Compensation, chosen: str, part: Part | None) -> list[str]:
    import numpy as np

    from vanejax.machine.controllers import axis_angle_deg
    from vanejax.machine.frame_notation import NOTATIONS

    place = "origin" if part is None else "centre"
    point = np.zeros((1, 3)) if part is None else part.center[None]
    actual = compensation.machine_from_part.apply(point)[0]
    nominal = compensation.nominal_machine_from_part.apply(point)[0]
    lines = ["", "compensation: from where the program presumes the part to where it is"]
    moved = _signed(actual - nominal, 4)
    lines.append(f"  the part's {place} is moved by {moved} mm (machine x, y, z)")
    motions = (
        ("machine", compensation.in_machine, "actual nominal^-1"),
        ("part", compensation.in_part, "nominal^-1 actual"),
    )
    for frame, motion, _ in motions:
        axis, angle = axis_angle_deg(motion.rotation)
        turned = f"turned by {angle:.4f} deg about ({_signed(axis, 3)})"
        lines.append(f"  {turned} (in the {frame}'s frame)")
    names = [n for n in COMPENSATION_FORMATS if chosen in (n, "all")] or ["matrix"]
    for frame, motion, formula in motions:
        lines += ["", f"compensation in the {frame}'s frame, {formula}:"]
        for name in names:
            lines += [f"  {line}" for line in NOTATIONS[name].write(motion).splitlines()]
    return lines


def _signed(vector: np.ndarray, digits: int) -> str:
    return ", ".join(f"{round(float(value), digits) + 0.0:+.{digits}f}" for value in vector)


def _tool_path(
    arguments: argparse.Namespace,
    path: ToolPath,
    moved: ToolPath,
    machine_from_part: RigidTransform,
    compensation: Compensation | None,
    part: Part | None,
) -> list[str]:
    """Writes the moved path, and says how it lies to the part where that is given."""
    from vanejax.machine.tool_path import tool_path_deviation, write_tool_path

    write_tool_path(arguments.out, moved)
    axes = "" if path.axes is None else " with tool axes"
    lines = ["", f"tool path: {len(path.points):,} points{axes}, machine frame: {arguments.out}"]
    if part is None:
        return lines
    from vanejax.cad import NearestFace

    surface = NearestFace(part)
    rows = [("compensated", moved)]
    if compensation is not None:
        in_part = arguments.path_frame == "part"
        nominal = compensation.nominal_machine_from_part
        rows.append(("as programmed", path.moved(nominal) if in_part else path))
    for words, points in rows:
        deviation = tool_path_deviation(
            points.points, surface, machine_from_part, tolerance_mm=arguments.tolerance_mm
        )
        near = f"{deviation.share_within:.1%} within {arguments.tolerance_mm:g} mm"
        lines.append(
            f"  {words + ':':15}off the CAD model at the measured pose by {deviation.mean_mm:.4f} "
            f"mm on average, {deviation.largest_mm:.4f} mm at most; {near}"
        )
    return lines
