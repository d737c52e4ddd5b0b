"""Tuning: the grid, the score, and that test views stay unseen."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments import tune as command
from experiments.configs import smoke
from experiments.studies.comparison.methods import GROUPS
from experiments.studies.comparison.settings import Comparison
from experiments.tune import CAP_DEG, GRIDS, cells, score_deg, tune, with_values
from vanejax.errors import InputError
from vanejax.training import load_scan_set, make_bank


def small() -> Comparison:
    config = Comparison(name="small", experiment=smoke.get_config())
    config.experiment.views.azimuths_deg = (0.0, 20.0, 60.0, 180.0)
    return config


def test_every_method_with_settings_has_a_grid_of_its_fields() -> None:
    assert set(GRIDS) == set(GROUPS)
    for name, grid in GRIDS.items():
        for values in cells(grid):
            changed = with_values(Comparison(), values)
            for path, value in values.items():
                group, field = path.split(".")
                assert group in GROUPS[name]
                assert getattr(getattr(changed, group), field) == value
    assert len(list(cells({"a": (1, 2), "b": (3, 4, 5)}))) == 6


def test_a_part_turned_over_counts_once_and_what_is_not_finite_as_that() -> None:
    errors = np.array([1.0, 3.0, 180.0, np.nan])
    results = SimpleNamespace(errors=SimpleNamespace(rotation_deg=errors))
    assert score_deg(results) == pytest.approx((1 + 3 + 2 * CAP_DEG) / 4)


def test_the_best_cell_wins_on_training_views_alone(monkeypatch, tmp_path: Path, capsys) -> None:
    banks = []

    def register_views(register, bank, sampling, **rest: object) -> SimpleNamespace:
        banks.append(bank)
        error = register["icp.max_distance"]
        errors = SimpleNamespace(
            rotation_deg=np.array([error, 2 * error]), translation_mm=np.array([error, error])
        )
        return SimpleNamespace(errors=errors, time_s=np.array([0.1, 0.1]))

    monkeypatch.setattr(command, "register_views", register_views)
    monkeypatch.setattr(command, "make_method", lambda name, config: config)
    monkeypatch.setattr(command, "with_values", lambda config, values: values)
    monkeypatch.setattr(command, "GRIDS", {"icp": {"icp.max_distance": (3.0, 1.0, 2.0)}})
    config = small()
    report = tune(config, tmp_path, ["icp"], 3)
    found = report["methods"]["icp"]
    assert found["best"]["values"] == {"icp.max_distance": 1.0}
    assert found["best"]["score_deg"] == 1.5
    assert len(found["cells"]) == 3
    # 2 elevations x 4 azimuths, of which 0 alone is a test azimuth: 6 training views, 3 of them
    assert report["training_views"] == [0, 2, 5]
    assert json.loads((tmp_path / "tuning.json").read_text()) == report
    assert "--config.icp.max_distance=1.0" in capsys.readouterr().out
    scans = load_scan_set(tmp_path / "scans.npz").train.select(np.array([0, 2, 5]))
    wanted = make_bank(scans, num_reference=config.experiment.data.num_reference)
    assert len(banks) == 3
    for bank in banks:
        np.testing.assert_array_equal(bank.scans.xyz, wanted.scans.xyz)


def test_a_method_without_a_grid_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="methods rpmnet: only icp"):
        tune(small(), tmp_path, ["rpmnet"], 3)
