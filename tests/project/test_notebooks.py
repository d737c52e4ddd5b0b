"""The notebooks hold the outputs of their code, and running them gives the same outputs."""

from __future__ import annotations

import html
import json
import tempfile
from pathlib import Path
from types import SimpleNamespace

import nbformat
import numpy as np
import pytest

from experiments import notebooks
from vanejax import Camera, Scanner, guide_vane, hemisphere_viewpoints, save_points
from vanejax.errors import InputError

PATHS = sorted(notebooks.FOLDER.glob("*.ipynb"))
EACH = pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
PICTURES = {"matching": 4, "registration": 4, "scanner": 3}
# what must hold in the kernel when all cells have run
CHECKS = {
    "scanner": "assert distance_mm.max() < 1e-3  # f32 points, 400 mm away",
    "registration": """
import json
assert result.verdict.status == again.verdict.status == "accepted"
assert rotation_error_deg < 0.01  # its sigma is 0.001 deg
assert chi_squared < 22.5  # 99.9 % of right poses
written = json.loads(pose_file.read_text())["part_from_camera"]
assert written == result.part_from_camera.as_matrix().tolist()
assert "Accepted" in report_file.read_text()
""",
    "matching": """
shares = [matching(m[-1], pair).right_share(10.0) for m in (untrained, trained)]
assert shares[1] > 1.3 * shares[0]  # after 40 steps
assert matching(shown[-1], shown_pair).right_share(10.0) > 0.8
assert degrees < 2.0 and mm < 2.0  # 95 % of the test views are within 1.04 deg
""",
}


def read(path: Path) -> nbformat.NotebookNode:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    return notebook


@EACH
def test_the_stored_outputs_are_of_this_code(path: Path) -> None:
    """If this is red: python -m experiments.notebooks"""
    notebook = read(path)
    assert notebook.metadata["outputs_of"] == notebooks.source_hash(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    assert all(cell.outputs for cell in code if "print(" in cell.source)
    kinds = {output.output_type for output in outputs}
    assert kinds <= {"stream", "execute_result", "display_data"}  # no error
    assert {output.name for output in outputs if output.output_type == "stream"} == {"stdout"}
    pictures = [
        output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})
    ]
    assert len(pictures) == PICTURES[path.stem]
    assert max(map(len, pictures)) * 3 / 4 <= notebooks.MAX_PICTURE_BYTES
    assert path.stat().st_size < 400_000
    assert f"{tempfile.gettempdir()}/" not in path.read_text()  # where they were run


@EACH
@pytest.mark.slow
def test_running_them_gives_the_stored_texts(path: Path, tmp_path) -> None:
    stored, notebook = read(path), read(path)
    notebook.cells.append(nbformat.v4.new_code_cell(CHECKS[path.stem]))
    notebooks.execute(notebook, tmp_path)
    assert list(tmp_path.iterdir()) == []  # nothing is left where the reader stands
    assert notebook.cells.pop().outputs == []
    assert notebooks.texts(notebook) == notebooks.texts(stored)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    # a box of warnings would be the first thing that a reader sees
    assert not any(output.get("name") == "stderr" for output in outputs)
    data = [output.data for output in outputs if "data" in output]
    figures = sum("image/png" in entry for entry in data)
    views = sum("<script" in html.unescape(entry.get("text/html", "")) for entry in data)
    assert (figures, views) == (PICTURES[path.stem] - 1, 1)


@pytest.mark.slow
def test_registration_takes_the_readers_own_files(tmp_path) -> None:
    """A scan in metres and a CAD file in inches, in place of the example."""
    part = guide_vane()
    files = {"scan_file": tmp_path / "mine.csv", "part_file": tmp_path / "cad.stl"}
    view = hemisphere_viewpoints(part.center).view(100)
    scan = Scanner(part, surface_samples=1000).scan(Camera().scaled(0.3), view)
    save_points(files["scan_file"], scan.points.astype(np.float64) / 1000)
    mesh = part.mesh.copy()
    mesh.apply_scale(1 / 25.4)
    mesh.export(files["part_file"])
    notebook = read(notebooks.FOLDER / "registration.ipynb")
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    for name, old, new in (
        ("part_units", '"mm"', '"in"'),
        *((name, '""', repr(str(file))) for name, file in files.items()),
    ):
        assert f"{name} = {old}" in code[0]
        code[0] = code[0].replace(f"{name} = {old}", f"{name} = {new}")
    space: dict = {}
    for cell in code:
        exec(compile(cell.replace("%matplotlib inline\n", ""), "registration.ipynb", "exec"), space)
    assert space["truth"] is None
    assert space["result"].verdict.status == "accepted"
    motion = view @ space["result"].part_from_camera
    assert np.linalg.norm(motion.apply(scan.points[:1]) - scan.points[:1]) < 0.05  # mm; no noise
    written = {file.name for file in tmp_path.iterdir()} - {file.name for file in files.values()}
    assert written == {"mine_pose.json", "mine_report.html"}


def test_the_command_runs_a_notebook_and_stores_its_outputs(tmp_path, monkeypatch, capsys) -> None:
    plot = "%matplotlib inline\nimport matplotlib.pyplot as plt\nprint('3.5 mm')\nplt.plot([1, 2]);"
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(plot)])
    nbformat.write(notebook, tmp_path / "own.ipynb")
    monkeypatch.setattr(notebooks, "FOLDER", tmp_path)
    monkeypatch.setattr(notebooks, "ROOT", tmp_path)
    notebooks.main(SimpleNamespace(names=["own"]))
    assert capsys.readouterr().out.startswith("own.ipynb: ")
    (cell,) = read(tmp_path / "own.ipynb").cells
    assert cell.execution_count == 1
    assert cell.outputs[0].text == "3.5 mm\n"
    assert "image/png" in cell.outputs[1].data
    changed = json.loads((tmp_path / "own.ipynb").read_text())
    assert changed["metadata"]["outputs_of"] == notebooks.source_hash(notebook)
    notebook.cells[0].source += "  # changed"
    assert changed["metadata"]["outputs_of"] != notebooks.source_hash(notebook)
    with pytest.raises(InputError, match="no notebook theirs"):
        notebooks.main(SimpleNamespace(names=["theirs"]))
