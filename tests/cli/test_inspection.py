"""What `inspect` says of every kind of file."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from example_step import step

from vanejax.cad.cad_file import MM_PER_UNIT, read_triangles
from vanejax.cad.parametric_vane import guide_vane
from vanejax.cli.inspection import inspect
from vanejax.errors import InputError
from vanejax.scanner import Camera, Scanner, hemisphere_viewpoints
from vanejax.scans.scan_file import save_points

SHARED = Path(__file__).parents[3] / "shared" / "data"


def sheet(count=500):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-50, 50, count), rng.uniform(-30, 30, count)
    return np.stack([x, y, 400 + 4 * np.sin(x / 9)], axis=1)


@pytest.fixture(scope="module")
def vane():
    return guide_vane()


@pytest.fixture(scope="module")
def view(vane):
    return Scanner(vane).scan(Camera(), hemisphere_viewpoints(vane.center).view(0))


def check(found):
    """Every answer can be printed and kept as JSON."""
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["path"] == found.path
    lines = found.text().splitlines()
    assert lines[0].startswith("file ")
    assert found.path in lines[0]
    return found


def test_a_scan(tmp_path, view):
    save_points(tmp_path / "vane.ply", view.points, view.normals)
    found = check(inspect(tmp_path / "vane.ply"))
    assert (found.kind, found.format) == ("point cloud", "PLY, binary little endian")
    assert found.size_bytes == (tmp_path / "vane.ply").stat().st_size
    assert found.points == len(view.points)
    np.testing.assert_allclose(found.extent, np.ptp(view.points, axis=0), rtol=1e-6)  # f32
    assert (found.units, found.missing, found.repeated) == ("mm", 0, 0)
    # at 400 mm a pixel is 0.24 x 0.18 mm wide; slanted faces are wider
    assert 0.18 < found.spacing < 0.21
    assert found.normals == "present, 100 % of them towards the origin"
    assert found.sensor == "can have stood at the origin, looking along -z"
    assert (found.sensor_origin, found.looks_along) == ((0.0, 0.0, 0.0), "-z")
    assert found.faces is found.watertight is found.volume_mm3 is None
    assert found.next_steps == (f"vanejax register {tmp_path / 'vane.ply'} PART.stl",)
    assert "points   " + f"{len(view.points):,}" in found.text()


@pytest.mark.parametrize(
    ("scale", "unit"), [(1, "mm"), (1e-3, "m"), (0.1, "mm"), (0.03, "cm"), (1e5, None)]
)
def test_the_unit_is_guessed_and_the_others_are_named(tmp_path, scale, unit):
    save_points(tmp_path / "my scan.csv", sheet() * scale)
    found = check(inspect(tmp_path / "my scan.csv"))
    assert found.units == unit
    expected = f"vanejax register '{tmp_path / 'my scan.csv'}' PART.stl"
    expected += f" --units-scan {unit}" if unit in ("m", "cm") else ""
    assert found.next_steps[0] == expected
    if scale == 0.1:
        assert "possible: cm (" in found.units_reason
    if unit is None:
        assert "is no part for a scanner in any of mm, m, cm, in" in found.units_reason
        assert "unclear: " in found.text()


def test_what_was_not_measured_is_counted(tmp_path):
    points = sheet()
    points[:7] = np.nan
    points[7:9] = 0
    points[20:23] = points[30]
    save_points(tmp_path / "a.npz", points, np.tile([0, 0, 1.0], (500, 1)))
    found = check(inspect(tmp_path / "a.npz"))
    assert (found.points, found.missing, found.repeated) == (500, 9, 3)
    assert found.normals == "present, 100 % of them away from the origin"
    assert "dropped  9 not measured, 3 repeated" in found.text()
    assert found.looks_along == "+z"


def test_a_moved_cloud_says_why_and_what_to_do(tmp_path, vane):
    save_points(tmp_path / "a.xyz", vane.sample(5000, 0)[0])
    found = check(inspect(tmp_path / "a.xyz"))
    assert found.sensor == "the origin lies inside the cloud: merged or centred"
    assert found.sensor_origin is found.looks_along is None
    assert found.normals == "none; they are estimated where they are needed"
    assert "--sensor-origin 0,0,0" in found.next_steps[1]


@pytest.mark.parametrize(
    "points", [np.full((5, 3), np.nan), np.ones((3, 3)), np.zeros((1, 3)), np.zeros((9, 3))]
)
def test_a_scan_of_nothing_is_still_described(tmp_path, points):
    save_points(tmp_path / "a.ply", points, np.full_like(points, np.nan))
    found = check(inspect(tmp_path / "a.ply"))
    assert found.points == len(points)
    assert "are too few for a pose" in found.notes[-1]
    assert found.next_steps == ()
    assert found.sensor_origin is None


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj", ".glb"])
def test_a_cad_file(tmp_path, vane, suffix):
    path = tmp_path / f"vane{suffix}"
    vane.export(path)
    found = check(inspect(path))
    assert (found.kind, found.faces) == ("mesh", len(vane.mesh.faces))
    assert (found.watertight, found.bodies) == (True, 1)
    # OBJ rounds to eight decimals, GLB to float32
    np.testing.assert_allclose(found.volume_mm3, vane.mesh.volume, rtol=1e-5)
    unit = "m" if suffix == ".glb" else "mm"
    assert found.units == unit
    size = np.array(found.extent) * MM_PER_UNIT[unit]
    np.testing.assert_allclose(size, vane.extent_mm, rtol=1e-6)
    option = " --units-cad m" if unit == "m" else ""
    assert found.next_steps == (
        f"vanejax register SCAN.ply {path}{option}",
        f"vanejax scan {path}{option} --out scans",
    )
    assert "surface  watertight, 1 body, " in found.text()


def test_meshes_with_faults(tmp_path):
    box = trimesh.creation.box((30, 40, 50))
    trimesh.Trimesh(box.vertices, box.faces[2:]).export(tmp_path / "open.ply")
    found = check(inspect(tmp_path / "open.ply"))
    assert (found.watertight, found.volume_mm3) == (False, None)
    assert found.notes[-1].startswith("cannot serve as a part: open.ply")
    assert found.next_steps[0].startswith("vanejax register ")
    assert found.next_steps[0].endswith("PART.stl   # if this is a scan")
    two = trimesh.util.concatenate([box, box.copy().apply_translation([100, 0, 0])])
    two.export(tmp_path / "two.stl")
    found = check(inspect(tmp_path / "two.stl"))
    assert (found.watertight, found.bodies) == (True, 2)
    assert found.volume_mm3 == pytest.approx(120_000)
    vertices = np.array(box.vertices)
    vertices[0] = np.nan
    trimesh.Trimesh(vertices, box.faces, process=False).export(tmp_path / "nan.stl")
    found = check(inspect(tmp_path / "nan.stl"))
    assert found.watertight is None
    assert "not finite" in found.notes[-1]


@pytest.mark.parametrize("unit", ["mm", "m", "in"])
def test_a_step_file_knows_its_unit(tmp_path, unit):
    pytest.importorskip("cascadio")
    path = tmp_path / "corner.step"
    path.write_text(step(unit))
    found = check(inspect(path))
    assert (found.kind, found.format, found.units) == ("mesh", "STEP", unit)
    assert found.units_reason == "by the file's own word or standard"
    vertices, _, _ = read_triangles(path, units=unit)
    size = np.ptp(vertices, axis=0) / MM_PER_UNIT[unit]
    np.testing.assert_allclose(found.extent, size, rtol=1e-12)
    path.write_text("ISO-10303-21;")
    with pytest.raises(InputError, match="no shape in this STEP file"):
        inspect(path)


def test_arrays_that_are_no_scan(tmp_path):
    np.savez(tmp_path / "a.npz", images=np.zeros((4, 5), np.uint8), labels=np.zeros(7))
    found = check(inspect(tmp_path / "a.npz"))
    assert found.kind == "arrays"
    assert found.notes[:2] == ("images: [4, 5] uint8", "labels: [7] float64")
    np.savez(tmp_path / "b.npz", header=np.zeros(7, np.uint8))
    found = check(inspect(tmp_path / "b.npz"))
    assert found.kind == "arrays"
    assert "not a weights file of vanejax" in found.notes[-1]


def test_a_pose(tmp_path):
    matrix = np.eye(4)
    matrix[:3, 3] = [1, 2, 3]
    (tmp_path / "pose.json").write_text(json.dumps({"part_from_camera": matrix.tolist()}))
    found = check(inspect(tmp_path / "pose.json"))
    assert found.kind == "pose"
    assert "[-1. -2. -3.] mm in the scan" in found.notes[0]
    assert found.next_steps[0].endswith(f"--init {tmp_path / 'pose.json'}")
    (tmp_path / "other.json").write_text('{"name": "vane"}')
    assert check(inspect(tmp_path / "other.json")).kind == "unknown"


@pytest.mark.parametrize(
    ("name", "data", "written"),
    [("a.png", b"\x89PNG\r\n\x1a\n\0\0", "binary"), ("notes.md", b"# Notes", "text")],
)
def test_any_other_file(tmp_path, name, data, written):
    (tmp_path / name).write_bytes(data)
    found = check(inspect(tmp_path / name))
    assert (found.kind, found.format) == ("unknown", written)
    assert found.notes[0].startswith("not a file that vanejax reads: .ply, .pcd")


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match="is a folder"):
        inspect(tmp_path)
    for name, data, words in (
        ("a.ply", None, "no such file"),
        *((name, b"", "is empty") for name in ("a.ply", "a.stl", "a.npz", "a.json")),
        ("a.npz", b"PK\x03\x04 and nothing", "damaged"),
        ("a.stl", b"solid a\n", "without triangles"),
    ):
        if data is not None:
            (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=words):
            inspect(tmp_path / name)


def test_the_spacing_of_a_large_cloud_is_that_of_the_whole(tmp_path, monkeypatch):
    points = np.random.default_rng(0).uniform(0, 100, (40_000, 3)) * [1, 1, 0] + [0, 0, 300]
    save_points(tmp_path / "a.ply", points)
    whole = inspect(tmp_path / "a.ply").spacing
    # median distance to the nearest of a Poisson process: sqrt(ln 2 / (pi density)); 2,000 of them
    # tell it to 1.6 % (one sigma), and it is a percent larger at the rim
    assert whole == pytest.approx(np.sqrt(np.log(2) / (np.pi * 4)), rel=0.06)
    monkeypatch.setattr("vanejax.cli.inspection._SPACING_POINTS", 4000)
    assert inspect(tmp_path / "a.ply").spacing == pytest.approx(whole, rel=0.07)


@pytest.mark.parametrize("name", ["w.npz", "w.safetensors"])
def test_weights(tmp_path, monkeypatch, name):
    np.savez(tmp_path / "w.npz", header=np.zeros(7, np.uint8), kernel=np.zeros((2, 2)))
    (tmp_path / "w.safetensors").write_bytes(b"\x02\0\0\0\0\0\0\0{}")
    sampling = SimpleNamespace(num_reference=1024, num_source=717)
    matcher = SimpleNamespace(
        part_name="vane", part_sha256="ab" * 32, radius_mm=75.0, sampling=sampling, iterations=5
    )
    monkeypatch.setattr("vanejax.training.weight_file.load_model", lambda path: matcher)
    found = check(inspect(tmp_path / name))
    assert found.kind == "weights"
    assert found.notes == (
        "trained for the part vane (sha256 abababababab), radius 75 mm",
        "1,024 reference and up to 717 source points, 5 iterations",
    )
    assert found.next_steps[0].endswith(f"--weights {tmp_path / name}")
