"""Fine registration against the Cramer-Rao bound of the same rays, and what it says of itself."""

from __future__ import annotations

import numpy as np
import pytest
from example_scans import (
    MIDDLE,
    batch,
    box,
    disturbed,
    exact_points,
    ideal_scan,
    measured_points,
    model,
    motion,
    pose_error,
    small_motion,
    vane,
    with_noise,
)
from scipy.stats import chi2

from vanejax.cad.part import Part
from vanejax.localization.covariance import uncertainty
from vanejax.localization.fine_registration import refine, robust_gauss_newton, subset
from vanejax.localization.residuals import RayCasting, SurfaceMatching
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import look_at

CERTAIN = chi2.ppf(0.9999, 6)  # 27.9: one right draw in 10,000 is farther off


def true_information(
    part: Part, points: np.ndarray, truth: RigidTransform, noise_mm: float
) -> np.ndarray:
    """[6, 6] inverse of the Cramer-Rao bound for white noise along these rays, at the true pose.

    A ray of direction d that meets a face of normal n at x changes its range by
    ``((x - c) x n . omega + n . v) / (n . d)``. Rays flatter than 88.9 deg are left out: they hold
    in the limit of no noise only.
    """
    range_mm = np.linalg.norm(points, axis=1, keepdims=True)
    direction = truth.rotate(points / range_mm)
    sensor = np.broadcast_to(truth.translation, points.shape)
    hits = model(part).scanner.cast(sensor, direction)
    closing = np.einsum("ni,ni->n", hits.normals, direction)
    met = (hits.face >= 0) & (closing < -0.02)
    x = sensor + np.where(met, hits.distance_mm, 0)[:, None] * direction - part.center
    row = np.concatenate([np.cross(x, hits.normals), hits.normals], axis=1)
    row = row[met] / closing[met, None]
    return row.T @ row / noise_mm**2


def squared_error(part: Part, found: RigidTransform, truth: RigidTransform, information) -> float:
    """In standard deviations: chi-square with six degrees of freedom for a bound that is met."""
    e = small_motion(part, found, truth)
    return float(e @ information @ e)


@pytest.fixture(scope="module")
def exact() -> tuple[np.ndarray, RigidTransform]:
    """2,300 points without noise, and the true part_from_camera."""
    scan, truth = ideal_scan(vane())
    return exact_points(vane(), scan), truth


@pytest.fixture(scope="module")
def fine() -> tuple[np.ndarray, RigidTransform]:
    """14,000 points without noise, and the true part_from_camera."""
    scan, truth = ideal_scan(vane(), camera=MIDDLE)
    return exact_points(vane(), scan), truth


# --- where it ends ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "noise_mm", [0.1, *(pytest.param(mm, marks=pytest.mark.slow) for mm in (0.05, 0.5, 1.0))]
)
def test_the_error_is_the_bounds_and_no_draw_is_far_off(exact, noise_mm):
    """Twenty draws of noise; seed 18 at 0.1 mm once kept a ray that had slipped off its face."""
    points, truth = exact
    bound = true_information(vane(), points, truth, noise_mm)
    errors = []
    for seed in range(20):
        noisy = with_noise(points, noise_mm, seed)
        found = refine(model(vane()), noisy, disturbed(vane(), truth, 5, 5, seed))
        errors.append(squared_error(vane(), found.part_from_camera, truth, bound))
        assert found.num_points == len(points)
        assert 0.99 * len(points) <= found.num_inliers <= len(points)
        assert 3 <= found.iterations < 60
    assert max(errors) < CERTAIN
    assert found.method == "ray casting"
    # the mean over 20 draws of six: chi-square with 120 degrees of freedom, one in 1,000
    assert np.mean(errors) < 1.2 * chi2.ppf(0.999, 120) / 20


def test_a_scan_without_noise_gives_the_pose_itself(fine):
    points, truth = fine
    found = refine(model(vane()), points, disturbed(vane(), truth, 5, 5, seed=1))
    angle, shift = pose_error(vane(), found.part_from_camera, truth)
    assert angle < 1e-4
    assert shift < 1e-4
    assert found.converged


def test_it_stops_by_itself(fine):
    points, truth = fine
    points = with_noise(points, 0.1, 3)
    found = refine(model(vane()), points, disturbed(vane(), truth, 5, 5, seed=3))
    again = refine(model(vane()), points, found.part_from_camera)
    assert found.converged
    assert again.converged
    assert again.iterations < 12
    # where it started does not matter: the rest is a tenth of a standard deviation
    between = small_motion(vane(), again.part_from_camera, found.part_from_camera)
    assert between @ found.information @ between < 0.06


def test_a_motion_of_the_scan_moves_the_answer(exact):
    points, truth = exact
    points = with_noise(points, 0.1, 0)
    init = disturbed(vane(), truth, 3, 3, seed=4)
    found = refine(model(vane()), points, init)
    other = motion(box(), [40, -100, 70], [300, -200, 100])  # other frame from camera
    away = RayCasting(model(vane()).scanner, model(vane()).surface, other.translation)
    moved = refine(away, other.apply(points), init @ other.inverse())
    back = moved.part_from_camera @ other
    between = small_motion(vane(), back, found.part_from_camera)
    # rounding of 1e-13 of a coordinate may make a ray at an edge change its face
    assert between @ found.information @ between < 0.06
    np.testing.assert_allclose(moved.information, found.information, rtol=0.02, atol=1)


def test_the_same_call_gives_the_same_bits(exact):
    points, truth = exact
    points = with_noise(points, 0.5, 0)
    init = disturbed(vane(), truth, 3, 3, seed=4)
    one, two = (refine(model(vane()), points, init, seed=5) for _ in range(2))
    np.testing.assert_array_equal(one.part_from_camera.rotation, two.part_from_camera.rotation)
    np.testing.assert_array_equal(
        one.part_from_camera.translation, two.part_from_camera.translation
    )
    np.testing.assert_array_equal(one.information, two.information)


# --- scans that are worse than white noise ------------------------------------------------------


def test_ten_percent_of_gross_outliers(exact):
    seed = 1
    points, truth = exact
    points = with_noise(points, 0.1, seed)
    rng = np.random.default_rng(seed)
    lost = rng.random(len(points)) < 0.1
    points[lost] *= rng.uniform(0.9, 1.1, (lost.sum(), 1))  # up to 40 mm off along the ray
    found = refine(model(vane()), points, disturbed(vane(), truth, 5, 5, seed))
    bound = true_information(vane(), points[~lost], truth, 0.1)
    # outliers within five standard deviations stay: 1 % of them
    assert squared_error(vane(), found.part_from_camera, truth, bound) < 2 * CERTAIN
    assert found.noise_mm == pytest.approx(0.1, rel=0.2)


def test_a_missing_third(exact):
    points, truth = exact
    points = with_noise(points, 0.1, 1)
    kept = points[points[:, 0] > np.quantile(points[:, 0], 1 / 3)]
    found = refine(model(vane()), kept, disturbed(vane(), truth, 5, 5, seed=0))
    bound = true_information(vane(), kept, truth, 0.1)
    assert squared_error(vane(), found.part_from_camera, truth, bound) < CERTAIN


def test_without_a_sensor_it_falls_back_to_point_to_plane(fine):
    seed = 0
    points, truth = fine
    points = with_noise(points, 0.1, seed)
    measured = SurfaceMatching(model(vane()).surface, reach_mm=20.0)
    other = motion(box(), [40, -100, 70], [300, -200, 100])  # other frame from camera
    init = disturbed(vane(), truth, 2, 2, seed) @ other.inverse()
    found = refine(measured, other.apply(points), init)
    angle, shift = pose_error(vane(), found.part_from_camera @ other, truth)
    # five times the bound: matches at edges are to the wrong face by now and then
    assert angle < 0.02
    assert shift < 0.02
    assert found.method == "point to plane"
    assert found.converged
    # along the normal, not along the ray: 0.1 mm x the mean cosine of some 0.5
    assert 0.03 < found.noise_mm < 0.1


def test_a_plane_leaves_three_directions_open():
    """A scan of one face only: what it holds is found, what it does not hold stays as it was."""
    part = box()
    view = look_at(part.center + np.array([0.0, 0.0, 400.0]), part.center)
    points, truth = measured_points(part, view, noise_mm=0.05)
    inner = np.all(np.abs(truth.apply(points)[:, :2] - part.center[:2]) < [25, 12], axis=1)
    init = motion(part, [0.5, -0.5, 0.0], [0.0, 0.0, 1.0]) @ truth
    found = refine(model(part), points[inner], init)
    e = small_motion(part, found.part_from_camera, truth)
    assert np.abs(np.degrees(e[:2])).max() < 0.05
    assert abs(e[5]) < 0.02
    assert not found.converged  # six directions were asked for
    sure = uncertainty(found, part.center)
    assert sure.weakest_rotation_sigma_deg > 10
    assert abs(sure.weakest_rotation_axis[2]) > 0.99
    assert sure.weakest_translation_sigma_mm > 10
    assert abs(sure.weakest_translation_axis[2]) < 0.1


# --- robust Gauss-Newton --------------------------------------------------------------------------


def test_each_pose_of_a_batch_converges(exact):
    points, truth = exact
    starts = [disturbed(vane(), truth, 10, 5, seed) for seed in range(4)]
    found, iterations = robust_gauss_newton(model(vane()), batch(*starts), points, iterations=20)
    alone, _ = robust_gauss_newton(model(vane()), batch(starts[2]), points, iterations=20)
    assert iterations == 20
    for k in range(4):
        pose = RigidTransform(found.rotation[k], found.translation[k])
        assert max(pose_error(vane(), pose, truth)) < 0.2
    np.testing.assert_allclose(found.rotation[2], alone.rotation[0], atol=1e-9)


def test_it_stops_where_nothing_moves(exact):
    points, truth = exact
    _, iterations = robust_gauss_newton(
        model(vane()), batch(truth), points, iterations=20, min_step_deg=0.1
    )
    assert iterations == 1


# --- what it says of itself ---------------------------------------------------------------------


def test_the_information_is_the_bounds(fine):
    points, truth = fine
    noisy = with_noise(points, 0.1, 1)
    found = refine(model(vane()), noisy, disturbed(vane(), truth, 2, 2, seed=0))
    bound = true_information(vane(), points, truth, 0.1)
    ratio = np.linalg.eigvals(np.linalg.solve(bound, found.information)).real
    assert ratio.min() > 0.75
    assert ratio.max() < 1.1


@pytest.mark.slow
def test_the_covariance_covers_the_errors(exact):
    """Normalised squared errors of 30 draws: their sum is chi-square with 180 degrees."""
    points, truth = exact
    errors = []
    for seed in range(30):
        noisy = with_noise(points, 0.2, 100 + seed)
        found = refine(model(vane()), noisy, disturbed(vane(), truth, 2, 2, seed))
        errors.append(squared_error(vane(), found.part_from_camera, truth, found.information))
    low, high = chi2.ppf([0.001, 0.999], 180)
    assert low < np.sum(errors) < 1.15 * high  # 1.15: the noise itself is estimated
    assert max(errors) < CERTAIN


def test_errors_that_go_together_widen_the_covariance(fine):
    """A smooth error field of 0.1 mm under 0.05 mm of white noise: the patches' scores show it."""
    points, truth = fine
    white = with_noise(points, 0.05, 2)
    init = disturbed(vane(), truth, 1, 1, seed=0)
    plain = refine(model(vane()), white, init)
    angle = points[:, :2] / np.ptp(points[:, :2], axis=0).max() * 2 * np.pi
    along = np.linalg.norm(points, axis=1, keepdims=True)
    ratio, errors = [], []
    for phase in range(4):
        wave = np.sin(2 * angle[:, 0] + phase) * np.cos(2 * angle[:, 1] + 2 * phase)
        bent = white * (1 + 0.1 * np.sqrt(2) * wave[:, None] / along)
        found = refine(model(vane()), bent, init)
        errors.append(squared_error(vane(), found.part_from_camera, truth, found.information))
        grown = np.linalg.solve(found.information, plain.information)
        ratio.append(np.median(np.linalg.eigvals(grown).real))
    # variance of one ray: 0.0025 + 0.01, five times; more than that is the correlation
    assert min(ratio) > 10
    # white noise's covariance alone would give hundreds
    assert np.mean(errors) < 4 * 6


# --- subsets ------------------------------------------------------------------------------------


def test_a_subset_is_drawn_without_replacement():
    points = np.zeros((1000, 3))
    some = subset(points, 100, seed=0)
    assert len(np.unique(some)) == 100
    assert (np.diff(some) > 0).all()
    np.testing.assert_array_equal(some, subset(points, 100, seed=0))
    assert not np.array_equal(some, subset(points, 100, seed=1))
    np.testing.assert_array_equal(subset(points, 1000, seed=0), np.arange(1000))
    np.testing.assert_array_equal(subset(points, 5000, seed=0), np.arange(1000))
