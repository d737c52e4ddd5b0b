"""Frames in the words of controllers: KUKA, ISO G-code, Heidenhain, Siemens, and plain matrices.

Every notation is a function that writes and one that reads again, and names its convention and
source. What is written is rounded to `DECIMALS_MM` and `DECIMALS_DEG`;
`vanejax.machine.controllers.rounding_error_mm` says what that moves. Millimetres and degrees; host
numpy only.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.machine.pose_file import euler_deg, kuka_frame, parse_transform
from vanejax.rigid import RigidTransform

DECIMALS_MM = 4
DECIMALS_DEG = 5
DECIMALS_MATRIX = 9  # of a rotation's entries, which are read as the nearest rotation
WORK_OFFSETS = range(1, 7)  # G10 L2 P1 to P6 are G54 to G59

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"


@dataclasses.dataclass(frozen=True)
class Notation:
    """One way to say a frame.

    Attributes:
      title: whose it is.
      formula: of its convention, and its source.
      write: text of a frame.
      read: the frame of such a text; raises `InputError`.
    """

    title: str
    formula: str
    write: Callable[[RigidTransform], str]
    read: Callable[[str], RigidTransform]


# a 4x4 matrix


def write_matrix(machine_from_part: RigidTransform) -> str:
    """Four rows of four numbers: [x_machine, 1] = M [x_part, 1], mm."""
    rows = np.asarray(machine_from_part.as_matrix(), np.float64)
    decimals = [DECIMALS_MATRIX] * 3 + [DECIMALS_MM]
    return "\n".join(
        " ".join(
            f"{_fixed(value, places):>14}" for value, places in zip(row, decimals, strict=True)
        )
        for row in rows
    )


def read_matrix(text: str) -> RigidTransform:
    """The frame that 16 numbers are, row by row.

    Raises:
      InputError: other than 16 numbers, or no rigid motion.
    """
    return parse_transform(text, where="the matrix", target="machine", source="part")


# KUKA


def write_kuka(machine_from_part: RigidTransform) -> str:
    """KUKA's FRAME {X, Y, Z, A, B, C}; see `vanejax.machine.pose_file.kuka_frame`."""
    frame = kuka_frame(machine_from_part)
    words = [f"{name} {_fixed(value, _places(name))}" for name, value in frame.items()]
    return "{" + ",".join(words) + "}"


def read_kuka(text: str) -> RigidTransform:
    """The frame of ``{X 1, Y 2, Z 3, A 10, B 20, C 30}``; a name and = may stand before it.

    Raises:
      InputError: no braces, or a component that is missing, doubled, unknown or no number.
    """
    match = re.search(r"\{\s*(?:FRAME\s*:)?([^{}]*)\}", text, re.IGNORECASE)
    if not match:
        raise InputError("the KUKA frame has no {X ..., Y ..., Z ..., A ..., B ..., C ...}")
    words = []
    for item in match[1].split(","):
        name, *value = item.split() or [""]
        words.append((name.upper(), " ".join(value)))
    values = _all_of(words, "XYZABC", "the KUKA frame")
    rotation = _rotation("ZYX", values["A"], values["B"], values["C"])
    return RigidTransform(rotation, _xyz(values))


# ISO G-code


def write_iso(machine_from_part: RigidTransform, *, work_offset: int = 1) -> str:
    """A work offset, and a tilted working plane upon it.

    G10 L2 P1 sets G54: the part's origin in the machine. G68.2 X Y Z I J K gives a feature
    coordinate system upon the active offset, here with the same origin, turned by Euler angles:
    I about Z, J about the X so turned, K about the Z turned twice (Fanuc; post
    processors call it EULER_ZXZ_R).

    Args:
      machine_from_part: the work frame.
      work_offset: P of G10 L2, 1 to 6: G54 to G59.
    """
    if work_offset not in WORK_OFFSETS:
        raise InputError(f"work offset {work_offset}: should be 1 to 6, for G54 to G59")
    x, y, z = (_fixed(v, DECIMALS_MM) for v in machine_from_part.translation)
    i, j, k = (_fixed(v, DECIMALS_DEG) for v in euler_deg(machine_from_part.rotation, "ZXZ"))
    return (
        f"G90 G10 L2 P{work_offset} X{x} Y{y} Z{z}\n"
        f"G{53 + work_offset}\n"
        f"G68.2 X0. Y0. Z0. I{i} J{j} K{k}"
    )


def read_iso(text: str) -> RigidTransform:
    """The frame of a work offset and, if there is one, of the tilted working plane upon it.

    ``G10 L2 P1 X Y Z`` or the values alone, ``G54 X Y Z``; then ``G68.2 X Y Z I J K``, where what
    is left out is 0. Comments in ( ) or after ; and block numbers are passed over.

    Raises:
      InputError: no offset or two, a word or a code that is not one of these, inches.
    """
    offset: np.ndarray | None = None
    number: int | None = None
    selected: int | None = None
    tilted: RigidTransform | None = None
    for line in text.splitlines():
        words = _iso_words(line)
        codes = [value for letter, value in words if letter == "G"]
        others = [(letter, value) for letter, value in words if letter not in "GN"]
        unknown = [
            c for c in codes if c not in ("90", "21", "10", "68.2", *map(str, range(54, 60)))
        ]
        if unknown:
            raise InputError(
                f"the ISO block {line.strip()!r} has G{unknown[0]}; a work frame is G10 L2 P1 (or "
                "G54) with X, Y, Z in mm and absolute, and G68.2"
            )
        selected = next((int(c) - 53 for c in codes if 54 <= float(c) < 60), selected)
        if "10" in codes or ("68.2" not in codes and others):
            if offset is not None:
                raise InputError(f"the ISO block {line.strip()!r} is a second work offset")
            if tilted is not None:
                raise InputError("G68.2 stands before the work offset that it is upon")
            if "10" in codes:
                values = _all_of(others, "LPXYZ", "G10 L2")
                number = int(values["P"])
                if values["L"] != 2 or values["P"] not in WORK_OFFSETS:
                    raise InputError(f"{line.strip()!r}: should be G10 L2 P1 to P6, for G54 to G59")
            elif any(54 <= float(c) < 60 for c in codes):
                values = _all_of(others, "XYZ", f"G{53 + (selected or 1)}")
                number = selected
            else:
                raise InputError(f"the ISO block {line.strip()!r} has coordinates, but no G10 L2")
            offset = _xyz(values)
        elif "68.2" in codes:
            if tilted is not None:
                raise InputError(f"the ISO block {line.strip()!r} is a second G68.2")
            values = _some_of(others, "XYZIJK", "G68.2 (with Euler angles, without P)")
            rotation = _rotation("ZXZ", values["I"], values["J"], values["K"])
            tilted = RigidTransform(rotation, _xyz(values))
    if offset is None:
        raise InputError("there is no work offset; give G10 L2 P1 X Y Z (or G54 X Y Z) in mm")
    if None not in (number, selected) and number != selected:
        raise InputError(f"sets G{53 + number} but works in G{53 + selected}; use the same")
    machine_from_work = RigidTransform(np.eye(3), offset)
    return machine_from_work if tilted is None else machine_from_work @ tilted


# Heidenhain


def write_heidenhain(machine_from_part: RigidTransform) -> str:
    """A datum shift and PLANE SPATIAL, upon a preset that is the machine's datum.

    SPA, SPB, SPC turn about the fixed X, then Y, then Z, which is the same as C, B, A about the
    turned axes (TNC 620, conversational programming, 10/2017, p. 540). STAY moves no axis.
    """
    x, y, z = (_fixed(v, DECIMALS_MM, sign=True) for v in machine_from_part.translation)
    a, b, c = (
        _fixed(v, DECIMALS_DEG, sign=True) for v in euler_deg(machine_from_part.rotation, "xyz")
    )
    return (
        "CYCL DEF 7.0 DATUM SHIFT\n"
        f"CYCL DEF 7.1 X{x}\nCYCL DEF 7.2 Y{y}\nCYCL DEF 7.3 Z{z}\n"
        f"PLANE SPATIAL SPA{a} SPB{b} SPC{c} STAY"
    )


def read_heidenhain(text: str) -> RigidTransform:
    """The frame of a datum shift and, if there is one, of PLANE SPATIAL after it.

    Raises:
      InputError: an axis of the shift or an angle is missing or doubled.
    """
    text = re.sub(r";.*", "", text).upper()
    shifts = re.findall(rf"CYCL DEF 7\.[1-9]\s+([A-Z])\s*({_NUMBER})\s*$", text, re.MULTILINE)
    values = _all_of(shifts, "XYZ", "the datum shift (CYCL DEF 7)")
    rotation = np.eye(3)
    planes = re.findall(r"PLANE\s+SPATIAL(.*)", text)
    if len(planes) > 1:
        raise InputError("there are two PLANE SPATIAL; a work frame has one")
    if planes:
        angles = _all_of(
            re.findall(rf"SP([A-Z])\s*({_NUMBER})(?![\d.])", planes[0]), "ABC", "PLANE SPATIAL, SP"
        )
        rotation = _rotation("ZYX", angles["C"], angles["B"], angles["A"])
    return RigidTransform(rotation, _xyz(values))


# Siemens


def write_siemens(machine_from_part: RigidTransform) -> str:
    """The settable frame of G54 with its rotation.

    CTRANS, then CROT with RPY angles: Z, then the turned Y, then the X turned twice (MD10600 = 1,
    the default; SINUMERIK 840D sl, Basic Functions, K2, 11/2006, p. 56).
    """
    frame = kuka_frame(machine_from_part)
    shift = ",".join(f"{n},{_fixed(frame[n], DECIMALS_MM)}" for n in "XYZ")
    turn = ",".join(
        f"{axis},{_fixed(frame[n], DECIMALS_DEG)}" for axis, n in zip("XYZ", "CBA", strict=True)
    )
    return f"$P_UIFR[1]=CTRANS({shift}):CROT({turn})"


def read_siemens(text: str) -> RigidTransform:
    """The frame of ``CTRANS(X,1,Y,2,Z,3):CROT(X,10,Y,20,Z,30)``; CROT may be left out.

    Raises:
      InputError: no CTRANS, another function in the chain, or a component missing or doubled.
    """
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
        values.append(_all_of(list(zip(items[::2], items[1::2], strict=True)), "XYZ", name))
    rotation = np.eye(3)
    if len(values) == 2:
        angles = values[1]
        rotation = _rotation("ZYX", angles["Z"], angles["Y"], angles["X"])
    return RigidTransform(rotation, _xyz(values[0]))


NOTATIONS: Mapping[str, Notation] = {
    "matrix": Notation(
        "4x4 matrix", "row by row, [x_machine, 1] = M [x_part, 1], mm", write_matrix, read_matrix
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
        write_iso,
        read_iso,
    ),
    "heidenhain": Notation(
        "Heidenhain",
        "mm, deg; upon a preset at the machine's datum, R = Rz(SPC) Ry(SPB) Rx(SPA)",
        write_heidenhain,
        read_heidenhain,
    ),
    "siemens": Notation(
        "Siemens frame of G54",
        "mm, deg; CROT by RPY: R = Rz(Z) Ry(Y) Rx(X)",
        write_siemens,
        read_siemens,
    ),
}
_SIGNS = (
    (r"CTRANS", "siemens"),
    (r"CYCL\s+DEF|PLANE\s+SPATIAL", "heidenhain"),
    (r"\{\s*(FRAME\s*:)?\s*[XYZABC]\b", "kuka"),
    (r"^[\sN\d]*G\d", "iso"),
)


def notation_of(text: str) -> str:
    """The key in `NOTATIONS` of a text; what is no other is a matrix."""
    plain = re.sub(r"\([^()]*\)", "", text) if "CTRANS" not in text.upper() else text
    for pattern, name in _SIGNS:
        if re.search(pattern, plain, re.IGNORECASE | re.MULTILINE):
            return name
    return "matrix"


def _rotation(order: str, *angles_deg: float) -> np.ndarray:
    """Rotation [3, 3] of three angles, in an order as scipy names it."""
    # a whole number of turns less: degrees are exact, radians are not
    return Rotation.from_euler(order, np.remainder(angles_deg, 360.0), degrees=True).as_matrix()


def _xyz(values: Mapping[str, float]) -> np.ndarray:
    return np.array([values["X"], values["Y"], values["Z"]])


def _fixed(value: float, places: int, *, sign: bool = False) -> str:
    """A number with so many decimals, never -0."""
    rounded = round(float(value), places) + 0.0
    return f"{rounded:{'+' if sign else ''}.{places}f}"


def _places(name: str) -> int:
    return DECIMALS_MM if name in "XYZ" else DECIMALS_DEG


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


def _all_of(words: Sequence[tuple[str, str]], names: str, where: str) -> dict[str, float]:
    """Every one of the one-letter names once, and no other."""
    values = _some_of(words, names, where)
    missing = [name for name in names if name not in dict(words)]
    if missing:
        raise InputError(f"{where} has no {', '.join(missing)}; it needs {', '.join(names)}")
    return values


def _some_of(words: Sequence[tuple[str, str]], names: str, where: str) -> dict[str, float]:
    """Some of the names, each at most once, and no other; what is left out is 0."""
    values = dict.fromkeys(names, 0.0)
    seen: set[str] = set()
    for name, text in words:
        if not name or name not in names:
            raise InputError(f"{where} has {name or 'nothing'!r}; it takes {', '.join(names)}")
        if name in seen:
            raise InputError(f"{where} has {name} twice")
        seen.add(name)
        try:
            values[name] = float(text.replace("_", "?"))  # 1_0 is a number to Python alone
        except ValueError:
            raise InputError(f"{where}: {name} is {text!r}, which is no number") from None
        if not np.isfinite(values[name]):
            raise InputError(f"{where}: {name} is {text}, which is not finite")
    return values
