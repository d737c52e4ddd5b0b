"""Tool paths: points to machine with the tool's axes, moved to where the part is, and checked.

Points are in the part's frame or in the machine's, see `vanejax.machine.controllers`; the tool's
axis points away from the material, along the outward normal. Host numpy, float64, mm.
"""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from vanejax.cad import NearestFace, Part
from vanejax.errors import InputError
from vanejax.files import write_text
from vanejax.machine.controllers import Compensation
from vanejax.rigid import RigidTransform
from vanejax.scanner.virtual_scanner import Scanner
from vanejax.scans.point_file import TEXT_SUFFIXES, read_points

MOST_LINES = 2_000  # of a raster: more is a spacing in the wrong unit
UNIT_TOLERANCE = 0.02  # of an axis' length: files round


class ToolPath(NamedTuple):
    """Points [N, 3] f64, mm, in the order in which the tool meets them, and its axes.

    Axes are [N, 3] f64, unit, away from the material; None where nothing is known of them.
    """

    points: np.ndarray
    axes: np.ndarray | None = None

    def moved(self, motion: RigidTransform) -> ToolPath:
        """Points moved and axes turned by a motion, for example ``machine_from_part``."""
        axes = None if self.axes is None else motion.rotate(self.axes)
        return ToolPath(motion.apply(self.points), axes)


class PathDeviation(NamedTuple):
    """Distances [N] f64 to the surface, positive outside the material, and what is near enough."""

    signed_mm: np.ndarray
    tolerance_mm: float

    @property
    def largest_mm(self) -> float:
        """The largest distance on either side."""
        return float(np.abs(self.signed_mm).max())

    @property
    def mean_mm(self) -> float:
        """The mean distance, either side counted alike."""
        return float(np.abs(self.signed_mm).mean())

    @property
    def share_within(self) -> float:
        """Share of the points within the tolerance, 0 to 1."""
        return float(np.mean(np.abs(self.signed_mm) <= self.tolerance_mm))


def compensate(
    path: ToolPath, compensation: Compensation, *, frame: Literal["part", "machine"]
) -> ToolPath:
    """The path in the machine's frame, moved to where the part is.

    A path in the part's frame is put there by the measured work frame. One in the machine's was put
    there by the nominal work frame, and is moved by the difference.
    """
    motion = compensation.machine_from_part if frame == "part" else compensation.in_machine
    return path.moved(motion)


def tool_path_deviation(
    points_machine: np.ndarray,
    surface: NearestFace | Part,
    machine_from_part: RigidTransform,
    *,
    tolerance_mm: float,
) -> PathDeviation:
    """Signed distance of points from the CAD surface of a part that stands in the machine.

    Args:
      points_machine: [N, 3] mm, machine frame.
      surface: the part, or its surface where that was built before.

    Raises:
      InputError: no points, a coordinate that is not finite, or a tolerance that is not positive.
    """
    points = np.asarray(points_machine, np.float64)
    if points.ndim != 2 or points.shape[-1] != 3 or not len(points):
        raise InputError(f"points have shape {list(points.shape)}; give [N, 3], mm")
    if not np.isfinite(points).all():
        raise InputError("a point is not finite; leave it out")
    if not 0 < tolerance_mm < np.inf:
        raise InputError(f"tolerance {tolerance_mm} mm: should be more than 0")
    if isinstance(surface, Part):
        surface = NearestFace(surface)
    points_part = machine_from_part.inverse().apply(points)
    closest = surface.closest_points(points_part)
    off = points_part - closest.points
    side = np.where(np.einsum("ni,ni->n", off, closest.normals) < 0, -1.0, 1.0)
    return PathDeviation(side * np.linalg.norm(off, axis=1), float(tolerance_mm))


def raster_path(
    part: Part, *, towards: np.ndarray, spacing_mm: float, most_tilt_deg: float = 60.0
) -> ToolPath:
    """Lines to and fro, in the part's frame, over what a tool reaches from one side.

    Parallel rays on a square grid; where each first meets the part is a point of the path, the
    outward normal there is its axis.

    Args:
      towards: [3], part frame, the way in which the tool advances, any length.
      spacing_mm: between lines, and between points in a line.
      most_tilt_deg: steeper faces are left out.

    Raises:
      InputError: a direction or a spacing that makes no sense, or nothing is reached.
    """
    towards = np.asarray(towards, np.float64)
    length = np.linalg.norm(towards)
    if towards.shape != (3,) or not 0 < length < np.inf:
        raise InputError(f"direction {towards.tolist()}: should be three numbers, not all 0")
    towards = towards / length
    across = np.cross(towards, np.eye(3)[np.argmin(np.abs(towards))])
    across /= np.linalg.norm(across)
    frame = np.stack([across, np.cross(towards, across), towards])  # rows: along, across, depth
    corners = (np.asarray(part.mesh.vertices, np.float64) - part.center) @ frame.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    if not (high - low)[:2].max() / MOST_LINES < spacing_mm < np.inf:
        raise InputError(
            f"spacing {spacing_mm} mm: should be more than the part's "
            f"{(high - low)[:2].max():.4g} mm over {MOST_LINES:,}"
        )
    u, v = (np.arange(low[i] + spacing_mm / 2, high[i], spacing_mm) for i in (0, 1))
    grid_u = np.tile(u, (len(v), 1))
    grid_u[1::2] = grid_u[1::2, ::-1]  # to and fro
    depth = np.full(grid_u.size, low[2] - 1.0)
    start = np.stack([grid_u.ravel(), np.repeat(v, len(u)), depth], axis=1) @ frame + part.center
    hits = Scanner(part).cast(start, np.tile(towards, (len(start), 1)))
    flat = -hits.normals @ towards >= np.cos(np.radians(most_tilt_deg))
    reached = (hits.face >= 0) & flat
    if not reached.any():
        raise InputError("no face is reached; turn the direction, or take a finer spacing")
    points = start[reached] + hits.distance_mm[reached, None] * towards[None]
    return ToolPath(points, hits.normals[reached])


def read_tool_path(path: str | os.PathLike[str]) -> ToolPath:
    """A table of x, y, z in mm, and i, j, k of the tool's axis where it has them.

    The columns are named in the first line of the text, or in this order.

    Raises:
      InputError: as `vanejax.scans.point_file.read_points`; or names a point that is not finite,
        or an axis that is not of unit length.
    """
    path = Path(path)
    if path.suffix.lower() not in TEXT_SUFFIXES:
        raise InputError(
            f"{path}: a tool path is a table of x,y,z[,i,j,k]: {', '.join(TEXT_SUFFIXES)}"
        )
    file = read_points(path)
    if not np.isfinite(file.points).all():
        number = int(np.argmin(np.isfinite(file.points).all(axis=1)))
        raise InputError(f"{path}: point {number + 1} has a coordinate that is not finite")
    if file.normals is None:
        # colours in a scan may be passed over; an axis in a tool path may not
        if file.notes:
            raise InputError(
                f"{path}: {file.notes[0]}; name the columns x,y,z,i,j,k in the first line, with "
                "i, j, k of unit length, or leave out what is not meant"
            )
        return ToolPath(file.points)
    axes = file.normals.astype(np.float64)
    lengths = np.linalg.norm(axes, axis=1)
    wrong = ~(np.abs(lengths - 1) <= UNIT_TOLERANCE)
    if wrong.any():
        number = int(np.argmax(wrong))
        raise InputError(
            f"{path}: the tool axis of point {number + 1} has length {lengths[number]:.4g}, not 1"
        )
    return ToolPath(file.points, axes / lengths[:, None])


def write_tool_path(path: str | os.PathLike[str], tool_path: ToolPath) -> None:
    """Writes a table that `read_tool_path` reads again: 1e-6 mm, 1e-9 of an axis."""
    with_axes = tool_path.axes is not None
    columns = np.concatenate(tool_path, axis=1) if with_axes else tool_path.points
    formats = ["%.6f"] * 3 + ["%.9f"] * (3 * with_axes)
    header = "x,y,z,i,j,k" if with_axes else "x,y,z"
    text = io.StringIO()
    np.savetxt(text, columns, fmt=formats, delimiter=",", header=header, comments="")
    write_text(path, text.getvalue())
