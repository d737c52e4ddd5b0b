"""How alike scans are, and a sensor fitted to them: on images made here, and on real scans."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh

from experiments.pages.reproduction.studies import recorded
from experiments.studies.sensor_fit import study as sensor_fit
from experiments.studies.sensor_fit.sensor_statistics import (
    Compared,
    Grid,
    compared,
    distance,
    find_grid,
    residual_gap,
    statistics,
    unlikeness,
)
from vanejax.cad import part_from_mesh
from vanejax.errors import InputError
from vanejax.localization import RayCasting, measurement_model
from vanejax.scanner import Camera, Sensor, look_at, measure
from vanejax.scanner.camera import field_of_view_deg
from vanejax.scanner.sensor import consumer_depth

REAL = Path(__file__).parents[4] / "shared" / "data" / "real_scans"
GRID = Grid(focal_px=212.3, column_phase=0.21, row_phase=-0.37)
CAMERA = Camera(
    width=120,
    height=96,
    fov_x_deg=field_of_view_deg(120, 300.0),
    fov_y_deg=field_of_view_deg(96, 300.0),
    near_mm=100.0,
)


@pytest.fixture(scope="module")
def model() -> RayCasting:
    """A step of three blocks: faces, edges and a pose that is known."""
    blocks = [
        trimesh.creation.box(bounds=((x, -30, 0), (x + 20, 30 - 10 * n, 14 * (n + 1))))
        for n, x in enumerate((-30, -10, 10))
    ]
    mesh = trimesh.boolean.union(blocks)
    part = part_from_mesh(mesh.vertices, mesh.faces, name="steps")
    return measurement_model(part, np.zeros(3))


POSE = look_at(np.array([120.0, -150.0, 240.0]), np.array([0.0, 0.0, 10.0]))


def image(residual: np.ndarray, *, predicted: float = 200.0) -> Compared:
    """A scan of a plane seen flat, without edges; NaN residuals are not measured."""
    plane = np.full(residual.shape, predicted)
    far = np.full(residual.shape, 50.0)
    return Compared(plane + residual, plane, np.full(residual.shape, 10.0), far, 0 * plane)


def on_grid(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    row, column = rng.integers(-90, 90, (2, count))
    return GRID.rays(row, column) * rng.uniform(180, 300, count)[:, None]


def test_the_grid_of_a_camera_is_found_from_its_points_where_they_have_one():
    # half-precision coordinates, as the real scans have them
    scans = [(on_grid(2000, seed) / 1000).astype(np.float16) * 1000.0 for seed in range(3)]
    found = find_grid(scans)
    assert dataclasses.astuple(found) == pytest.approx(dataclasses.astuple(GRID), abs=0.02)
    points = np.random.default_rng(0).uniform(-50, 50, (3000, 3)) - [0, 0, 250]
    with pytest.raises(InputError, match="do not lie on a grid"):
        find_grid([points])


def test_an_ideal_scan_has_no_residuals_and_no_holes(model):
    scan = measure(model.scanner, Sensor(camera=CAMERA), POSE, np.random.default_rng(0))
    seen = compared(model, scan.points.astype(np.float64), POSE, Grid(CAMERA.fx, 0.5, 0.5))
    there = np.isfinite(seen.measured)
    assert there.sum() == len(scan.points) > 1500
    np.testing.assert_array_equal(there, np.isfinite(seen.predicted))
    np.testing.assert_allclose(seen.residual_mm[there], 0, atol=1e-3)  # f32 points at 300 mm
    np.testing.assert_allclose(
        np.sort(seen.incidence_deg[there]), np.sort(scan.ideal.incidence_deg), atol=0.01
    )
    figures = statistics([seen])
    for name, value in figures.items():
        if name.endswith("(mm)") or "not measured" in name or "outline" in name:
            assert np.isnan(value) or abs(value) < 1e-3, name
    # the outline is an edge, the middle of a face is none, a crease adds to a ridge's depth
    assert seen.edge_px[there].min() <= 1
    assert seen.edge_px.max() > 4
    assert np.nanmax(seen.crease_mm) > 0.5


def white_noise(rng: np.random.Generator) -> Compared:
    return image(0.5 * rng.standard_normal((100, 120)))


def test_figures_of_white_noise():
    rng = np.random.default_rng(0)
    scans = [white_noise(rng) for _ in range(3)]
    figures = statistics(scans)
    # 36,000 values: a median's relative error is 1.7 / sqrt(n), some 1 %
    assert figures["inside: spread (mm)"] == pytest.approx(0.5, rel=0.03)
    assert figures["inside: beyond 3 spreads (share)"] == pytest.approx(0.0027, abs=0.002)
    for lag in (1, 3, 8, 20):  # of two values the difference has twice the variance
        name = f"residuals {lag} px apart: difference (mm)"
        assert figures[name] == pytest.approx(0.5 * np.sqrt(2), rel=0.03)
    assert np.isnan(figures["inside, incidence above 60 deg: spread (mm)"])
    assert figures["inside, 0 to 40 deg: not measured (share)"] == 0
    assert residual_gap(scans[:1], scans[:1]) == 0
    assert residual_gap(scans[:1], scans[1:]) < 0.03
    far = dataclasses.replace(scans[1], measured=scans[1].measured + 20)
    assert residual_gap(scans[:1], [far]) == 1


def test_figures_of_smooth_errors_holes_and_steps():
    column = np.arange(120.0)
    smooth = np.sin((column + np.arange(100.0)[:, None]) / 30)
    figures = statistics([image(smooth)])
    near, far = (figures[f"residuals {lag} px apart: difference (mm)"] for lag in (1, 20))
    # along a line the differences grow nearly in proportion to the distance
    assert far == pytest.approx(20 * near, rel=0.15)
    smooth[:, ::4] = np.nan
    assert statistics([image(smooth)])["inside, 0 to 40 deg: not measured (share)"] == 0.25
    stepped = np.floor(np.broadcast_to(column / 10, (100, 120)))
    same = statistics([image(stepped)])["neighbours of the same depth (share)"]
    assert same == pytest.approx(108 / 119)


def test_what_lies_near_an_edge_is_counted_apart():
    scan = white_noise(np.random.default_rng(0))
    edge = np.full(scan.edge_px.shape, 50.0)
    edge[:, :60] = 1.0
    residual = scan.residual_mm
    residual[:, :60] = 5.0
    residual[:50, :60] = np.nan
    beside = dataclasses.replace(scan, measured=200.0 + residual, edge_px=edge)
    figures, gap = statistics([beside]), residual_gap([scan], [beside])
    assert figures["inside: spread (mm)"] == pytest.approx(0.5, rel=0.05)
    assert figures["inside: beyond 3 spreads (share)"] < 0.01
    assert figures["residuals 3 px apart: difference (mm)"] == pytest.approx(0.71, rel=0.05)
    assert figures["inside, 0 to 40 deg: not measured (share)"] == 0
    assert figures["at edges: not measured (share)"] == 0.5
    assert figures["at edges: beyond 3 spreads (share)"] == 1
    assert gap < 0.03


def test_rounding_is_the_share_of_what_a_window_would_add():
    crease = np.random.default_rng(0).standard_normal((100, 120))
    scan = dataclasses.replace(image(0.7 * crease), crease_mm=crease)
    assert statistics([scan])["rounding of edges (ratio)"] == pytest.approx(0.7, rel=0.02)


def test_distances_are_logarithms_of_ratios():
    one = {"a (mm)": 10.0, "b (share)": 0.5, "c (ratio)": 1.0}
    assert distance(one, one) == 0
    other = {"a (mm)": 20.05, "b (share)": 0.5, "c (ratio)": 1.0}
    assert unlikeness(one, other)["a (mm)"] == pytest.approx(np.log(2))
    assert distance(one, other) == pytest.approx(np.log(2) / 3)
    assert distance(other, one) == pytest.approx(distance(one, other))
    nothing = {"a (mm)": 0.0, "b (share)": float("nan"), "c (ratio)": -3.0}
    assert unlikeness(one, nothing).keys() == {"a (mm)", "c (ratio)"}
    assert np.isfinite(distance(one, nothing))
    # a slope below 0 is as little as none
    none = unlikeness({"c (ratio)": 0.0}, one)["c (ratio)"]
    assert unlikeness({"c (ratio)": -3.0}, one)["c (ratio)"] == none


def test_effects_alone_and_left_out_are_those_of_the_sensor():
    full = dataclasses.replace(consumer_depth(), camera=CAMERA)
    for effect, names in sensor_fit.EFFECTS.items():
        one, rest = full.only(*names), sensor_fit.without(full, effect)
        for other, others in sensor_fit.EFFECTS.items():
            for name in others:
                has, lacks = (one, rest) if other == effect else (rest, one)
                assert getattr(has, name) == getattr(full, name), (effect, name)
                assert getattr(lacks, name) == getattr(Sensor(), name), (effect, name)
        assert any(getattr(full, name) != getattr(Sensor(), name) for name in names)
        assert one.camera == rest.camera == CAMERA


def test_a_search_finds_the_values_that_are_likest():
    wanted = {"noise_px": 0.02, "window_px": 2.5}

    def unlike(sensor: Sensor) -> float:
        return sum(np.log(getattr(sensor, name) / value) ** 2 for name, value in wanted.items())

    start = {"noise_px": 0.1, "window_px": 1.0}
    found = sensor_fit.fit(unlike, Sensor(), start, steps=200)
    for name, value in wanted.items():
        assert getattr(found, name) == pytest.approx(value, rel=0.01)
    assert found.border_dropout_px == 0


def test_values_that_no_sensor_has_are_held_at_the_nearest():
    made = sensor_fit.with_values(
        Sensor(), {"flying_pixel_rate": 3.0, "correlation_px": 0.2, "max_incidence_deg": 200.0}
    )
    assert (made.flying_pixel_rate, made.correlation_px, made.max_incidence_deg) == (1.0, 1.0, 90.0)


@pytest.mark.slow
@pytest.mark.skipif(not REAL.exists(), reason=f"the real scans are not at {REAL}")
def test_the_fitted_sensor_is_liker_to_real_scans_than_an_ideal_one():
    scans = sensor_fit.load(REAL)[1::5]  # three of both parts, the first two not fitted to
    grid = find_grid([scan.points for scan in scans])
    assert grid.focal_px == pytest.approx(consumer_depth().camera.fx, abs=0.05)
    real = [scan.compared(grid) for scan in scans]
    # every pixel is measured once
    for scan, seen in zip(scans, real, strict=True):
        assert np.isfinite(seen.measured).sum() == len(scan.points)
    wanted = statistics(real)
    fitted, ideal = (
        statistics(sensor_fit.measured_by(scans, sensor, 0))
        for sensor in (consumer_depth(), Sensor(camera=consumer_depth().camera))
    )
    assert distance(wanted, fitted) < 0.8
    assert distance(wanted, ideal) > 2


def test_the_preset_is_what_was_fitted():
    fitted, preset = recorded()["sensor_fit"]["sensor"], consumer_depth()
    field_of = {recorded_as: field for field, recorded_as in sensor_fit.RECORDED_AS.items()}
    for name, value in fitted.items():
        assert getattr(preset, field_of.get(name, name)) == pytest.approx(value, rel=1e-5), name
