"""What is measured afresh is held against the record."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from experiments.configs import smoke, vane
from experiments.pages.reproduction import live as live_module
from experiments.pages.reproduction.studies import recorded
from vanejax.cad import guide_vane
from vanejax.errors import InputError


def test_live_figures_are_held_against_the_record() -> None:
    same = live_module.side_by_side({"a": (1.0, 1.01), "b": (2.0, 1.99)})
    assert "All 2 figures are the recorded ones within 2%." in same
    apart = live_module.side_by_side({"a": (1.0, 1.01), "b": (2.0, 1.8), "c": (1.0, 1.05)})
    assert "2 of 3 figures differ from the record by more than 2%, most the b (10%)." in apart
    assert "| b | 2.00 | 1.80 | -10.0% |" in apart


def test_the_page_says_that_another_network_differs() -> None:
    record = recorded()["vane"]
    report = copy.deepcopy(record)
    report["summary"]["rotation_error_deg"]["max"] *= 2
    text = live_module.against_evaluation(
        record, live_module.Live(report, "w.npz", "0123456789abc", 60.0)
    )
    assert "most the rotation error (deg), max (100%)" in text
    assert "these weights were trained from commit 0123456789." in text


def matcher_of(config, **other) -> SimpleNamespace:
    """What `check_recipe` and `evaluate_live` look at."""
    network = config.make_network()
    fields = {
        "model": network.model,
        "iterations": network.iterations,
        "voxel_mm": config.data.voxel_mm,
        "sampling": SimpleNamespace(num_reference=config.data.num_reference),
        "variables": "weights",
        "trained": {"commit": "abc"},
        "check_part": Mock(),
    }
    return SimpleNamespace(**fields | other)


def test_weights_of_another_recipe_are_refused() -> None:
    config = vane.get_config()
    live_module.check_recipe(matcher_of(config), config)
    with pytest.raises(InputError, match=r"voxel_mm is 3\.0, not 1\.5"):
        live_module.check_recipe(matcher_of(config, voxel_mm=3.0), config)
    with pytest.raises(InputError, match="iterations is 2, not 5"):
        live_module.check_recipe(matcher_of(config, iterations=2), config)


def test_the_live_evaluation_scans_anew_with_the_weights_given(tmp_path, monkeypatch) -> None:
    asked = {}

    def evaluate(config, scans, variables, folder, *, part):
        asked.update(scans=scans, variables=variables, folder=folder)
        return {"views": len(scans.test)}

    monkeypatch.setattr(live_module, "evaluate", evaluate)
    config = smoke.get_config()
    matcher = matcher_of(config)
    live = live_module.evaluate_live(matcher, "w.npz", tmp_path, config=config)
    assert matcher.check_part.call_args.args[0].sha256 == guide_vane().sha256
    assert asked["variables"] == "weights"
    assert asked["folder"] == tmp_path / "vane"
    assert live.report["views"] == len(asked["scans"].test) > 0
    assert (live.weights, live.trained, live.position) == ("w.npz", "abc", None)
