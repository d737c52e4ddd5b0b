"""Where a part sits in a machine, and how far a program is off.

``machine`` is the base frame of the controller: $WORLD of a robot, the machine's coordinate system
of a milling machine; ``part`` is that of the CAD model, which the program counts from, and
``machine_from_part`` the work frame. Millimetres and degrees; host numpy only.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.machine.frame_notation import NOTATIONS, notation_of
from vanejax.machine.pose_file import parse_transform, read_text
from vanejax.rigid import RigidTransform


class Compensation(NamedTuple):
    """Where the part is, as measured, and where the program presumes it."""

    machine_from_part: RigidTransform
    nominal_machine_from_part: RigidTransform

    @property
    def in_machine(self) -> RigidTransform:
        """Actual after nominal inverse: moves a programmed point of the machine's frame.

        ``machine_from_part = in_machine @ nominal_machine_from_part``.
        """
        return self.machine_from_part @ self.nominal_machine_from_part.inverse()

    @property
    def in_part(self) -> RigidTransform:
        """The same motion seen from the part: moves a programmed point of the part's frame.

        ``machine_from_part = nominal_machine_from_part @ in_part``.
        """
        return self.nominal_machine_from_part.inverse() @ self.machine_from_part


def axis_angle_deg(rotation: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit axis [3] and angle in degrees, 0 to 180, of a rotation [3, 3]; z for no rotation."""
    vector = Rotation.from_matrix(rotation).as_rotvec()
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 0 else np.array([0.0, 0.0, 1.0])
    return axis, float(np.degrees(angle))


def rounding_error_mm(written: RigidTransform, meant: RigidTransform, radius_mm: float) -> float:
    """How far at most a point moves when ``written`` takes the place of ``meant``.

    ``|dt| + radius |dR|_F / sqrt 2``: the second is the chord 2 sin(angle / 2) at the radius, the
    distance from the origin of the part's frame to its farthest point.
    """
    moved = np.linalg.norm(written.translation - meant.translation)
    chord = np.linalg.norm(written.rotation - meant.rotation) / np.sqrt(2)
    return float(moved + radius_mm * chord)


def read_frame(path: str | os.PathLike[str], *, target: str, source: str) -> RigidTransform:
    """The frame target_from_source, such as machine_from_part, in a file.

    It is text in a notation of `NOTATIONS`; or JSON with ``{target}_from_{source}`` or its inverse,
    as `vanejax.machine.pose_file.parse_transform` reads it.

    Raises:
      InputError: the file cannot be read, or holds no frame; names the file and the fault.
    """
    text = read_text(Path(path))
    name = notation_of(text)
    if name == "matrix":
        return parse_transform(text, where=str(path), target=target, source=source)
    try:
        return NOTATIONS[name].read(text)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
