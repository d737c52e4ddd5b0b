"""Command lines: config look-up, overrides and their errors, seen as a user sees them."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.configs import smoke, table1
from experiments.runner.command_line import resolve_config, workdir
from vanejax.errors import InputError

ROOT = Path(__file__).parents[3]


def value(content: object) -> SimpleNamespace:
    """What a flag holds."""
    return SimpleNamespace(value=content)


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "experiments.train", *arguments],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_a_bare_name_is_found_here_first_and_then_in_the_package(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    ours = resolve_config(["train", "--config", "vane.py"])[2]
    assert Path(ours) == ROOT / "experiments" / "configs" / "vane.py"
    (tmp_path / "vane.py").write_text("")
    assert resolve_config(["train", "--config=vane.py"])[1] == "--config=vane.py"


def test_an_unknown_config_lists_those_there_are() -> None:
    with pytest.raises(InputError, match=r"paper\.py, public\.py, smoke\.py, table1\.py, vane\.py"):
        resolve_config(["train", "--config", "vain.py"])
    with pytest.raises(InputError, match="--config needs a file"):
        resolve_config(["train", "--config"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--config", "vain.py"], ["vain.py", "smoke.py"]),
        ([], ["--config is missing"]),
        (
            ["--config", "smoke.py", "--config.model.num_neighbours=16"],
            ["num_neighbours", "did you mean num_neighbors?", "radius", "feature_width"],
        ),
        (["--config", "smoke.py", "--config.model=16"], ["is a group", "num_neighbors"]),
        (
            ["--config", "smoke.py", "--config.model.num_neighbors=abc"],
            ["config.model.num_neighbors=abc", "it takes an int, for example 32"],
        ),
        (["--config", "smoke.py", "--wrokdir=x"], ["wrokdir", "workdir"]),
        (["--config", "smoke.py", "--config.data.noise=-1"], ["config.data.noise=-1.0", ">= 0"]),
        (["--config", "smoke.py", "--config.part.path=none.stl"], ["none.stl"]),
        (["--config", "smoke.py", "stray"], ["stray"]),
        (
            ["--config", "smoke.py", "--config.model.name=pointnet"],
            ["config.model.name='pointnet'", "did you mean pointnetlk?", "dcp", "pcrnet"],
        ),
        (["--config", "smoke.py", "--config.dcp.heads=3"], ["dcp.width=512", "dcp.heads=3"]),
        (
            ["--config", "smoke.py", "--config.pointnetlk.origin=mean"],
            ["pointnetlk.origin='mean'", "means, target"],
        ),
        (["--config", "table1.py"], ["of the kind Comparison", "takes Experiment"]),
    ],
)
def test_a_wrong_command_line_is_one_clear_error(
    arguments: list[str], words: list[str], tmp_path
) -> None:
    done = run(*arguments, "--workdir", str(tmp_path / "run"))
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in done.stderr


def test_another_network_has_a_folder_of_its_own() -> None:
    config = smoke.get_config()
    assert workdir(value(None), value(config)) == Path("runs/smoke")
    config.model.name = "dcp"
    assert workdir(value(None), value(config)) == Path("runs/smoke-dcp")
    assert workdir(value("here"), value(config)) == Path("here")
    assert workdir(value(None), value(table1.get_config())) == Path("runs/table1")


def test_help_names_the_config_and_the_workdir() -> None:
    done = run("--help")
    text = done.stdout + done.stderr
    assert "--config" in text
    assert "smoke.py" in text
    assert "--workdir" in text
    assert "VANEJAX_CACHE_DIR" in text
    assert "Traceback" not in text


def test_compiled_programs_are_kept_where_the_user_says(tmp_path) -> None:
    cache, workdir = tmp_path / "cache", str(tmp_path / "run")
    wrong = ["--config", "smoke.py", "--config.data.noise=-1", "--workdir", workdir]
    assert run(*wrong, VANEJAX_CACHE_DIR=str(cache)).returncode == 2
    assert cache.is_dir()  # made before the settings were looked at
    assert run(*wrong, VANEJAX_CACHE_DIR="off", XDG_CACHE_HOME=str(tmp_path)).returncode == 2
    assert not (tmp_path / "vanejax").exists()
