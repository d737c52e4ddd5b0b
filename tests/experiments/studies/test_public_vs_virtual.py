"""Generic shapes against virtual scans: the command on little, and the figures it draws from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from example_experiment import tiny_experiment

from experiments.configs import public, vane
from experiments.runner.experiment import Experiment
from experiments.runner.trained import trained
from experiments.studies.public_vs_virtual.study import of_virtual_scans, public_vs_virtual, table
from vanejax.errors import InputError

pytestmark = pytest.mark.usefixtures("hasty_compiler")


def small() -> Experiment:
    config = tiny_experiment()
    config.name = "small"
    config.views.elevations_deg, config.views.azimuths_deg = (60.0, 85.0), (0.0, 20.0, 40.0, 180.0)
    config.data.shapes = "solids:6"
    config.data.num_reference = 256
    config.training.steps, config.training.evaluate_every = 2, 1
    return config


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("public")


@pytest.fixture(scope="module")
def report(folder: Path, hasty_compiler) -> dict:
    return public_vs_virtual(small(), folder, {}, progress=False)


@pytest.mark.slow
def test_both_are_trained_and_tested_on_the_same_views(report: dict, folder: Path) -> None:
    assert report["views"] == {"all": 4, "hardest": 2}
    assert "solids" in report["trained_on"]["public"]["title"]
    assert "virtual scans" in report["trained_on"]["virtual"]["title"]
    assert report["trained_on"]["public"]["training"]["steps"] == 2
    shapes = json.loads((folder / "public" / "shapes.json").read_text())
    assert len(shapes["sha256"]) == 64
    assert not (folder / "virtual" / "shapes.json").exists()
    fits = [report[name]["at_true_pose"]["rmse_mm"] for name in ("public", "virtual")]
    assert fits[0] == fits[1]  # the same pairs
    assert json.loads((folder / "public_vs_virtual.json").read_text()) == report
    for name in ("axis_errors_hardest.png", "axis_errors_all.png"):
        assert (folder / name).stat().st_size > 10_000


@pytest.mark.slow
def test_the_reduction_is_that_of_the_means(report: dict) -> None:
    for views, count in (("all_views", 4), ("hardest_views", 2)):
        errors = report[views]
        turned = 1 - np.mean(errors["virtual"]["mre_per_axis_deg"]) / np.mean(
            errors["public"]["mre_per_axis_deg"]
        )
        assert errors["reduction"]["rotation"] == pytest.approx(turned, abs=1e-5)  # six digits
        assert len(errors["public"]["mre_per_view_deg"]) == count
    text = table(report)
    assert "the paper says about 80%" in text
    assert text.count("\n| ") == 4  # below the header


def test_only_what_is_trained_on_differs() -> None:
    config = public.get_config()
    virtual = of_virtual_scans(config)
    assert (config.data.shapes, virtual.data.shapes) == ("solids", "")
    assert virtual.training == config.training
    assert virtual.loss == config.loss == vane.get_config().loss
    assert virtual.model == config.model


def test_without_shapes_there_is_nothing_to_compare(tmp_path: Path) -> None:
    config = small()
    config.data.shapes = ""
    with pytest.raises(InputError, match=r"config\.data\.shapes is empty"):
        public_vs_virtual(config, tmp_path, {})


def test_a_checkpoint_of_pytorch_is_read_for_an_rpmnet_only(tmp_path: Path) -> None:
    weights = tmp_path / "weights.npz"
    np.savez(weights, unknown=np.zeros(3, np.float32))
    config = small()
    part = config.make_part()
    with pytest.raises(InputError, match="for an RPM-Net only"):
        trained(config, part, None, tmp_path / "x", weights)
    config.model.name = "rpmnet"
    with pytest.raises(InputError, match="not a published RPM-Net's"):
        trained(config, part, None, tmp_path / "x", weights)
