"""Ablations: what is run, kept, gone on with and refused; training itself is mocked but once."""

import dataclasses
import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from example_experiment import tiny_experiment

from experiments import ablate
from experiments.configs.smoke import get_config
from experiments.runner.experiment import Experiment
from experiments.runner.run_folder import RunFolder, TrainingRecord
from experiments.runner.stopping import Interrupted, TrainingDiverged, exit_code
from experiments.runner.sweep import Cell, Sweep, grid
from experiments.runner.trained import Trained
from experiments.studies.ablation import picture as ablation_picture
from experiments.studies.ablation.table import over_seeds, table
from vanejax.errors import InputError

ROOT = Path(__file__).parents[2]
SWEEPS = [Sweep("model.num_neighbors", (4, 8)), Sweep("data.noise", (0.0, 0.01))]


class Mock:
    """Stands in for training and testing; remembers the configs that it was asked for."""

    def __init__(self) -> None:
        self.trained: list[Experiment] = []
        self.tested: list[Experiment] = []
        self.trouble: dict[int, BaseException] = {}  # raised after so many trainings
        self.steps = 40  # that a training does

    def train(self, config, part, scans, folder) -> Trained:
        self.trained.append(config)
        with RunFolder(folder) as run:
            run.claim(config, part)
        if trouble := self.trouble.get(len(self.trained) - 1):
            raise trouble
        return Trained({}, config, TrainingRecord(({"step": self.steps},), seconds=360.0))

    def test(self, config, scans, variables) -> dict:
        self.tested.append(config)
        error = 1.0 + config.data.noise + 0.1 * config.seed + 1 / config.model.num_neighbors
        figures = {"mean": error, "median": error, "p95": 2 * error, "max": 3 * error}
        measures = dict.fromkeys(ablate.MEASURES, figures | {"non_finite": 0})
        return {"views": 6, "non_finite_views": 0} | measures


@pytest.fixture
def mock(monkeypatch) -> Mock:
    mock = Mock()
    monkeypatch.setattr(ablate, "trained", mock.train)
    monkeypatch.setattr(ablate, "errors_under", mock.test)
    monkeypatch.setattr(ablate, "load_or_scan", lambda config, part, path: path)
    return mock


def lines(workdir: Path) -> list[dict]:
    return [json.loads(line) for line in (workdir / "cells.jsonl").read_text().splitlines()]


def test_each_cell_is_trained_once_and_tested_twice(mock: Mock, tmp_path, capsys) -> None:
    base = get_config()
    report = ablate.ablate(base, SWEEPS, (0,), tmp_path)
    cells = grid(SWEEPS, (0,))
    assert mock.trained == [cell.config(base) for cell in cells]
    own, same = (cells[0].config(base), ablate.same_test(cells[0].config(base), base))
    assert same.data.noise == base.data.noise == 0.01
    assert same.model.num_neighbors == own.model.num_neighbors == 4
    # where the two tests are one, as for the cells at the config's own noise, it is made once
    assert [c.data.noise for c in mock.tested] == [0.0, 0.01, 0.01, 0.0, 0.01, 0.01]
    rows = lines(tmp_path)
    assert [row["cell"] for row in rows] == [cell.name for cell in cells]
    for row in rows:
        assert {"overrides", "seed", "config", "commit", "date", "versions", "tests"} <= set(row)
        assert row["training"]["ended_by"] == "steps"
        assert row["training"]["hours"] == 0.1
        assert (tmp_path / "cells" / row["cell"] / "run.json").exists()
    saved = json.loads((tmp_path / "ablation.json").read_text())
    assert saved == report
    assert all("config" not in cell for cell in saved["cells"])
    assert (tmp_path / "ablation.png").stat().st_size > 10_000
    text = capsys.readouterr().out
    assert "the same test for all" in text
    assert "budget" not in text


def test_what_is_finished_is_not_run_again(mock: Mock, tmp_path) -> None:
    ablate.ablate(get_config(), SWEEPS[:1], (0,), tmp_path)
    before = lines(tmp_path)
    ablate.ablate(get_config(), SWEEPS[:1], (0,), tmp_path)
    assert len(mock.trained) == 2
    assert lines(tmp_path) == before
    wider = [Sweep("model.num_neighbors", (8, 16, 4))]
    report = ablate.ablate(get_config(), wider, (0,), tmp_path)
    assert [config.model.num_neighbors for config in mock.trained] == [4, 8, 16]
    assert [cell["overrides"]["model.num_neighbors"] for cell in report["cells"]] == [8, 16, 4]
    ablate.ablate(get_config(), wider, (1,), tmp_path)
    assert len(mock.trained) == 6  # another seed is another cell


def test_a_signal_keeps_what_is_done_and_the_rest_goes_on(mock: Mock, tmp_path, capsys) -> None:
    mock.trouble = {
        1: Interrupted(signal.SIGTERM, 7, tmp_path),
        2: KeyboardInterrupt(),
    }

    def ablation() -> int:
        return exit_code(lambda: ablate.ablate(get_config(), SWEEPS, (0,), tmp_path))

    assert ablation() == 128 + signal.SIGTERM
    error = capsys.readouterr().err
    assert "stopped by SIGTERM after step 7" in error
    assert error.count("\n") == 1
    assert len(lines(tmp_path)) == 1
    assert ablation() == 130
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "ablation.json").exists()
    assert ablation() == 0
    names = [cell.name for cell in grid(SWEEPS, (0,))]
    assert [row["cell"] for row in lines(tmp_path)] == names
    assert len(mock.trained) == 6  # the second cell was begun three times, the others once
    assert not list(tmp_path.rglob("*.partial"))


def test_a_folder_that_cannot_be_gone_on_with_is_refused_by_name(mock: Mock, tmp_path) -> None:
    ablate.ablate(get_config(), SWEEPS[:1], (0,), tmp_path)
    other = get_config()
    other.model.radius = 0.4
    with pytest.raises(InputError, match=r"config\.model\.radius was 0\.3, now 0\.4"):
        ablate.ablate(other, SWEEPS[:1], (0,), tmp_path)
    path = tmp_path / "cells.jsonl"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"cells\.jsonl"):
        ablate.ablate(get_config(), SWEEPS[:1], (0,), tmp_path)
    assert len(mock.trained) == 2


def test_a_cell_of_another_part_is_not_finished(mock: Mock, tmp_path) -> None:
    ablate.ablate(get_config(), SWEEPS[:1], (0,), tmp_path)
    cell, part = grid(SWEEPS[:1], (0,))[0], get_config().make_part()
    rows = lines(tmp_path)
    assert ablate.finished(cell, part, rows) == rows[0]
    rows[0]["part"]["sha256"] = "of a file that was changed since"
    assert ablate.finished(cell, part, rows) is None


def test_settings_that_cannot_be_run_are_refused_before_anything_is(mock: Mock, tmp_path) -> None:
    for sweep, message in (
        (Sweep("data.noise", (0.0, -1.0)), r"config\.data\.noise=-1\.0"),
        (Sweep("model.name", ("rpmnet", "rpmnett")), "did you mean rpmnet"),
        (Sweep("dcp.loss.cycle", (0.0, 0.1)), "rpmnet does not use it.* model.radius.* loss.pose"),
        (Sweep("views.azimuths_deg", ((0.0, 20.0), (20.0,))), "both kinds are needed"),
        (Sweep("views.azimuths_deg", ((0.0, 20.0), (40.0,))), "both kinds are needed"),
    ):
        with pytest.raises(InputError, match=message):
            ablate.ablate(get_config(), [sweep], (0,), tmp_path / "run")
    assert not mock.trained
    assert not (tmp_path / "run").exists()


def test_a_training_that_diverges_is_a_result(mock: Mock, tmp_path, capsys) -> None:
    mock.trouble = {0: TrainingDiverged("loss not finite at step 5")}
    report = ablate.ablate(get_config(), SWEEPS[:1], (0,), tmp_path)
    first, second = report["points"]
    assert first["ended_by"] == ["divergence"]
    assert first["tests"] == {"own": None, "same": None}
    assert second["ended_by"] == ["steps"]
    assert "divergence" in capsys.readouterr().out
    ablate.ablate(get_config(), SWEEPS[:1], (0,), tmp_path)
    assert len(mock.trained) == 2


def test_a_budget_that_ended_a_cell_is_told(mock: Mock, tmp_path, capsys) -> None:
    mock.steps = 12
    report = ablate.ablate(get_config(), SWEEPS[:1], (0,), tmp_path)
    assert [point["ended_by"] for point in report["points"]] == [["budget"]] * 2
    text = capsys.readouterr().out.splitlines()
    assert [line.split()[-2:] for line in text if "0.10" in line] == [["12", "budget"]] * 2


def test_seeds_are_told_as_mean_and_spread(mock: Mock, tmp_path, capsys) -> None:
    report = ablate.ablate(get_config(), SWEEPS[:1], (0, 1, 2), tmp_path)
    four, eight = report["points"]
    assert four["seeds"] == eight["seeds"] == [0, 1, 2]
    errors = np.array([1.26, 1.36, 1.46])  # the mock's, at noise 0.01 and k = 4
    spread = four["tests"]["own"]["rotation_error_deg"]["mean"]
    assert spread["mean"] == pytest.approx(errors.mean())
    assert spread["std"] == pytest.approx(errors.std(ddof=1))
    assert (spread["min"], spread["max"]) == pytest.approx((errors.min(), errors.max()))
    same = four["tests"]["same"]["rotation_error_deg"]["mean"]
    assert same["min"] == same["max"]  # one test for all: drawn with the config's seed
    assert "1.360 ± 0.100" in capsys.readouterr().out


def test_cells_with_the_same_scans_share_them(tmp_path) -> None:
    shared, base = ablate.SharedScans(tmp_path), get_config()

    def path(**overrides) -> Path:
        fields = tuple((name.replace("__", "."), value) for name, value in overrides.items())
        return shared.path(Cell(fields, seed=1).config(base))

    assert path() == path(data__noise=0.0) == path(model__num_neighbors=4)
    others = {path(), path(data__voxel_mm=5.0), path(views__distance_mm=500.0)}
    others |= {path(views__azimuths_deg=(0.0, 20.0)), path(views__resolution=0.5)}
    assert len(others) == 5


def test_the_same_test_is_the_bases_but_for_what_is_trained() -> None:
    base = get_config()
    cell = Cell((("data.noise", 0.0), ("data.shapes", "solids"), ("views.distance_mm", 500.0)), 5)
    config = cell.config(base)
    expected = dataclasses.replace(base, data=dataclasses.replace(base.data, shapes="solids"))
    assert ablate.same_test(config, base) == expected
    assert config == cell.config(base)  # and the cell's own is as it was


def report_of(sweeps: list[Sweep], errors: dict[tuple, float | None]) -> dict:
    """A report as of ablation.json from the mean errors, by the values of the sweeps."""
    rows = []
    for values, error in errors.items():
        names = ("mean", "median", "p95", "max")
        test = {"views": 6, "non_finite_views": error is None}
        test |= dict.fromkeys(ablate.MEASURES, dict.fromkeys(names, error))
        overrides = {sweep.field: value for sweep, value in zip(sweeps, values, strict=True)}
        told = {"ended_by": "steps", "steps": 9, "hours": 0.5}
        tests = {"own": test, "same": test}
        rows.append({"overrides": overrides, "seed": 0, "training": told, "tests": tests})
    report = {
        "part": {"name": "vane"},
        "sweeps": [dataclasses.asdict(sweep) for sweep in sweeps],
        "seeds": [0],
        "points": over_seeds(rows),
    }
    return json.loads(json.dumps(report))


def test_the_picture_has_a_line_for_each_other_value_on_a_fitting_axis() -> None:
    neighbors, noise = Sweep("model.num_neighbors", (8, 16, 32)), Sweep("data.noise", (0.0, 0.01))
    errors = {(k, n): 1 + n + 1 / k for k in neighbors.values for n in noise.values}
    figure = ablation_picture.picture(report_of([neighbors, noise], errors))
    rotation, translation = figure.axes  # one row: the two tests are one
    assert [t.get_text() for t in rotation.get_legend().get_texts()] == ["noise 0", "noise 0.01"]
    assert rotation.get_xscale() == translation.get_xscale() == "log"
    drawn = [line for line in rotation.lines if len(line.get_xdata()) == 3]
    for line, n in zip(drawn, noise.values, strict=True):
        np.testing.assert_array_equal(line.get_xdata(), neighbors.values)
        np.testing.assert_allclose(line.get_ydata(), [errors[k, n] for k in neighbors.values])
    names = Sweep("model.name", ("rpmnet", "dcp"))
    figure = ablation_picture.picture(report_of([names], {("rpmnet",): 1.0, ("dcp",): 90.0}))
    axes = figure.axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["rpmnet", "dcp"]
    assert (axes.get_xscale(), axes.get_yscale()) == ("linear", "log")
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), [0, 1])


def test_points_without_a_figure_are_told_and_left_out_of_the_picture() -> None:
    sweep = Sweep("data.noise", (0.0, 0.01))
    report = report_of([sweep], {(0.0,): None, (0.01,): 2.0})
    assert "WARNING: 1 registrations are not finite" in table(report)
    axes = ablation_picture.picture(report).axes[0]
    assert axes.get_xscale() == "linear"  # 0 has no place on the other
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), [0.01])
    nothing = report_of([sweep], {(0.0,): None, (0.01,): None})
    assert len(ablation_picture.picture(nothing).axes) == 2


def test_which_values_want_a_logarithmic_axis() -> None:
    for values in ((8, 16, 32, 64), (0.001, 0.1, 0.01)):
        assert ablation_picture.geometric(values)
    for values in ((10, 20, 30), (0.0, 0.01, 0.1), (8, 64)):
        assert not ablation_picture.geometric(values)


@pytest.mark.slow
def test_two_cells_from_scans_to_picture(tmp_path, capsys, hasty_compiler) -> None:
    config = tiny_experiment()
    config.training.steps = 2
    # two cells that compile to the same programs, under another noise than the config's
    sweeps = [Sweep("training.log_every", (1, 2)), Sweep("data.noise", (0.02,))]
    report = ablate.ablate(config, sweeps, (0,), tmp_path)
    assert len(list(tmp_path.glob("scans-*.npz"))) == 1
    first, second = report["points"]
    assert first["tests"] == second["tests"]  # how often is logged changes nothing
    assert first["tests"]["own"] != first["tests"]["same"]
    for test in first["tests"].values():
        assert test["views"] == 2
        assert test["rotation_error_deg"]["mean"]["mean"] > 0
    assert (first["ended_by"], first["steps"]) == (["steps"], [2])
    before = (tmp_path / "cells.jsonl").read_bytes()
    again = ablate.ablate(config, sweeps, (0,), tmp_path)
    assert again["points"] == report["points"]
    assert (tmp_path / "cells.jsonl").read_bytes() == before
    assert (
        "2 of 2, data.noise=0.02,training.log_every=2,seed=0: finished" in capsys.readouterr().out
    )


def test_the_command_lists_cells_and_refuses_in_one_line(tmp_path) -> None:
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "experiments.ablate", "--config", "smoke.py", *arguments]
        command += ["--workdir", str(tmp_path / "run")]
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)

    sweep = ("--sweep", "data.noise=0,0.01", "--seeds", "0,1", "--cell_minutes=2", "--cells")
    done = run(*sweep)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == "data.noise=0.0,seed=0: 40 steps, 2 min at most"
    assert len(done.stdout.splitlines()) == 4
    assert not (tmp_path / "run").exists()
    done = run("--sweep", "model.num_neighbors=8,16", "--config.model.name=pointnetlk", "--cells")
    assert done.returncode == 2
    assert done.stderr.startswith(
        "error: --sweep model.num_neighbors: pointnetlk does not use it; its fields are "
        "pointnetlk.delta, "
    )
    assert done.stderr.count("\n") == 1
