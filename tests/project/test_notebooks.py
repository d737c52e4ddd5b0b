"""The notebooks run from top to bottom: their code alone, and in a kernel as Jupyter runs them."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from headless_browser import CHROMIUM, HeadlessBrowser

from vanejax.cad.parametric_vane import guide_vane
from vanejax.scanner.camera import Camera, hemisphere_viewpoints
from vanejax.scanner.virtual_scanner import Scanner
from vanejax.scans.scan_file import save_points

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))
# figures and interactive views that a reader sees
SHOWN = {"matching": (3, 1), "registration": (3, 1), "scanner": (2, 1)}
CACHE = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)
EACH = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code_of(path: Path) -> list[str]:
    """The code cells of a notebook, without what only Jupyter understands."""
    cells = json.loads(path.read_text())["cells"]
    return [
        "".join(line for line in cell["source"] if not line.startswith("%"))
        for cell in cells
        if cell["cell_type"] == "code"
    ]


def run_cells(code: list[str], path: Path) -> dict[str, Any]:
    """The names that code cells leave behind; what only shows itself is made and not shown."""
    space: dict[str, Any] = {}
    for cell in code:
        exec(compile(cell, str(path), "exec"), space)
    return space


@EACH
def test_outputs_are_not_committed(path: Path) -> None:
    cells = json.loads(path.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert code
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code)
    assert len({cell["id"] for cell in cells}) == len(cells)


def test_the_notebooks_are_these():
    assert [path.stem for path in NOTEBOOKS] == sorted(SHOWN)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory) -> Path:
    """A folder for compiled programs: the kernel need not compile again what this process did."""
    return tmp_path_factory.mktemp("compiled")


@EACH
def test_every_cell_runs(path: Path, capsys, compiled, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    before = {name: getattr(jax.config, name) for name in CACHE}
    try:
        for name, value in zip(CACHE, (str(compiled), 0.0, -1), strict=True):
            jax.config.update(name, value)
        space = run_cells(code_of(path), path)
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
    assert list(tmp_path.iterdir()) == []  # nothing is left where the reader stands
    if path.stem == "scanner":
        assert space["off"].max() < 1e-3  # f32 points, 400 mm away
        assert "216 viewpoints, 54 of them for tests" in capsys.readouterr().out
    if path.stem == "registration":
        for result in (space["result"], space["again"]):
            assert result.verdict.status == "accepted"
        assert space["rotation_error_deg"] < 0.01  # its sigma is 0.001 deg
        assert space["chi_squared"] < 22.5  # 99.9 % of right poses
        saved = json.loads(space["pose_file"].read_text())
        assert saved["part_from_camera"] == space["result"].part_from_camera.as_matrix().tolist()
        assert "Accepted" in space["report_file"].read_text()
    if path.stem == "matching":
        before, after = (
            space["matching"](space[name][-1], space["pair"]) for name in ("untrained", "trained")
        )
        assert after.right_share(10.0) > 1.3 * before.right_share(10.0)  # after 40 steps
        # 95 % of the test views are within 1.04 deg
        assert space["degrees"] < 2.0
        assert space["mm"] < 2.0
        found = space["matching"](space["shown"][-1], space["shown_pair"])
        assert found.right_share(10.0) > 0.8


def test_registration_takes_the_readers_own_files(tmp_path) -> None:
    """A scan in metres and a CAD file in inches, in place of the example."""
    (path,) = (path for path in NOTEBOOKS if path.stem == "registration")
    part = guide_vane()
    (tmp_path / "data").mkdir()
    names = {"scan_file": tmp_path / "data" / "mine.csv", "part_file": tmp_path / "cad.stl"}
    view = hemisphere_viewpoints(part.center).view(100)
    scan = Scanner(part, surface_samples=1000).scan(Camera().scaled(0.3), view)
    save_points(names["scan_file"], scan.points.astype(np.float64) / 1000)
    mesh = part.mesh.copy()
    mesh.apply_scale(1 / 25.4)
    mesh.export(names["part_file"])
    code = code_of(path)
    assert 'part_units = "mm"' in code[0]
    code[0] = code[0].replace('part_units = "mm"', 'part_units = "in"')
    for name, file in names.items():
        assert f'{name} = ""' in code[0]
        code[0] = code[0].replace(f'{name} = ""', f"{name} = {str(file)!r}")
    space = run_cells(code, path)
    assert space["truth"] is None
    assert space["result"].verdict.status == "accepted"
    off = view @ space["result"].part_from_camera
    assert np.linalg.norm(off.apply(scan.points[:1]) - scan.points[:1]) < 0.05  # mm; no noise
    written = sorted(file.name for file in (tmp_path / "data").iterdir())
    assert written == ["mine.csv", "mine_pose.json", "mine_report.html"]


@pytest.fixture(scope="module")
def executed(tmp_path_factory, compiled):
    """Gives a notebook's cells after a kernel has run it, each notebook once."""
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    pytest.importorskip("ipykernel", reason="ipykernel is not installed")
    import nbformat

    done: dict[Path, Any] = {}

    def run(path: Path) -> Any:
        if path not in done:
            notebook = nbformat.read(path, as_version=4)
            nbformat.validate(notebook)
            folder = tmp_path_factory.mktemp(path.stem)
            cache = zip(CACHE, (str(compiled), "0", "-1"), strict=True)
            environment = os.environ | {name.upper(): value for name, value in cache}
            client = nbclient.NotebookClient(
                notebook, timeout=300, kernel_name="python3",
                resources={"metadata": {"path": str(folder)}},
            )  # fmt: skip
            client.execute(env=environment)
            done[path] = notebook.cells
        return done[path]

    return run


def outputs(cells: Any) -> list[Any]:
    return [output for cell in cells if cell.cell_type == "code" for output in cell.outputs]


@EACH
def test_a_kernel_shows_every_picture(path: Path, executed) -> None:
    found = outputs(executed(path))
    assert [o for o in found if o.output_type == "error"] == []
    # a box of warnings would be the first thing that a reader sees
    assert "".join(o.text for o in found if o.get("name") == "stderr") == ""
    shown = [o.data for o in found if o.output_type in ("execute_result", "display_data")]
    figures = sum("image/png" in data for data in shown)
    views = sum("<iframe" in data.get("text/html", "") for data in shown)
    assert (figures, views) == SHOWN[path.stem]


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium or google-chrome on the PATH")
@EACH
def test_a_browser_shows_it_without_a_network(path: Path, executed, tmp_path) -> None:
    """All outputs one below the other, as an exported notebook has them."""
    body = []
    for output in outputs(executed(path)):
        data = output.get("data", {})
        if "text/html" in data:
            body.append(data["text/html"])
        elif "image/png" in data:
            body.append(f'<p><img src="data:image/png;base64,{data["image/png"]}">')
    page = tmp_path / "notebook.html"
    page.write_text("<!doctype html><link rel=icon href='data:,'><body>" + "\n".join(body))
    with HeadlessBrowser() as browser:
        browser.open(page, height=5000)  # a frame out of sight is not drawn
        pictures = "[...document.images].map(i => i.complete && i.naturalWidth > 300)"
        assert browser.evaluate(pictures) == [True] * SHOWN[path.stem][0]
        frame = "document.querySelector('iframe')"
        box = browser.evaluate(
            f"(({{x, y, width, height}}) => ({{x, y: y + scrollY, width, height}}))"
            f"({frame}.getBoundingClientRect())"
        )
        for _ in range(100):  # the frame loads on its own
            browser.settle()
            pixels = np.round(255 * browser.screenshot(box)) @ (65536, 256, 1)
            colors = len(np.unique(pixels))
            if colors > 300:
                break
        assert colors > 300  # the shaded part; the page around it has some dozens
        assert browser.requests() == [page.as_uri()]
        assert browser.complaints() == []
