"""A part that differs from its CAD model: what is found of it, and what the pose is worth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from example_scans import (
    MIDDLE,
    box,
    disturbed,
    ideal_scan,
    measured_points,
    model,
    pose_error,
    random_view,
    small_motion,
    vane,
    with_noise,
)

from vanejax.cad.investment_casting import InvestmentCasting, as_cast
from vanejax.cad.part import part_from_mesh
from vanejax.errors import InputError
from vanejax.localization.covariance import uncertainty
from vanejax.localization.deviation_patches import as_designed, scaled_pose
from vanejax.localization.fine_registration import refine
from vanejax.localization.form_deviation import (
    CLEAR_MM,
    check_lengths,
    with_form_deviation,
)
from vanejax.localization.pose_batch import stack
from vanejax.localization.pose_result import Refinement
from vanejax.localization.residuals import SurfaceMatching
from vanejax.localization.sensor_calibration import Calibration
from vanejax.rigid import RigidTransform
from vanejax.scanner import Scanner
from vanejax.scanner.range_errors import Lens


def registered(points: np.ndarray, truth: RigidTransform, **options) -> Refinement:
    init = disturbed(vane(), truth, 1, 1, seed=0)
    return with_form_deviation(
        model(vane()), points, refine(model(vane()), points, init), **options
    )


def squared_error(found: Refinement, truth: RigidTransform) -> float:
    """Over covariance and the six unknowns: about 1."""
    error = small_motion(vane(), found.part_from_camera, truth)
    return float(error @ found.information @ error) / 6


def test_a_part_that_is_its_model_keeps_its_pose():
    points, truth = measured_points(vane(), camera=MIDDLE)
    init = disturbed(vane(), truth, 1, 1, seed=0)
    plain = refine(model(vane()), points, init)
    found = with_form_deviation(model(vane()), points, plain)
    assert found.form.is_as_designed
    assert found.form.converged
    assert dataclasses.replace(found, form=None) == plain or np.array_equal(
        found.information, plain.information
    )
    np.testing.assert_array_equal(
        found.part_from_camera.as_matrix(), plain.part_from_camera.as_matrix()
    )


@pytest.mark.parametrize("factor", [1.003, 0.98])
def test_another_size_is_found_and_named(factor):
    """The part stays where it is; the camera's scale may be it, too, and sigma covers that."""
    center = vane().center
    vertices = (np.asarray(vane().mesh.vertices) - center) * factor + center
    larger = part_from_mesh(vertices, np.asarray(vane().mesh.faces), name="of another size")
    _, truth = ideal_scan(vane(), camera=MIDDLE)
    scan = Scanner(larger).scan(MIDDLE, truth.inverse())
    points = with_noise(scan.points.astype(np.float64), 0.05, 0)
    found = registered(points, truth)
    assert found.form.scale_error == pytest.approx(factor - 1, abs=1e-4)
    assert max(pose_error(vane(), found.part_from_camera, truth)) < 0.01
    range_mm = np.linalg.norm(truth.inverse().apply(center[None]))
    off_mm = abs(factor - 1) * range_mm  # if it is the camera
    assert uncertainty(found, center).translation_bound_mm > off_mm


def test_a_wrong_focal_length_is_found_and_costs_little():
    points, truth = measured_points(vane(), camera=MIDDLE, noise_mm=0.02)
    points[:, :2] *= 1.002
    found = registered(points, truth)
    assert found.form.focal_error == pytest.approx(0.002, abs=1e-4)
    assert max(pose_error(vane(), found.part_from_camera, truth)) < 0.01


def test_much_stock_is_found_from_where_least_squares_ends():
    """Some 1.4 mm off, with many points on another face than they seem."""
    casting = InvestmentCasting(allowance_mm=1.0, waviness_mm=0.0)
    cast = as_cast(vane(), casting, np.random.default_rng(0))
    _, truth = ideal_scan(vane(), camera=MIDDLE)
    scan = Scanner(cast).scan(MIDDLE, truth.inverse())
    points = with_noise(scan.points.astype(np.float64), 0.02, 0)
    plain = refine(model(vane()), points, truth)
    assert pose_error(vane(), plain.part_from_camera, truth)[1] > 0.5
    found = with_form_deviation(model(vane()), points, plain)
    assert found.form.converged
    assert found.form.stock_mm == pytest.approx(1.0, abs=0.02)
    assert found.form.unexplained_share < 0.005
    assert max(pose_error(vane(), found.part_from_camera, truth)) < 0.02


@pytest.mark.slow
def test_stock_that_varies_is_counted_in_sigma():
    casting = InvestmentCasting(allowance_mm=0.3, waviness_mm=0.1, wavelength_mm=30.0)
    _, truth = ideal_scan(vane(), camera=MIDDLE)
    ratios, before, after = [], [], []
    for seed in range(3):
        cast = as_cast(vane(), casting, np.random.default_rng(seed))
        scan = Scanner(cast).scan(MIDDLE, truth.inverse())
        points = with_noise(scan.points.astype(np.float64), 0.02, seed)
        plain = refine(model(vane()), points, truth)
        found = with_form_deviation(model(vane()), points, plain)
        before.append(pose_error(vane(), plain.part_from_camera, truth)[1])
        after.append(pose_error(vane(), found.part_from_camera, truth)[1])
        ratios.append(squared_error(found, truth))
    assert np.mean(after) < 0.1 * np.mean(before)
    assert np.mean(ratios) < 2


def test_a_bend_of_the_range_is_counted_in_sigma():
    points, truth = measured_points(vane(), camera=MIDDLE, noise_mm=0.02)
    slope = points[:, :2].sum(axis=1) / points[:, 2]
    points *= 1 + 0.05 * np.cos(40 * slope + 1)[:, None] / 400
    found = registered(points, truth)
    assert found.form.field != "none"
    assert squared_error(found, truth) < 3
    # and the pose is better for it
    plain = refine(model(vane()), points, truth)
    before, after = (pose_error(vane(), r.part_from_camera, truth) for r in (plain, found))
    assert after[0] < 0.7 * before[0]


@pytest.mark.parametrize(("bend_mm", "stays"), [(0.1, False), (0.8, True)])
def test_a_large_rest_alone_leaves_the_pose_of_all_points(bend_mm: float, stays: bool):
    """Nothing is known of it but its size; a small one is known well enough to move the pose."""
    points, truth = measured_points(vane(), camera=MIDDLE)
    across = points[:, 0] / points[:, 2]
    across = (across - across.mean()) / np.ptp(across)
    bend = bend_mm * np.cos(4 * np.pi * across)
    points *= 1 + bend[:, None] / np.linalg.norm(points, axis=1, keepdims=True)
    plain = refine(model(vane()), points, truth)
    found = with_form_deviation(model(vane()), points, plain)
    form = found.form
    assert not any((form.stock_mm, form.scale_error, form.focal_error))
    assert (form.field_mm > CLEAR_MM) == stays
    same = found.part_from_camera.translation == plain.part_from_camera.translation
    assert np.all(same) == stays
    assert squared_error(found, truth) < 3


@pytest.mark.parametrize("pixels", [0.5, -0.3])
def test_an_error_of_calibration_counts_where_it_is_given(pixels):
    """The part itself shows most of it: what is left is in sigma."""
    points, truth = measured_points(vane(), camera=MIDDLE, noise_mm=0.05)
    (shift,) = Calibration(MIDDLE, lens=Lens(center_error_px=(pixels, 0.0))).displacements(points)
    calibration = Calibration(MIDDLE, lens=Lens(center_error_px=(0.5, 0.5)))
    known = registered(points + shift, truth, calibration=calibration)
    plain = refine(model(vane()), points + shift, truth)
    assert known.form.converged
    assert squared_error(known, truth) < 3
    assert squared_error(plain, truth) > 30
    bounds = [uncertainty(r, vane().center).translation_bound_mm for r in (plain, known)]
    assert bounds[1] > 1.5 * bounds[0]


def test_too_little_smooth_surface_is_said():
    points, truth = measured_points(vane())
    found = registered(points[:: len(points) // 40], truth)
    assert not found.form.is_told
    assert found.form.is_as_designed


def test_one_plane_leaves_what_it_leaves():
    """Of a box's face alone, edges fix the rest, and of a casting they are a little elsewhere."""
    points, truth = measured_points(box(), camera=MIDDLE, noise_mm=0.02)
    inside = truth.apply(points)
    top = points[inside[:, 2] > inside[:, 2].max() - 0.2]
    plain = refine(model(box()), top, truth)
    found = with_form_deviation(model(box()), top, plain)
    sigma = uncertainty(found, box().center).weakest_translation_sigma_mm
    assert 0.2 < sigma < 0.5


def test_points_without_stock_and_scale_lie_on_the_part():
    casting = InvestmentCasting(allowance_mm=0.4, waviness_mm=0.0)
    cast = as_cast(vane(), casting, np.random.default_rng(0))
    _, truth = ideal_scan(vane(), camera=MIDDLE)
    points = Scanner(cast).scan(MIDDLE, truth.inverse()).points.astype(np.float64)
    measured = 1.01 * points  # by a camera with a wrong scale
    terms = np.array([0.4, 0.01, 0.0])
    designed, moved = as_designed(model(vane()), measured, truth, terms)
    residuals = designed.residuals(stack(truth), moved)
    assert np.median(np.abs(residuals.deviation_mm[residuals.hit])) < 2e-3


def test_scaled_poses_keep_the_line_of_sight():
    _, truth = ideal_scan(vane())
    center = vane().center
    there = truth.inverse().apply(center[None])
    back = scaled_pose(truth, center, 1.02).inverse().apply(center[None])
    np.testing.assert_allclose(back, 1.02 * there, atol=1e-12)


def test_it_works_without_the_sensors_place():
    casting = InvestmentCasting(allowance_mm=0.5, waviness_mm=0.0)
    cast = as_cast(vane(), casting, np.random.default_rng(0))
    _, truth = ideal_scan(vane(), camera=MIDDLE)
    points = Scanner(cast).scan(MIDDLE, truth.inverse()).points.astype(np.float64)
    surface = SurfaceMatching(model(vane()).surface, reach_mm=20.0)
    plain = refine(surface, with_noise(points, 0.02, 0), truth)
    found = with_form_deviation(surface, with_noise(points, 0.02, 0), plain)
    assert found.form.stock_mm == pytest.approx(0.5, abs=0.15)
    before, after = (pose_error(vane(), r.part_from_camera, truth)[1] for r in (plain, found))
    assert after < 0.5 * before


def test_stock_on_one_side_shows_beyond_the_edges():
    """All that is seen of three faces of a box looks moved; the far edges are where it shows."""
    vertices = np.asarray(box().mesh.vertices).copy()
    vertices[vertices[:, 2] > box().center[2], 2] += 1.0
    stocked = part_from_mesh(vertices, np.asarray(box().mesh.faces), name="with stock on top")
    view = random_view(box(), 1)
    shares = []
    for part in (box(), stocked):
        points = Scanner(part).scan(MIDDLE, view).points.astype(np.float64)
        plain = refine(model(box()), with_noise(points, 0.02, 0), view.inverse())
        found = with_form_deviation(model(box()), with_noise(points, 0.02, 0), plain)
        shares.append(found.form.beyond_edges_share)
    assert shares[0] < 1e-3
    assert shares[1] > 5e-3


@pytest.mark.parametrize(
    ("lengths", "words"),
    [
        ((-1.0, None), "max_allowance_mm must be 0 mm or more"),
        ((float("nan"), None), "max_allowance_mm must be 0 mm or more"),
        ((None, 0.0), "form_tolerance_mm must be more than 0 mm"),
        ((None, float("inf")), "form_tolerance_mm must be more than 0 mm"),
    ],
)
def test_lengths_that_cannot_be_are_refused(lengths, words):
    with pytest.raises(InputError, match=words):
        check_lengths(*lengths)
