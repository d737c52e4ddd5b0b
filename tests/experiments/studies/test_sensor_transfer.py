"""What virtual scans of one kind or another are worth on real ones, with networks given."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest

from experiments.studies.sensor_transfer import study as sensor_transfer
from experiments.studies.sensor_transfer.study import IDEAL, NO_NETWORK, make_parser
from vanejax.cad import guide_vane
from vanejax.scanner import Scanner, hemisphere_viewpoints, measure, preset
from vanejax.scans import save_points
from vanejax.training import find_weights


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One scan of the guide vane by a paper camera, in the place of a real one."""
    folder = tmp_path_factory.mktemp("scans")
    part = guide_vane()
    part.export(folder / "part.stl")
    pose = hemisphere_viewpoints(part.center).view(60)
    sensor = preset("paper_camera").scaled(0.4)
    scan = measure(Scanner(part), sensor, pose, np.random.default_rng(0))
    save_points(folder / "scan.ply", scan.points)
    entry = {
        "scan": "scan.ply", "cad": "part.stl", "cad_unit_mm": 1.0, "scan_units": "mm",
        "scan_from_cad_mm": [pose.as_matrix().tolist()],
    }  # fmt: skip
    (folder / "ground_truth.json").write_text(json.dumps([entry]))
    return folder


@pytest.mark.slow
def test_a_good_network_and_a_bad_one_are_told_apart(
    folder: Path, record, tmp_path: Path, monkeypatch, capsys
) -> None:
    good = find_weights("pretrained", guide_vane())
    # weights that know nothing: every feature alike
    bad = dataclasses.replace(good, variables=jax.tree.map(np.zeros_like, good.variables))
    asked = []

    def network(config, place):
        asked.append((config.online.effects, place))
        return good if config.online.effects else bad

    monkeypatch.setattr(sensor_transfer, "network", network)
    arguments = ["--starts", "3", "--steps", "7", "--sensor", "paper_camera"]
    report = record(sensor_transfer, "sensor_transfer", str(folder), *arguments)
    assert asked == [(False, tmp_path / "part_ideal"), (True, tmp_path / "part_paper_camera")]
    found = report["summary"]["all"]
    assert found["paper_camera"]["alone"]["right"] == 1.0
    assert found["paper_camera"]["alone"]["rotation_deg"] < 2
    assert found[IDEAL]["alone"]["rotation_deg"] > 5
    assert found["paper_camera"]["refined"]["rotation_deg"] < 0.1
    assert 0 < found[NO_NETWORK]["alone"]["rotation_deg"] <= 45
    assert report["summary"]["part"] == found
    assert report["scans"] == {"scan.ply": found}
    assert found[IDEAL]["alone"]["registrations"] == 3
    printed = capsys.readouterr().out
    assert sensor_transfer.table(report) in printed
    assert "| paper_camera | all | 3 of 3 |" in printed


def test_two_trainings_differ_in_the_effects_alone(folder: Path) -> None:
    (known,) = sensor_transfer.load_truth(folder)
    real, ideal = (
        sensor_transfer.recipe(known, "consumer_depth", effects=effects, steps=9, seed=4)
        for effects in (True, False)
    )
    real.check()
    assert (real.name, ideal.name) == ("part_consumer_depth", "part_ideal")
    assert (real.online.effects, ideal.online.effects) == (True, False)
    ideal.name, ideal.online = real.name, dataclasses.replace(ideal.online, effects=True)
    assert ideal == real
    assert real.online.resolution == 1.0  # its own pixels


def test_a_sensor_that_is_none_is_refused(folder: Path, capsys) -> None:
    with pytest.raises(SystemExit):
        make_parser().parse_args([str(folder), "--sensor", "consumer"])
    assert "no sensor 'consumer'" in capsys.readouterr().err
