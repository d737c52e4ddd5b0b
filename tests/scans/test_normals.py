"""Normals of clouds: exact surfaces, a slow oracle, the vane, and what degenerates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from vanejax.cad import guide_vane
from vanejax.errors import InputError
from vanejax.scanner import Camera, Scanner, hemisphere_viewpoints
from vanejax.scans.normals import _enough_neighbors, _planes_at, estimate_normals


def angle_deg(a, b):
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.degrees(np.arctan2(cross, np.sum(a * b, axis=-1)))


def quality(points, count, at=slice(None)):
    """Which neighbourhoods are a surface's, and the normals' standard errors in degrees."""
    queries = points[at]
    planes = _planes_at(cKDTree(points), points, queries, np.ones_like(queries), count)
    return planes[1], np.degrees(planes[2])


def plane(count, rng):
    points = np.concatenate([rng.uniform(-50, 50, (count, 2)), np.zeros((count, 1))], axis=1)
    return points, np.tile([0.0, 0.0, 1.0], (count, 1))


def sphere(count, rng):
    normals = rng.normal(size=(count, 3))
    normals[:, 2] = np.abs(normals[:, 2])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 40 * normals, normals


def cylinder(count, rng):
    angle, height = rng.uniform(0.2, np.pi - 0.2, count), rng.uniform(-50, 50, count)
    normals = np.stack([np.cos(angle), np.zeros(count), np.sin(angle)], axis=1)
    return 25 * normals + np.stack([0 * height, height, 0 * height], axis=1), normals


@pytest.fixture(scope="module")
def view():
    part = guide_vane()
    return Scanner(part).scan(Camera(), hemisphere_viewpoints(part.center).view(30))


SENSOR = np.array([0.0, 0.0, 400.0])


@pytest.mark.parametrize("surface", [plane, sphere, cylinder])
@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3])
def test_noisy_surfaces(surface, noise):
    rng = np.random.default_rng(1)
    points, normals = surface(40_000, rng)
    at = rng.choice(len(points), 1000, replace=False)
    points = points + noise * rng.normal(size=(len(points), 1)) * normals
    found = estimate_normals(points, sensor_origin=SENSOR, at=at)
    assert found.dtype == np.float32
    error = angle_deg(found, normals[at])
    # two axes of 1.25 deg at most, whose length has a median of 1.2 sigma; and some curvature
    assert np.median(error) < (2.0 if noise else 0.6)  # without noise the curvature is all
    # its own estimate of that is honest: the median of a Rayleigh distribution is 1.18 sigma,
    # and the worst axis is no better than both
    if surface is plane and noise:
        tilt_deg = quality(points, _enough_neighbors(cKDTree(points), points), at)[1]
        assert 0.6 < np.median(error) / (1.18 * np.median(tilt_deg)) < 1.1


# degrees, medians; the true normals are those of flat triangles, which turn by some degrees each
@pytest.mark.parametrize(("noise_mm", "limit"), [(0.0, 0.3), (0.05, 1.6), (0.1, 1.8), (0.5, 3.5)])
def test_normals_of_the_vane(view, noise_mm, limit):
    rng = np.random.default_rng(0)
    points = view.points.astype(np.float64)
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    points = points + noise_mm * rng.normal(size=(len(points), 1)) * ray
    at = rng.choice(len(points), 2000, replace=False)
    found = estimate_normals(points, sensor_origin=np.zeros(3), at=at)
    assert np.median(angle_deg(found, view.normals[at])) < limit
    assert (np.sum(found * points[at], axis=1) <= 1e-3).all()  # f32 eps of 400 mm


def slow_normals(points, sensor, count):
    normals, conditions = [], []
    for point in points:
        near = points[np.argsort(np.linalg.norm(points - point, axis=1), kind="stable")[:count]]
        centered = near - near.mean(axis=0)
        _, widths, axes = np.linalg.svd(centered, full_matrices=False)
        normal = axes[2]
        normals.append(normal if normal @ (sensor - point) >= 0 else -normal)
        conditions.append(widths[0] ** 2 / (widths[1] ** 2 - widths[2] ** 2))
    return np.array(normals), np.array(conditions)


@given(
    shift=st.tuples(*[st.floats(-2000, 2000)] * 3),
    scale=st.sampled_from([0.01, 1.0, 100.0]),
    seed=st.integers(0, 100),
    count=st.sampled_from([5, 16, 20]),
)
@settings(max_examples=15, deadline=None)
def test_a_slow_loop_finds_the_same(shift, scale, seed, count):
    rng = np.random.default_rng(seed)
    points = sphere(150, rng)[0] + rng.normal(scale=0.3, size=(150, 3))
    points = points * scale + np.array(shift)
    sensor = points.mean(axis=0) + np.array([0, 0, 500 * scale])
    found = estimate_normals(points, sensor_origin=sensor, num_neighbors=count)
    expected, conditions = slow_normals(points, sensor, count)
    # edge-on the sign is a matter of rounding
    clear = np.abs(np.sum(expected * (sensor - points), axis=1)) > 1e-3 * 500 * scale
    assert clear.mean() > 0.9
    # perturbation of an eigenvector: error of the matrix, some f32 eps of its norm, over the gap
    bound = np.degrees(10 * np.finfo(np.float32).eps * conditions)
    assert (angle_deg(found, expected)[clear] < bound[clear]).all()


@pytest.mark.parametrize("count", [1, 511, 512, 513, 4096, 4097])
def test_some_of_the_points_are_as_all_of_them(count):
    points = sphere(5000, np.random.default_rng(0))[0]
    everywhere = estimate_normals(points, sensor_origin=SENSOR, num_neighbors=16)
    at = np.random.default_rng(1).choice(5000, count, replace=False)
    some = estimate_normals(points, sensor_origin=SENSOR, num_neighbors=16, at=at)
    np.testing.assert_allclose(some, everywhere[at], atol=1e-6)  # f32 eps x 10
    assert estimate_normals(points, sensor_origin=SENSOR, at=at[:0]).shape == (0, 3)


def test_normals_face_the_sensor_or_away_from_the_middle():
    points, normals = sphere(3000, np.random.default_rng(0))
    inward = estimate_normals(points, sensor_origin=np.zeros(3), num_neighbors=16)
    assert angle_deg(inward, -normals).max() < 30
    outward = estimate_normals(points, sensor_origin=None, num_neighbors=16)
    assert np.mean(np.sum(outward * (points - points.mean(axis=0)), axis=1) >= 0) == 1


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((100, 3)),
        np.full((3, 3), 7.0),
        np.array([[1.0, 2.0, 3.0]]),
        np.array([[0.0, 0, 0], [1, 0, 0]]),
        np.linspace(0, 1, 200)[:, None] * [3.0, 4.0, 5.0] + 500,
        np.random.default_rng(0).normal(size=(30, 3)) * 1e-30,
        np.random.default_rng(0).normal(size=(30, 3)) * 1e30,
    ],
    ids=["zero", "three alike", "one", "two", "line", "tiny", "huge"],
)
@pytest.mark.parametrize("sensor", [None, SENSOR])
def test_degenerate_clouds_give_finite_unit_vectors(points, sensor):
    normals = estimate_normals(points, sensor_origin=sensor)
    assert normals.shape == points.shape
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    reliable, tilt_deg = quality(points, 16)
    assert np.isfinite(tilt_deg).all()
    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-9 * np.abs(points).max()) < 2:
        assert not reliable.any()


def test_what_is_no_surface_is_not_reliable():
    rng = np.random.default_rng(0)
    assert quality(plane(3000, rng)[0], 16)[0].mean() > 0.99
    lump = rng.uniform(-1, 1, (3000, 3))
    assert quality(lump, 64)[0].mean() < 0.1
    wire = np.stack([np.linspace(0, 100, 3000), *rng.normal(scale=1e-4, size=(2, 3000))], axis=1)
    assert quality(wire, 64)[0].mean() < 0.01
    double = np.repeat(plane(1000, rng)[0], 2, axis=0)
    assert quality(double, 16)[0].mean() > 0.95


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (np.zeros((0, 3)), {}, r"shape \[0, 3\]"),
        (np.zeros((5, 2)), {}, r"shape \[5, 2\]"),
        (np.full((5, 3), np.nan), {}, "finite points; clean the scan first"),
        (np.zeros((5, 3)), {"num_neighbors": 2}, "at least 3"),
        (np.zeros((5, 3)), {"at": [5]}, "indices below 5"),
        (np.zeros((5, 3)), {"at": [-1]}, "indices below 5"),
        (np.zeros((5, 3)), {"at": [True]}, "indices below 5"),
    ],
)
def test_wrong_input_is_refused(points, options, message):
    with pytest.raises(InputError, match=message):
        estimate_normals(points, sensor_origin=None, **options)


@pytest.mark.slow
def test_a_few_normals_of_a_large_cloud():
    rng = np.random.default_rng(0)
    points, normals = cylinder(3_000_000, rng)
    points = points.astype(np.float32)
    at = rng.choice(len(points), 4096, replace=False)
    found = estimate_normals(points, sensor_origin=SENSOR, at=at)
    assert np.median(angle_deg(found, normals[at])) < 0.5
