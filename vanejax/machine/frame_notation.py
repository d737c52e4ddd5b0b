"""Frames in the notation of controllers: KUKA, ISO G-code, Heidenhain, Siemens, plain matrices.

What is written is rounded. A reader raises `InputError` where a component is missing, repeated,
unknown or no number. Millimetres and degrees.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.machine.pose_file import euler_deg, parse_transform
from vanejax.rigid import RigidTransform

DECIMALS_MM = 4
DECIMALS_DEG = 5
DECIMALS_MATRIX = 9  # of a rotation's entries, which are read as the nearest rotation
WORK_OFFSETS = {str(53 + p): p for p in range(1, 7)}  # G10 L2 P1 to P6 are G54 to G59

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"


class Notation(NamedTuple):
    """Whose notation it is, the formula of its convention, and what writes and reads a frame."""

    title: str
    formula: str
    write: Callable[[RigidTransform], str]
    read: Callable[[str], RigidTransform]


def write_matrix(machine_from_part: RigidTransform) -> str:
    """Four rows of four numbers: [x_machine, 1] = M [x_part, 1], mm."""
    places = [DECIMALS_MATRIX] * 3 + [DECIMALS_MM]
    return "\n".join(
        " ".join(f"{_fixed(v, n):>14}" for v, n in zip(row, places, strict=True))
        for row in machine_from_part.as_matrix()
    )


def _writer(template: str, order: str, *, sign: str = "") -> Callable[[RigidTransform], str]:
    """Fills in X, Y, Z and three angles in an order as scipy names it, rounded."""

    def write(machine_from_part: RigidTransform) -> str:
        angles = euler_deg(machine_from_part.rotation, order)
        shift = [_fixed(v, DECIMALS_MM, sign=sign) for v in machine_from_part.translation]
        return template.format(*shift, *(_fixed(v, DECIMALS_DEG, sign=sign) for v in angles))

    return write


# KUKA System Software, operating and programming instructions
write_kuka = _writer("{{X {0},Y {1},Z {2},A {5},B {4},C {3}}}", "xyz")


def read_kuka(text: str) -> RigidTransform:
    """The frame of ``{X 1, Y 2, Z 3, A 10, B 20, C 30}``; a name and = may stand before it."""
    match = re.search(r"\{\s*(?:FRAME\s*:)?([^{}]*)\}", text, re.IGNORECASE)
    if not match:
        raise InputError("the KUKA frame has no {X ..., Y ..., Z ..., A ..., B ..., C ...}")
    items = [re.split(r"\s+", item.strip() + " ", maxsplit=1) for item in match[1].split(",")]
    words = [(name.upper(), value.strip()) for name, value in items]
    values = _values(words, "XYZABC", "the KUKA frame")
    return _frame(values, [values[name] for name in "ABC"])


def read_iso(text: str) -> RigidTransform:
    """The frame of a work offset and, if there is one, of the tilted working plane upon it.

    ``G10 L2 P1 X Y Z`` or the values alone, ``G54 X Y Z``; then ``G68.2 X Y Z I J K``, where what
    is left out is 0. Comments in ( ) or after ; and block numbers are skipped.
    """
    offset = tilted = number = selected = None
    for line in text.splitlines():
        words = _iso_words(line)
        block = f"the ISO block {line.strip()!r}"
        codes = [value for letter, value in words if letter == "G"]
        others = [(letter, value) for letter, value in words if letter not in "GN"]
        unknown = [code for code in codes if code not in ("90", "21", "10", "68.2", *WORK_OFFSETS)]
        if unknown:
            raise InputError(
                f"{block} has G{unknown[0]}; a work frame is G10 L2 P1 (or G54) with X, Y, Z in mm "
                "and absolute, and G68.2"
            )
        chosen = [WORK_OFFSETS[code] for code in codes if code in WORK_OFFSETS]
        selected = chosen[0] if chosen else selected
        if "68.2" in codes and "10" not in codes:
            if tilted is not None:
                raise InputError(f"{block} is a second G68.2")
            values = _values(others, "XYZIJK", "G68.2 (with Euler angles, without P)", some=True)
            tilted = _frame(values, [values[name] for name in "IJK"], "ZXZ")
        elif others or "10" in codes:
            if offset is not None:
                raise InputError(f"{block} is a second work offset")
            if tilted is not None:
                raise InputError("G68.2 stands before the work offset that it is upon")
            if "10" in codes:
                values = _values(others, "LPXYZ", "G10 L2")
                number = values["P"]
                if values["L"] != 2 or number not in WORK_OFFSETS.values():
                    raise InputError(f"{line.strip()!r}: should be G10 L2 P1 to P6, for G54 to G59")
            elif chosen:
                values, number = _values(others, "XYZ", f"G{53 + selected}"), selected
            else:
                raise InputError(f"{block} has coordinates, but no G10 L2")
            offset = _frame(values)
    if offset is None:
        raise InputError("there is no work offset; give G10 L2 P1 X Y Z (or G54 X Y Z) in mm")
    if selected not in (None, number):
        raise InputError(f"sets G{53 + int(number)} but works in G{53 + selected}; use the same")
    return offset if tilted is None else offset @ tilted


def read_heidenhain(text: str) -> RigidTransform:
    """The frame of a datum shift and, if there is one, of PLANE SPATIAL after it."""
    text = re.sub(r";.*", "", text).upper()
    shifts = re.findall(rf"CYCL DEF 7\.[1-9]\s+([A-Z])\s*({_NUMBER})\s*$", text, re.MULTILINE)
    values = _values(shifts, "XYZ", "the datum shift (CYCL DEF 7)")
    planes = re.findall(r"PLANE\s+SPATIAL(.*)", text)
    if len(planes) > 1:
        raise InputError("there are two PLANE SPATIAL; a work frame has one")
    if not planes:
        return _frame(values)
    words = re.findall(rf"SP([A-Z])\s*({_NUMBER})(?![\d.])", planes[0])
    angles = _values(words, "ABC", "PLANE SPATIAL, SP")
    return _frame(values, [angles[name] for name in "CBA"])


def read_siemens(text: str) -> RigidTransform:
    """The frame of ``CTRANS(X,1,Y,2,Z,3):CROT(X,10,Y,20,Z,30)``; CROT may be left out."""
    _, _, chain = re.sub(r";.*", "", text).upper().rpartition("=")
    calls = re.findall(r"([A-Z]+)\s*\(([^()]*)\)", chain)
    names = [name for name, _ in calls]
    if names not in (["CTRANS"], ["CTRANS", "CROT"]):
        raise InputError(
            f"the frame is {':'.join(names) or 'empty'}; it should be CTRANS(...):CROT(...)"
        )
    values = []
    for name, inside in calls:
        items = [item.strip() for item in inside.split(",")]
        if len(items) % 2:
            raise InputError(f"{name}({inside}) should be pairs of an axis and a number")
        values.append(_values(list(zip(items[::2], items[1::2], strict=True)), "XYZ", name))
    shift, *turn = values
    return _frame(shift, [turn[0][name] for name in "ZYX"]) if turn else _frame(shift)


NOTATIONS: Mapping[str, Notation] = {
    "matrix": Notation(
        "4x4 matrix",
        "row by row, [x_machine, 1] = M [x_part, 1], mm",
        write_matrix,
        lambda text: parse_transform(text, where="the matrix", target="machine", source="part"),
    ),
    "kuka": Notation(
        "KUKA frame",
        "mm, deg; R = Rz(A) Ry(B) Rx(C): about z, the turned y, the x turned twice",
        write_kuka,
        read_kuka,
    ),
    "iso": Notation(
        "ISO G-code (Fanuc)",
        "mm, deg; G68.2 is upon G54, R = Rz(I) Rx(J) Rz(K): about Z, X', Z''",
        # a tilted working plane with the origin of G54; post processors call it EULER_ZXZ_R
        _writer("G90 G10 L2 P1 X{} Y{} Z{}\nG54\nG68.2 X0. Y0. Z0. I{} J{} K{}", "ZXZ"),
        read_iso,
    ),
    "heidenhain": Notation(
        "Heidenhain",
        "mm, deg; upon a preset at the machine's datum, R = Rz(SPC) Ry(SPB) Rx(SPA)",
        # TNC 620, conversational programming, 10/2017, p. 540; STAY moves no axis
        _writer(
            "CYCL DEF 7.0 DATUM SHIFT\nCYCL DEF 7.1 X{}\nCYCL DEF 7.2 Y{}\nCYCL DEF 7.3 Z{}\n"
            "PLANE SPATIAL SPA{} SPB{} SPC{} STAY",
            "xyz",
            sign="+",
        ),
        read_heidenhain,
    ),
    "siemens": Notation(
        "Siemens frame of G54",
        "mm, deg; CROT by RPY: R = Rz(Z) Ry(Y) Rx(X)",
        # MD10600 = 1, the default; SINUMERIK 840D sl, Basic Functions, K2, 11/2006, p. 56
        _writer("$P_UIFR[1]=CTRANS(X,{},Y,{},Z,{}):CROT(X,{},Y,{},Z,{})", "xyz"),
        read_siemens,
    ),
}
_PATTERNS = {
    "siemens": r"CTRANS",
    "heidenhain": r"CYCL\s+DEF|PLANE\s+SPATIAL",
    "kuka": r"\{\s*(FRAME\s*:)?\s*[XYZABC]\b",
    "iso": r"^[\sN\d]*G\d",
}


def notation_of(text: str) -> str:
    """The key in `NOTATIONS` of a text; what is no other is a matrix."""
    plain = re.sub(r"\([^()]*\)", "", text) if "CTRANS" not in text.upper() else text
    for name, pattern in _PATTERNS.items():
        if re.search(pattern, plain, re.IGNORECASE | re.MULTILINE):
            return name
    return "matrix"


def _frame(
    shift: Mapping[str, float], angles_deg: Sequence[float] = (0, 0, 0), order: str = "ZYX"
) -> RigidTransform:
    """The frame at X, Y, Z of ``shift``, turned by three angles in an order as scipy names it."""
    # a whole number of turns less: degrees are exact, radians are not
    rotation = Rotation.from_euler(order, np.remainder(angles_deg, 360.0), degrees=True)
    return RigidTransform(rotation.as_matrix(), np.array([shift[name] for name in "XYZ"]))


def _fixed(value: float, places: int, *, sign: str = "") -> str:
    """A number with so many decimals, never -0."""
    return f"{round(float(value), places) + 0.0:{sign}.{places}f}"


def _iso_words(line: str) -> list[tuple[str, str]]:
    """Letters and numbers of a block, as text: G68.2 is no float."""
    plain = re.sub(r"\([^()]*\)|;.*", "", line).upper().replace("%", "")
    words = re.findall(rf"([A-Z])\s*({_NUMBER})", plain)
    rest = re.sub(rf"[A-Z]\s*{_NUMBER}", "", plain).strip()
    if rest:
        raise InputError(
            f"the ISO block {line.strip()!r} has {rest!r}, which is no word with a number"
        )
    return [(a, re.sub(r"^0+(?=\d)", "", b) if a == "G" else b) for a, b in words]


def _values(
    words: Sequence[tuple[str, str]], names: str, where: str, *, some: bool = False
) -> dict[str, float]:
    """Every one of the one-letter names once, and no other; with ``some``, the rest is 0."""
    values: dict[str, float] = {}
    for name, text in words:
        if not name or name not in names:
            raise InputError(f"{where} has {name or 'nothing'!r}; it takes {', '.join(names)}")
        if name in values:
            raise InputError(f"{where} has {name} twice")
        try:
            values[name] = float(text.replace("_", "?"))  # 1_0 is a number to Python alone
        except ValueError:
            raise InputError(f"{where}: {name} is {text!r}, which is no number") from None
        if not np.isfinite(values[name]):
            raise InputError(f"{where}: {name} is {text}, which is not finite")
    missing = [name for name in names if name not in values]
    if missing and not some:
        raise InputError(f"{where} has no {', '.join(missing)}; it needs {', '.join(names)}")
    return dict.fromkeys(missing, 0.0) | values
