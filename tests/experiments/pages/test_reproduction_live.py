"""What is measured afresh is held against the record."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import pytest

from experiments.configs import smoke, vane
from experiments.pages.reproduction import live as live_module
from experiments.pages.reproduction.live import (
    Live,
    against_evaluation,
    check_recipe,
    evaluate_live,
    side_by_side,
)
from experiments.pages.reproduction.studies import recorded
from vanejax.cad import guide_vane
from vanejax.errors import InputError


def test_live_figures_are_held_against_the_record() -> None:
    same = side_by_side({"a": (1.0, 1.01), "b": (2.0, 1.99)})
    assert "All 2 figures are the recorded ones within 2%." in same
    apart = side_by_side({"a": (1.0, 1.01), "b": (2.0, 1.8), "c": (1.0, 1.05)})
    assert "2 of 3 figures differ from the record by more than 2%, most the b (10%)." in apart
    assert "| b | 2.00 | 1.80 | -10.0% |" in apart


def test_the_page_says_that_another_network_differs() -> None:
    record = recorded()["vane"]
    report = copy.deepcopy(record)
    report["summary"]["rotation_error_deg"]["max"] *= 2
    text = against_evaluation(record, Live(report, "w.npz", "0123456789abc", 60.0))
    assert "most the rotation error (deg), max (100%)" in text
    assert "these weights were trained from commit 0123456789." in text


@dataclasses.dataclass(frozen=True)
class FakeMatcher:
    """What `check_recipe` and `evaluate_live` look at."""

    model: Any
    iterations: int
    voxel_mm: float
    sampling: Any
    variables: Any = "weights"
    trained: Any = dataclasses.field(default_factory=lambda: {"commit": "abc"})

    def check_part(self, part) -> None:
        assert part.sha256 == guide_vane().sha256


def matcher_of(config, **other) -> FakeMatcher:
    network = config.make_network()
    fields = {
        "model": network.model,
        "iterations": network.iterations,
        "voxel_mm": config.data.voxel_mm,
        "sampling": dataclasses.make_dataclass("D", ["num_reference"])(config.data.num_reference),
    }
    return FakeMatcher(**fields | other)


def test_weights_of_another_recipe_are_refused() -> None:
    config = vane.get_config()
    check_recipe(matcher_of(config), config)
    with pytest.raises(InputError, match=r"voxel_mm is 3\.0, not 1\.5"):
        check_recipe(matcher_of(config, voxel_mm=3.0), config)
    with pytest.raises(InputError, match="iterations is 2, not 5"):
        check_recipe(matcher_of(config, iterations=2), config)


def test_the_live_evaluation_scans_anew_with_the_weights_given(tmp_path, monkeypatch) -> None:
    asked = {}

    def evaluate(config, scans, variables, folder, *, part):
        asked.update(scans=scans, variables=variables, folder=folder)
        return {"views": len(scans.test)}

    monkeypatch.setattr(live_module, "evaluate", evaluate)
    config = smoke.get_config()
    live = evaluate_live(matcher_of(config), "w.npz", tmp_path, config=config)
    assert asked["variables"] == "weights"
    assert asked["folder"] == tmp_path / "vane"
    assert live.report["views"] == len(asked["scans"].test) > 0
    assert (live.weights, live.trained, live.position) == ("w.npz", "abc", None)
