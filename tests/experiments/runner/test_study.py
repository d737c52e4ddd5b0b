"""What the commands of studies share."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from experiments.runner import study_command as study
from vanejax.errors import InputError


@pytest.mark.parametrize("text", ["", "0", "-1", "a", "1,,2", "nan", "inf"])
def test_numbers_that_are_none_are_refused(text: str) -> None:
    assert study.positive_numbers("0.1,2") == (0.1, 2.0)
    with pytest.raises(argparse.ArgumentTypeError, match=r"0\.1,0\.5"):
        study.positive_numbers(text)


@pytest.mark.parametrize("text", ["", "0", "-1", "1.5", "x"])
def test_counts_are_whole_and_positive(text: str) -> None:
    assert study.count("12") == 12
    with pytest.raises(argparse.ArgumentTypeError, match="whole number"):
        study.count(text)


def run(monkeypatch: pytest.MonkeyPatch, main, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["study", *arguments])
    with pytest.raises(SystemExit) as left:
        study.run(main, study.make_parser("name", "words"))
    return left.value.code


def test_faults_of_the_input_are_one_line(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def refuse(settings: argparse.Namespace) -> None:
        raise InputError(f"seed {settings.seed} is no good")

    assert run(monkeypatch, refuse, "--seed", "7") == 2
    assert capsys.readouterr().err == "error: seed 7 is no good\n"
    assert run(monkeypatch, lambda settings: {"a": "report"}) == 0


def test_compiled_programs_are_kept_where_the_user_says(monkeypatch, capsys) -> None:
    enabled = []
    monkeypatch.setattr(study.compilation_cache, "enable", lambda: enabled.append(True))
    assert run(monkeypatch, lambda settings: enabled.append(False)) == 0
    assert enabled == [True, False]  # before anything is compiled
    assert run(monkeypatch, print, "--help") == 0
    assert "VANEJAX_CACHE_DIR" in capsys.readouterr().out


def test_a_report_says_where_it_comes_from(tmp_path: Path) -> None:
    settings = study.make_parser("name", "words").parse_args(["--out", str(tmp_path / "new")])
    header = study.header("a method", settings)
    report = study.save(settings.out, "name", header | {"value": np.float32(0.5), "no": np.nan})
    assert report == json.loads((tmp_path / "new" / "name.json").read_text())
    assert (report["seed"], report["value"], report["no"]) == (0, 0.5, None)
    assert {"date", "commit", "versions", "machine", "config"} <= set(report)
    assert report["config"]["out"] == str(tmp_path / "new")


def test_a_folder_that_cannot_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        study.save(tmp_path / "file" / "folder", "name", {})
