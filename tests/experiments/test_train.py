"""The main job end to end on the smoke config: kill, resume, refuse, diverge."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from experiments.runner.run_folder import read_log

ROOT = Path(__file__).parents[2]
STEPS = 40


@pytest.fixture(scope="module")
def environment(tmp_path_factory) -> dict[str, str]:
    # the runs of this file compile the same steps: one cache for them spares minutes
    cache = tmp_path_factory.mktemp("compilation")
    return os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)}


def start(workdir: Path, environment: dict[str, str], *overrides: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "experiments.train", "--config", "smoke.py"]
    command += ["--workdir", str(workdir), *overrides]
    with open(workdir.with_suffix(".out"), "a") as out:
        return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=out, stderr=out)


def finish(workdir: Path, environment: dict[str, str], *overrides: str) -> tuple[int, str]:
    code = start(workdir, environment, *overrides).wait(timeout=300)
    return code, workdir.with_suffix(".out").read_text()


def wait_for_step(workdir: Path, process: subprocess.Popen, step: int) -> None:
    for _ in range(3000):
        if any(row["step"] >= step for row in read_log(workdir)):
            return
        assert process.poll() is None, workdir.with_suffix(".out").read_text()
        time.sleep(0.1)
    raise AssertionError(f"step {step} was not reached in 300 s")


def arrays_of(workdir: Path, step: int) -> dict[str, np.ndarray]:
    """Every array of a saved state, read without the training code."""
    import orbax.checkpoint as ocp

    with ocp.CheckpointManager((workdir / "checkpoints").absolute()) as manager:
        assert step in manager.all_steps()
        tree = manager.restore(step, args=ocp.args.StandardRestore())
    import jax

    return {jax.tree_util.keystr(k): np.asarray(v) for k, v in jax.tree.leaves_with_path(tree)}


def assert_bit_equal(left: Path, right: Path) -> None:
    one, other = arrays_of(left, STEPS), arrays_of(right, STEPS)
    assert one.keys() == other.keys()
    assert len(one) > 100  # parameters, their average, two moments: nothing was left out
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name], err_msg=name)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory, environment) -> Path:
    workdir = tmp_path_factory.mktemp("unbroken") / "run"
    code, text = finish(workdir, environment)
    assert code == 0, text
    return workdir


def test_a_run_leaves_everything_it_promises(unbroken: Path) -> None:
    rows = read_log(unbroken)
    losses = [row["loss"] for row in rows if "loss" in row]
    assert len(losses) == STEPS // 5
    assert losses[-1] < losses[0]
    record = json.loads((unbroken / "run.json").read_text())
    assert record["config"]["model"]["num_neighbors"] == 8
    assert len(record["part"]["sha256"]) == 64
    assert "jax" in record["versions"]
    assert list((unbroken / "events").glob("events.out.tfevents.*"))
    evaluation = json.loads((unbroken / "evaluation.json").read_text())
    assert evaluation
    for picture in ("overlays.png", "error_map.png", "training_curves.png"):
        assert (unbroken / picture).stat().st_size > 10_000, picture
    assert not list(unbroken.rglob("*.partial"))


def test_killed_at_any_moment_it_ends_bit_equal(unbroken: Path, tmp_path, environment) -> None:
    workdir = tmp_path / "killed"
    for step in (5, 20):  # before the first checkpoint, and between two
        process = start(workdir, environment)
        wait_for_step(workdir, process, step)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    code, text = finish(workdir, environment)
    assert code == 0, text
    assert_bit_equal(unbroken, workdir)
    steps = [row["step"] for row in read_log(workdir) if "loss" in row]
    assert steps == sorted(set(steps))  # rows beyond the checkpoint were dropped, none is double


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_saves_and_leaves(unbroken: Path, tmp_path, environment, number) -> None:
    workdir = tmp_path / "stopped"
    process = start(workdir, environment)
    wait_for_step(workdir, process, 10)
    process.send_signal(number)
    assert process.wait(timeout=60) == 128 + number
    text = workdir.with_suffix(".out").read_text()
    assert f"stopped by {number.name}" in text
    assert "Traceback" not in text
    if number is signal.SIGTERM:
        code, text = finish(workdir, environment)
        assert code == 0, text
        assert_bit_equal(unbroken, workdir)


def test_another_config_is_refused_by_name(unbroken: Path, environment) -> None:
    before = (unbroken / "run.json").read_bytes()
    code, text = finish(unbroken, environment, "--config.model.radius=0.4")
    assert code == 2
    assert "config.model.radius was 0.3, now 0.4" in text
    assert "Traceback" not in text
    assert (unbroken / "run.json").read_bytes() == before


def test_divergence_stops_and_keeps_the_last_good_checkpoint(tmp_path, environment) -> None:
    workdir = tmp_path / "diverged"
    code, text = finish(
        workdir,
        environment,
        "--config.training.learning_rate=1e30",
        "--config.training.warmup_steps=12",
        "--config.training.save_every=1",
    )
    assert code == 1
    assert "training stopped" in text
    assert "last good checkpoint is kept" in text
    kept = list((workdir / "checkpoints").glob("[0-9]*"))
    assert kept
    for path in kept:
        assert all(
            np.isfinite(value).all() for value in arrays_of(workdir, int(path.name)).values()
        )
    assert "Traceback" not in text


def test_evaluating_again_gives_the_same_figures(unbroken: Path, environment) -> None:
    first = json.loads((unbroken / "evaluation.json").read_text())
    command = [sys.executable, "-m", "experiments.evaluate", "--config", "smoke.py"]
    command += ["--workdir", str(unbroken)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    again = json.loads((unbroken / "evaluation.json").read_text())
    assert again["summary"]["rotation_error_deg"] == first["summary"]["rotation_error_deg"]


def test_a_budget_ends_a_run_for_good(tmp_path, environment) -> None:
    workdir = tmp_path / "short"
    for _ in range(2):  # the second time nothing is left to do
        code, text = finish(workdir, environment, "--config.training.budget_minutes=0.001")
        assert code == 0, text
        told = json.loads((workdir / "evaluation.json").read_text())["training"]
        assert told["ended_by"] == "budget"
        assert told["steps"] == 1
        assert told["wanted_steps"] == STEPS
        assert len(told["curve"]) == 1  # what was reached is validated
    assert arrays_of(workdir, 1)


def test_training_on_scans_without_end_resumes_bit_equal(tmp_path, environment) -> None:
    """Scan n is the same whoever asks for it: a run that is stopped sees what another one sees."""
    endless = [
        "--config.endless.sensor=paper_camera",
        "--config.endless.resolution=0.125",
        "--config.endless.casting_mm=0.5",
        "--config.endless.castings=2",
    ]
    code, text = finish(tmp_path / "unbroken", environment, *endless)
    assert code == 0, text
    rows = [row for row in read_log(tmp_path / "unbroken") if "loss" in row]
    assert all(np.isfinite(row["scan_wait_s"]) for row in rows)
    workdir = tmp_path / "stopped"
    process = start(workdir, environment, *endless)
    wait_for_step(workdir, process, 15)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) == 128 + signal.SIGTERM
    code, text = finish(workdir, environment, *endless)
    assert code == 0, text
    assert_bit_equal(tmp_path / "unbroken", workdir)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("--config.endless.sensor=hawk", "no sensor 'hawk'"),
        ("--config.endless.castings=0", "castings=0 must be 1 or more"),
        ("--config.data.shapes=solids", "train on one of them"),
    ],
)
def test_endless_settings_that_give_no_scans_are_refused(
    tmp_path, environment, override, words
) -> None:
    code, text = finish(
        tmp_path / "run", environment, "--config.endless.sensor=paper_camera", override
    )
    assert code == 2, text
    assert words in text
    assert "Traceback" not in text
