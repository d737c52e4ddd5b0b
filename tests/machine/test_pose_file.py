"""Poses in files: conventions against scipy, and every way a guess can be wrong."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from example_result import example_result, pose
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from vanejax.cad.declared_symmetry import PartSymmetry, Symmetry
from vanejax.errors import InputError
from vanejax.machine.pose_file import pose_to_dict, read_pose, result_to_dict, write_result
from vanejax.machine.pose_record import read_record
from vanejax.rigid import RigidTransform, rigid_from_matrix

NAMES = {"scan_name": "scan", "part_name": "vane", "part_sha256": "ab" * 32}
ANGLE = st.floats(-180, 180)
EXACT = {"rtol": 0, "atol": 1e-12}  # f64 eps times the largest translation, 400 mm, and a few more


def strict(text: str) -> Any:
    """JSON as its standard has it: without NaN and Infinity."""

    def refuse(constant: str) -> float:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def read(tmp_path: Path, content: Any, name: str = "pose.json") -> RigidTransform:
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_pose(path)


@given(ANGLE, st.one_of(st.floats(-90, 90), st.sampled_from([-90.0, 90.0, 89.9999999])), ANGLE)
def test_every_form_of_a_pose_is_the_same_pose(a: float, b: float, c: float) -> None:
    truth = pose((a, b, c), (1.0, -2.0, 300.0))
    found = pose_to_dict(truth)
    np.testing.assert_array_equal(found["part_from_camera"], truth.as_matrix())
    np.testing.assert_allclose(
        np.array(found["part_from_camera"]) @ found["camera_from_part"], np.eye(4), **EXACT
    )
    for name in ("part_from_camera", "camera_from_part"):
        forms, matrix = found[f"{name}_as"], np.array(found[name])
        kuka = forms["kuka"]
        rotations = {
            "quaternion": Rotation.from_quat(np.roll(forms["quaternion_wxyz"], -1)),
            "euler": Rotation.from_euler("xyz", forms["euler_xyz_deg"], degrees=True),
            # scipy's capitals turn about the moved axes: R = Rz(A) Ry(B) Rx(C)
            "kuka": Rotation.from_euler("ZYX", [kuka[i] for i in "ABC"], degrees=True),
        }
        for form, rotation in rotations.items():
            # near 90 deg the roots of nearly nothing keep half the digits
            np.testing.assert_allclose(
                rotation.as_matrix(), matrix[:3, :3], rtol=0, atol=1e-7, err_msg=form
            )
        np.testing.assert_array_equal(forms["translation_mm"], matrix[:3, 3])
        np.testing.assert_array_equal([kuka[i] for i in "XYZ"], matrix[:3, 3])
        assert forms["quaternion_wxyz"][0] >= 0


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    result = example_result("ambiguous")
    write_result(path, result, **NAMES, seed=3, weights_name="vane.npz")
    found = read_pose(path)
    np.testing.assert_allclose(found.as_matrix(), result.part_from_camera.as_matrix(), **EXACT)
    values = strict(path.read_text())
    assert values["verdict"] == {"status": "ambiguous", "reason": "made up to be ambiguous"}
    assert values["part"] == {"name": "vane", "sha256": "ab" * 32}
    assert values["scan"] == {"name": "scan", "sensor_origin_mm": [0.0, 0.0, 0.0]}
    assert (values["seed"], values["weights"]) == (3, "vane.npz")
    assert np.shape(values["uncertainty"]["covariance"]) == (6, 6)
    assert values["uncertainty"]["weakest_translation"] == {
        "axis": [0.0, 0.6, 0.8],
        "sigma_mm": 0.0061,
    }
    assert values["verification"]["points"] == {"inlier": 6, "before": 0, "behind": 1, "beside": 1}
    assert values["refinement"]["noise_mm"] == 0.1012
    (other,) = values["alternatives"]
    assert other["rotation_from_the_answer_deg"] == 180.0
    np.testing.assert_array_equal(
        other["part_from_camera"], result.alternatives[0].part_from_camera.as_matrix()
    )
    assert values["notes"] == ["2 points were dropped"]
    assert values["seconds"] == {"search": 1.25, "refinement": 0.5}
    assert values["versions"]["numpy"] == np.__version__
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_not_known_is_null_not_nan(tmp_path: Path) -> None:
    result = example_result(sensor=False)
    uncertainty = dataclasses.replace(result.uncertainty, covariance=np.full((6, 6), np.inf))
    write_result(
        tmp_path / "pose.json", dataclasses.replace(result, uncertainty=uncertainty), **NAMES
    )
    values = strict((tmp_path / "pose.json").read_text())
    assert values["verification"]["violation_share"] is None
    assert values["verification"]["unmeasured_share"] is None
    assert values["verification"]["inlier_share"] == 0.75
    assert values["scan"]["sensor_origin_mm"] is None
    assert values["uncertainty"]["covariance"][0] == [None] * 6
    assert result_to_dict(result, **NAMES)["refinement"]["converged"] is True


def test_the_symmetry_is_written_and_a_free_rotation_is_null(tmp_path: Path) -> None:
    result = example_result()
    axis = (np.array([7.0, -4.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    symmetry = PartSymmetry(Symmetry.parse("z:any,x:180"), np.eye(4)[None], axis, 0.02, axis[0], 50)
    free = dataclasses.replace(
        result.uncertainty, rotation_sigma_deg=np.array([0.1, 0.2, np.inf]), free_axis=axis[1]
    )
    write_result(
        tmp_path / "pose.json",
        dataclasses.replace(result, symmetry=symmetry, uncertainty=free),
        **NAMES,
    )
    written = strict((tmp_path / "pose.json").read_text())
    assert written["symmetry"] == {
        "declared": "z:any,x:180",
        "motions": np.eye(4)[None].tolist(),
        "free_axis": {"point_mm": [7, -4, 0], "direction": [0, 0, 1]},
        "largest_difference_mm": 0.02,
    }
    assert written["uncertainty"]["rotation_sigma_deg"] == [0.1, 0.2, None]
    assert result_to_dict(result, **NAMES)["symmetry"] is None
    assert read_record(tmp_path / "pose.json").covariance is not None


def test_every_way_to_write_a_guess(tmp_path: Path) -> None:
    truth = pose((10.0, -20.0, 30.0), (1.5, -2.25, 400.125))
    matrix = truth.as_matrix().tolist()
    inverse = truth.inverse().as_matrix().tolist()
    flat = [number for row in matrix for number in row]
    rows = "\n".join(" ".join(map(repr, row)) for row in matrix)
    contents = {
        "own.json": {"part_from_camera": matrix, "camera_from_part": inverse, "note": 1},
        "nested.json": {"part_from_camera": {"matrix": matrix}},
        "inverse.json": {"camera_from_part": inverse},
        "bare.json": matrix,
        "flat.json": flat,
        "bom.json": "\ufeff" + json.dumps(matrix),
        "rows.txt": f"# by hand\n{rows}  # the last row\n",
        "commas.csv": ",".join(map(repr, flat)),
        "semicolons.csv": rows.replace(" ", ";"),
        "list.txt": json.dumps(flat),
    }
    for name, content in contents.items():
        found = read(tmp_path, content, name)
        assert found.rotation.dtype == found.translation.dtype == np.float64
        np.testing.assert_allclose(found.as_matrix(), matrix, err_msg=name, **EXACT)


@given(st.lists(st.floats(-4e-4, 4e-4), min_size=9, max_size=9), ANGLE, ANGLE)
def test_a_rounded_matrix_becomes_the_nearest_rotation(
    noise: list[float], a: float, c: float
) -> None:
    truth = pose((a, 25.0, c), (0.0, 0.0, 100.0))
    rough = truth.as_matrix()
    rough[:3, :3] += np.reshape(noise, (3, 3))
    gram = rough[:3, :3].T @ rough[:3, :3]
    if np.abs(gram - np.eye(3)).max() > 1e-3:
        with pytest.raises(InputError, match="no rotation"):
            rigid_from_matrix(rough, where="here")
        return
    found = rigid_from_matrix(rough, where="here").rotation
    np.testing.assert_allclose(found, polar(rough[:3, :3])[0], atol=1e-13)


def changed(row: int, column: int, value: Any) -> list[list[Any]]:
    matrix = np.eye(4).tolist()
    matrix[row][column] = value
    return matrix


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"pose": np.eye(4).tolist()}, "no \"part_from_camera\".*has 'pose'"),
        ({}, "it has nothing"),
        ("[" * 100_000, "not valid JSON"),
        ("", "holds 0 numbers"),
        (" ".join(["0"] * 17), "holds 17 numbers"),
        ("hello", "neither JSON nor 16 numbers"),
        ("nan " * 16, "not finite"),
        (np.eye(3).tolist(), "no 4x4 matrix"),
        (changed(0, 3, "1"), "no 4x4 matrix"),
        (changed(0, 3, True), "no 4x4 matrix"),
        (changed(0, 3, 10**400), "not finite"),
        ({"part_from_camera": "identity"}, "part_from_camera: holds no 4x4 matrix"),
        (changed(3, 3, 2.0), r"last row is \[0.0, 0.0, 0.0, 2.0\]"),
        (changed(3, 0, 100.0), "column-major: transpose"),
        (changed(0, 0, -1.0), "mirror image"),
        (changed(0, 1, 0.01), "axes are not unit and square.*by 0.01"),
        (changed(0, 0, 1e200), "entry of size 1e[+]200"),
        (np.diag([1000.0, 1000, 1000, 1]).tolist(), "scales by 1000"),
        (np.diag([0.0, 0, 0, 1]).tolist(), "axes are not unit"),
        (
            {"part_from_camera": changed(0, 3, 5.0), "camera_from_part": changed(0, 3, 5.0)},
            "not inverse to each other",
        ),
    ],
)
def test_what_is_no_pose_is_named(tmp_path: Path, content: Any, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, content)
    assert str(caught.value).startswith(str(tmp_path / "pose.json"))


def test_what_is_no_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n\xff\xfe\x00")
    with open(tmp_path / "large.json", "wb") as file:
        file.truncate(1 << 30)
    for name, words in (
        ("none.json", "no such file"),
        (".", "is a folder"),
        ("/dev/zero", "or a device"),
        ("picture.png", "is no text"),
        ("large.json", "1024 MiB are too large"),
    ):
        with pytest.raises(InputError, match=words):
            read_pose(tmp_path / name)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=5)
        | st.dictionaries(st.sampled_from(["part_from_camera", "matrix", "x"]), inner, max_size=3)
    ),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(JSON.map(lambda value: json.dumps(value).encode()) | st.binary(max_size=50))
def test_nothing_but_an_input_error_comes_of_rubbish(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "rubbish"
    path.write_bytes(content)
    with pytest.raises(InputError):
        read_pose(path)
