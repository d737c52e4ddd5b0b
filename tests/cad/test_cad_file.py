"""Files as people have them: good ones of every format, and every kind of bad one."""

from __future__ import annotations

import json
import os
import struct
import sys
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import trimesh
from example_step import FACES, STEP_UNITS, VERTICES, step
from hypothesis import strategies as st

from vanejax.cad import cad_file
from vanejax.cad.cad_file import read_triangles
from vanejax.cad.mesh_repair import repair_solid
from vanejax.errors import InputError

VOLUME = 40 * 30 * 20 / 6


def corner() -> trimesh.Trimesh:
    return trimesh.Trimesh(VERTICES, FACES, process=False)


def encoded(kind: str) -> bytes:
    data = corner().export(file_type=kind)
    return data.encode() if isinstance(data, str) else data


def write(folder: Path, name: str, data: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def volume(path: Path, units: str = "mm") -> float:
    vertices, faces, _ = read_triangles(path, units=units)
    solid, _ = repair_solid(vertices, faces, name=path.name)
    return trimesh.Trimesh(solid.points, solid.faces, process=False).volume


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.stl", "stl"),
        ("a.STL", "stl_ascii"),
        ("a.ply", "ply"),
        ("a.obj", "obj"),
        ("a.glb", "glb"),
    ],
)
def test_every_format_is_read_and_the_folder_stays_as_it_was(tmp_path, name, kind):
    path = write(tmp_path, name, encoded(kind))
    path.chmod(0o444)
    before = path.stat().st_mtime_ns
    assert volume(path) == pytest.approx(VOLUME, rel=1e-6)
    assert os.listdir(tmp_path) == [name]
    assert path.stat().st_mtime_ns == before


def test_ascii_ply_and_quads_are_read(tmp_path):
    box = trimesh.creation.box((10, 20, 30))
    path = write(tmp_path, "a.ply", box.export(file_type="ply", encoding="ascii"))
    assert volume(path) == pytest.approx(6000)
    corners = [(x, y, z) for z in (0, 30) for y in (0, 20) for x in (0, 10)]
    quads = ["1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6"]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {quad}" for quad in quads]
    assert volume(write(tmp_path, "a.obj", "\n".join(lines))) == pytest.approx(6000)


def test_gltf_with_a_buffer_beside_it_is_read(tmp_path):
    for name, data in trimesh.Scene(corner()).export(file_type="gltf").items():
        write(tmp_path, name.replace("model.gltf", "a.gltf"), data)
    assert volume(tmp_path / "a.gltf") == pytest.approx(VOLUME, rel=1e-6)
    next(tmp_path.glob("*.bin")).unlink()
    with pytest.raises(InputError, match=r"a.gltf: is no readable GLTF file"):
        read_triangles(tmp_path / "a.gltf", units="m")


def test_every_body_is_placed_by_its_node(tmp_path):
    scene = trimesh.Scene()
    for x in (0, 100):
        move = np.eye(4)
        move[:3, :3] *= 2
        move[0, 3] = x
        scene.add_geometry(corner(), transform=move)
    vertices, faces, _ = read_triangles(
        write(tmp_path, "a.glb", scene.export(file_type="glb")), units="mm"
    )
    assert len(faces) == 8
    np.testing.assert_allclose(
        [vertices.min(axis=0), vertices.max(axis=0)], [[0] * 3, [180, 60, 40]]
    )


def test_bytes_after_a_binary_stl_are_passed_over(tmp_path):
    path = write(tmp_path, "a.stl", encoded("stl") + b"\0" * 6)
    _, faces, notes = read_triangles(path, units="mm")
    assert len(faces) == 4
    assert notes == ("passed over 6 bytes after the last triangle",)


def test_a_binary_stl_may_begin_with_solid(tmp_path):
    data = b"solid facet vertex" + encoded("stl")[18:]
    assert volume(write(tmp_path, "a.stl", data)) == pytest.approx(VOLUME, rel=1e-6)


def glb_with(change) -> bytes:
    """The corner as GLB, with its JSON changed."""
    data = encoded("glb")
    length = struct.unpack("<I", data[12:16])[0]
    tree = json.loads(data[20 : 20 + length])
    change(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + data[20 + length :]
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def no_view(tree) -> None:
    for accessor in tree["accessors"]:
        accessor.pop("bufferView", None)
        accessor["count"] = 2**33


POINTS_ONLY = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(
    f"property float {axis}\n" for axis in "xyz"
)
TEXT = "Dear colleague,\nplease find the vane attached.\n"
ASCII = encoded("stl_ascii").decode()


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.stl", b"", "a.stl: is empty"),
        ("a.ply", b" \n", "a.ply: is empty"),
        ("a.stl", TEXT * 10, "a.stl: is no STL file"),
        ("a.stl", "solid state physics\n" + TEXT * 10, "without triangles, or another text"),
        ("a.stl", "solid a\nendsolid a\n", "without triangles"),
        ("a.stl", encoded("stl")[:80] + bytes(4), "without triangles"),
        ("a.stl", encoded("stl")[:60], "truncated"),
        ("a.stl", encoded("stl")[:-10], r"promises 4 triangles \(200 bytes\) and holds 190 bytes"),
        ("a.stl", encoded("stl")[:80] + b"\xff" * 4 + bytes(50), "promises 4,294,967,295"),
        ("a.stl", ASCII[: len(ASCII) // 2], "truncated or damaged: .*, no endsolid"),
        ("a.stl", ASCII.replace("vertex 4", "vertex x4"), "a vertex is not three numbers"),
        ("a.stl", ASCII.replace("vertex 4", "vertex 1 4"), "a vertex is not three numbers"),
        ("a.ply", TEXT, "a.ply: is no PLY file"),
        ("a.ply", encoded("ply")[:-10], "a.ply: "),
        ("a.ply", POINTS_ONLY + "end_header\n1 2 3\n", "a scan, not a CAD model"),
        ("a.ply", POINTS_ONLY.replace("vertex 1", "vertex 9" + "0" * 15) + "end_header\n", "trunc"),
        ("a.obj", TEXT, "a.obj: "),
        ("a.obj", "v 0 0 0\nv 1 0 0\n", "a.obj: "),
        ("a.obj", "v 0\nv 1\nv 2\nf 1 2 3\n", "a vertex is not three numbers"),
        ("a.glb", TEXT, "a.glb: is no readable"),
        ("a.glb", encoded("glb")[:-40], "a.glb: is no readable"),
        ("a.glb", glb_with(no_view), "promises"),
        ("a.gltf", "[1, 2]", "a.gltf: is no readable"),
        ("a.gltf", '{"asset": {"version": "2.0"}}', "a.gltf: "),
        ("a.step", TEXT, "a.step: is no STEP file"),
        ("a.xyz", "1 2 3", "cannot read .xyz; use one of .stl, .obj, .ply"),
        ("a", "1 2 3", "cannot read a file without suffix"),
    ],
)
def test_a_bad_file_is_named_with_the_reason(tmp_path, name, data, message):
    with pytest.raises(InputError, match=message) as caught:
        read_triangles(write(tmp_path, name, data), units="mm")
    assert str(tmp_path / name) in str(caught.value)


def test_missing_files_and_folders_are_named(tmp_path):
    with pytest.raises(InputError, match=r"gone.stl: no such file"):
        read_triangles(tmp_path / "gone.stl", units="mm")
    (tmp_path / "folder.stl").mkdir()
    with pytest.raises(InputError, match=r"folder.stl: is a folder"):
        read_triangles(tmp_path / "folder.stl", units="mm")


def test_files_and_meshes_beyond_memory_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.stl"
    with path.open("wb") as file:
        file.truncate(cad_file.MAX_BYTES + 1)  # sparse: takes no disk
    with pytest.raises(InputError, match=r"1.0 GiB are more than 1 GiB"):
        read_triangles(path, units="mm")
    monkeypatch.setattr(cad_file, "MAX_FACES", 3)
    for name, kind in (("b.stl", "stl_ascii"), ("b.ply", "ply")):
        with pytest.raises(InputError, match=r"4 .* are more than"):
            read_triangles(write(tmp_path, name, encoded(kind)), units="mm")


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "ply", "obj", "glb"])
@hypothesis.given(data=st.data())
@hypothesis.settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture],
)
def test_a_damaged_file_gives_a_part_or_an_input_error(tmp_path, kind, data):
    whole = bytearray(encoded(kind))
    for _ in range(data.draw(st.integers(0, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(whole)))
    suffix = "stl" if kind.startswith("stl") else kind
    path = write(tmp_path, f"a.{suffix}", bytes(whole[:cut]) if cut % 2 else bytes(whole))
    message = path.name
    try:
        volume(path)
    except InputError as error:
        message = str(error)
    assert path.name in message


@pytest.mark.parametrize("unit", list(STEP_UNITS))
def test_step_comes_out_in_mm_whatever_its_unit(tmp_path, unit):
    pytest.importorskip("cascadio")
    path = write(tmp_path, "corner.stp", step(unit))
    vertices, _, _ = read_triangles(path, units=unit)
    # OpenCASCADE hands the mesh over in float32 metres: 0.04 m +- 4e-9
    np.testing.assert_allclose(vertices.max(axis=0), [40, 30, 20], rtol=2e-7)
    assert volume(path, unit) == pytest.approx(VOLUME, rel=1e-6)
    assert os.listdir(tmp_path) == ["corner.stp"]


def test_step_knows_its_unit_better(tmp_path):
    pytest.importorskip("cascadio")
    for unit, wrong in (("mm", "m"), ("in", "mm"), ("m", "mm")):
        path = write(tmp_path, "corner.step", step(unit))
        with pytest.raises(InputError, match=f"its unit is '{unit}', not '{wrong}': use units="):
            read_triangles(path, units=wrong)


def test_a_step_file_without_a_shape_is_refused(tmp_path):
    pytest.importorskip("cascadio")
    text = step("mm")
    for damaged in (text.replace("#16=CLOSED_SHELL", "#16=NOTHING"), text[: len(text) // 2]):
        with pytest.raises(InputError, match=r"corner.step: .*export"):
            read_triangles(write(tmp_path, "corner.step", damaged), units="mm")


def test_step_without_cascadio_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cascadio", None)
    with pytest.raises(InputError, match=r"pip install 'vanejax\[step\]'"):
        read_triangles(write(tmp_path, "corner.step", step("mm")), units="mm")
