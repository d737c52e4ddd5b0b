"""Frames as controllers say them: scipy as oracle, examples by hand, every text read again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from example_result import pose
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vanejax.cli.compensate import FORMATS
from vanejax.errors import InputError
from vanejax.machine import frame_notation
from vanejax.machine.controllers import Compensation, axis_angle_deg, read_frame, rounding_error_mm
from vanejax.machine.frame_notation import NOTATIONS, notation_of
from vanejax.rigid import RigidTransform

RADIUS = 120.0
# half a unit of the last decimal: of three coordinates, and of three angles, which turn about unit
# axes and hence add up at most
ROUNDING = np.sqrt(3) * 0.5e-4 + RADIUS * 3 * np.radians(0.5e-5)
# nine entries, each off by 0.5e-9, and then made a rotation, which at most doubles it
MATRIX_ROUNDING = np.sqrt(3) * 0.5e-4 + RADIUS * 2 * 3 * 0.5e-9
UNIT = st.floats(-1, 1).filter(lambda v: abs(v) > 1e-3)
QUATERNION = st.tuples(*[st.floats(-1, 1)] * 3, UNIT).map(Rotation.from_quat)
# where two axes of a notation fall together, exactly and nearly
LOCKED = st.tuples(
    st.floats(-180, 180),
    st.sampled_from([-90.0, 90.0, 0.0, 180.0]),
    st.sampled_from([0.0, 1e-15, 1e-12, 1e-9, 1e-7, 1e-5, -1e-9]),
    st.floats(-180, 180),
    st.sampled_from(["ZYX", "ZXZ"]),
).map(lambda v: Rotation.from_euler(v[4], [v[0], v[1] + v[2], v[3]], degrees=True))
ROTATION = st.one_of(QUATERNION, LOCKED)
X90_THEN_Z90 = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # x goes to y, y to z, z to x


def frame(rotation: Rotation) -> RigidTransform:
    """A composed pose, as all are: every entry is rounded by itself, the small ones too."""
    first = pose((10.0, 20.0, 30.0), (0.0, 0.0, 0.0)).rotation
    matrix = first @ (first.T @ rotation.as_matrix())
    return RigidTransform(matrix, np.array([812.34567, -45.00004, 1300.5]))


@pytest.mark.parametrize("name", list(NOTATIONS))
@given(rotation=ROTATION)
def test_what_is_written_is_read_again(name: str, rotation: Rotation) -> None:
    meant = frame(rotation)
    text = NOTATIONS[name].write(meant)
    assert notation_of(text) == name
    found = NOTATIONS[name].read(text)
    limit = MATRIX_ROUNDING if name == "matrix" else ROUNDING
    assert rounding_error_mm(found, meant, RADIUS) <= limit
    # rounded once it is what it is
    assert rounding_error_mm(NOTATIONS[name].read(NOTATIONS[name].write(found)), found, 1.0) < 1e-4
    assert "-0.0000 " not in text + " "


@pytest.mark.parametrize("name", list(NOTATIONS))
@given(rotation=ROTATION)
def test_without_rounding_nothing_is_lost(name: str, rotation: Rotation) -> None:
    """Near the poles too, where each angle alone is hardly known."""
    with pytest.MonkeyPatch.context() as patch:
        for places in ("DECIMALS_MM", "DECIMALS_DEG", "DECIMALS_MATRIX"):
            patch.setattr(frame_notation, places, 15)
        found = NOTATIONS[name].read(NOTATIONS[name].write(frame(rotation)))
    # nearer than 1e-7 rad to the poles scipy sets an angle to 0; 1e-12 mm of 1300
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), rtol=0, atol=2e-7)
    np.testing.assert_allclose(found.translation, frame(rotation).translation, rtol=0, atol=1e-12)


ANGLE = st.floats(-180, 180).map(lambda v: round(v, 6))


@pytest.mark.parametrize(
    ("text", "rotation", "translation"),
    [
        # about z by 90, then about the x so turned by 90
        ("{X 1, Y 2, Z 3, A 90, B 0, C 90}", X90_THEN_Z90, [1, 2, 3]),
        ("BASE_DATA[2]={FRAME: X 1,Y 2,Z 3,A 90,B 0,C 90}", X90_THEN_Z90, [1, 2, 3]),
        ("{C 0, B 90, A 0, Z 3, Y 2, X 1}", [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], [1, 2, 3]),
        # the same in I and J; and x turned first shows in J and K
        ("G54 X1. Y2. Z3.\nG68.2 I90. J90.", X90_THEN_Z90, [1, 2, 3]),
        (
            "N10 G10 L2 P1 X1 Y2 Z3 (part)\nN20 G54\nG68.2 X0 Y0 Z0 I0 J90 K90 ; tilt",
            [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
            [1, 2, 3],
        ),
        # X Y Z of G68.2 count from the offset, along the machine's axes
        (
            "G90 G10 L2 P3 X100. Y0. Z0.\nG56\nG68.2 X10. Y0. Z5. I90. J0. K0.",
            [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
            [110, 0, 5],
        ),
        ("G10 L2 P1 X-.5 Y0 Z0", np.eye(3), [-0.5, 0, 0]),
        # the manual's example: SPA+45 SPB+0 SPC+90
        (
            "1 CYCL DEF 7.0 DATUM SHIFT\n2 CYCL DEF 7.1 X+1\n3 CYCL DEF 7.2 Y+2\n"
            "4 CYCL DEF 7.3 Z+3\n5 PLANE SPATIAL SPA+45 SPB+0 SPC+90 MOVE DIST10 F500",
            [[0, -(0.5**0.5), 0.5**0.5], [1, 0, 0], [0, 0.5**0.5, 0.5**0.5]],
            [1, 2, 3],
        ),
        ("$P_UIFR[1]=CTRANS(X,1,Y,2,Z,3):CROT(X,90,Y,0,Z,90)\nG54", X90_THEN_Z90, [1, 2, 3]),
        ("$P_UIFR[1] = ctrans(x, 1, y, 2, z, 3)", np.eye(3), [1, 2, 3]),
        ("0 0 1 1\n1 0 0 2\n0 1 0 3\n0 0 0 1", X90_THEN_Z90, [1, 2, 3]),
    ],
)
def test_examples_by_hand(text: str, rotation: list, translation: list, tmp_path: Path) -> None:
    (tmp_path / "frame.txt").write_text(text)
    found = read_frame(tmp_path / "frame.txt", target="machine", source="part")
    np.testing.assert_allclose(found.rotation, rotation, rtol=0, atol=1e-15)
    np.testing.assert_allclose(found.translation, translation, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("name", "order", "locked", "words"),
    [
        ("kuka", "ZYX", 90, "A 0.00000,B 90.00000,C 30.00000"),
        ("kuka", "ZYX", -90, "A 0.00000,B -90.00000,C 70.00000"),
        ("iso", "ZXZ", 0, "I70.00000 J0.00000 K0.00000"),
        ("iso", "ZXZ", 180, "I-30.00000 J180.00000 K0.00000"),
    ],
)
def test_a_locked_angle_is_zero(name: str, order: str, locked: float, words: str) -> None:
    text = NOTATIONS[name].write(frame(Rotation.from_euler(order, [20, locked, 50], degrees=True)))
    assert words in text


def test_json_names_its_frames(tmp_path: Path) -> None:
    truth = pose((10.0, -20.0, 30.0), (1.5, -2.25, 400.125))
    path = tmp_path / "nominal.json"
    for name, value in (("machine_from_part", truth), ("part_from_machine", truth.inverse())):
        path.write_text(json.dumps({name: value.as_matrix().tolist()}))
        found = read_frame(path, target="machine", source="part")
        np.testing.assert_allclose(found.as_matrix(), truth.as_matrix(), rtol=0, atol=1e-12)
    with pytest.raises(InputError, match='no "machine_from_camera" and no "camera_from_machine"'):
        read_frame(path, target="machine", source="camera")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{X 1, Y 2, Z 3, A 4, B 5}", "KUKA frame has no C; it needs X, Y, Z, A, B, C"),
        ("{X 1, Y 2, Z 3, A 4, B 5, C 6, S 2}", "KUKA frame has 'S'; it takes X"),
        ("{X 1, X 2, Z 3, A 4, B 5, C 6}", "KUKA frame has X twice"),
        ("{X 1, Y 2, Z 3, A 4, B 5, C six}", "C is 'six', which is no number"),
        ("{X 1, Y 2, Z 3, A 4, B 5, C nan}", "C is nan, which is not finite"),
        ("{X 1_0, Y 2, Z 3, A 4, B 5, C 6}", "X is '1_0', which is no number"),
        ("{X 1, Y 2, Z 3, A 4, B 5, C 6", "has no {X ..., Y"),
        ("G68.2 X0 Y0 Z0 I0 J0 K0", "no work offset; give G10 L2 P1"),
        ("G10 L2 P7 X0 Y0 Z0", "P1 to P6, for G54 to G59"),
        ("G10 L20 P1 X0 Y0 Z0", "should be G10 L2"),
        ("G10 L2 P1 X0 Y0 Z0\nG55", "sets G54 but works in G55; use the same"),
        ("G10 L2 P1 X0 Y0 Z0\nG10 L2 P2 X0 Y0 Z0", "is a second work offset"),
        ("G10 L2 P1 X0 Y0 Z0\nG68.2 I1\nG68.2 J1", "is a second G68.2"),
        ("G68.2 I1\nG10 L2 P1 X0 Y0 Z0", "stands before the work offset"),
        ("G10 L2 P1 X0 Y0 Z0\nG68.2 P1 I1 J2 K3", "G68.2 .with Euler angles, without P. has 'P'"),
        ("G20\nG10 L2 P1 X0 Y0 Z0", "has G20; a work frame is"),
        ("G91 G10 L2 P1 X0 Y0 Z0", "has G91; .* absolute"),
        ("G10 L2 P1 X0 Y0 Z", "has 'Z', which is no word with a number"),
        ("G90\nX1 Y2 Z3", "has coordinates, but no G10 L2"),
        ("G54 X1 Y2 Z3 A90", "G54 has 'A'"),
        ("PLANE SPATIAL SPA+0 SPB+0 SPC+0 STAY", "datum shift .* has no X, Y, Z"),
        ("CYCL DEF 7.1 X+1\nCYCL DEF 7.2 Y+1\nCYCL DEF 7.3 Z+1\nPLANE SPATIAL SPA+0", "no B, C"),
        ("$P_UIFR[1]=CTRANS(X,1,Y,2,Z,3):CMIRROR(X)", "frame is CTRANS:CMIRROR; it should be"),
        ("$P_UIFR[1]=CTRANS(X,1,Y,2,Z)", "should be pairs of an axis and a number"),
        ("1 2 3", "holds 3 numbers; a pose is 16"),
        ("2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1", "no rotation: it scales by 2"),
    ],
)
def test_what_is_wrong_with_a_text_is_said(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "frame.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as error:
        read_frame(path, target="machine", source="part")
    assert str(error.value).startswith(f"{path}: ")


def test_the_command_offers_every_notation() -> None:
    assert tuple(NOTATIONS) == FORMATS


@given(ROTATION)
def test_axis_and_angle(rotation: Rotation) -> None:
    axis, angle = axis_angle_deg(rotation.as_matrix())
    assert angle == pytest.approx(
        np.degrees(rotation.magnitude()), abs=1e-12 + 1e-7 * (angle > 179)
    )
    again = Rotation.from_rotvec(axis * angle, degrees=True).as_matrix()
    np.testing.assert_allclose(again, rotation.as_matrix(), rtol=0, atol=1e-14)


@given(ROTATION, ROTATION, st.integers(0, 2**32 - 1))
def test_no_point_is_moved_farther_than_rounding_says(
    one: Rotation, other: Rotation, seed: int
) -> None:
    a = RigidTransform(one.as_matrix(), np.array([1.0, 2.0, 3.0]))
    b = RigidTransform((one * other).as_matrix(), np.array([1.5, 2.0, 3.0]))
    points = np.random.default_rng(seed).normal(size=(50, 3))
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    moved = np.linalg.norm(a.apply(points) - b.apply(points), axis=1).max()
    assert moved <= rounding_error_mm(a, b, RADIUS) + 1e-9
    # the bound is met across the axis; 0.5 mm along it may add up to it or not
    assert (
        rounding_error_mm(a, b, RADIUS) <= 0.5 + 2 * RADIUS * np.sin(other.magnitude() / 2) + 1e-5
    )


@given(ROTATION, ROTATION)
def test_the_compensation_leads_from_nominal_to_actual(one: Rotation, other: Rotation) -> None:
    actual, nominal = frame(one), pose((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)) @ frame(other)
    found = Compensation(actual, nominal)
    for again in (found.in_machine @ nominal, nominal @ found.in_part):
        np.testing.assert_allclose(again.as_matrix(), actual.as_matrix(), rtol=0, atol=1e-11)
    # one motion in two frames: the same angle, and conjugate
    seen = nominal @ found.in_part @ nominal.inverse()
    np.testing.assert_allclose(seen.as_matrix(), found.in_machine.as_matrix(), rtol=0, atol=1e-9)
