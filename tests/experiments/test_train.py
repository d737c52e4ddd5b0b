"""Training from scans to report: what it leaves, stop and resume, kill, refuse, diverge, budget."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest
from example_experiment import tiny_experiment

from experiments.runner.experiment import Experiment
from experiments.runner.run_folder import RunFolder, read_log
from experiments.runner.stopping import exit_code
from experiments.runner.training_log import TrainingLog
from experiments.train import train
from vanejax.errors import InputError

ROOT = Path(__file__).parents[2]
STEPS = tiny_experiment().training.steps

pytestmark = pytest.mark.usefixtures("hasty_compiler")


def run(config: Experiment, workdir: Path) -> int:
    return exit_code(lambda: train(config, workdir))


def stop_after(monkeypatch: pytest.MonkeyPatch, steps: int, number: signal.Signals) -> None:
    """Sends a signal to this process once a training has done so many steps."""
    add, count = TrainingLog.add, itertools.count(1)

    def add_and_stop(log: TrainingLog, metrics: dict) -> None:
        add(log, metrics)
        if next(count) == steps:
            os.kill(os.getpid(), number)

    monkeypatch.setattr(TrainingLog, "add", add_and_stop)


def arrays_of(workdir: Path, step: int) -> dict[str, np.ndarray]:
    """Every array of a saved state, read without the training code."""
    with ocp.CheckpointManager((workdir / "checkpoints").absolute()) as manager:
        assert step in manager.all_steps()
        tree = manager.restore(step, args=ocp.args.StandardRestore())
    return {jax.tree_util.keystr(k): np.asarray(v) for k, v in jax.tree.leaves_with_path(tree)}


def assert_bit_equal(left: Path, right: Path, step: int = STEPS) -> None:
    expected, arrays = arrays_of(left, step), arrays_of(right, step)
    assert expected.keys() == arrays.keys()
    assert len(expected) > 30  # parameters, their average, two moments: nothing was left out
    for name, value in expected.items():
        np.testing.assert_array_equal(value, arrays[name], err_msg=name)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory, hasty_compiler) -> Path:
    workdir = tmp_path_factory.mktemp("unbroken") / "run"
    assert run(tiny_experiment(), workdir) == 0
    return workdir


def test_a_run_leaves_everything_it_promises(unbroken: Path) -> None:
    rows = read_log(unbroken)
    losses = [row["loss"] for row in rows if "loss" in row]
    assert len(losses) == STEPS // 2
    assert np.isfinite(losses).all()
    record = json.loads((unbroken / "run.json").read_text())
    assert record["config"]["pcrnet"]["loss"]["iterations"] == 1
    assert len(record["part"]["sha256"]) == 64
    assert "jax" in record["versions"]
    assert list((unbroken / "events").glob("events.out.tfevents.*"))
    assert json.loads((unbroken / "evaluation.json").read_text())["training"]["steps"] == STEPS
    for picture in ("overlays.png", "error_map.png", "training_curves.png"):
        assert (unbroken / picture).stat().st_size > 10_000, picture
    assert not list(unbroken.rglob("*.partial"))


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)]
)
def test_a_signal_saves_and_the_rest_is_bit_equal(
    unbroken: Path, tmp_path, monkeypatch, capsys, number
) -> None:
    workdir = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        stop_after(patch, 5, number)
        assert run(tiny_experiment(), workdir) == 128 + number
    assert f"stopped by {number.name} after step 5; saved in {workdir}." in capsys.readouterr().err
    assert not (workdir / "evaluation.json").exists()
    assert run(tiny_experiment(), workdir) == 0
    assert_bit_equal(unbroken, workdir)
    steps = [row["step"] for row in read_log(workdir) if "loss" in row]
    assert steps == sorted(set(steps))


def test_another_config_is_refused_by_name(unbroken: Path, capsys) -> None:
    before = (unbroken / "run.json").read_bytes()
    config = tiny_experiment()
    config.model.radius = 0.4
    assert run(config, unbroken) == 2
    assert "config.model.radius was 0.3, now 0.4" in capsys.readouterr().err
    assert (unbroken / "run.json").read_bytes() == before


def test_a_run_of_an_earlier_version_goes_on(unbroken: Path, tmp_path) -> None:
    """Its config has fewer fields, other names, and losses beside their networks."""
    record = json.loads((unbroken / "run.json").read_text())
    old = record["config"]
    old["endless"] = old.pop("online")
    del old["data"]["num_source"]
    for name in ("dcp", "pointnetlk", "pcrnet"):
        old[name] |= old[name].pop("loss")
    (tmp_path / "run.json").write_text(json.dumps(record))
    config = tiny_experiment()
    part = config.make_part()
    RunFolder(tmp_path).claim(config, part)
    config.pcrnet.loss.pose = 2.0
    with pytest.raises(InputError, match=r"config\.pcrnet\.loss\.pose was 1\.0, now 2\.0"):
        RunFolder(tmp_path).claim(config, part)


@pytest.mark.slow
def test_divergence_stops_and_keeps_the_last_good_checkpoint(tmp_path, capsys) -> None:
    workdir, config = tmp_path / "diverged", tiny_experiment()
    config.training.learning_rate, config.training.warmup_steps = 1e30, 8
    config.training.save_every = 1
    assert run(config, workdir) == 1
    text = capsys.readouterr().err
    assert "training stopped" in text
    assert "last good checkpoint is kept" in text
    kept = list((workdir / "checkpoints").glob("[0-9]*"))
    assert kept
    for path in kept:
        for name, value in arrays_of(workdir, int(path.name)).items():
            assert np.isfinite(value).all(), name


@pytest.mark.slow
def test_a_budget_ends_a_run_for_good(tmp_path) -> None:
    workdir, config = tmp_path / "short", tiny_experiment()
    config.training.budget_minutes = 0.0001
    for _ in range(2):  # the second time nothing is left to do
        assert run(config, workdir) == 0
        report = json.loads((workdir / "evaluation.json").read_text())["training"]
        assert report["ended_by"] == "budget"
        assert report["steps"] == 1
        assert report["wanted_steps"] == STEPS
        assert len(report["curve"]) == 1  # what was reached is validated
    assert arrays_of(workdir, 1)


@pytest.mark.slow
def test_training_on_online_scans_resumes_bit_equal(tmp_path, monkeypatch) -> None:
    """Scan n is the same whoever asks for it: a run that is stopped sees what another one sees."""
    config = tiny_experiment()
    config.online.sensor, config.online.resolution = "paper_camera", 0.125
    config.online.casting_mm, config.online.castings = 0.5, 2
    config.training.steps, config.data.num_reference = 8, 256
    assert run(config, tmp_path / "unbroken") == 0
    rows = [row for row in read_log(tmp_path / "unbroken") if "loss" in row]
    assert all(np.isfinite(row["scan_wait_s"]) for row in rows)
    with monkeypatch.context() as patch:
        stop_after(patch, 3, signal.SIGTERM)
        assert run(config, tmp_path / "stopped") == 128 + signal.SIGTERM
    assert run(config, tmp_path / "stopped") == 0
    assert_bit_equal(tmp_path / "unbroken", tmp_path / "stopped", step=8)


@pytest.mark.slow
def test_killed_by_force_the_smoke_run_ends_bit_equal(tmp_path, programs) -> None:
    """RPM-Net, as a user runs it; and evaluating it again gives the same figures."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(programs)}

    def start(module: str, workdir: Path) -> subprocess.Popen:
        command = [sys.executable, "-m", module, "--config", "smoke.py", "--workdir", str(workdir)]
        return subprocess.Popen(command, cwd=ROOT, env=environment)

    def finish(module: str, workdir: Path) -> None:
        assert start(module, workdir).wait(timeout=600) == 0

    unbroken, workdir = tmp_path / "unbroken", tmp_path / "killed"
    finish("experiments.train", unbroken)
    process = start("experiments.train", workdir)
    while not any(row["step"] >= 20 for row in read_log(workdir)):
        assert process.poll() is None
        time.sleep(0.1)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    finish("experiments.train", workdir)
    assert_bit_equal(unbroken, workdir, step=40)
    steps = [row["step"] for row in read_log(workdir) if "loss" in row]
    assert steps == sorted(set(steps))  # rows beyond the checkpoint were dropped, none is double
    losses = [row["loss"] for row in read_log(unbroken) if "loss" in row]
    assert losses[-1] < losses[0]

    first = json.loads((unbroken / "evaluation.json").read_text())
    finish("experiments.evaluate", unbroken)
    again = json.loads((unbroken / "evaluation.json").read_text())
    assert again["summary"]["rotation_error_deg"] == first["summary"]["rotation_error_deg"]
