"""What the readers of point files share: tables of binary records or of text, into arrays.

No count that a file states is trusted before it is held against the bytes that are there, and only
the columns that are wanted are kept.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from vanejax.errors import InputError

MAX_POINTS = 50_000_000  # cleaned, that is about 5 GB of memory

_ROWS_AT_ONCE = 1 << 18

POINT_NAMES = (("x", "y", "z"), ("points:0", "points:1", "points:2"))
NORMAL_NAMES = (
    ("nx", "ny", "nz"),
    ("normal_x", "normal_y", "normal_z"),
    ("normalx", "normaly", "normalz"),
    ("normals:0", "normals:1", "normals:2"),
    ("i", "j", "k"),  # of measuring machines and tool paths
)


@dataclasses.dataclass(frozen=True, eq=False)
class PointFile:
    """The points of a file as they stand in it.

    Attributes:
      points: [N, 3] f64, in the file's own unit; NaN or anything where nothing was measured.
      normals: [N, 3] f32, of any length; None if the file has none.
      format: what the file is, in words.
      viewpoint: [3] f64, file's unit, where the file says that the sensor stood; else None.
      num_faces: of a mesh; 0 for a cloud.
      notes: what was passed over, a sentence each.
    """

    points: np.ndarray
    normals: np.ndarray | None
    format: str
    viewpoint: np.ndarray | None = None
    num_faces: int = 0
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Field:
    """A column of a table: its name, numpy type code such as ``"<f4"``, and values per row."""

    name: str
    code: str
    count: int = 1

    @property
    def size(self) -> int:
        """Bytes per row."""
        return np.dtype(self.code).itemsize * self.count


def wanted_columns(names: Sequence[str], path: Path) -> tuple[list[int], list[int]]:
    """Which columns hold the points, and which the normals (none, if they are not all there).

    InputError if x, y or z is missing.
    """
    lower = [name.lower() for name in names]
    points, normals = (
        next(([lower.index(n) for n in group] for group in choices if set(group) <= set(lower)), [])
        for choices in (POINT_NAMES, NORMAL_NAMES)
    )
    if not points:
        raise InputError(
            f"{path}: has no columns x, y and z, only {', '.join(names[:12]) or 'none'}; export "
            "the points with their coordinates"
        )
    return points, normals


def check_count(path: Path, count: int, bytes_per_point: int, held: int) -> None:
    """Refuses, by InputError, a promised number of points that is zero, too large, or not there.

    A point takes ``bytes_per_point`` at least, and the file has ``held`` bytes after its header.
    """
    if count < 1:
        raise InputError(f"{path}: holds no points; export the scan again")
    needed = count * bytes_per_point
    if needed > held:
        raise InputError(
            f"{path}: truncated: it promises {count:,} points ({needed:,} bytes or more) and "
            f"holds {held:,} bytes; copy or export it again"
        )
    check_most(path, count)


def check_most(path: Path, count: int) -> None:
    """Refuses, by InputError, more points than fit in memory."""
    if count > MAX_POINTS:
        raise InputError(
            f"{path}: {count:,} points are more than the {MAX_POINTS:,} that fit in memory; thin "
            "the scan first"
        )


def read_records(
    file: BinaryIO, fields: Sequence[Field], count: int, path: Path
) -> tuple[np.ndarray, np.ndarray | None]:
    """Points [N, 3] f64 and normals [N, 3] f32 or None of packed records, from the file's position.

    InputError if a coordinate is missing, or the file ends early.
    """
    columns = wanted_columns([field.name for field in fields], path)
    dtype = np.dtype([(f"f{i}", f.code, (f.count,)) for i, f in enumerate(fields)])
    points = np.empty((count, 3), np.float64)
    normals = np.empty((count, 3), np.float32) if columns[1] else None
    for start in range(0, count, _ROWS_AT_ONCE):
        rows = min(_ROWS_AT_ONCE, count - start)
        data = file.read(rows * dtype.itemsize)
        if len(data) < rows * dtype.itemsize:
            raise InputError(f"{path}: truncated at point {start:,}; copy or export it again")
        block = np.frombuffer(data, dtype)
        with np.errstate(over="ignore", invalid="ignore"):
            for array, chosen in zip((points, normals), columns, strict=True):
                for axis, column in enumerate(chosen):
                    array[start : start + rows, axis] = block[f"f{column}"][:, 0]
    return points, normals


def read_text_records(
    path: Path, fields: Sequence[Field], count: int, *, skip_lines: int, last: bool = True
) -> tuple[np.ndarray, np.ndarray | None]:
    """Points [N, 3] f64 and normals [N, 3] f32 or None of ``count`` lines, one for each point.

    ``last`` says whether the file ends after them. InputError if a coordinate is missing, something
    is not a number, or there are more or fewer lines.
    """
    points, normals = wanted_columns([field.name for field in fields], path)
    first = np.cumsum([0] + [field.count for field in fields])
    columns = [int(first[i]) for i in points + normals]
    rows = read_text_rows(path, columns, skip_lines=skip_lines, max_rows=count + last)
    if len(rows) != count:
        held = f"{len(rows):,}" if len(rows) < count else "more"
        raise InputError(
            f"{path}: truncated, or its header is wrong: it promises {count:,} points and holds "
            f"{held}; copy or export it again"
        )
    return split_columns(rows)


def read_text_rows(
    path: Path, columns: Sequence[int], *, skip_lines: int, **options: Any
) -> np.ndarray:
    """Numbers [N, len(columns)] f64 of a table in a text file; further options of `np.loadtxt`.

    InputError says where something is not a number, or a row is too short.
    """
    options = {"comments": None, "encoding": "latin-1"} | options  # latin-1 takes any bytes
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that it passes over blank lines
            # a path, not an open file: numpy then reads in large pieces
            return np.loadtxt(
                str(path.absolute()),
                np.float64,
                skiprows=skip_lines,
                usecols=columns,
                ndmin=2,
                quotechar='"',
                **options,
            )
    except ValueError as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path}: truncated, damaged, or not a table of numbers: {reason} (counted after the "
            f"header's {skip_lines} lines); export it again"
        ) from error


def split_columns(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Points [N, 3] f64 and normals [N, 3] f32 or None of rows [N, 3 or 6]."""
    points = np.ascontiguousarray(rows[:, :3], np.float64)
    if rows.shape[1] < 6:
        return points, None
    with np.errstate(over="ignore"):
        return points, np.ascontiguousarray(rows[:, 3:6], np.float32)


def refuse_rest(file: BinaryIO, bytes_per_point: int, path: Path) -> None:
    """Refuses, by InputError, a file that goes on after its last point.

    Fewer bytes than a point takes, and padding with zeros or white space, are no points.
    """
    rest = file.read(1 << 20)
    if len(rest) >= bytes_per_point and rest.strip(b"\0 \t\r\n"):
        raise InputError(
            f"{path}: goes on after its last point: the number of points in its header is wrong; "
            "export it again"
        )
