"""Pictures of what a sensor and a segmentation made of a scan, pixel by pixel."""

from __future__ import annotations

import json

import numpy as np
import pytest
from matplotlib.colors import Normalize, to_rgb

from experiments.studies.sensor_effects import study as sensor_effects
from experiments.studies.sensor_effects.study import effects, table
from vanejax.cad.parametric_vane import guide_vane
from vanejax.errors import InputError
from vanejax.plotting.sensing import (
    REASON_COLORS,
    error_image,
    measurements_picture,
    off_surface_mm,
    segments_picture,
)
from vanejax.scanner.camera import Camera, hemisphere_viewpoints
from vanejax.scanner.clutter import Clutter, clutter_scene
from vanejax.scanner.measurement import Measurement, Reason, measure
from vanejax.scanner.range_errors import Trueness
from vanejax.scanner.sensor import Sensor, paper_camera
from vanejax.scanner.virtual_scanner import Scanner
from vanejax.scans.segmentation import Segment, Segments

SMALL = Camera(width=160, height=128, near_mm=200.0)


@pytest.fixture(scope="module")
def scanner() -> Scanner:
    return Scanner(guide_vane())


def taken(scanner: Scanner, sensor: Sensor) -> Measurement:
    view = hemisphere_viewpoints(scanner.part.center).view(50)
    return measure(scanner, sensor, view, np.random.default_rng(0))


def test_every_reason_has_its_color_and_every_point_its_error(scanner):
    scan = taken(scanner, paper_camera().scaled(0.125))
    image = error_image(scan, Normalize(-0.1, 0.1)).reshape(-1, 3)
    for reason, color in REASON_COLORS.items():
        found = np.all(image[scan.ideal.pixel] == to_rgb(color), axis=1)
        np.testing.assert_array_equal(found, scan.reason == reason)
    nothing = np.setdiff1d(np.arange(len(image)), scan.ideal.pixel)
    assert (image[nothing] == 1).all()
    assert Reason.MEASURED not in REASON_COLORS


def test_a_scan_that_is_too_far_by_a_tenth_stands_off_by_its_cosine(scanner):
    scan = taken(scanner, Sensor(camera=SMALL, trueness=Trueness(scale=1e-3)))
    cosine = np.cos(np.radians(scan.ideal.incidence_deg.astype(np.float64)))
    # farther from the camera is into the part
    np.testing.assert_allclose(
        off_surface_mm(scan), -1e-3 * scan.ideal.range_mm[scan.kept] * cosine, atol=1e-4
    )


def test_a_panel_for_each_measurement_and_a_legend_of_what_is_seen(scanner):
    scans = {"ideal": Sensor(camera=SMALL), "shadow": Sensor(camera=SMALL, shadow=True)}
    scans_taken = {name: taken(scanner, s) for name, s in scans.items()}
    figure = measurements_picture(scans_taken)
    assert [axes.get_title(loc="left") for axes in figure.axes[:2]] == [
        "ideal\nno error",
        f"shadow\n{scans_taken['shadow'].hole_share:.1%} lost",
    ]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["shadowed"]
    ideal, shadow = (axes.get_images()[0].get_array() for axes in figure.axes[:2])
    assert np.any(np.all(shadow == to_rgb(REASON_COLORS[Reason.SHADOWED]), axis=-1))
    assert not np.any(np.all(ideal == to_rgb(REASON_COLORS[Reason.SHADOWED]), axis=-1))


def test_each_effect_stands_alone():
    """Bare but for one change each; together they are the paper's camera."""
    sensors = effects()
    assert sensors["all"] == paper_camera()
    bare = sensors["ideal"]
    for name, sensor in sensors.items():
        changed = [f for f in vars(bare) if getattr(sensor, f) != getattr(bare, f)]
        assert name in ("ideal", "all") or 1 <= len(changed) <= 2, (name, changed)


def test_the_command_measures_times_and_draws(tmp_path, capsys, monkeypatch):
    small = paper_camera().scaled(0.125)
    monkeypatch.setattr(sensor_effects, "paper_camera", lambda: small)
    arguments = ["--views", "1", "--repeats", "1", "--out", str(tmp_path)]
    report = sensor_effects.main(sensor_effects.make_parser().parse_args(arguments))
    assert report["effects"]["ideal"]["ratio"] == 1.0
    assert report["effects"]["ideal"]["hole_share"] == 0.0
    assert report["effects"]["strong light"]["hole_share"] > 0.2
    assert json.loads((tmp_path / "sensor_effects.json").read_text()) == report
    assert (tmp_path / "sensor_effects.png").stat().st_size > 20_000
    assert (tmp_path / "sensor_effects.pdf").exists()
    assert "projector shadow" in capsys.readouterr().out
    report["effects"]["all"]["ratio"] = 3.5
    assert "MISSED" in table(report)
    for wrong in (["--view", "216"], ["--views", "217"]):
        with pytest.raises(InputError, match=wrong[0]):
            sensor_effects.main(sensor_effects.make_parser().parse_args([*arguments, *wrong]))


def test_a_segmentation_is_drawn_beside_the_truth():
    scene = clutter_scene(guide_vane(), Clutter(table=True, clamps=1), np.random.default_rng(0))
    camera = Camera(width=160, height=128, near_mm=200.0)
    scan = scene.scanner().scan(camera, hemisphere_viewpoints(guide_vane().center).view(50))
    owner = scene.owner(scan.face)
    truth = np.array([Segment.PART, Segment.TABLE, Segment.OTHER], np.uint8)[owner]
    figure = segments_picture(scan, camera, scene, Segments(truth, ()))
    found, right = (axes.get_images()[0].get_array() for axes in figure.axes)
    np.testing.assert_array_equal(found, right)
    assert "0.0% of the points wrong" in figure.axes[0].get_title()
    wrong = truth.copy()
    wrong[: len(wrong) // 4] = Segment.OTHER
    figure = segments_picture(scan, camera, scene, Segments(wrong, ()))
    share = np.mean(wrong != truth)
    assert share > 0.1
    assert f"{share:.1%} of the points wrong" in figure.axes[0].get_title()
    with pytest.raises(InputError, match="the segmentation 1"):
        segments_picture(scan, camera, scene, Segments(truth[:1], ()))
