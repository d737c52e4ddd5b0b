"""Points of PLY files: text or binary of either byte order, with any further elements."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import BinaryIO

import numpy as np

from vanejax.errors import InputError
from vanejax.scans.point_records import (
    Field,
    PointFile,
    check_count,
    read_records,
    read_text_records,
    refuse_rest,
)

_CODES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_LINES = 10_000


@dataclasses.dataclass
class _Element:
    """Properties are fields; those of lists have an item type besides that of their length."""

    name: str
    count: int
    fields: list[Field] = dataclasses.field(default_factory=list)
    items: list[str | None] = dataclasses.field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        return any(self.items)

    @property
    def least_bytes(self) -> int:
        """Bytes of a row in which every list is empty."""
        return sum(field.size for field in self.fields)


def read_ply(path: Path) -> PointFile:
    """The vertices of a PLY file, and their normals where it has them.

    InputError if the file is truncated, its counts are wrong, or it is no PLY file.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        encoding, elements, header_lines = _header(file, path)
        names = [element.name for element in elements]
        if "vertex" not in names:
            raise InputError(f"{path}: holds no points: it has no element 'vertex'")
        place = names.index("vertex")
        vertex, held = elements[place], size - file.tell()
        if vertex.has_lists:
            raise InputError(
                f"{path}: lists inside of vertices cannot be read; export plain points"
            )
        text = encoding == "ascii"
        # in text, a value takes a digit and a separator
        least = [2 * len(e.fields) if text else e.least_bytes for e in elements]
        check_count(path, vertex.count, least[place], held)
        promised = sum(e.count * size for e, size in zip(elements, least, strict=True))
        if promised > held + text:  # text may end without a separator
            counts = ", ".join(f"{element.count:,} of {element.name}" for element in elements)
            raise InputError(
                f"{path}: truncated: it promises {counts} ({promised:,} bytes or more) and holds "
                f"{held:,} bytes; copy or export it again"
            )
        last = place == len(elements) - 1
        if text:
            skip = header_lines + sum(element.count for element in elements[:place])
            points, normals = read_text_records(
                path, vertex.fields, vertex.count, skip_lines=skip, last=last
            )
        else:
            for element in elements[:place]:
                _skip(file, element, path)
            points, normals = read_records(file, vertex.fields, vertex.count, path)
            if last:
                refuse_rest(file, vertex.least_bytes, path)
    faces = sum(element.count for element in elements if element.name in ("face", "tristrips"))
    return PointFile(points, normals, "PLY, " + encoding.replace("_", " "), num_faces=faces)


def _header(file: BinaryIO, path: Path) -> tuple[str, list[_Element], int]:
    """Encoding, elements, and number of lines; the file then stands at the first element."""
    if file.readline(16).strip() != b"ply":
        raise InputError(f"{path}: is no PLY file: it does not begin with 'ply'; export it again")
    encoding, elements = "", []
    for number in itertools.count(2):
        line = file.readline(1 << 16)
        words = line.decode("latin-1").split()
        if not line.endswith(b"\n") or number > _MAX_HEADER_LINES:
            raise InputError(f"{path}: truncated: its header has no end; copy or export it again")
        if not words or words[0] in ("comment", "obj_info"):
            continue
        try:
            match words:
                case ["end_header"]:
                    break
                case ["format", encoding, _] if encoding in _BYTE_ORDERS:
                    order = _BYTE_ORDERS[encoding]
                case ["element", name, count] if count.isdecimal() and len(count) < 19:
                    elements.append(_Element(name, int(count)))
                case ["property", "list", length, item, name]:
                    elements[-1].fields.append(Field(name, order + _CODES[length]))
                    elements[-1].items.append(order + _CODES[item])
                case ["property", code, name]:
                    elements[-1].fields.append(Field(name, order + _CODES[code]))
                    elements[-1].items.append(None)
                case _:
                    raise KeyError
        except (KeyError, IndexError, UnboundLocalError) as error:
            raise InputError(
                f"{path}: line {number} of its PLY header makes no sense: "
                f"{line[:60].decode('latin-1').strip()!r}; export it again"
            ) from error
    if not encoding:
        raise InputError(f"{path}: its PLY header states no format; export it again")
    return encoding, elements, number


def _skip(file: BinaryIO, element: _Element, path: Path) -> None:
    """Passes over a binary element that stands before the vertices."""
    if not element.has_lists:
        file.seek(element.count * element.least_bytes, 1)
        return
    for _ in range(element.count):
        for field, item in zip(element.fields, element.items, strict=True):
            head = file.read(field.size)
            if len(head) < field.size:
                raise InputError(f"{path}: truncated; copy or export it again")
            if item:
                length = int(np.frombuffer(head, field.code)[0])
                file.seek(max(length, 0) * np.dtype(item).itemsize, 1)
