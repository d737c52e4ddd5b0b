"""Tool paths: moved, read, written, and the whole way from a displaced part to points on it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from example_result import pose
from scipy.spatial.transform import Rotation

import vanejax
from vanejax.cad import guide_vane, part_from_mesh
from vanejax.errors import InputError
from vanejax.machine.controllers import Compensation
from vanejax.machine.frame_notation import read_kuka, write_kuka
from vanejax.machine.tool_path import (
    ToolPath,
    compensate,
    raster_path,
    read_tool_path,
    tool_path_deviation,
    write_tool_path,
)
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Scanner, hemisphere_viewpoints
from vanejax.scans.measured_scan import clean_scan

DOWN = np.array([0.0, 0.0, -1.0])


MESH = trimesh.creation.box((40.0, 60.0, 10.0))
BOX = part_from_mesh(MESH.vertices, MESH.faces, name="box")


@pytest.mark.slow
def test_a_displaced_vane_is_hit_and_without_compensation_missed() -> None:
    """The part lies elsewhere than the program presumes; a scan finds it; the path is on it."""
    part = guide_vane()
    path = raster_path(part, towards=DOWN, spacing_mm=6.0)
    machine_from_camera = pose((178.0, 3.0, 91.0), (812.0, -240.0, 905.0))
    camera_from_part = hemisphere_viewpoints(part.center).view(40)
    true = machine_from_camera @ camera_from_part
    # 1.2 deg and 3.6 mm: what a fixture leaves of a casting
    turned = RigidTransform(
        Rotation.from_rotvec([0.6, -0.8, 0.6], degrees=True).as_matrix(), np.array([2.0, -3.0, 0.5])
    )
    nominal = true @ turned
    ideal = Scanner(part).scan(Camera().scaled(0.35), camera_from_part)
    noise = np.random.default_rng(0).normal(0, 0.05, (len(ideal.points), 1))
    rays = ideal.points / np.linalg.norm(ideal.points, axis=1, keepdims=True)
    result = vanejax.register(clean_scan(ideal.points + noise * rays), part)
    assert result.verdict.status == "accepted"
    measured = machine_from_camera @ result.camera_from_part
    # as the controller gets it, rounded
    found = Compensation(read_kuka(write_kuka(measured)), nominal)
    moved = {
        "part": compensate(path, found, frame="part"),
        "machine": compensate(path.moved(nominal), found, frame="machine"),
    }
    np.testing.assert_allclose(moved["part"].points, moved["machine"].points, rtol=0, atol=1e-9)
    np.testing.assert_allclose(moved["part"].axes, moved["machine"].axes, rtol=0, atol=1e-9)
    hit = tool_path_deviation(moved["part"].points, part, true, tolerance_mm=0.05)
    missed = tool_path_deviation(path.moved(nominal).points, part, true, tolerance_mm=0.05)
    assert hit.largest_mm < 0.05
    assert hit.share_within == 1.0
    assert missed.mean_mm > 0.3
    assert missed.share_within < 0.2
    # the axes are the true surface's normals
    true_axes = true.rotate(path.axes)
    assert np.einsum("ni,ni->n", moved["part"].axes, true_axes).min() > np.cos(np.radians(0.02))


def test_a_raster_covers_a_box_to_and_fro() -> None:
    path = raster_path(BOX, towards=3 * DOWN, spacing_mm=4.0)
    assert len(path.points) == 10 * 15
    np.testing.assert_allclose(path.points[:, 2], 5.0, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(path.axes, np.tile([0.0, 0, 1], (150, 1)))
    steps = np.linalg.norm(np.diff(path.points, axis=0), axis=1)
    np.testing.assert_allclose(steps, 4.0, rtol=0, atol=1e-5)  # the next line starts where one ends
    assert len(np.unique(np.round(path.points, 3), axis=0)) == 150


def test_a_raster_leaves_out_steep_faces_and_what_is_hidden() -> None:
    part = guide_vane()
    path = raster_path(part, towards=DOWN, spacing_mm=5.0, most_tilt_deg=30.0)
    assert (path.axes[:, 2] >= np.cos(np.radians(30.0)) - 1e-12).all()
    above = path.points + 0.01 * path.axes
    # the way back to the tool is free
    assert np.isinf(Scanner(part).cast(above, np.tile(-DOWN, (len(above), 1))).distance_mm).all()
    on = tool_path_deviation(
        path.points, part, RigidTransform.identity(dtype=np.float64), tolerance_mm=1e-6
    )
    assert on.share_within == 1.0


@pytest.mark.parametrize(
    ("towards", "spacing", "words"),
    [
        ([0.0, 0.0, 0.0], 1.0, "should be three numbers, not all 0"),
        ([0.0, 0.0, -1.0], 0.0, "spacing 0.0 mm: should be more"),
        ([0.0, 0.0, -1.0], 1e-6, "over 2,000"),
        ([0.0, 0.0, -1.0], 300.0, "no face is reached"),
    ],
)
def test_a_raster_that_makes_no_sense(towards: list, spacing: float, words: str) -> None:
    with pytest.raises(InputError, match=words):
        raster_path(BOX, towards=np.array(towards), spacing_mm=spacing)


def test_the_sign_is_positive_outside() -> None:
    machine_from_part = pose((10.0, 20.0, 30.0), (100.0, 200.0, 300.0))
    points = np.array([[0.0, 0, 5.25], [0, 0, 4.5], [20.03, 0, 0], [0, 0, 5]])
    found = tool_path_deviation(
        machine_from_part.apply(points), BOX, machine_from_part, tolerance_mm=0.05
    )
    np.testing.assert_allclose(found.signed_mm, [0.25, -0.5, 0.03, 0], rtol=0, atol=1e-9)
    assert (found.largest_mm, found.share_within) == (pytest.approx(0.5), 0.5)
    assert found.mean_mm == pytest.approx(0.195)


@pytest.mark.parametrize(
    ("points", "tolerance", "words"),
    [
        (np.zeros((0, 3)), 0.1, r"shape \[0, 3\]"),
        (np.zeros(3), 0.1, r"shape \[3\]"),
        (np.full((2, 3), np.nan), 0.1, "not finite"),
        (np.zeros((1, 3)), 0.0, "tolerance 0.0 mm"),
    ],
)
def test_deviations_of_nonsense(points: np.ndarray, tolerance: float, words: str) -> None:
    with pytest.raises(InputError, match=words):
        tool_path_deviation(points, BOX, pose((0, 0, 0), (0, 0, 0)), tolerance_mm=tolerance)


@pytest.mark.parametrize("with_axes", [True, False])
def test_a_path_is_read_as_it_was_written(tmp_path: Path, with_axes: bool) -> None:
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(20, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    path = ToolPath(rng.normal(0, 3000, (20, 3)), axes if with_axes else None)
    write_tool_path(tmp_path / "path.csv", path)
    header = (tmp_path / "path.csv").read_text().splitlines()[0]
    assert header == ("x,y,z,i,j,k" if with_axes else "x,y,z")
    found = read_tool_path(tmp_path / "path.csv")
    np.testing.assert_allclose(found.points, path.points, rtol=0, atol=0.51e-6)
    if with_axes:
        np.testing.assert_allclose(found.axes, axes, rtol=0, atol=2e-7)  # read as float32
    else:
        assert found.axes is None


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "x,y,z,i,j,k\n1,2,3,0,0,2\n", "tool axis of point 1 has length 2, not 1"),
        ("a.csv", "x,y,z,i,j,k\n1,2,3,0,0,1\n1,2,3,0,0,0\n", "tool axis of point 2 has length 0"),
        ("a.csv", "x,y,z\n1,2,3\n1,nan,3\n", "point 2 has a coordinate that is not finite"),
        ("a.csv", "x,y,z,f\n1,2,3,100\n", "name the columns x,y,z,i,j,k"),
        ("a.csv", "1.5,2,3,0,0,0.5\n", "name the columns x,y,z,i,j,k"),
        ("a.ply", "ply\n", "a tool path is a table"),
        ("none.csv", None, "no such file"),
    ],
)
def test_what_is_wrong_with_a_path_is_said(
    tmp_path: Path, name: str, text: str | None, words: str
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words) as error:
        read_tool_path(tmp_path / name)
    assert name in str(error.value)
