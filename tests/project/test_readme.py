"""The README: short, its first screen, and everything that it shows runs as it is written."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from vanejax.cli.program import main

README = (Path(__file__).parents[2] / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.DOTALL | re.MULTILINE)


def test_it_is_short_and_starts_with_the_picture_and_the_two_commands() -> None:
    assert len(README.split()) <= 1500
    first_screen = README.partition("\n## ")[0]
    assert len(first_screen.splitlines()) < 35
    assert "](docs/overview.png)" in first_screen
    train, test = blocks("sh")[0].splitlines()
    assert blocks("sh")[0] in first_screen
    assert train.endswith("-m experiments.train --config vane.py")
    # one line, as .ci/run takes it
    assert re.fullmatch(r"python3 -m venv .* install .*'\.\[test\]' .*-m pytest", test)


def test_the_commands_register_a_scan(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (block,) = [b for b in blocks("sh") if "vanejax register" in b]
    commands = [
        shlex.split(line, comments=True)[1:]
        for line in block.splitlines()
        if line.startswith("vanejax ")
    ]
    assert [command[0] for command in commands] == ["scan", "register"]
    for command in commands:
        assert main(command) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("scans: 6 scans")
    for line in blocks("text")[0].splitlines():  # but for the last digits of another processor
        assert re.sub(r"\d+", "#", line) in re.sub(r"\d+", "#", printed)
    pose = np.array(json.loads(Path("pose.json").read_text())["part_from_camera"])
    label = json.loads(Path("scans/labels.json").read_text())["views"][0]
    truth = np.linalg.inv(np.array(label["camera_from_part"]))
    np.testing.assert_allclose(pose, truth, atol=0.01)  # 400 mm times 1e-5 rad, and 0.0003 mm
    assert Path("pose.html").stat().st_size > 10_000


@pytest.mark.slow  # 216 scans, and the compilation of a training step
def test_the_core_runs() -> None:
    (code,) = blocks("python")
    assert len(code.splitlines()) <= 17
    space: dict = {}
    exec(compile(code, "README.md", "exec"), space)
    assert (len(space["scans"].train), len(space["scans"].test)) == (162, 54)
    assert int(space["state"].step) == 1
    assert np.isfinite(float(space["metrics"]["loss"]))
    result = space["result"]
    assert result.verdict.status == "accepted"
    placed = result.part_from_camera.apply(space["scan"].points[:100])
    true = space["views"].view(20).inverse().apply(space["scan"].points[:100])
    np.testing.assert_allclose(placed, true, atol=0.01)  # mm, no noise
