"""The notebooks' code runs from top to bottom, without Jupyter."""

import json
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_cell_runs(path: Path, capsys) -> None:
    cells = json.loads(path.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert code
    assert all(not cell["outputs"] for cell in cells if cell["cell_type"] == "code")
    space: dict[str, object] = {}
    for cell in code:
        exec(compile(cell, str(path), "exec"), space)
    if path.stem == "scanner":
        assert space["off"].max() < 1e-3  # f32 points, 400 mm away
        assert "216 viewpoints, 54 of them for tests" in capsys.readouterr().out
    if path.stem == "registration":
        for result in (space["result"], space["again"]):
            assert result.verdict.status == "accepted"
        assert space["rotation_error_deg"] < 0.01  # its sigma is 0.0015 deg
        assert space["chi_squared"] < 22.5  # 99.9 % of right poses
