"""Each effect of the sensor where physics says, and none where it is switched off."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from example_scans import solid
from scipy.special import erf

from vanejax.cad import guide_vane
from vanejax.errors import InputError
from vanejax.scanner import (
    Camera,
    Clutter,
    Measurement,
    Reason,
    Scanner,
    hemisphere_viewpoints,
    look_at,
    measure,
)
from vanejax.scanner.exposure import Exposure
from vanejax.scanner.range_errors import Trueness, near_outline, window_mean
from vanejax.scanner.sensor import PRESETS, Sensor, preset

CAMERA = Camera(width=320, height=256, near_mm=100.0)
ABOVE = look_at(np.array([0.0, 0.0, 400.0]), np.zeros(3))


def boxes(*bounds: tuple) -> Scanner:
    return Scanner(solid(*(trimesh.creation.box(bounds=b) for b in bounds)))


@pytest.fixture(scope="module")
def plate() -> Scanner:
    """A plate whose upper face is z = 0, 400 mm below the camera; no noise is absorbed by edges."""
    return boxes(((-90, -60, -4), (90, 60, 0)))


@pytest.fixture(scope="module")
def vane() -> Scanner:
    return Scanner(guide_vane())


@pytest.fixture(scope="module")
def ball() -> Scanner:
    return Scanner(solid(trimesh.creation.icosphere(subdivisions=4, radius=50.0)))


def take(scanner: Scanner, sensor: Sensor, *, seed: int = 0, pose=ABOVE) -> Measurement:
    return measure(scanner, sensor, pose, np.random.default_rng(seed))


def depth_error(scan: Measurement) -> np.ndarray:
    """[n] mm, measured depth less the true one."""
    return (scan.ideal.points[scan.kept, 2] - scan.points[:, 2]).astype(np.float64)


def test_without_effects_the_scan_is_the_ideal_one_bit_for_bit(vane):
    view = hemisphere_viewpoints(vane.part.center).view(50)
    sensor = Sensor(camera=CAMERA)
    ideal = vane.scan(CAMERA, view)
    scan = take(vane, sensor, pose=view)
    np.testing.assert_array_equal(scan.points, ideal.points)
    np.testing.assert_array_equal(scan.reason, np.zeros(len(ideal.points), np.uint8))
    np.testing.assert_array_equal(scan.range_mm, scan.ideal.range_mm[scan.kept])
    for name in ("face", "pixel", "normals"):
        np.testing.assert_array_equal(getattr(scan, name), getattr(ideal, name))


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_deterministic_and_seeded(name, vane):
    view = hemisphere_viewpoints(vane.part.center).view(50)
    sensor = preset(name).scaled(0.25) if name != "consumer_depth" else preset(name)
    one, same, other = (take(vane, sensor, seed=seed, pose=view) for seed in (4, 4, 5))
    np.testing.assert_array_equal(one.points, same.points)
    np.testing.assert_array_equal(one.reason, same.reason)
    assert np.isfinite(one.points).all()
    assert (one.points.shape == other.points.shape and (one.points == other.points).all()) == (
        name == "ideal"
    )


def test_the_shadow_ends_where_the_projector_s_ray_over_the_edge_lands():
    """A block 20 mm high ends at x = -20; the projector stands at x = +120 - or at -120."""
    scanner = boxes(((-90, -60, -4), (90, 60, 0)), ((-40, -60, -1), (-20, 60, 20)))
    for baseline, edge, inward in ((120.0, -40.0, -1), (-120.0, -20.0, 1)):
        scan = take(scanner, Sensor(camera=CAMERA, baseline_mm=baseline, shadow=True))
        points = ABOVE.inverse().apply(scan.ideal.points.astype(np.float64))
        floor = np.abs(points[:, 2]) < 1e-3
        dark = floor & (scan.reason == Reason.SHADOWED)
        # from (baseline, 400) over (edge, 20) down to z = 0
        lands = edge + (edge - baseline) * 20 / 380
        low, high = sorted((edge, lands))
        inside = floor & (points[:, 0] > low) & (points[:, 0] < high)
        assert dark.sum() > 500
        np.testing.assert_array_equal(dark, inside)
        assert np.sign(lands - edge) == inward


def test_dropout_begins_at_its_angle(ball):
    scan = take(ball, Sensor(camera=CAMERA, max_incidence_deg=60.0))
    steep = scan.ideal.incidence_deg > 60.0
    clear = np.abs(scan.ideal.incidence_deg - 60.0) > 1e-3
    assert steep.sum() > 1000
    np.testing.assert_array_equal((scan.reason == Reason.GRAZING)[clear], steep[clear])


def test_strong_light_makes_holes_and_short_exposure_makes_dark(plate):
    def shares(exposure: Exposure) -> tuple[float, float]:
        scan = take(plate, Sensor(camera=CAMERA, exposure=exposure))
        return tuple(np.mean(scan.reason == why) for why in (Reason.SATURATED, Reason.DARK))

    good = Exposure(exposure_ms=10.0)
    assert shares(good) == (0.0, 0.0)
    assert shares(dataclasses.replace(good, exposure_ms=0.3)) == (0.0, 1.0)
    assert shares(dataclasses.replace(good, exposure_ms=60.0)) == (1.0, 0.0)
    # a lamp that the middle of the plate mirrors into the camera
    lamp = Exposure(
        projector_per_ms=1e-6,
        least_modulation=0.0,
        ambient_per_ms=0.01,
        ambient_towards=(0, 0, 1),
        specular=0.5,
        roughness=0.03,
    )
    saturated, _ = shares(lamp)
    assert 0.005 < saturated < 0.6
    scan = take(plate, Sensor(camera=CAMERA, exposure=lamp))
    hole = scan.ideal.points[scan.reason == Reason.SATURATED][:, :2]
    rest = scan.ideal.points[scan.reason == Reason.MEASURED][:, :2]
    assert np.linalg.norm(hole, axis=1).max() < np.linalg.norm(rest, axis=1).max() / 2
    assert np.linalg.norm(hole.mean(axis=0)) < 3


def test_noise_has_the_variance_of_triangulation(plate):
    """sigma_z = z^2 / (f b) sigma_d, at two depths."""
    for z in (300.0, 600.0):
        pose = look_at(np.array([0.0, 0.0, z]), np.zeros(3))
        sensor = Sensor(camera=CAMERA, baseline_mm=100.0, noise_px=0.05)
        errors = np.concatenate(
            [depth_error(take(plate, sensor, seed=seed, pose=pose)) for seed in range(3)]
        )
        sigma = z**2 / (CAMERA.fx * 100.0) * 0.05
        assert sensor.range_sigma_mm(z) == pytest.approx(sigma)
        # n values: the relative error of a standard deviation is 1 / sqrt(2 n)
        np.testing.assert_allclose(errors.std(), sigma, rtol=4 / np.sqrt(2 * len(errors)) + 1e-3)
        np.testing.assert_allclose(errors.mean(), 0, atol=4 * sigma / np.sqrt(len(errors)) + 1e-4)


def test_noise_grows_where_less_light_comes_back(plate):
    """Shot noise: half the exposure gives sqrt(2) times the noise, at every pixel."""

    def spread(exposure_ms: float) -> float:
        exposure = Exposure(exposure_ms=exposure_ms, ambient_per_ms=0.0, least_modulation=0.01)
        return depth_error(
            take(plate, Sensor(camera=CAMERA, noise_px=0.05, exposure=exposure))
        ).std()

    # the same draws twice: the ratio has no error of sampling but rounding
    assert spread(5.0) / spread(10.0) == pytest.approx(np.sqrt(2), rel=1e-3)


def test_errors_lie_along_the_pixel_s_ray(plate):
    scan = take(
        plate, Sensor(camera=CAMERA, noise_px=0.2, flying_pixel_rate=1.0, outlier_rate=0.01)
    )
    true = scan.ideal.points[scan.kept]
    np.testing.assert_allclose(np.cross(true, scan.points) / 400**2, 0, atol=3e-7)  # f32 eps, twice


def test_mixed_pixels_lie_at_depth_edges_between_both_surfaces():
    scanner = boxes(((-90, -60, -4), (90, 60, 0)), ((-20, -20, -1), (20, 20, 30)))
    scan = take(scanner, Sensor(camera=CAMERA, flying_pixel_rate=1.0, jump_mm=5.0))
    error = depth_error(scan)
    moved = np.abs(error) > 1e-3
    assert 100 < moved.sum() < 0.05 * len(error)
    height = ABOVE.inverse().apply(scan.points.astype(np.float64))[moved, 2]
    assert (height > -0.01).all()
    assert (height < 30.01).all()


def test_steps_of_depth_and_of_disparity(plate):
    scan = take(plate, Sensor(camera=CAMERA, noise_px=0.3, depth_quantisation_mm=0.5))
    steps = -scan.points[:, 2] / 0.5
    np.testing.assert_allclose(steps, np.round(steps), atol=2e-4)
    sensor = Sensor(camera=CAMERA, noise_px=0.3, disparity_quantisation_px=0.125)
    disparity = sensor.focal_baseline / -take(plate, sensor).points[:, 2].astype(np.float64) / 0.125
    np.testing.assert_allclose(disparity, np.round(disparity), atol=1e-3)
    assert len(np.unique(np.round(disparity))) > 5


def test_trueness_biases_and_does_not_scatter(plate):
    scan = take(plate, Sensor(camera=CAMERA, trueness=Trueness(scale=1e-3)))
    np.testing.assert_allclose(depth_error(scan), 0.4, atol=5e-4)
    bent = take(plate, Sensor(camera=CAMERA, trueness=Trueness(bend_mm=(0.5, 0.0))))
    x = CAMERA.project(bent.ideal.points[:, :])[:, 0] / (CAMERA.width / 2) - 1
    np.testing.assert_allclose(depth_error(bent), 0.5 * x**2, atol=1e-3)


def test_outliers_and_lost_pixels_have_their_shares(plate):
    scan = take(plate, Sensor(camera=CAMERA, outlier_rate=0.05, outlier_mm=10.0, dropout_rate=0.1))
    error = np.abs(depth_error(scan))
    count = len(scan.reason)
    # binomial: 4 standard deviations
    assert abs(np.mean(scan.reason == Reason.LOST) - 0.1) < 4 * np.sqrt(0.09 / count)
    assert abs(np.mean(error > 1e-2) - 0.05) < 4 * np.sqrt(0.0475 / count) + 1e-3
    assert error.max() < 10.01
    assert error.max() > 9


def test_what_is_measured_outside_the_clip_planes_is_dropped(plate):
    near = dataclasses.replace(CAMERA, near_mm=399.0)
    scan = take(plate, Sensor(camera=near, outlier_rate=0.5, outlier_mm=50.0))
    assert np.mean(scan.reason == Reason.OUT_OF_RANGE) > 0.15
    assert (-scan.points[:, 2] >= 399.0).all()


def test_organised_arrays_hold_the_packed_ones(vane):
    view = hemisphere_viewpoints(vane.part.center).view(80)
    scan = take(vane, preset("paper_camera").scaled(0.2), pose=view)
    images = scan.organised()
    camera = scan.sensor.camera
    for name, image in images.items():
        assert image.shape[:2] == (camera.height, camera.width), name
    there = np.isfinite(images["range_mm"])
    np.testing.assert_array_equal(np.flatnonzero(there), scan.pixel)
    np.testing.assert_array_equal(images["points"][there], scan.points)
    np.testing.assert_array_equal(images["face"][there], scan.face)
    np.testing.assert_array_equal(images["clean_range_mm"][there], scan.ideal.range_mm[scan.kept])
    reasons = np.bincount(images["reason"].ravel(), minlength=8)
    assert reasons[Reason.NOTHING] == camera.width * camera.height - len(scan.reason)
    assert reasons[Reason.MEASURED] == len(scan.points)
    assert 0 < scan.hole_share < 1
    assert len(scan.normals) == len(scan.points)


@pytest.mark.slow
def test_the_paper_s_camera_keeps_the_accuracy_of_its_table():
    """0.1 mm at 300 and 1 mm at 1300 mm, read as a bound on 95 % of the errors; not far below."""
    for z, bound in ((300.0, 0.1), (1300.0, 1.0)):
        half = z / 8
        scanner = boxes(((-half, -half, -4), (half, half, 0)))
        pose = look_at(np.array([0.0, 0.0, z]), np.zeros(3))
        sensor = dataclasses.replace(
            preset("paper_camera"), flying_pixel_rate=0.0, outlier_rate=0.0
        )
        errors = []
        for seed in range(8):
            rng = np.random.default_rng(seed)
            scan = measure(scanner, sensor.sample(rng).exposed_for(z), pose, rng)
            assert len(scan.points), f"nothing is measured at {z} mm"
            errors.append(np.quantile(np.abs(depth_error(scan)), 0.95))
        assert 0.3 * bound < np.median(errors) <= bound


def test_another_camera_of_a_kind_differs_and_keeps_its_switches():
    rng = np.random.default_rng(0)
    kind = preset("paper_camera")
    made = [kind.sample(rng) for _ in range(200)]
    scales = np.array([sensor.trueness.scale for sensor in made])
    np.testing.assert_allclose(scales.std(), kind.trueness.scale, rtol=0.2)
    noise = np.log([sensor.noise_px / kind.noise_px for sensor in made])
    np.testing.assert_allclose(noise.std(), 0.3, rtol=0.2)
    assert all(sensor.shadow and sensor.camera == kind.camera for sensor in made)
    assert dataclasses.replace(Sensor().sample(rng), correlation_px=16.0) == Sensor()


def test_fewer_pixels_leave_the_errors_in_mm(plate):
    sensor = dataclasses.replace(preset("paper_camera"), exposure=None)
    for factor in (0.25, 0.5):
        small = sensor.scaled(factor)
        assert small.camera.width == sensor.camera.width * factor
        assert small.range_sigma_mm(400.0) == pytest.approx(sensor.range_sigma_mm(400.0))
        # in mm an error of the disparity is z^2 / (f b) of it, and a length in the image z / f
        for name in ("correlated_px", "correlation_px", "disparity_quantisation_px"):
            mine, theirs = (getattr(s, name) / s.camera.fx for s in (small, sensor))
            assert mine == pytest.approx(theirs), name


CANNOT_BE = {
    Sensor: {
        "baseline_mm": 0.0,
        "max_incidence_deg": 91.0,
        "noise_px": -1.0,
        "edge_fattening_px": np.nan,
        "incidence_spread_deg": -1.0,
        "correlation_px": 0.5,
        "flying_pixel_rate": 1.5,
        "outlier_rate": np.nan,
        "depth_quantisation_mm": np.inf,
    },
    Exposure: {
        "exposure_ms": 0.0,
        "projector_per_ms": np.nan,
        "roughness": -1.0,
        "ambient_per_ms": -0.1,
        "specular": 1.5,
        "ambient_towards": (0.0, 0.0, 0.0),
        "least_modulation": np.inf,
    },
    Clutter: {"clamps": -1, "chips": -1, "drops": -1, "tilt_deg": np.nan},
}


@pytest.mark.parametrize(
    ("settings", "name"), [(kind, name) for kind, values in CANNOT_BE.items() for name in values]
)
def test_what_cannot_be_is_refused(settings, name):
    with pytest.raises(InputError, match=f"{settings.__name__.lower()}: {name}=.* must"):
        settings(**{name: CANNOT_BE[settings][name]})


def test_an_unknown_preset_is_answered_with_the_known_ones():
    with pytest.raises(InputError, match="ideal, paper_camera, consumer_depth"):
        preset("hawk")


def roof(slope: float) -> Scanner:
    """A ridge along y through (0, 0, 0), seen from above; both sides fall off by ``slope``."""
    mesh = trimesh.convex.convex_hull(
        [(x, y, z) for x, z in ((-60, -60 * slope), (60, -60 * slope), (0, 0)) for y in (-40, 40)]
    )
    return Scanner(solid(mesh))


def test_a_matching_window_rounds_a_ridge_off():
    """On the ridge of slopes +k and -k it is the mean of k |x| over the window."""
    camera = Camera(width=640, height=128, fov_y_deg=12.0, near_mm=100.0)
    sensor = Sensor(camera=camera, window_px=3.0, jump_mm=20.0)
    scan = take(roof(0.8), sensor)
    middle = (scan.pixel // camera.width == 64) & (abs(scan.pixel % camera.width - 319.5) < 1)
    assert middle.sum() == 2
    across = ABOVE.inverse().apply(scan.ideal.points.astype(np.float64))[:, 0]
    pitch = 400 / camera.fx
    # half a column beside the ridge: the mean of |x| over a window there, less the pixel's own
    over_window = 3.0 * np.sqrt(2 / np.pi) * np.exp(-(0.5**2) / 18) + 0.5 * erf(0.5 / np.sqrt(18))
    # the pitch is that at the ridge's depth, and the window reaches 4 mm behind it
    missing = 0.8 * pitch * (over_window - 0.5)
    np.testing.assert_allclose(depth_error(scan)[middle], missing, rtol=0.02)
    inside = (np.abs(across) > 20 * pitch) & (np.abs(across) < 60 - 20 * pitch)
    inside &= np.abs(scan.pixel // camera.width - 64) < 40
    assert inside.sum() > 1000
    # planes keep their disparity: it is linear in the image
    np.testing.assert_allclose(depth_error(scan)[inside], 0, atol=2e-3)


def test_what_a_window_matched_beside_its_pixel_errs_by_the_slope():
    slope, adhesion = 0.8, 0.5
    sensor = Sensor(camera=CAMERA, edge_fattening_px=adhesion, correlation_px=4.0, jump_mm=20.0)
    errors = []
    for seed in range(4):
        scan = take(roof(slope), sensor, seed=seed)
        across = ABOVE.inverse().apply(scan.ideal.points.astype(np.float64))[:, 0]
        inner = (np.abs(across) > 6) & (np.abs(across) < 54)
        errors.append(depth_error(scan)[inner])
    # one column is depth / fx mm wide; from above a slope of 1 is seen at 45 deg
    expected = slope * adhesion * 400 / CAMERA.fx
    np.testing.assert_allclose(np.concatenate(errors).std(), expected, rtol=0.15)


def test_a_window_is_a_weighted_mean_of_the_pixels_that_see_the_part():
    rng = np.random.default_rng(0)
    row, column = np.nonzero(rng.random((17, 23)) < 0.7)
    row, column = row + 100, column + 40
    disparity = rng.uniform(10, 20, len(row)).astype(np.float32)
    found = window_mean(row, column, disparity, window_px=1.5)
    for k in range(0, len(row), 7):
        squared = (row - row[k]) ** 2 + (column - column[k]) ** 2
        # scipy cuts the window at 4 standard deviations along each axis
        near = np.maximum(abs(row - row[k]), abs(column - column[k])) <= 6
        weight = np.exp(-0.5 * squared / 1.5**2) * near
        np.testing.assert_allclose(found[k], np.sum(weight * disparity) / weight.sum(), rtol=1e-5)
    aside = np.stack([np.full(len(row), 1.0), np.full(len(row), -2.0)])
    shifted = window_mean(row, column, disparity, window_px=1.5, offset_px=aside)
    place = {(r, c): k for k, (r, c) in enumerate(zip(row, column, strict=True))}
    pairs = [(k, place[r + 1, c - 2]) for (r, c), k in place.items() if (r + 1, c - 2) in place]
    assert len(pairs) > 50
    here, there = np.transpose(pairs)
    np.testing.assert_allclose(shifted[here], found[there], rtol=1e-5)
    assert not len(window_mean(row[:0], column[:0], disparity[:0], window_px=1.0))


def test_a_rim_is_what_lies_near_a_pixel_that_sees_nothing():
    rng = np.random.default_rng(1)
    seen = rng.random((20, 30)) < 0.95
    row, column = np.nonzero(seen)
    width = rng.uniform(0, 3, len(row))
    beside = np.argwhere(~np.pad(seen, 1)) - 1
    nearest = np.min(np.hypot(*(np.stack([row, column], -1)[:, None] - beside).T), axis=0)
    np.testing.assert_array_equal(near_outline(row + 7, column + 5, width), nearest - 0.5 < width)
    assert not near_outline(row, column, np.zeros(len(row))).any()
    assert not len(near_outline(row[:0], column[:0], width[:0]))


def test_the_outline_is_lost_and_nothing_else(plate):
    sensor = Sensor(camera=CAMERA, border_dropout_px=2.0, correlation_px=4.0)
    scans = [take(plate, sensor, seed=seed) for seed in range(4)]
    lost = np.stack([scan.reason == Reason.LOST for scan in scans])
    x, y = np.abs(ABOVE.inverse().apply(scans[0].ideal.points.astype(np.float64))[:, :2]).T
    from_outline = np.minimum((90 - x) * CAMERA.fx, (60 - y) * CAMERA.fy) / 400
    assert from_outline[lost.any(axis=0)].max() < 2.0 * 6  # a normal number above 5 is not met
    # at its mean width half of the strip is lost; some 600 independent places
    at_width = np.abs(from_outline - 2.0) < 0.5
    assert abs(lost[:, at_width].mean() - 0.5) < 0.08


def test_the_limit_of_incidence_varies_from_place_to_place(ball):
    sensor = Sensor(
        camera=CAMERA, max_incidence_deg=60.0, incidence_spread_deg=5.0, correlation_px=3.0
    )
    scans = [take(ball, sensor, seed=seed) for seed in range(3)]
    incidence = np.concatenate([scan.ideal.incidence_deg for scan in scans])
    lost = np.concatenate([scan.reason == Reason.GRAZING for scan in scans])
    for angle, share in ((50.0, 0.023), (60.0, 0.5), (70.0, 0.977)):
        near = np.abs(incidence - angle) < 0.7
        # the field has few independent places in so narrow a ring
        assert abs(lost[near].mean() - share) < 0.1, angle
