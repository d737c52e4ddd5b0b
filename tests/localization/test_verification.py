"""What a scan says for and against poses: right ones, wrong ones, obstacles and holes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from example_scans import (
    MIDDLE,
    batch,
    box,
    exact_points,
    ideal_scan,
    measured_points,
    model,
    motion,
    vane,
    with_noise,
)
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vanejax.cad import GuideVaneSegment, part_from_mesh
from vanejax.localization.pose_result import PointStatus, Verification
from vanejax.localization.residuals import SurfaceMatching
from vanejax.localization.scan_patches import View
from vanejax.localization.verification import evidence, predicted_unmeasured, verify
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import look_at

NOISE = 0.1
TOLERANCE = 0.3  # three standard deviations
ORIGIN = np.zeros(3)


def checked(part, pose: RigidTransform, points: np.ndarray, view: View | None = None):
    every = np.arange(len(points))
    view = View(points, ORIGIN) if view is None else view
    return verify(model(part), pose, points, every, tolerance_mm=TOLERANCE, view=view)


@pytest.fixture(scope="module")
def seen() -> tuple[np.ndarray, RigidTransform]:
    """The vane with 14,000 points, and its true part_from_camera."""
    return measured_points(vane(), camera=MIDDLE, noise_mm=NOISE)


@pytest.fixture(scope="module")
def right(seen) -> Verification:
    points, truth = seen
    return checked(vane(), truth, points)


# --- the right pose -----------------------------------------------------------------------------


def test_the_right_pose_has_nothing_against_it(seen, right):
    points, _ = seen
    # along the normal the noise is smaller than along the ray: beyond three sigma lie under 0.3 %
    assert right.inlier_share > 0.99
    assert right.violation_share < 0.005
    assert right.unmeasured_share < 0.03
    assert right.tolerance_mm == TOLERANCE
    assert right.score > 0.85  # 1 - mean (0.1 cosine / 0.3)^2 = 0.94, less what is seen empty
    np.testing.assert_array_equal(right.checked, np.arange(len(points)))


def test_deviation_is_signed_and_along_the_normal(seen):
    """Every point pulled 0.2 mm towards the sensor lies before the surface: positive."""
    scan, truth = ideal_scan(vane())
    points = exact_points(vane(), scan)
    near = points * (1 - 0.2 / np.linalg.norm(points, axis=1, keepdims=True))
    found = checked(vane(), truth, near)
    cosine = found.deviation_mm / 0.2
    assert np.nanmin(cosine) > 0
    assert np.nanquantile(cosine, 0.999) <= 1 + 1e-9
    assert 0.4 < np.nanmean(cosine) < 0.95
    far = points * (1 + 0.2 / np.linalg.norm(points, axis=1, keepdims=True))
    assert np.nanmax(checked(vane(), truth, far).deviation_mm) < 0


# --- wrong poses --------------------------------------------------------------------------------

PITCH_DEG = 360 / GuideVaneSegment().vanes_per_ring


def one_pitch(part) -> RigidTransform:
    """The segment turned about the engine's axis, which runs along z far below, by one vane."""
    middle_radius = (275 + 325) / 2
    turn = Rotation.from_rotvec([0, 0, np.radians(PITCH_DEG)]).as_matrix()
    axis = np.array([0.0, -middle_radius, 0.0])
    return RigidTransform(turn, axis - turn @ axis)


WRONG = {
    "one pitch off": one_pitch(vane()),
    "upside down": motion(vane(), [180, 0, 0], [0, 0, 0]),
    "10 deg": motion(vane(), [0, 0, 10], [0, 0, 0]),
    "45 deg": motion(vane(), [0, 45, 0], [0, 0, 0]),
    "90 deg": motion(vane(), [90, 0, 0], [0, 0, 0]),
    "180 deg": motion(vane(), [0, 0, 180], [0, 0, 0]),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_pose_is_found_out(seen, right, name):
    points, truth = seen
    wrong = WRONG[name] @ truth
    found = checked(vane(), wrong, points)
    assert found.inlier_share < 0.35
    assert found.violation_share + (found.status == PointStatus.BEFORE).mean() > 0.2
    assert found.score < 0.3 < right.score
    view = View(points, ORIGIN)
    poses = batch(truth, wrong)
    judged = evidence(model(vane()), poses, points, tolerance_mm=TOLERANCE, view=view)
    assert judged.preference(0, 1) > 10
    assert judged.total[0] == pytest.approx(right.score)


# --- rays ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def on_top() -> tuple[np.ndarray, RigidTransform]:
    """The box seen from straight above: its top only."""
    view = look_at(box().center + np.array([0.0, 0.0, 400.0]), box().center)
    return measured_points(box(), view, noise_mm=0.0)


def test_points_through_material_are_behind(on_top):
    points, truth = on_top
    middle = np.all(np.abs(truth.apply(points)[:, :2] - box().center[:2]) < 10, axis=1)
    through = points.copy()
    through[middle] *= 415 / 385  # 30 mm deeper: out at the bottom
    found = checked(box(), truth, through)
    np.testing.assert_array_equal(found.status == PointStatus.BEHIND, middle)
    assert found.violation_share == pytest.approx(middle.mean())
    assert found.score == pytest.approx(1 - 1.5 * middle.mean(), abs=0.01)


def test_a_clamp_in_front_counts_as_before(on_top):
    points, truth = on_top
    middle = np.all(np.abs(truth.apply(points)[:, :2] - box().center[:2]) < 10, axis=1)
    covered = points.copy()
    covered[middle] *= 365 / 385  # 20 mm nearer
    found = checked(box(), truth, covered)
    np.testing.assert_array_equal(found.status == PointStatus.BEFORE, middle)
    assert found.violation_share == 0
    assert found.unmeasured_share < 0.01  # its rays measured something
    assert found.score == pytest.approx(1 - middle.mean(), abs=0.01)


def test_points_past_the_part_are_beside(on_top):
    points, truth = on_top
    table = np.stack(np.meshgrid(np.linspace(60, 90, 6), np.linspace(-30, 30, 9)), -1).reshape(
        -1, 2
    )
    table = np.concatenate([table, np.full((len(table), 1), -420.0)], axis=1)
    every = np.concatenate([points, table])
    found = checked(box(), truth, every)
    beside = np.arange(len(every)) >= len(points)
    np.testing.assert_array_equal(found.status == PointStatus.BESIDE, beside)


def test_a_ray_that_just_misses_an_edge_belongs_to_it(on_top):
    points, truth = on_top
    # 0.2 mm beyond the top's edge at x = 47 mm
    rim = np.array([[47.2, y, 26.0] for y in np.linspace(-20, 12, 9)])
    every = np.concatenate([points, truth.inverse().apply(rim)])
    found = checked(box(), truth, every)
    assert (found.status == PointStatus.INLIER).all()
    np.testing.assert_allclose(found.deviation_mm[-9:], 0.2, atol=1e-4)


# --- what was not measured ----------------------------------------------------------------------


def test_half_a_scan_lacks_half(seen):
    points, truth = seen
    half = points[points[:, 0] < np.median(points[:, 0])]
    found = checked(vane(), truth, half)
    # half of the points, but not quite half of the cells: those flatter than 75 deg are not asked
    assert 0.35 < found.unmeasured_share < 0.6
    assert found.inlier_share > 0.99
    assert found.score < checked(vane(), truth, points).score - 0.2


@pytest.mark.parametrize(("flat_deg", "missing"), [(70, True), (78, False)])
def test_surface_seen_too_flat_may_be_missing(flat_deg, missing):
    """The box from the side: its end is measured, its top at ``flat_deg`` of incidence is not."""
    offset = 400 * np.array([np.sin(np.radians(flat_deg)), 0.0, np.cos(np.radians(flat_deg))])
    points, truth = measured_points(box(), look_at(box().center + offset, box().center))
    end = points[truth.apply(points)[:, 0] > 46.5]
    found = checked(box(), truth, end)
    assert 100 < len(end) < 0.8 * len(points)
    if missing:
        assert found.unmeasured_share > 0.15
    else:
        assert found.unmeasured_share < 0.05


def test_rays_to_unmeasured_surface_hit_it(seen):
    points, truth = seen
    half = points[points[:, 0] < np.median(points[:, 0])]
    rays, patch, missing, _ = predicted_unmeasured(model(vane()), truth, View(half, ORIGIN))
    assert rays.shape == (len(patch), 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-12)
    hits = model(vane()).scanner.cast(
        np.broadcast_to(truth.translation, rays.shape), truth.rotate(rays)
    )
    assert (hits.face[missing] >= 0).all()
    assert missing.sum() > 100
    # they lie where the points were taken away
    gone = points[points[:, 0] >= np.median(points[:, 0])]
    beyond = rays[missing, 0] / -rays[missing, 2] > (gone[:, 0] / -gone[:, 2]).min() - 0.01
    assert beyond.mean() > 0.95


# --- the view -----------------------------------------------------------------------------------


def test_no_empty_cell_lies_on_a_measured_point(seen):
    points, _ = seen
    view = View(points, ORIGIN)
    rays, _, _ = view.empty_cells(points.mean(axis=0), vane().radius)
    assert len(rays) > 100
    # the ray through the middle of an empty cell is half a cell and more from any measured one
    image = points[:, :2] / -points[:, 2:]
    empty = rays[:, :2] / -rays[:, 2:]
    gap, _ = cKDTree(image).query(empty, p=np.inf)
    assert gap.min() > 0.9 * view.size


# --- without a sensor ---------------------------------------------------------------------------


def test_without_a_sensor_there_are_points_on_the_part_and_beside_it(seen):
    points, truth = seen
    measured = SurfaceMatching(model(vane()).surface, reach_mm=10.0)
    far = points + np.array([0.0, 0.0, 200.0])
    every = np.concatenate([points, far])
    found = verify(measured, truth, every, np.arange(len(every)), tolerance_mm=TOLERANCE, view=None)
    assert found.inlier_share == pytest.approx(0.5, abs=0.03)
    assert np.isnan(found.violation_share)
    assert np.isnan(found.unmeasured_share)
    assert np.isfinite(found.score)
    assert (found.status[len(points) :] != PointStatus.INLIER).mean() > 0.99


# --- preferences --------------------------------------------------------------------------------


def test_preference_is_antisymmetric(seen):
    points, truth = seen
    poses = batch(truth, motion(vane(), [0, 0, 1], [0, 0, 0]) @ truth, WRONG["45 deg"] @ truth)
    for view, measured in (
        (View(points, ORIGIN), model(vane())),
        (None, SurfaceMatching(model(vane()).surface, reach_mm=10.0)),
    ):
        judged = evidence(measured, poses, points, tolerance_mm=TOLERANCE, view=view)
        for a in range(3):
            assert judged.preference(a, a) == 0
            for b in range(3):
                assert judged.preference(a, b) == -judged.preference(b, a)
        assert judged.preference(0, 1) > 0
        assert judged.total.argmax() == 0


def box_with_a_notch(side_mm: float):
    """The box of 80 x 50 x 30 mm without a cube of ``side_mm`` at one upper corner."""
    solid = trimesh.creation.box((80, 50, 30))
    notch = trimesh.creation.box((2 * side_mm, 2 * side_mm, 2 * side_mm))
    notch.apply_translation([40, 25, 15])
    mesh = trimesh.boolean.difference([solid, notch])
    return part_from_mesh(mesh.vertices, mesh.faces, name="notched box")


def test_a_small_feature_tells_two_poses_apart():
    """A notch of 8 mm, 1.3 % of what is seen: half a turn about z has 98 % of the points on it."""
    part = box_with_a_notch(8.0)
    view = look_at(part.center + np.array([60.0, 90.0, 380.0]), part.center)
    scan, truth = ideal_scan(part, view, MIDDLE)
    points = with_noise(exact_points(part, scan), 0.05, 0)
    turned = motion(part, [0, 0, 180], [0, 0, 0]) @ truth
    sides, every = View(points, ORIGIN), np.arange(len(points))
    judged = evidence(model(part), batch(truth, turned), points, tolerance_mm=0.2, view=sides)
    other = verify(model(part), turned, points, every, tolerance_mm=0.2, view=sides)
    assert other.inlier_share > 0.95
    assert judged.preference(0, 1) > 4  # `Limits.least_preference`


def test_a_symmetry_is_preferred_by_nobody():
    points, truth = measured_points(
        box(), look_at(box().center + np.array([60.0, 90.0, 380.0]), box().center), camera=MIDDLE
    )
    turned = motion(box(), [0, 0, 180], [0, 0, 0]) @ truth
    judged = evidence(
        model(box()), batch(truth, turned), points, tolerance_mm=0.3, view=View(points, ORIGIN)
    )
    assert abs(judged.preference(0, 1)) < 3
