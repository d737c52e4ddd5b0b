"""Each disturbance grows with its strength, and leaves the truth what it is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from experiments.studies.robustness import disturbances
from experiments.studies.robustness.disturbances import Disturbed, Series, Stand, saturating
from vanejax.cad import guide_vane
from vanejax.localization import RayCasting, measurement_model
from vanejax.localization.pose_batch import stack
from vanejax.scanner import Reason, hemisphere_viewpoints, measure, preset
from vanejax.scans import Segment, Segments


@pytest.fixture(scope="module")
def model() -> RayCasting:
    part = guide_vane()
    return measurement_model(part, np.zeros(3))


@pytest.fixture(scope="module")
def series(model) -> dict[str, Series]:
    return {one.name: one for one in Stand(model.part, seed=3).series(views=2)}


def deviations(model: RayCasting, scan: Disturbed) -> np.ndarray:
    """[n] mm of up to 5,000 points that the model predicts at the true pose."""
    pose = scan.part_from_camera
    some = scan.points[:: max(1, len(scan.points) // 5000)]
    found = model.residuals(stack(pose), some)
    return found.deviation_mm[0][found.hit[0]]


def test_the_same_arguments_give_the_same_scan(series):
    one, same, other = (series["distance"].take(400.0, number) for number in (0, 0, 1))
    np.testing.assert_array_equal(one.points, same.points)
    assert len(one.points) != len(other.points) or (one.points != other.points).any()


def test_distances_and_angles_are_those_asked_for(series, model):
    center = model.part.center[None]
    for distance in (300.0, 800.0):
        scan = series["distance"].take(distance, 0)
        found = scan.part_from_camera.inverse().apply(center)[0]
        assert -found[2] == pytest.approx(distance, abs=1e-6)
        assert np.median(np.abs(deviations(model, scan))) < 0.3
    scan = series["angle"].take(130.0, 0)
    eye = scan.part_from_camera.translation - center[0]
    assert np.degrees(np.arctan2(eye[1], eye[0])) == pytest.approx(130.0)
    assert np.linalg.norm(eye) == pytest.approx(400.0)
    assert len(series["angle"].values) == 36


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_strong_light_saturates_the_share_asked_for(model, share):
    view = hemisphere_viewpoints(model.part.center).view(20)
    sensor = preset("paper_camera").scaled(0.5)
    bright = saturating(model.scanner, sensor, view, share, seed=0)
    assert bright.exposure.exposure_ms > sensor.exposure.exposure_ms
    assert dataclasses.replace(bright, exposure=sensor.exposure) == sensor
    reason = measure(model.scanner, bright, view, np.random.default_rng(1)).reason
    # found at a quarter of the pixels: its own sampling of the image
    assert np.mean(reason == Reason.SATURATED) == pytest.approx(share, abs=0.03)
    assert saturating(model.scanner, sensor, view, 0.0, seed=0) == sensor


def test_chips_and_drops_are_measured_and_stay(series):
    clean, littered = (series["chips"].take(count, 0) for count in (0.0, 40.0))
    assert clean.clutter_share == 0
    assert 0.003 < littered.clutter_share < 0.5


def test_a_table_is_taken_away_again(series, model):
    scan = series["fixture"].take(2.0, 0)
    assert len(scan.points) < 0.7 * len(scan.measured.points)
    assert scan.clutter_share < 0.3
    assert np.median(np.abs(deviations(model, scan))) < 0.3


def test_a_casting_stands_off_the_cad_by_its_allowance(series, model):
    medians = [
        np.median(deviations(model, series["casting"].take(allowance, 0)))
        for allowance in (0.0, 1.0)
    ]
    assert abs(medians[0]) < 0.05
    assert medians[1] == pytest.approx(0.5, abs=0.15)  # half of it everywhere, the rest in waves


def test_correlated_noise_is_what_is_asked_for(series, model):
    quiet, loud = (
        np.std(np.clip(deviations(model, series["noise"].take(pixels, 0)), -1, 1))
        for pixels in (0.0, 0.2)
    )
    assert loud > 1.5 * quiet


def test_a_table_that_stays_counts_as_foreign(series, model, monkeypatch):
    def everything(points, part, **_):
        return Segments(np.full(len(points), Segment.PART, np.uint8), ())

    monkeypatch.setattr(disturbances, "segment", everything)
    scan = series["fixture"].take(0.0, 0)  # the table is all there is beside the part
    assert len(scan.points) == len(scan.measured.points)
    # the rays of its points miss the part
    hit = model.residuals(stack(scan.part_from_camera), scan.points).hit[0]
    assert scan.clutter_share == pytest.approx(1 - hit.mean(), abs=0.03)
    assert scan.clutter_share > 0.3
