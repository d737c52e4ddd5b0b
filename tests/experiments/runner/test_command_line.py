"""Command lines: config look-up, overrides and their errors, seen as a user sees them."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from absl import flags

from experiments.configs import smoke, table1
from experiments.runner import command_line
from experiments.runner.command_line import default_workdir, resolve_config
from experiments.runner.experiment import Experiment
from vanejax.errors import InputError
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.training import Pair, RpmNetLoss

ROOT = Path(__file__).parents[3]


def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "experiments.train", *arguments],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.fixture
def command(monkeypatch) -> Callable[..., int]:
    """A command with ``--config`` and ``--workdir`` in this process: its exit code."""

    def run_here(*arguments: str, main: Callable[[Experiment], object] = Experiment.check) -> int:
        before = set(flags.FLAGS)
        monkeypatch.setattr(sys, "argv", ["train", *arguments])
        try:
            with pytest.raises(SystemExit) as left:
                command_line.run(lambda config, _: main(config))
        finally:
            for name in set(flags.FLAGS) - before:
                delattr(flags.FLAGS, name)
            flags.FLAGS.unparse_flags()
        return left.value.code

    return run_here


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
            ["config.model.num_neighbors=abc", "it takes an int, for example 8"],
        ),
        (["--config", "smoke.py", "--wrokdir=x"], ["wrokdir", "workdir"]),
        (["--config", "smoke.py", "--config.data.noise=-1"], ["config.data.noise=-1.0", ">= 0"]),
        (["--config", "smoke.py", "stray"], ["stray"]),
        (
            ["--config", "smoke.py", "--config.model.name=pointnet"],
            ["config.model.name='pointnet'", "did you mean pointnetlk?", "dcp", "pcrnet"],
        ),
        (["--config", "smoke.py", "--config.dcp.heads=3"], ["dcp.width=512", "dcp.heads=3"]),
        (["--config", "smoke.py", "--config.loss.pose=0", "--config.loss.matching=0"], ["all 0"]),
        (["--config", "smoke.py", "--config.training.average_decay=1"], ["lie in [0, 1)"]),
        (["--config", "smoke.py", "--config.model.feature_width=12"], ["multiple of 8"]),
        (["--config", "smoke.py", "--config.online.sensor=hawk"], ["no sensor 'hawk'"]),
        (["--config", "smoke.py", "--config.online.castings=0"], ["castings=0 must be positive"]),
        (
            ["--config=vane_robust.py", "--config.data.shapes=solids"],
            ["config.data.shapes='solids'", "config.online.sensor", "train on one of them"],
        ),
        (
            ["--config", "smoke.py", "--config.pointnetlk.origin=mean"],
            ["pointnetlk.origin='mean'", "means, target"],
        ),
        (["--config", "table1.py"], ["of the kind Comparison", "takes Experiment"]),
    ],
)
def test_a_wrong_command_line_is_one_clear_error(arguments, words, command, capsys) -> None:
    assert command(*arguments) == 2
    text = capsys.readouterr().err
    assert text.startswith("error: ")
    assert text.count("\n") == 1
    for word in words:
        assert word in text


def test_overrides_reach_every_group_of_the_tree(command) -> None:
    configs = []
    code = command(
        "--config",
        "smoke.py",
        "--config.model.num_neighbors=16",
        "--config.dcp.loss.matching=0.3",
        "--config.pcrnet.head=(8,4)",
        "--config.online.distance_mm=(200,300)",
        "--config.training.quick_compilation=false",
        main=configs.append,
    )
    assert code == 0
    expected = smoke.get_config()
    expected.model.num_neighbors, expected.dcp.loss.matching = 16, 0.3
    expected.pcrnet.head, expected.online.distance_mm = (8, 4), (200, 300)
    expected.training.quick_compilation = False
    assert configs == [expected]


def test_a_loss_needs_one_file_that_a_config_names(command, tmp_path, capsys) -> None:
    """The example of docs/adding_a_method.md: on the command line, checked, and in the step."""
    page = (ROOT / "docs" / "adding_a_method.md").read_text()
    code = page.partition("```python\n# my_loss.py\n")[2].partition("```")[0]
    path, configs = tmp_path / "my_loss.py", []
    path.write_text(code)
    assert command(f"--config={path}", "--config.loss.sharpness=0.5", main=configs.append) == 0
    loss = configs[0].make_network().loss
    match = SimpleNamespace(
        target_from_source=RigidTransform.identity(),
        log_assignment=np.zeros((3, 3), np.float32),
        beta=4.0,
    )
    cloud = PointCloud.create(np.eye(3, dtype=np.float32), np.eye(3, dtype=np.float32))
    pair = Pair(cloud, cloud, RigidTransform.identity())
    total, parts = loss.of_match(match, cloud, pair)
    rest, _ = RpmNetLoss(matching=0.02, matching_sigma=0.02).of_match(match, cloud, pair)
    assert parts["sharpness"] == 0.25
    np.testing.assert_allclose(total - rest, 0.5 * 0.25, rtol=1e-5)  # f32
    assert command(f"--config={path}", "--config.loss.sharpness=-1") == 2
    assert "config.loss.sharpness=-1.0 must be >= 0" in capsys.readouterr().err
    path.write_text(code.replace("config.loss =", "config.lost ="))
    assert command(f"--config={path}") == 2
    assert "Experiment has no field 'lost'; did you mean loss?" in capsys.readouterr().err


def test_another_network_has_a_folder_of_its_own() -> None:
    config = smoke.get_config()
    assert default_workdir(config) == "runs/smoke"
    config.model.name = "dcp"
    assert default_workdir(config) == "runs/smoke-dcp"
    assert default_workdir(table1.get_config()) == "runs/table1"


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
    wrong = ["--config", "smoke.py", "--config.part.path=none.stl", "--workdir", workdir]
    done = run(*wrong, VANEJAX_CACHE_DIR=str(cache))
    assert done.returncode == 2
    assert "none.stl" in done.stderr
    assert "Traceback" not in done.stderr
    assert cache.is_dir()
