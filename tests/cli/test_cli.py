"""The command line as a person meets it: what it prints, what it writes, how it fails."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from example_result import example_result, pose

import vanejax.localization.registration
import vanejax.report
import vanejax.training.export
from vanejax.cad import Part, guide_vane, part_from_mesh
from vanejax.cli.pose_summary import summary, verdict_line
from vanejax.cli.program import main
from vanejax.cli.register import wants_color
from vanejax.cli.scan import parse_views
from vanejax.localization.pose_result import FormDeviation
from vanejax.machine.pose_file import pose_to_dict, read_pose
from vanejax.scanner import Camera, Scanner, hemisphere_viewpoints
from vanejax.scans.scan_file import load_scan

ROOT = Path(__file__).parents[2]
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
CORNERS = np.array([[0, 0, 0], [70, 0, 0], [0, 60, 0], [0, 0, 50.0]])


@pytest.fixture(autouse=True)
def _colors(monkeypatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)


@pytest.fixture(scope="module")
def wedge() -> Part:
    return part_from_mesh(CORNERS, FACES, name="wedge")


@pytest.fixture(scope="module")
def files(wedge: Part, tmp_path_factory) -> Path:
    """A folder with wedge.stl and a scan of it, scan.ply, made with our own command."""
    folder = tmp_path_factory.mktemp("files")
    wedge.export(folder / "wedge.stl")
    made = ["--out", str(folder / "scans"), "--views", "40,", "--resolution", "0.1", "--quiet"]
    assert main(["scan", str(folder / "wedge.stl"), *made]) == 0
    (folder / "scans" / "view_040.ply").rename(folder / "scan.ply")
    return folder


class Register:
    """Stands in for `vanejax.localization.registration.register`: keeps what it was called with."""

    def __init__(self, answer: Any) -> None:
        self.answer, self.calls = answer, []

    def __call__(self, scan: Any, part: Any, **options: Any) -> Any:
        self.calls.append((scan, part, options))
        if isinstance(self.answer, BaseException):
            raise self.answer
        return self.answer


@pytest.fixture
def fake(monkeypatch) -> Callable[[Any], Register]:
    def make(answer: Any) -> Register:
        register = Register(answer)
        monkeypatch.setattr(vanejax.localization.registration, "register", register)
        return register

    return make


def register(files: Path, *options: Any) -> int:
    given = map(str, options)
    return main(["register", str(files / "scan.ply"), str(files / "wedge.stl"), *given])


@pytest.mark.parametrize(("status", "code"), [("accepted", 0), ("ambiguous", 3), ("rejected", 4)])
def test_the_exit_code_is_the_verdict(files, fake, capsys, status: str, code: int) -> None:
    fake(example_result(status))
    assert register(files) == code
    out, err = capsys.readouterr()
    assert err == ""
    lines = out.splitlines()
    assert lines[0] == f"{status.upper()}: made up to be {status}"
    assert "\x1b" not in out
    assert ("turned by 180.00 deg" in out) == (status == "ambiguous")


def test_the_summary_has_the_figures(files, fake, capsys) -> None:
    fake(example_result())
    register(files)
    out = capsys.readouterr().out
    for words in (
        "1.5000     -2.2500    400.1250 mm",
        "10.0000    -20.0000     30.0000 deg (fixed axes x, y, z)",
        "0.0040      0.0050      0.0060 mm, at most 0.0061 along (+0.00, +0.60, +0.80)",
        "0.0010      0.0020      0.0030 deg, at most 0.0030 about (+0.00, +0.00, +1.00)",
        "75.0 % of 8 points, within 0.31 mm",
        "violations   12.5 %",
        "unmeasured   3.1 %",
        "0.1012 mm; ray casting, 9 iterations, converged, 6 of 8 points",
        "note: 2 points were dropped",
        "search 1.25 s, refinement 0.50 s, total",
    ):
        assert words in out


@pytest.mark.parametrize(
    ("form", "line"),
    [
        (None, None),
        (FormDeviation(), "no difference from the CAD model shows"),
        (FormDeviation(is_told=False), "unknown: too little smooth surface was measured"),
        (
            FormDeviation(stock_mm=0.5026, stock_sigma_mm=0.0025, field="form", field_mm=0.1),
            "stock 0.503 +- 0.003 mm; the surface varies by 0.1 mm",
        ),
    ],
)
def test_the_form_has_one_line(form: FormDeviation | None, line: str | None) -> None:
    result = example_result()
    refinement = dataclasses.replace(result.refinement, form=form)
    text = summary(dataclasses.replace(result, refinement=refinement), color=False, seconds={})
    found = [words[6:].strip() for words in text.splitlines() if words.startswith("  form ")]
    assert found == ([] if line is None else [line])


def test_what_is_not_known_is_said(files, fake, capsys) -> None:
    fake(example_result(sensor=False))
    assert register(files, "--sensor-origin", "unknown") == 0
    out = capsys.readouterr().out
    assert "violations   unknown" in out
    assert "nan" not in out.lower()


def test_colours_are_for_terminals_that_want_them(monkeypatch) -> None:
    verdict = example_result("rejected").verdict
    assert verdict_line(verdict, color=True).startswith("\x1b[1;31mREJECTED\x1b[0m: ")
    monkeypatch.setenv("TERM", "xterm")
    assert not wants_color()
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    assert wants_color()
    monkeypatch.setenv("NO_COLOR", "1")
    assert not wants_color()
    monkeypatch.setenv("NO_COLOR", "")
    monkeypatch.setenv("TERM", "dumb")
    assert not wants_color()


def test_everything_reaches_register(files, fake, wedge: Part, tmp_path: Path) -> None:
    called = fake(example_result()).calls
    guess = pose((5.0, 6.0, 7.0), (1.0, 2.0, 3.0))
    (tmp_path / "guess.json").write_text(json.dumps(pose_to_dict(guess)))
    options = ["--init", tmp_path / "guess.json", "--seed", "7"]
    assert register(files, *options, "--sensor-origin", "-1,2.5,3e1") == 0
    ((scan, part, given),) = called
    assert part.sha256 == wedge.sha256
    assert scan.name == "scan"
    np.testing.assert_array_equal(scan.sensor_origin, [-1.0, 2.5, 30.0])
    # f64 rounding of the nearest rotation
    np.testing.assert_allclose(given["init"].as_matrix(), guess.as_matrix(), rtol=0, atol=1e-14)
    assert (given["seed"], given["weights"]) == (7, None)
    assert str(given["symmetry"]) == "none"
    assert register(files, "--sensor-origin=unknown", "--symmetry", "z:any,x:180") == 0
    assert str(called[1][2]["symmetry"]) == "z:any,x:180"
    assert called[1][0].sensor_origin is None
    assert called[1][2]["init"] is None


def test_units_are_those_given(files, fake, tmp_path: Path, wedge: Part) -> None:
    called = fake(example_result()).calls
    points = load_scan(files / "scan.ply").points
    np.savetxt(tmp_path / "metres.xyz", points / 1000)
    part_from_mesh(CORNERS / 10, FACES, name="small").export(tmp_path / "centimetres.stl")
    arguments = ["register", str(tmp_path / "metres.xyz"), str(tmp_path / "centimetres.stl")]
    assert main([*arguments, "--units-scan", "m", "--units-cad", "cm"]) == 0
    ((scan, part, _),) = called
    # savetxt writes 19 digits; the part's corners are float32
    np.testing.assert_allclose(scan.points, points, rtol=1e-12)
    np.testing.assert_allclose(part.extent_mm, wedge.extent_mm, rtol=1e-6)
    # not told, metres are known by the size of the part
    assert main([*arguments, "--units-cad", "cm"]) == 0
    np.testing.assert_allclose(called[1][0].points, points, rtol=1e-12)


def test_json_and_report_are_written(files, fake, capsys, monkeypatch, tmp_path, wedge) -> None:
    result = example_result("ambiguous")
    fake(result)
    reports = []
    monkeypatch.setattr(
        vanejax.report, "write_report", lambda *given, limits: reports.append(given)
    )
    outputs = ["--json", tmp_path / "pose.json", "--report", tmp_path / "report.html"]
    asked = ["--calibration", "paper_camera", "--tolerance", "0.2mm,0.1deg"]
    assert register(files, *outputs, *asked) == 3
    values = json.loads((tmp_path / "pose.json").read_text())
    assert values["calibration"] == "paper_camera"
    assert values["tolerance"] == {"mm": 0.2, "deg": 0.1}
    assert values["part"] == {"name": "wedge", "sha256": wedge.sha256}
    assert values["verdict"]["status"] == "ambiguous"
    found = read_pose(tmp_path / "pose.json")
    np.testing.assert_allclose(
        found.as_matrix(), result.part_from_camera.as_matrix(), rtol=0, atol=1e-12
    )
    ((path, told, scan, part),) = reports
    assert Path(path) == tmp_path / "report.html"
    assert told is result
    assert (scan.name, part.sha256) == ("scan", wedge.sha256)
    # what was written serves as a guess, and may be written over
    assert register(files, "--init", tmp_path / "pose.json", "--json", tmp_path / "pose.json") == 3


MIRROR = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "COMMAND"),
        (["register", "scan.ply"], "required: CAD"),
        (["register", "scan.ply", "wedge.stl", "--iint", "x"], "unrecognized arguments: --iint"),
        (["register", "none.ply", "wedge.stl"], "none.ply: no such file"),
        (["register", "scan.ply", "none.stl"], "none.stl: no such file"),
        (["register", "text.docx", "wedge.stl"], "text.docx: .*docx"),
        (["register", "scan.ply", "text.docx"], "text.docx: cannot read .docx"),
        (["register", "cut.ply", "wedge.stl"], "cut.ply"),
        (["register", "scan.ply", "wedge.stl", "--units-scan", "ell"], "unknown unit 'ell'"),
        (["register", "scan.ply", "wedge.stl", "--units-cad", "ell"], "unknown unit 'ell'"),
        (["register", "scan.ply", "wedge.stl", "--units-cad", "m"], "read as m the part is"),
        (["register", "scan.ply", "wedge.stl", "--init", "mirror.json"], "mirror image"),
        (["register", "scan.ply", "wedge.stl", "--init", "none.json"], "none.json: no such file"),
        (["register", "scan.ply", "wedge.stl", "--weights", "none.npz"], "none.npz: no such file"),
        (["register", "scan.ply", "wedge.stl", "--weights", "text.docx"], "not a weights file"),
        (
            ["register", "scan.ply", "wedge.stl", "--tolerance", "1mm"],
            "a length and an angle above",
        ),
        (
            ["register", "scan.ply", "wedge.stl", "--symmetry", "w:180"],
            "symmetry w:180: w:180 is no axis and angle",
        ),
        (
            ["register", "scan.ply", "wedge.stl", "--symmetry", "z:100"],
            "100 deg is no half, third or other whole part of 360 deg",
        ),
        (["register", "scan.ply", "wedge.stl", "--calibration", "ideal"], "'ideal' has no errors"),
        (["register", "scan.ply", "wedge.stl", "--sensor-origin", "here"], "here: should be X,Y,Z"),
        (["register", "scan.ply", "wedge.stl", "--sensor-origin", "1,2"], "should be X,Y,Z"),
        (["register", "scan.ply", "wedge.stl", "--sensor-origin", "1,2,nan"], "should be X,Y,Z"),
        (["register", "scan.ply", "wedge.stl", "--json", "no/out.json"], "No such file or direct"),
        (["register", "scan.ply", "wedge.stl", "--json", "./scan.ply"], "is SCAN already"),
        (["register", "scan.ply", "wedge.stl", "--report", "no/out.html"], "No such file or dir"),
        (["register", "scan.ply", "wedge.stl", "--report", "out.pdf"], "should end in .html"),
        (
            ["register", "scan.ply", "wedge.stl", "--json", "a.html", "--report", "a.html"],
            "is --json already",
        ),
        (["scan", "wedge.stl"], "required: --out"),
        (["scan", "none.stl", "--out", "new"], "none.stl: no such file"),
        (["scan", "wedge.stl", "--out", "."], "is not empty; choose another folder, or --force"),
        (["scan", "wedge.stl", "--out", "scan.ply"], "scan.ply: is a file"),
        (["scan", "wedge.stl", "--out", "scan.ply/new"], "cannot be used: Not a directory"),
        (["scan", "wedge.stl", "--out", "new", "--views", "many"], "--views many: should be"),
        (["scan", "wedge.stl", "--out", "new", "--views", "217"], "there are 1 to 216"),
        (["scan", "wedge.stl", "--out", "new", "--views", "0,216"], "there is no 216"),
        (["scan", "wedge.stl", "--out", "new", "--views", "3,3"], "twice"),
        (["scan", "wedge.stl", "--out", "new", "--noise-mm", "-1"], "--noise-mm -1.0: should be"),
        (["scan", "wedge.stl", "--out", "new", "--noise-mm", "nan"], "--noise-mm nan: should be"),
        (["scan", "wedge.stl", "--out", "new", "--seed", "-1"], "--seed -1: should be 0 or more"),
        (["scan", "wedge.stl", "--out", "new", "--resolution", "0"], "must be positive"),
        (["inspect", "none.ply"], "none.ply"),
        (["export", "."], "run.json: no such file"),
        (["export", "none"], "none: no such folder"),
        (["export", ".", "--out", "no/vane.npz"], "No such file or directory"),
    ],
)
def test_bad_input_is_one_line_and_no_work(
    files, fake, capsys, monkeypatch, tmp_path, arguments: list[str], words: str
) -> None:
    called = fake(AssertionError("registered all the same")).calls
    for name in ("scan.ply", "wedge.stl"):
        (tmp_path / name).write_bytes((files / name).read_bytes())
    (tmp_path / "cut.ply").write_bytes((files / "scan.ply").read_bytes()[:-100])
    (tmp_path / "text.docx").write_text("words")
    (tmp_path / "mirror.json").write_text(json.dumps({"part_from_camera": MIRROR}))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("vanejax: error: ")
    assert err.count("\n") == 1
    assert re.search(words, err), err
    assert not called
    left = {path: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    assert left == before


def test_trouble_on_the_way_is_one_line_and_a_bug_is_not_hidden(files, fake, capsys) -> None:
    full = OSError(errno.ENOSPC, "No space left on device", "pose.json")
    for trouble, code, words in (
        (KeyboardInterrupt(), 130, "interrupted"),
        (full, 1, "error: pose.json: No space left on device"),
        (MemoryError(), 1, "error: not enough memory"),
    ):
        fake(trouble)
        assert register(files) == code
        assert capsys.readouterr().err == f"vanejax: {words}\n"
    fake(ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        register(files)


def distance_from_planes(points: np.ndarray) -> np.ndarray:
    """[N, 4] mm: how far points [N, 3], part frame, are from the planes of the wedge's faces."""
    a, b, c = CORNERS[FACES].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.abs(np.einsum("fi,nfi->nf", normals, points[:, None] - a[None]))


def scanned(files: Path, out: Path, *options: str) -> tuple[dict[str, Any], list[Any]]:
    """Labels and scans that the command makes of the wedge."""
    arguments = ["scan", str(files / "wedge.stl"), "--out", str(out), "--quiet", *options]
    assert main(arguments) == 0
    return scans_of(out)


def scans_of(folder: Path) -> tuple[dict[str, Any], list[Any]]:
    labels = json.loads((folder / "labels.json").read_text())
    return labels, [load_scan(folder / row["file"], units="mm") for row in labels["views"]]


def test_scans_lie_on_the_part_where_the_labels_say(files, tmp_path, wedge, capsys) -> None:
    out = tmp_path / "new" / "scans"
    labels, scans = scanned(files, out, "--resolution", "0.1", "--views", "0,5,100")
    printed = capsys.readouterr()
    assert printed.err == ""
    assert f"{out}: 3 scans of wedge, " in printed.out
    assert {path.name for path in out.iterdir()} == {
        "labels.json",
        *(f"view_{view:03d}.ply" for view in (0, 5, 100)),
    }
    assert labels["part"]["sha256"] == wedge.sha256
    assert labels["camera"]["width"] == 128
    viewpoints = hemisphere_viewpoints(wedge.center)
    for row, scan in zip(labels["views"], scans, strict=True):
        assert row["points"] == len(scan.points) > 100
        camera_from_part = np.array(row["camera_from_part"])
        view = viewpoints.view(row["view"])
        np.testing.assert_array_equal(camera_from_part, view.as_matrix())
        gaps = distance_from_planes(view.inverse().apply(scan.points))
        assert gaps.min(axis=1).max() < 1e-4  # f32 at 400 mm
        facing = np.einsum("ni,ni->n", scan.normals, -scan.points)
        assert (facing > 0).all()


def test_noise_is_along_the_ray_and_repeatable(files, tmp_path, wedge) -> None:
    def run(name: str, *options: str) -> np.ndarray:
        view = ("--views", "100,", "--resolution", "0.3", "--format", "npz")
        return scanned(files, tmp_path / name, *view, *options)[1][0].points

    clean = run("clean")
    noisy = run("noisy", "--noise-mm", "0.5")
    np.testing.assert_array_equal(noisy, run("again", "--noise-mm", "0.5"))
    assert (noisy != run("other", "--noise-mm", "0.5", "--seed", "1")).any()
    away = np.linalg.norm(clean, axis=1)
    along = np.linalg.norm(noisy, axis=1) - away
    assert len(clean) > 2000
    # f32 at 400 mm
    drawn = np.random.default_rng([0, 100]).normal(scale=0.5, size=len(along))
    np.testing.assert_allclose(along, drawn, rtol=0, atol=1e-4)
    np.testing.assert_allclose(noisy / (away + along)[:, None], clean / away[:, None], atol=1e-6)
    ideal = Scanner(wedge).scan(Camera().scaled(0.3), hemisphere_viewpoints(wedge.center).view(100))
    np.testing.assert_array_equal(clean, ideal.points)


@pytest.mark.parametrize("suffix", ["ply", "npz", "xyz", "pcd"])
def test_every_format_is_read_again(files, tmp_path, suffix: str) -> None:
    options = ("--views", "2", "--resolution", "0.1", "--format", suffix)
    labels, scans = scanned(files, tmp_path / "scans", *options)
    assert [row["file"] for row in labels["views"]] == [f"view_000.{suffix}", f"view_215.{suffix}"]
    assert [row["points"] for row in labels["views"]] == [len(scan.points) for scan in scans]


def test_a_folder_that_is_not_empty_needs_force(files, tmp_path, capsys) -> None:
    arguments = ["scan", str(files / "wedge.stl"), "--out", str(tmp_path), "--resolution", "0.1"]
    arguments += ["--quiet", "--views", "1"]
    assert main(arguments) == 0
    assert main(arguments) == 2
    assert "--force" in capsys.readouterr().err
    (tmp_path / "labels.json").write_text("stale")
    assert main([*arguments, "--force"]) == 0
    assert json.loads((tmp_path / "labels.json").read_text())["units"] == "mm"


def test_a_scan_that_fails_leaves_no_labels(files, tmp_path, capsys) -> None:
    (tmp_path / "labels.json").write_text("stale")
    arguments = ["scan", str(files / "wedge.stl"), "--out", str(tmp_path), "--force", "--quiet"]
    assert main([*arguments, "--views", "1", "--distance-mm", "5000"]) == 2
    assert "view 0: the part lies" in capsys.readouterr().err
    assert not (tmp_path / "labels.json").exists()


def test_views_are_spread_or_listed() -> None:
    is_test = hemisphere_viewpoints(np.zeros(3)).is_test
    assert parse_views("216", is_test) == list(range(216))
    assert parse_views("1", is_test) == [0]
    assert parse_views("7,", is_test) == [7]
    assert parse_views("9,0,5", is_test) == [9, 0, 5]
    assert parse_views("test", is_test) == np.flatnonzero(is_test).tolist()
    six = np.array(parse_views("6", is_test))
    assert len(set(six // 36)) == 6  # elevations
    assert len(set(six % 36)) == 6  # azimuths


def test_the_guide_vane_needs_no_file(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ["scan", "vane", "--views", "1", "--resolution", "0.1", "--quiet", "--out"]
    assert main([*arguments, "scans"]) == 0
    labels, _ = scans_of(tmp_path / "scans")
    assert labels["part"]["sha256"] == guide_vane().sha256
    (tmp_path / "vane").write_text("a file of that name goes first")
    assert main([*arguments, "other"]) == 2


def test_inspect_speaks_and_writes_json(files, capsys) -> None:
    assert main(["inspect", str(files / "scan.ply")]) == 0
    text = capsys.readouterr().out
    assert "point cloud" in text
    assert main(["inspect", "--json", str(files / "wedge.stl")]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["watertight"] is True


def test_export_says_what_it_wrote(monkeypatch, tmp_path, capsys) -> None:
    class Matcher:
        part_name, part_sha256, trained = "vane", "ab" * 32, {"step": 40}

    def export(workdir: str, path: Path, *, checkpoint: str) -> Matcher:
        path.write_bytes(b"x" * 2_000_000)
        assert (workdir, checkpoint) == (str(tmp_path), "last")
        return Matcher()

    monkeypatch.setattr(vanejax.training.export, "export_workdir", export)
    assert main(["export", str(tmp_path), "--checkpoint", "last"]) == 0
    assert capsys.readouterr().out == (
        f"{tmp_path}/model.safetensors: RPM-Net for vane (sha256 abababababab), step 40, 2.0 MB\n"
    )


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "vanejax", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100)


def test_as_a_process_it_fails_in_one_line() -> None:
    done = run("register", "none.ply", "none.stl")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("vanejax: error: none.stl: no such file")
    assert done.stderr.count("\n") == 1


def test_help_and_version() -> None:
    done = run("--help")
    assert (done.returncode, done.stderr) == (0, "")
    for name in ("register", "scan", "inspect", "export", "exit codes"):
        assert name in done.stdout
    done = run("--version")
    assert (done.returncode, done.stdout[:8]) == (0, "vanejax ")


def modules_after(program: str, folder: Path) -> set[str]:
    """The top-level packages that a program has loaded at its end."""
    program += "; import sys; print('\\n', *{name.split('.')[0] for name in sys.modules})"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.parametrize(
    "program",
    ["import vanejax", "from vanejax.cli import program; program.main(['register', '--help'])"],
)
def test_the_package_and_help_load_nothing_heavy(program, tmp_path) -> None:
    loaded = modules_after(program, tmp_path)
    assert "vanejax" in loaded
    assert not loaded & {"numpy", "scipy", "jax", "flax", "trimesh", "matplotlib"}


@pytest.mark.parametrize(
    "arguments",
    [
        ["inspect", "scan.ply"],
        ["register", "scan.ply", "wedge.stl", "--quiet"],
        ["scan", "wedge.stl", "--out", "scans", "--views", "40,", "--quiet"],
    ],
    ids=" ".join,
)
def test_who_needs_no_network_does_not_wait_for_jax(files, tmp_path, arguments) -> None:
    arguments = [str(files / word) if "." in word else word for word in arguments]
    program = f"from vanejax.cli.program import main; assert main({arguments}) in (0, 3, 4)"
    loaded = modules_after(program, tmp_path)
    assert "numpy" in loaded
    assert not loaded & {"jax", "flax", "matplotlib"}
