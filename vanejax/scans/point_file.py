"""Points of any file that scanners and their software write, as they stand in the file."""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from vanejax.errors import InputError
from vanejax.files import array_header, read_head
from vanejax.scans.pcd_file import read_pcd
from vanejax.scans.ply_file import read_ply
from vanejax.scans.point_records import (
    MAX_POINTS,
    POINT_NAMES,
    PointFile,
    check_most,
    read_text_rows,
    split_columns,
    wanted_columns,
)

TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".asc", ".pts")
MAX_BYTES = 2**34

_MAGIC = {b"ply": ".ply", b"# .PCD": ".pcd", b"PK\x03\x04": ".npz", b"\x93NUMPY": ".npy"}
_MESH_SUFFIXES = (".stl", ".obj", ".glb", ".gltf", ".step", ".stp")


def read_points(path: Path) -> PointFile:
    """The points of a PLY, PCD, text (XYZ, TXT, CSV, ASC, PTS), NPZ or NPY file, not cleaned.

    InputError if the file is missing, empty, a folder, truncated, or of another kind.
    """
    suffix = path.suffix.lower()
    head = read_head(path, max_bytes=MAX_BYTES, advice="thin the scan first")
    if suffix in _MESH_SUFFIXES:
        raise InputError(
            f"{path}: is a CAD file, not a scan; the scan comes first, the CAD file second"
        )
    if suffix not in READERS:
        raise InputError(
            f"{path}: cannot read {suffix or 'a file without suffix'} as a scan; use one of "
            + ", ".join(READERS)
        )
    for magic, right in _MAGIC.items():
        if head.startswith(magic) and suffix != right:
            raise InputError(
                f"{path}: is named {suffix} but holds {right[1:].upper()}: rename it to {right}"
            )
    try:
        return READERS[suffix](path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _read_text(path: Path) -> PointFile:
    """Tables: a header line or comments may stand before them, and in PTS the number of points."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    if b"\0" in head:
        raise InputError(f"{path}: is no text, or UTF-16: save it as UTF-8 text; or rename it")
    bom = head.startswith(b"\xef\xbb\xbf")
    lines = head.decode("utf-8-sig" if bom else "latin-1", errors="replace").splitlines()
    names: list[str] = []
    promised, titled = None, False
    for number, line in enumerate(lines):
        delimiter = _delimiter(line, number, path)
        comment = line.lstrip().startswith(("#", "//"))
        words = _words(line.lstrip("#/ \t") if comment else line, delimiter)
        if comment or not words:
            names = words or names
        elif not all(map(_is_number, words)):
            if titled:
                raise InputError(f"{path}: line {number + 1} is no row of numbers: {line[:60]!r}")
            names, titled = words, True
        elif len(words) == 1 and words[0].isdecimal() and promised is None:
            promised = int(words[0])
        else:
            break
    else:
        raise InputError(f"{path}: holds no points: no line in it is a row of numbers")
    columns, named = _text_columns(path, names, words, line)
    rows = read_text_rows(
        path,
        columns,
        skip_lines=number,
        delimiter=delimiter,
        comments="#",
        encoding="utf-8-sig" if bom else "latin-1",
    )
    if promised not in (None, len(rows)):
        raise InputError(
            f"{path}: truncated, or its first line is wrong: it promises {promised:,} points and "
            f"holds {len(rows):,}; copy or export it again"
        )
    check_most(path, len(rows))
    points, normals = split_columns(rows)
    notes: tuple[str, ...] = ()
    if normals is not None and not named and not _are_directions(normals):
        normals = None
        notes = ("columns 4 to 6 are no unit vectors (colours?) and were passed over",)
    elif len(words) > len(columns):
        notes = (f"passed over {len(words) - len(columns)} of {len(words)} columns",)
    kind = {None: "spaces or tabs", ",": "commas", ";": "semicolons"}[delimiter]
    return PointFile(points, normals, f"text, columns apart by {kind}", notes=notes)


def _delimiter(line: str, number: int, path: Path) -> str | None:
    """What stands between the columns of a line, None for white space; refuses decimal commas."""
    numeric = re.fullmatch(r"[\s\d.,;+\-eE]*", line)
    split_otherwise = ";" in line or re.search(r"\d[ \t]+[-+\d]", line)
    if numeric and split_otherwise and re.search(r"\d,\d", line):
        raise InputError(
            f"{path}: line {number + 1} has decimal commas: {line[:60].strip()!r}; export it with "
            "decimal points"
        )
    return ";" if ";" in line else "," if "," in line else None


def _words(line: str, delimiter: str | None) -> list[str]:
    words = [word.strip().strip('"').strip() for word in line.split(delimiter)]
    while words and not words[-1]:  # lines may end with a delimiter
        words.pop()
    return words


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return not word  # an empty cell: for the reader to complain about
    return "_" not in word


def _text_columns(
    path: Path, names: list[str], words: list[str], line: str
) -> tuple[list[int], bool]:
    """The columns to read, points first, and whether the file names them."""
    if len(words) < 3:
        raise InputError(
            f"{path}: a row has {len(words)} columns instead of x, y and z: {line[:60].strip()!r}"
        )
    plain = [re.sub(r"[\[(].*", "", name.lower()).strip() for name in names]  # "X (mm)" is x
    if len(plain) == len(words) and any(set(choice) <= set(plain) for choice in POINT_NAMES):
        points, normals = wanted_columns(plain, path)
        return points + normals, True
    # six whole numbers apart by commas may be three with decimal commas: unit vectors tell
    if len(words) == 6 and "," in line and not re.search(r"[.eE;]", line):
        normal = np.array([float(word or "nan") for word in words[3:]], np.float32)
        if not _are_directions(normal[None]):
            raise InputError(
                f"{path}: rows like {line[:60].strip()!r} may be three numbers with decimal commas "
                "or six whole numbers; use decimal points, or name the columns in the first line"
            )
    return list(range(6 if len(words) == 6 else 3)), False


def _are_directions(vectors: np.ndarray) -> bool:
    """Whether vectors [N, 3] are unit vectors as files round them, but for a few."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(vectors, axis=1)
    unit = np.abs(length - 1) < 0.02
    empty = ~np.isfinite(length) | (length == 0)
    return bool(unit.any() and np.mean(unit | empty) > 0.95)


def _read_numpy(path: Path) -> PointFile:
    if path.suffix.lower() == ".npy":
        with path.open("rb") as file:
            array = _read_array(file, path.stat().st_size, path, "the array")
        points, normals = _rows(array, path, "the array", (3, 6))
        return PointFile(points, normals, "NumPy array")
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            key = next((key for key in ("points", "xyz") if key in members), None)
            if key is None:
                raise InputError(
                    f"{path}: has no array 'points' or 'xyz', only "
                    f"{', '.join(list(members)[:12]) or 'nothing'}; is it a scan?"
                )
            arrays = {}
            for name in (key, "normals"):
                if name in members:
                    with archive.open(members[name]) as file:
                        size = members[name].file_size
                        arrays[name] = _read_array(file, size, path, f"array {name!r}")
    except InputError:
        raise
    except Exception as error:  # a damaged archive can raise anything: zlib's, struct's, zipfile's
        raise InputError(f"{path}: damaged: {error}; copy or export it again") from error
    points, normals = _rows(arrays[key], path, f"array {key!r}", (3,))
    if "normals" in arrays:
        with np.errstate(over="ignore"):
            normals, _ = _rows(arrays["normals"], path, "array 'normals'", (3,))
            normals = normals.astype(np.float32)
        if len(normals) != len(points):
            raise InputError(f"{path}: has {len(points):,} points but {len(normals):,} normals")
    return PointFile(points, normals, "NumPy archive")


def _read_array(file: BinaryIO, size: int, path: Path, name: str) -> np.ndarray:
    """The array in a stream of ``size`` bytes; only numbers, and no more than are there."""
    try:
        shape, fortran, dtype = array_header(file)
    except ValueError as error:
        raise InputError(f"{path}: {name} is damaged, or no NumPy array") from error
    if dtype.kind not in "fiu":
        raise InputError(f"{path}: {name} holds {dtype}, not numbers")
    count = math.prod(shape)  # whole numbers of Python: no overflow
    if count * dtype.itemsize > size:
        raise InputError(
            f"{path}: truncated: {name} promises {count:,} numbers and the file holds {size:,} "
            "bytes of it; copy or export it again"
        )
    if count > 6 * MAX_POINTS:
        raise InputError(f"{path}: {name} of shape {shape} is too large; thin the scan first")
    data = file.read(count * dtype.itemsize)
    if len(data) < count * dtype.itemsize:
        raise InputError(f"{path}: truncated in {name}; copy or export it again")
    file.read(1)  # the archive's reader checks its sum at the end
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")


def _rows(
    array: np.ndarray, path: Path, name: str, widths: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Points [N, 3] and normals [N, 3] or None of an array [..., 3 or 6], organised or not."""
    if array.ndim < 2 or array.shape[-1] not in widths:
        expected = " or ".join(f"[N, {width}]" for width in widths)
        raise InputError(f"{path}: {name} has shape {list(array.shape)}, not {expected}")
    if not array.size:
        raise InputError(f"{path}: holds no points; export the scan again")
    return split_columns(array.reshape(-1, array.shape[-1]))


READERS: dict[str, Callable[[Path], PointFile]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    **dict.fromkeys(TEXT_SUFFIXES, _read_text),
    **dict.fromkeys((".npz", ".npy"), _read_numpy),
}
"""By suffix, what reads a file of points: a new format goes here.

Raises InputError for a file that is damaged, truncated or too large, OSError if it cannot be read.
"""
