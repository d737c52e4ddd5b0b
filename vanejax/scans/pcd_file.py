"""Points of PCD files (Point Cloud Library): text, binary, and compressed; organised or not.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. In the compressed
form each field lies in one piece, all points after each other, and LZF packs the whole.
"""

from __future__ import annotations

import itertools
import struct
from pathlib import Path
from typing import BinaryIO

import lzf
import numpy as np

from vanejax.errors import InputError
from vanejax.scans.point_records import (
    Field,
    PointFile,
    check_count,
    read_records,
    read_text_records,
    refuse_rest,
    wanted_columns,
)

_CODES = {
    **{("F", "4"): "<f4", ("F", "8"): "<f8"},
    **{("I", size): f"<i{size}" for size in "1248"},
    **{("U", size): f"<u{size}" for size in "1248"},
}
_KEYS = frozenset(
    ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
)
_MAX_HEADER_LINES = 1000
_LZF_MOST = 264 / 3  # bytes that one longest back reference of three bytes stands for


def read_pcd(path: Path) -> PointFile:
    """The points of a PCD file, and their normals where it has them; NaN rows are kept.

    InputError if the file is truncated, its counts are wrong, or it is no PCD file.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        header, lines = _header(file, path)
        fields, count = _fields(header, path), _count(header, path)
        encoding = header["DATA"][0].lower() if header["DATA"] else ""
        held, row_bytes = size - file.tell(), sum(field.size for field in fields)
        if encoding == "ascii":
            values = sum(field.count for field in fields)
            check_count(path, count, 2 * values - 1, held)
            points, normals = read_text_records(path, fields, count, skip_lines=lines)
        elif encoding == "binary":
            check_count(path, count, row_bytes, held)
            points, normals = read_records(file, fields, count, path)
            refuse_rest(file, row_bytes, path)
        elif encoding == "binary_compressed":
            check_count(path, count, max(1, int(row_bytes / _LZF_MOST)), held)
            points, normals = _read_compressed(file, fields, count, path)
        else:
            raise InputError(
                f"{path}: PCD data {encoding!r} is not known; save it as ascii, binary or "
                "binary_compressed"
            )
    kind = "PCD, " + encoding.replace("_", " ")
    return PointFile(points, normals, kind, viewpoint=_viewpoint(header, path))


def _header(file: BinaryIO, path: Path) -> tuple[dict[str, list[str]], int]:
    """Values by key, and number of lines; the file then stands at the data."""
    header: dict[str, list[str]] = {}
    for number in itertools.count(1):
        line = file.readline(1 << 16)
        words = line.decode("latin-1").split("#")[0].split()
        if words and words[0] not in _KEYS:
            raise InputError(
                f"{path}: is no PCD file: line {number} begins with {words[0][:20]!r}; export it "
                "again"
            )
        if not line or number > _MAX_HEADER_LINES:
            raise InputError(f"{path}: truncated: its header has no DATA; copy or export it again")
        if words:
            header[words[0]] = words[1:]
        if "DATA" in header:
            return header, number


def _fields(header: dict[str, list[str]], path: Path) -> list[Field]:
    names = header.get("FIELDS", [])
    kinds, sizes = header.get("TYPE", []), header.get("SIZE", [])
    counts = header.get("COUNT", ["1"] * len(names))
    try:
        fields = [
            Field(name, _CODES[kind.upper(), size], int(count))
            for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True)
        ]
    except (KeyError, ValueError) as error:
        raise InputError(
            f"{path}: FIELDS, TYPE, SIZE and COUNT of its header do not fit together: "
            f"{len(names)} fields of types {kinds[:12]}, sizes {sizes[:12]}, counts {counts[:12]}"
        ) from error
    points, normals = wanted_columns(names, path)
    wrong = [f"{f.name} {f.count}" for f in fields if not 0 < f.count < 2**16]
    several = (fields[i] for i in points + normals if fields[i].count > 1)
    wrong += [f"{f.name} {f.count}" for f in several]
    if wrong:
        raise InputError(f"{path}: COUNT of its header makes no sense: {', '.join(wrong[:12])}")
    return fields


def _count(header: dict[str, list[str]], path: Path) -> int:
    """Number of points, which WIDTH x HEIGHT and POINTS must agree on."""
    stated = {}
    for key in ("WIDTH", "HEIGHT", "POINTS"):
        if key in header:
            value = "".join(header[key])
            if not value.isdecimal() or len(value) > 18:
                raise InputError(f"{path}: {key} {value[:30]!r} of its header is no count")
            stated[key] = int(value)
    area = stated["WIDTH"] * stated.get("HEIGHT", 1) if "WIDTH" in stated else None
    points = stated.get("POINTS", area)
    if points is None or area not in (None, points):
        raise InputError(
            f"{path}: the number of points in its header is missing or contradicts itself: "
            + (", ".join(f"{key} {value:,}" for key, value in stated.items()) or "none")
        )
    return points


def _viewpoint(header: dict[str, list[str]], path: Path) -> np.ndarray | None:
    """Where the sensor stood; None for PCL's default, the origin."""
    try:
        values = np.array([float(word) for word in header.get("VIEWPOINT", [])])
    except ValueError as error:
        raise InputError(
            f"{path}: VIEWPOINT {' '.join(header['VIEWPOINT'])[:60]!r} of its header is no pose"
        ) from error
    position = values[:3]
    stated = len(position) == 3 and np.isfinite(position).all() and any(position)
    return position if stated else None


def _read_compressed(
    file: BinaryIO, fields: list[Field], count: int, path: Path
) -> tuple[np.ndarray, np.ndarray | None]:
    sizes = file.read(8)
    packed, unpacked = struct.unpack("<II", sizes) if len(sizes) == 8 else (0, 0)
    needed = count * sum(field.size for field in fields)
    data = file.read(packed)
    if len(data) < packed or unpacked != needed:
        raise InputError(
            f"{path}: truncated or damaged: {count:,} points take {needed:,} bytes, it promises "
            f"{unpacked:,} packed into {packed:,} and holds {len(data):,}; copy or export it again"
        )
    if unpacked > packed * _LZF_MOST:
        raise InputError(f"{path}: damaged: {packed:,} bytes cannot hold {unpacked:,}")
    try:
        table = lzf.decompress(data, unpacked)
    except ValueError:
        table = None
    if table is None or len(table) != unpacked:
        raise InputError(f"{path}: its compressed data is damaged; copy or export it again")
    columns = wanted_columns([field.name for field in fields], path)
    start = np.cumsum([0] + [field.size * count for field in fields])
    arrays = []
    for chosen, dtype in zip(columns, (np.float64, np.float32), strict=True):
        array = np.empty((count, 3), dtype) if chosen else None
        with np.errstate(over="ignore", invalid="ignore"):
            for axis, i in enumerate(chosen):
                array[:, axis] = np.frombuffer(table, fields[i].code, count, int(start[i]))
        arrays.append(array)
    return arrays[0], arrays[1]
