"""``vanejax compensate``: what it prints is the work frame, what it refuses, and its page."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from example_result import example_result, pose

from vanejax.cad.part import Part, part_from_mesh
from vanejax.cli.program import main
from vanejax.localization.pose_result import FormDeviation, magnitude_bound
from vanejax.machine.frame_notation import NOTATIONS, read_kuka, write_kuka
from vanejax.machine.pose_file import write_result
from vanejax.machine.tool_path import ToolPath, read_tool_path, write_tool_path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "machine.md").read_text()

PART_FROM_CAMERA = example_result().part_from_camera
MACHINE_FROM_CAMERA = pose((170.0, 5.0, 80.0), (900.0, -150.0, 800.0))
MACHINE_FROM_PART = MACHINE_FROM_CAMERA @ PART_FROM_CAMERA.inverse()
NOMINAL = pose((0.2, -0.3, 1.0), (1.0, 2.0, -1.5)) @ MACHINE_FROM_PART
ROUNDED = {"rtol": 0, "atol": 2e-4}  # half of 1e-4 mm, and 1e-5 deg at 400 mm


@pytest.fixture(scope="module")
def box() -> Part:
    mesh = trimesh.creation.box((40.0, 60.0, 10.0))
    return part_from_mesh(mesh.vertices, mesh.faces, name="box")


def write_pose(path: str, box: Part, status: str = "accepted", **form) -> None:
    """A pose file of the example's result; of a casting, where its form is given."""
    result = example_result(status)
    if form:
        refinement = dataclasses.replace(result.refinement, form=FormDeviation(**form))
        result = dataclasses.replace(result, refinement=refinement)
    write_result(path, result, scan_name="scan", part_name="box", part_sha256=box.sha256)


@pytest.fixture
def files(box: Part, tmp_path: Path, monkeypatch) -> Path:
    """A folder with a pose of each verdict, a calibration, a nominal frame, a path and the part."""
    monkeypatch.chdir(tmp_path)
    for status in ("accepted", "ambiguous", "rejected"):
        write_pose(f"{status}.json", box, status)
    camera = {"machine_from_camera": MACHINE_FROM_CAMERA.as_matrix().tolist()}
    Path("camera.json").write_text(json.dumps(camera))
    Path("nominal.txt").write_text(write_kuka(NOMINAL))
    top = np.array([[-15.0, -25, 5], [15, -25, 5], [15, 25, 5], [-15, 25, 5]])
    write_tool_path("path.csv", ToolPath(top, np.tile([0.0, 0, 1], (4, 1))))
    box.export("box.stl")
    return tmp_path


CELL = ["accepted.json", "--camera-pose", "camera.json", "--nominal", "nominal.txt"]


def sections(out: str) -> list[str]:
    return out.rstrip("\n").split("\n\n")


def indented(section: str) -> str:
    return "\n".join(line for line in section.splitlines()[1:] if "rounding" not in line)


def test_it_prints_the_work_frame_in_every_notation(files: Path, capsys) -> None:
    assert main(["compensate", *CELL]) == 0
    _, *blocks = sections(capsys.readouterr().out)
    assert [block.splitlines()[0] for block in blocks[:5]] == [
        f"{notation.title}: {notation.formula}" for notation in NOTATIONS.values()
    ]
    for block, notation in zip(blocks, NOTATIONS.values(), strict=False):
        found = notation.read(indented(block))
        np.testing.assert_allclose(found.as_matrix(), MACHINE_FROM_PART.as_matrix(), **ROUNDED)


def test_it_prints_the_compensation_in_both_frames(files: Path, capsys) -> None:
    assert main(["compensate", *CELL, "--format", "kuka"]) == 0
    head, kuka, words, in_machine, in_part, _ = sections(capsys.readouterr().out)
    assert head.startswith("work frame: machine_from_part")
    np.testing.assert_allclose(
        read_kuka(kuka).as_matrix(), MACHINE_FROM_PART.as_matrix(), **ROUNDED
    )
    machine, part = read_kuka(in_machine), read_kuka(in_part)
    assert "actual nominal^-1" in in_machine
    assert "nominal^-1 actual" in in_part
    actual = MACHINE_FROM_PART.as_matrix()
    # 1e-5 deg at 900 mm
    limits = {"rtol": 0, "atol": 5e-4}
    np.testing.assert_allclose((machine @ NOMINAL).as_matrix(), actual, **limits)
    np.testing.assert_allclose((NOMINAL @ part).as_matrix(), actual, **limits)
    moved = MACHINE_FROM_PART.translation - NOMINAL.translation
    (found,) = re.findall(r"origin is moved by (.*) mm", words)
    np.testing.assert_allclose([float(v) for v in found.split(", ")], moved, **ROUNDED)
    # 0.2, -0.3, 1.0 deg about x, y, z, the other way round: 1.063 deg by hand
    assert len(re.findall(r"turned by 1\.06\d\d deg about", words)) == 2


def test_without_a_calibration_the_scan_is_in_the_machine(files: Path, capsys) -> None:
    assert main(["compensate", "accepted.json", "--format", "kuka"]) == 0
    out = capsys.readouterr().out
    expected = PART_FROM_CAMERA.inverse().as_matrix()
    np.testing.assert_allclose(read_kuka(out).as_matrix(), expected, **ROUNDED)
    assert "note: the scan's frame is taken to be the machine's (no --camera-pose)" in out
    assert "compensation" not in out


@pytest.mark.parametrize(("status", "code"), [("ambiguous", 3), ("rejected", 4)])
def test_a_doubtful_pose_moves_nothing(files: Path, capsys, status: str, code: int) -> None:
    command = ["compensate", f"{status}.json", "--tool-path", "path.csv", "--out", "moved.csv"]
    assert main(command) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"vanejax: refused: {status}.json is {status}: made up to be {status}; ")
    assert err.endswith(f"--accept-verdict {status}\n")
    assert err.count("\n") == 1
    assert not Path("moved.csv").exists()
    assert main([*command, "--accept-verdict", status]) == 0
    out = capsys.readouterr().out
    assert f"note: the pose is {status}: made up" in out
    assert "note: what the verdict doubts is not in the uncertainty" in out
    assert Path("moved.csv").exists()


def test_a_pose_by_hand_has_no_verdict(files: Path, capsys) -> None:
    Path("hand.txt").write_text(" ".join(map(str, PART_FROM_CAMERA.as_matrix().ravel())))
    assert main(["compensate", "hand.txt", "--format", "matrix"]) == 0
    assert "note: the pose has no verdict: nobody checked it" in capsys.readouterr().out


@pytest.mark.parametrize("frame", ["part", "machine"])
def test_the_path_is_moved_to_the_part(files: Path, capsys, frame: str) -> None:
    path = read_tool_path("path.csv")
    if frame == "machine":
        write_tool_path("path.csv", path.moved(NOMINAL))
    command = ["--tool-path", "path.csv", "--out", "moved.csv", "--path-frame", frame]
    assert main(["compensate", *CELL, *command, "--part", "box.stl"]) == 0
    found = read_tool_path("moved.csv")
    expected = path.moved(MACHINE_FROM_PART)
    np.testing.assert_allclose(found.points, expected.points, rtol=0, atol=5e-4)
    np.testing.assert_allclose(found.axes, expected.axes, rtol=0, atol=1e-6)
    words = sections(capsys.readouterr().out)[-2]
    assert words.startswith("tool path: 4 points with tool axes, machine frame: moved.csv")
    assert re.search(r"compensated: .* by 0\.000\d mm .*; 100\.0% within 0\.05 mm", words)
    assert re.search(r"as programmed: .* [1-9]\.\d+ mm at most; 0\.0% within 0\.05 mm", words)


def test_what_rounding_costs_is_said_for_the_part(files: Path, capsys) -> None:
    assert main(["compensate", *CELL, "--part", "box.stl"]) == 0
    costs = re.findall(r"rounding: at most (\S+) mm", capsys.readouterr().out)
    assert len(costs) == len(NOTATIONS)
    # the corner of the box is 36 mm away
    assert all(0 < float(cost) < 3**0.5 * 5e-5 + 36.4 * 3 * np.radians(5e-6) for cost in costs)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none.json"], "none.json: no such file"),
        (["accepted.json", "--nominal", "camera.json"], 'has no "machine_from_part"'),
        (["accepted.json", "--camera-pose", "accepted.json"], 'has no "machine_from_camera"'),
        (["accepted.json", "--nominal", "path.csv"], "neither JSON nor 16 numbers"),
        (["accepted.json", "--tool-path", "path.csv"], "--tool-path and --out go together"),
        (["accepted.json", "--out", "moved.csv"], "--tool-path and --out go together"),
        (["accepted.json", "--path-frame", "machine"], "--path-frame machine needs --nominal"),
        (["accepted.json", "--tolerance-mm", "0"], "--tolerance-mm 0.0: should be more"),
        (
            ["accepted.json", "--max-uncertainty-mm", "-1"],
            "--max-uncertainty-mm -1.0: should be more",
        ),
        (["bare.json", "--max-uncertainty-mm", "1"], "bare.json has no covariance"),
        (["accepted.json", "--camera-sigma", "0.1mm,0.1deg"], "needs --camera-pose"),
        (
            [*CELL, "--camera-sigma", "0.1mm"],
            "--camera-sigma 0.1mm: should be a length and an angle",
        ),
        ([*CELL, "--camera-sigma", "0.1mm,0deg"], "--camera-sigma 0.1mm,0deg: should be"),
        (["accepted.json", "--tool-path", "path.csv", "--out", "path.csv"], "is an input already"),
        (["accepted.json", "--tool-path", "path.csv", "--out", "no/a.csv"], "No such file"),
        (["accepted.json", "--part", "vane"], "is not the part of accepted.json"),
        (["accepted.json", "--format", "din"], "invalid choice: 'din'"),
        (["odd.json"], "its verdict has no status accepted, ambiguous, rejected"),
        (["word.json"], "its verdict has no status"),
    ],
)
def test_bad_input_is_one_line(files: Path, capsys, arguments: list[str], words: str) -> None:
    values = json.loads(Path("accepted.json").read_text())
    Path("odd.json").write_text(json.dumps(values | {"verdict": {"status": "fine"}}))
    Path("word.json").write_text(json.dumps(values | {"verdict": "accepted"}))
    Path("bare.json").write_text(json.dumps(PART_FROM_CAMERA.as_matrix().tolist()))
    assert main(["compensate", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("vanejax: error: ")
    assert err.count("\n") == 1
    assert words in err
    assert not Path("moved.csv").exists()


# how well it is known


PATH = ["--tool-path", "path.csv", "--out", "moved.csv"]


def known_mm(out: str, what: str) -> float:
    """The bound that is printed for the centre, the surface or the tip."""
    return float(re.search(rf"{what} is known to ([\d.]+) mm \(95 %\)", out)[1])


def test_without_a_camera_sigma_the_pose_alone_counts(files: Path, capsys) -> None:
    assert main(["compensate", *CELL, *PATH, "--part", "box.stl"]) == 0
    out = capsys.readouterr().out
    # of the example the largest sigma is 0.006 mm; 0.003 deg at 36 mm are a third of that
    centre = float(magnitude_bound(np.diag([4e-3, 5e-3, 6e-3]) ** 2))
    assert known_mm(out, "centre") == pytest.approx(centre, abs=5e-4)
    assert 0.012 <= known_mm(out, "tool tip") <= known_mm(out, "surface") < 0.02
    assert "by the camera's place" not in out
    assert "\n  the camera's place in the machine is taken as exact (no --camera-sigma)\n" in out
    assert "\n  errors of the camera's own calibration do not count" in out


def test_the_cameras_place_counts_by_its_distance(files: Path, capsys) -> None:
    sigma = ["--camera-sigma", "0.02mm,0.01deg"]
    assert main(["compensate", *CELL, *sigma, *PATH, "--format", "kuka"]) == 0
    out = capsys.readouterr().out
    points = read_tool_path("moved.csv").points
    arms = np.linalg.norm(points - MACHINE_FROM_CAMERA.translation, axis=1)
    sigma = np.stack([np.full_like(arms, 0.02), *[np.hypot(0.02, np.radians(0.01) * arms)] * 2])
    expected = magnitude_bound(sigma.T[:, :, None] ** 2 * np.eye(3))
    worst = int(expected.argmax())
    assert known_mm(out, "tool tip") == pytest.approx(expected[worst], abs=2e-3)  # 0.012 the pose
    place = ", ".join(f"{v:.1f}" for v in points[worst])
    assert f"worst at point {worst + 1} ({place})" in out
    assert f"{expected[worst]:.3f} mm by the camera's place alone" in out
    assert "taken as exact" not in out


def test_what_is_not_known_well_enough_moves_nothing(files: Path, capsys, box: Part) -> None:
    command = ["compensate", *CELL, *PATH]
    for options, words in (
        (
            ["--camera-sigma", "0.02mm,0.1deg"],
            "at most 1 mm is allowed: most of that is the camera",
        ),
        (["--max-uncertainty-mm", "0.01"], "at most 0.01 mm is allowed: scan more of the part"),
    ):
        assert main([*command, *options]) == 3
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert re.match(
            r"vanejax: refused: the tool tip is known to \S+ mm only \(95 %\), worst at", err
        )
        assert words in err
        assert not Path("moved.csv").exists()
    assert main([*command, "--camera-sigma", "0.02mm,0.1deg", "--max-uncertainty-mm", "2"]) == 0
    assert Path("moved.csv").exists()


def test_the_verdicts_tolerance_is_kept(files: Path, capsys) -> None:
    values = json.loads(Path("accepted.json").read_text())
    Path("strict.json").write_text(json.dumps(values | {"tolerance": {"mm": 0.01, "deg": 0.5}}))
    command = ["compensate", "strict.json", "--format", "kuka"]
    assert main(command) == 3
    assert "the part's centre is known to 0.014 mm only (95 %), and" in capsys.readouterr().err
    assert main([*command, "--max-uncertainty-mm", "0.02"]) == 0


UNCHANGED = ({"converged": True}, {"converged": False})


@pytest.mark.parametrize(
    ("form", "words"),
    [
        (
            {"stock_mm": 0.503, "stock_sigma_mm": 0.003},
            "casting has 0.503 +- 0.003 mm of stock: the first cut is that much deeper",
        ),
        (
            {"stock_mm": -0.2, "stock_sigma_mm": 0.01},
            "surface lies 0.200 +- 0.010 mm inside the CAD model: the tool cuts that much less",
        ),
        (
            {"field": "form", "field_mm": 0.12, "field_length_mm": 20.0},
            "off its CAD model by 0.12 mm (1 sigma) over 20 mm beyond the pose: the depth of cut "
            "varies by as much (95 %: 0.24 mm)",
        ),
        ({"field": "range", "field_mm": 0.01}, "the sensor's range seems to vary by 0.01 mm"),
        ({"field": "facing", "field_mm": 0.3}, "differs from face to face by as much (95 %: 0.59"),
        (
            # the corner of the box is 36.4 mm from its centre
            {"scale_error": 0.01, "scale_sigma": 0.001},
            "the camera's scale off, cuts are up to 0.36 +- 0.04 mm deeper, 36 mm from its centre",
        ),
        ({"focal_error": 0.001}, "focal length is off by +0.10% +- 0.00%: the pose allows for it"),
        ({"converged": True}, "no difference from the CAD model shows"),
        ({"converged": False}, "note: the estimate of how the part differs from its CAD model did"),
        ({"is_told": False}, "note: too little smooth surface was measured"),
    ],
)
def test_what_the_form_does_to_the_cut_is_said(
    files: Path, capsys, box: Part, form: dict, words: str
) -> None:
    write_pose("cast.json", box, **form)
    assert main(["compensate", "cast.json", "--part", "box.stl", "--format", "kuka"]) == 0
    out = capsys.readouterr().out
    assert words in out
    assert ("no difference from the CAD model shows" in out) == (form in UNCHANGED)
    assert "note: nothing is known of how the part differs" not in out


def test_of_an_old_file_nothing_more_is_said(files: Path, capsys) -> None:
    Path("bare.json").write_text(json.dumps(PART_FROM_CAMERA.as_matrix().tolist()))
    assert main(["compensate", "bare.json", *CELL[1:], *PATH]) == 0
    out = capsys.readouterr().out
    assert "is known to" not in out
    assert "note: the pose file has no covariance: nothing is known of how far" in out
    assert "note: nothing is known of how the part differs from its CAD model" in out
    assert Path("moved.csv").exists()


# the page


NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"


@pytest.mark.slow
def test_every_command_of_the_page_gives_what_it_shows(tmp_path: Path, monkeypatch, capsys) -> None:
    """In the order of the page; words to the letter, numbers to 0.002.

    A registration differs in its last digits from machine to machine.
    """
    monkeypatch.chdir(tmp_path)
    environment = os.environ | {"PYTHON": sys.executable, "PYTHONPATH": str(ROOT)}
    blocks = re.findall(r"^```(sh|python|text)\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    shown, printed, commands = 0, None, []
    for language, block in blocks:
        if language == "text":
            if printed is None:
                continue  # a drawing
            assert re.sub(NUMBER, "0", printed) == re.sub(NUMBER, "0", block)
            numbers = [[float(n) for n in re.findall(NUMBER, t)] for t in (printed, block)]
            np.testing.assert_allclose(numbers[0], numbers[1], rtol=0, atol=2e-3)
            shown, printed = shown + 1, None
            continue
        if language == "python":
            exec(compile(block, "docs/machine.md", "exec"), {})
            printed = capsys.readouterr().out
            continue
        shell = f'set -e\nvanejax() {{ "$PYTHON" -m vanejax "$@"; }}\n{block}'
        done = subprocess.run(
            ["bash", "-c", shell], env=environment, text=True, capture_output=True, timeout=300
        )
        assert done.returncode == 0, done.stderr
        printed = done.stdout
        commands += re.findall(r"^vanejax (\w+)", block, re.MULTILINE)
    assert commands[:3] == ["scan", "register", "compensate"]
    assert shown == 5
    # the six points to probe see every motion: none of 1 mm, or of 1 mm at 50 mm, hides from all
    targets = read_tool_path("targets.csv")
    moments = np.cross(targets.points - targets.points.mean(axis=0), targets.axes) / 50
    seen = np.linalg.svd(np.concatenate([targets.axes, moments], axis=1), compute_uv=False)
    assert seen.shape == (6,)
    assert seen.min() > 0.1


def test_the_page_names_every_formula_and_option() -> None:
    for notation in NOTATIONS.values():
        for formula in re.findall(r"R = [^:]*?\)(?=[,:;]| *$)", notation.formula):
            assert formula in PAGE, formula
    for option in ("--camera-pose", "--nominal", "--format", "--accept-verdict", "--tool-path"):
        assert option in PAGE
    for option in ("--camera-sigma", "--max-uncertainty-mm"):
        assert option in PAGE
