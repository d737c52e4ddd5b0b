"""``vanejax place``: what it prints and writes, what `compensate` takes of it, and its page."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import trimesh
from example_result import example_result

from vanejax.cad import part_from_mesh
from vanejax.cli.place import parse_mm
from vanejax.cli.program import main
from vanejax.errors import InputError
from vanejax.machine import read_record, write_result
from vanejax.rigid import RigidTransform
from vanejax.scans import save_points

PART_FROM_CAMERA = RigidTransform(np.eye(3), np.array([0.0, 0.0, -400.0]))


def box(low, high):
    mesh = trimesh.creation.box(bounds=[low, high])
    return part_from_mesh(mesh.vertices, mesh.faces, name="box")


@pytest.fixture
def files(tmp_path: Path, monkeypatch) -> Path:
    """A folder with a part, the scan of a blank with 1 mm on one side and 3 mm on the other."""
    monkeypatch.chdir(tmp_path)
    part, blank = box([0, 0, 0], [60, 40, 30]), box([-1, -2, -2], [63, 42, 32])
    part.export("part.stl")
    points, _, _ = blank.sample(20_000, 1)
    save_points("scan.ply", PART_FROM_CAMERA.inverse().apply(points))
    for status in ("accepted", "ambiguous"):
        result = dataclasses.replace(example_result(status), part_from_camera=PART_FROM_CAMERA)
        names = {"scan_name": "scan", "part_name": "box", "part_sha256": part.sha256}
        write_result(f"{status}.json", result, **names)
    return tmp_path


COMMAND = ["place", "scan.ply", "accepted.json", "part.stl", "--sensor-origin", "unknown"]


def test_the_place_goes_on_to_the_machine(files: Path, capsys) -> None:
    assert main([*COMMAND, "--stock", "0.5mm", "--json", "placed.json"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("ACCEPTED: feasible on what was seen (")
    assert re.search(r"least stock  (1\.9|2\.0)", out)
    assert "required 0.5 mm" in out
    record = read_record("placed.json")
    assert record.verdict.status == "accepted"
    moved = record.part_from_camera @ PART_FROM_CAMERA.inverse()
    np.testing.assert_allclose(moved.translation, [-1, 0, 0], atol=0.03)
    values = json.loads(Path("placed.json").read_text())["placement"]
    assert values["margin_mm"] == pytest.approx(1.5, abs=0.03)
    assert main(["compensate", "placed.json", "--part", "part.stl", "--format", "matrix"]) == 0
    assert "work frame" in capsys.readouterr().out


def test_a_blank_that_is_too_small_is_rejected(files: Path, capsys) -> None:
    assert main([*COMMAND, "--stock", "2.1mm", "--json", "placed.json"]) == 4
    assert "REJECTED: no pose leaves the stock: short by 0.1" in capsys.readouterr().out
    assert main(["compensate", "placed.json"]) == 4


def test_fixed_axes_and_even_stock_are_passed_on(files: Path, capsys) -> None:
    assert main([*COMMAND, "--stock", "0.5mm", "--fixed", "x,ry", "--even"]) == 0
    assert "moved        +0.000, " in capsys.readouterr().out


def test_only_another_pose_of_the_blank_is_a_doubt(files: Path, capsys) -> None:
    command = [word.replace("accepted", "ambiguous") for word in COMMAND]
    assert main([*command, "--stock", "0.5mm"]) == 3
    out = capsys.readouterr().out
    assert "but the blank's pose is ambiguous: made up to be ambiguous" in out
    values = json.loads(Path("ambiguous.json").read_text())
    Path("ambiguous.json").write_text(json.dumps(values | {"alternatives": []}))
    assert main([*command, "--stock", "0.5mm"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("ACCEPTED")
    assert "note: the blank's pose is ambiguous: made up to be ambiguous" in out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--stock", "0.5"], "--stock 0.5: should be a length of 0 or more, such as 0.5mm"),
        (["--stock", "0.5mm", "--fixed", "x,q"], "no axis 'q' to fix"),
        (["--stock", "0.5mm", "--json", "scan.ply"], "--json scan.ply: is an input already"),
    ],
)
def test_bad_input_is_one_line(files: Path, capsys, options: list[str], words: str) -> None:
    assert main([*COMMAND, *options]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1


def test_the_pose_of_another_part_is_refused(files: Path, capsys) -> None:
    box([0, 0, 0], [60, 40, 31]).export("other.stl")
    command = [word.replace("part.stl", "other.stl") for word in COMMAND]
    assert main([*command, "--stock", "0.5mm"]) == 2
    assert "is not the part of accepted.json" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "mm", "-1mm", "1e999mm", "1..2mm", "0.5 in"])
def test_a_length_has_its_unit(text: str) -> None:
    assert parse_mm(" 0.5 mm", option="--stock") == 0.5
    with pytest.raises(InputError, match="--stock"):
        parse_mm(text, option="--stock")


def masked(text: str) -> str:
    """What another processor prints too: without figures, and which of two equal sides is worse."""
    text = re.sub(r"[+-]?\d+(?:[.,]\d+)*", "0", re.sub(r"[+-][xyz]", "side", text.strip()))
    return re.sub(r"held by .*", "held by", text)


def test_its_page_runs_as_written(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "placement.md").read_text()
    blocks = re.findall(r"^```(sh|python|text)\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    shown, printed = 0, ""
    for language, block in blocks:
        if language == "text":
            assert masked(printed) == masked(block)
            shown += 1
        elif language == "python":
            exec(compile(block, "placement.md", "exec"), {})
            printed = capsys.readouterr().out
        else:
            assert main(shlex.split(block)[1:]) == 0
            printed = capsys.readouterr().out
    assert shown == 3
    moved = json.loads(Path("placed.json").read_text())["placement"]
    # turned by 0.4 deg, and 1 mm of stock on either side across y
    assert moved["rotation_vector_deg"][2] == pytest.approx(0.4, abs=0.03)
    assert moved["margin_mm"] == pytest.approx(0.5, abs=0.04)
