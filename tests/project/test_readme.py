"""What the README shows of registration runs as it is written."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from vanejax.cad.parametric_vane import guide_vane
from vanejax.cli.program import main

README = (Path(__file__).parents[2] / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("readme")


@pytest.fixture(autouse=True)
def _there(folder: Path, monkeypatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("VANEJAX_CACHE_DIR", "off")


def test_the_commands_register_a_scan(capsys) -> None:
    (block,) = [b for b in blocks("sh") if "vanejax register" in b]
    commands = [
        shlex.split(line, comments=True)[1:]
        for line in block.splitlines()
        if line.startswith("vanejax ")
    ]
    assert [command[0] for command in commands] == ["scan", "register"]
    for command in commands:
        assert main(command) == 0
    assert capsys.readouterr().out.startswith("scans: 6 scans")
    pose = np.array(json.loads(Path("pose.json").read_text())["part_from_camera"])
    label = json.loads(Path("scans/labels.json").read_text())["views"][0]
    truth = np.linalg.inv(np.array(label["camera_from_part"]))
    np.testing.assert_allclose(pose, truth, atol=0.01)  # 400 mm times 1e-5 rad, and 0.0003 mm
    assert Path("pose.html").stat().st_size > 10_000


def test_the_python_example_registers_a_file() -> None:
    guide_vane().export("part.stl")
    assert main(["scan", "vane", "--out", "one", "--views", "0,", "--resolution", "0.5"]) == 0
    Path("one/view_000.ply").rename("scan.ply")
    (block,) = [b for b in blocks("python") if "vanejax.register(" in b]
    space: dict[str, object] = {}
    exec(compile(block, "README.md", "exec"), space)
    assert space["result"].verdict.status == "accepted"
