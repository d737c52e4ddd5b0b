"""Displacements by errors of calibration, against what the virtual sensor does with them."""

from __future__ import annotations

import dataclasses
import re
from ast import literal_eval
from pathlib import Path

import numpy as np
import pytest
from example_scans import SMALL, ideal_scan, model, vane

from vanejax.errors import InputError
from vanejax.localization.sensor_calibration import Calibration
from vanejax.scanner import Sensor, measure
from vanejax.scanner.range_errors import Lens, Trueness
from vanejax.scanner.sensor import PRESETS
from vanejax.scans import MeasuredScan

ERRORS = {
    "k1": {"lens": Lens(k1=1e-3)},
    "p2": {"lens": Lens(p2=1e-4)},
    "focal": {"lens": Lens(focal_error=1e-4)},
    "rows": {"lens": Lens(center_error_px=(0.0, 0.1))},
    "scale": {"trueness": Trueness(scale=1e-4)},
    "bend": {"trueness": Trueness(bend_mm=(0.05, 0.0))},
}


@pytest.mark.parametrize("name", ERRORS)
def test_it_is_what_the_sensor_does(name):
    scan, _ = ideal_scan(vane())
    sensor = Sensor(SMALL, **ERRORS[name])
    taken = measure(model(vane()).scanner, sensor, scan.camera_from_part, np.random.default_rng(0))
    points = scan.points.astype(np.float64)
    (moved,) = Calibration.of(sensor).displacements(points)
    along = np.sign(np.sum(moved * (taken.points - points)))
    np.testing.assert_allclose(along * moved, taken.points - points, atol=2e-4)  # f32 of 400 mm
    assert np.abs(moved).max() > 1e-3


def test_each_error_counts_once():
    full = Calibration(
        lens=Lens(1e-3, 1e-3, 1e-4, 1e-4, 1e-4, (0.1, 0.1)), trueness=Trueness(1e-4, (0.02, 0.02))
    )
    points = np.array([[10.0, 20.0, -400.0], [-30.0, 5.0, -300.0]])
    assert full.displacements(points).shape == (10, 2, 3)
    assert Calibration().displacements(points).shape == (0, 2, 3)
    assert len(Calibration.of("paper_camera").displacements(points)) == 10


@pytest.mark.parametrize("sensor", ["ideal", "consumer_depth", Sensor(noise_px=0.1)])
def test_a_sensor_without_errors_of_calibration_is_refused(sensor):
    """It would count for nothing, and the covariance would look complete."""
    with pytest.raises(InputError, match=r"no errors of calibration .*: paper_camera"):
        Calibration.of(sensor)


def test_the_page_has_the_figures_of_every_calibrated_preset():
    page = (Path(__file__).parents[2] / "docs" / "virtual_scans.md").read_text()
    (names,) = re.findall(r"^\| error of calibration .* \| `(\w+)` \|$", page, re.MULTILINE)
    rows = dict(re.findall(r"^\| `(\w+\.\w+)` \|.*\| ([^|]+) \|$", page, re.MULTILINE))
    assert [n for n, make in PRESETS.items() if make().lens or make().trueness] == [names]
    calibration = Calibration.of(names)
    expected = {
        f"{part}.{field.name}": getattr(errors, field.name)
        for part, errors in (("lens", calibration.lens), ("trueness", calibration.trueness))
        for field in dataclasses.fields(errors)
    }
    assert {name: literal_eval(value) for name, value in rows.items()} == expected


def test_the_scan_must_be_in_the_cameras_frame():
    scan, _ = ideal_scan(vane())
    cloud = MeasuredScan(scan.points.astype(np.float64), None, np.zeros(3))
    Calibration().check_frame(cloud)
    for origin in (None, np.array([0.0, 0.0, 5.0])):
        with pytest.raises(InputError, match="in the camera's frame"):
            Calibration().check_frame(dataclasses.replace(cloud, sensor_origin=origin))
    with pytest.raises(InputError, match="hawk"):
        Calibration.of("hawk")
