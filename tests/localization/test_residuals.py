"""What a pose predicts, against planes and spheres by formula, and against finite differences."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from example_scans import (
    batch,
    box,
    disturbed,
    exact_points,
    ideal_scan,
    model,
    motion,
    vane,
    with_noise,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vanejax.cad.part import part_from_mesh
from vanejax.localization.residuals import SurfaceMatching, moved
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import look_at


def pointing_at(part, offset) -> RigidTransform:
    """part_from_camera of a camera ``offset`` mm away from the part's centre."""
    return look_at(part.center + np.asarray(offset, np.float64), part.center).inverse()


def rays(count: int, half_angle_deg: float, seed: int = 0) -> np.ndarray:
    """Unit directions [n, 3] about -z, camera frame."""
    rng = np.random.default_rng(seed)
    across = np.tan(np.radians(half_angle_deg)) * rng.uniform(-1, 1, (count, 2))
    d = np.concatenate([across, -np.ones((count, 1))], axis=1)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def finite_differences(law, delta: float, poses: RigidTransform, part) -> np.ndarray:
    """[n, 6] central differences of ``law(pose)`` [n] over the six coordinates of `moved`."""
    columns = []
    for k in range(6):
        step = np.zeros((1, 6))
        step[0, k] = delta
        columns.append((law(moved(part, poses, step)) - law(moved(part, poses, -step))) / 2 / delta)
    return np.stack(columns, axis=-1)


# --- rays ---------------------------------------------------------------------------------------


def test_deviation_from_a_plane_is_the_height_above_it():
    part = box()  # its top lies at z = 26 mm
    pose = pointing_at(part, [60, 50, 300])
    directions = rays(400, 1.5)
    height = np.random.default_rng(1).uniform(-3, 3, len(directions))
    sensor = pose.translation
    turned = pose.rotate(directions)
    range_mm = (26 + height - sensor[2]) / turned[:, 2]
    residuals = model(part).residuals(batch(pose), range_mm[:, None] * directions)
    assert residuals.hit.all()
    # the mesh is float32: 26 mm is good to 2e-6
    np.testing.assert_allclose(residuals.deviation_mm[0], height, atol=1e-5)
    np.testing.assert_allclose(residuals.cosine[0], -turned[:, 2], atol=1e-7)
    x = sensor + turned * ((26 - sensor[2]) / turned[:, 2])[:, None] - part.center
    up = np.broadcast_to([0.0, 0.0, 1.0], x.shape)
    expected = np.concatenate([np.cross(x, up), up], axis=1)
    np.testing.assert_allclose(residuals.jacobian[0], expected, atol=1e-4)


def test_range_to_a_sphere():
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=40.0)
    part = part_from_mesh(mesh.vertices, mesh.faces, name="ball")
    pose = pointing_at(part, [100, -200, 150])
    directions = rays(500, 6.0)
    turned, sensor = pose.rotate(directions), pose.translation
    half = turned @ sensor
    expected = -half - np.sqrt(half**2 - sensor @ sensor + 40.0**2)
    points = 250.0 * directions
    residuals = model(part).residuals(batch(pose), points)
    assert residuals.hit.all()
    predicted = residuals.deviation_mm[0] / residuals.cosine[0] + 250
    # the facets lie up to their sag inside the ball, and the ray goes that much deeper / cosine
    sag = 40 - np.min(np.einsum("fi,fi->f", part.mesh.face_normals, part.mesh.triangles[:, 0]))
    assert 0 < sag < 0.02
    deeper = (predicted - expected) * residuals.cosine[0]
    assert deeper.min() > -1e-4  # mm: the mesh's vertices are float32
    assert deeper.max() < 1.1 * sag  # the cosine is the facet's
    # turning a ball about its middle does next to nothing
    assert (
        np.abs(residuals.jacobian[0, :, :3]).max() < 40 * 0.03
    )  # mm / rad; facets tilt by 0.02 rad


@pytest.mark.parametrize("origin", [np.zeros(3), np.array([120.0, -40.0, 30.0])])
def test_predictions_are_what_the_scanner_casts(origin):
    part = vane()
    scan, truth = ideal_scan(part)
    points = scan.points.astype(np.float64)
    pose = disturbed(part, truth, 4.0, 3.0, seed=2)
    seen = dataclasses.replace(model(part), sensor_origin=origin)
    residuals = seen.residuals(batch(pose), points)
    away = points - origin
    range_mm = np.linalg.norm(away, axis=1)
    hits = model(part).scanner.cast(
        np.broadcast_to(pose.apply(origin[None]), points.shape), pose.rotate(away)
    )
    hit = hits.face >= 0
    np.testing.assert_array_equal(residuals.hit[0], hit)
    assert 0.5 < hit.mean() < 1
    predicted = residuals.deviation_mm[0] / residuals.cosine[0] + range_mm
    # f64, but cast and residuals turn the rays in another order of operations
    np.testing.assert_allclose(predicted[hit], hits.distance_mm[hit], atol=1e-7)
    np.testing.assert_allclose(residuals.jacobian[0, hit, 3:], hits.normals[hit], atol=1e-12)


def test_at_the_true_pose_an_ideal_scan_deviates_by_nothing():
    part = vane()
    scan, truth = ideal_scan(part)
    points = exact_points(part, scan)
    residuals = model(part).residuals(batch(truth), points)
    # of 2,300 rays a few meet an edge within float32 of Embree
    along = np.abs(residuals.deviation_mm[0])
    assert residuals.hit[0].mean() > 0.998
    assert np.mean(along < 1e-6) > 0.998
    assert len(points) > 0.99 * len(scan.points)


def test_jacobian_of_rays_against_finite_differences():
    seed = 0
    part = vane()
    scan, truth = ideal_scan(part)
    points = with_noise(scan.points.astype(np.float64), 0.5, seed)
    pose = batch(disturbed(part, truth, 3.0, 2.0, seed))
    residuals = model(part).residuals(pose, points)

    def along(poses):
        other = model(part).residuals(poses, points)
        return np.where(other.hit & residuals.hit, other.deviation_mm / other.cosine, np.nan)[0]

    numeric = finite_differences(along, 1e-6, pose, part)
    analytic = residuals.jacobian[0] / residuals.cosine[0][:, None]
    clear = residuals.hit[0] & (residuals.cosine[0] > 0.1)
    # a step of 1e-6 changes the face of a few rays; elsewhere 1e-6 x 70 mm / cosine^2, and rounding
    off = np.abs(numeric - analytic)[clear].max(axis=1)
    assert np.mean(off < 0.01) > 0.995
    assert clear.mean() > 0.7


@pytest.mark.parametrize("precision", ["faces", "samples", "grid"])
def test_a_ray_that_misses_has_its_distance_to_the_surface(precision):
    part = box()
    pose = pointing_at(part, [0, 0, 300])
    # 3 mm outside the box's +x side, whose face lies at x = 47 mm
    target = np.array([[50.0, y, z] for y in (-20, -4, 10) for z in (11.0, 16.0, 22.0)])
    points = pose.inverse().apply(target)
    residuals = model(part).residuals(batch(pose), points, precision=precision)
    assert not residuals.hit.any()
    within = {"faces": 1e-5, "samples": 1.0, "grid": 9.0}[
        precision
    ]  # cells of 3.3 mm, 2 sqrt(3) / 2
    np.testing.assert_allclose(residuals.deviation_mm[0], 3.0, atol=within)
    assert (residuals.deviation_mm >= 3 - 1e-5).all()  # no sample is nearer than the surface
    np.testing.assert_allclose(np.linalg.norm(residuals.jacobian[0, :, 3:], axis=1), 1, atol=1e-12)
    assert (residuals.jacobian[0, :, 3] > 0.7).all()  # away from the surface: +x
    np.testing.assert_array_equal(residuals.cosine, 1.0)


def test_jacobian_of_misses_against_finite_differences():
    part = box()
    pose = pointing_at(part, [40, -30, 300])
    target = part.center + np.array([[60.0, 3, 5], [-70, 10, 2], [4, 50, -3], [52, 40, 20]])
    points = pose.inverse().apply(target)
    residuals = model(part).residuals(batch(pose), points)
    assert not residuals.hit.any()
    numeric = finite_differences(
        lambda poses: model(part).residuals(poses, points).deviation_mm[0], 1e-5, batch(pose), part
    )
    np.testing.assert_allclose(
        numeric, residuals.jacobian[0], atol=1e-3
    )  # 1e-5 x curvature, mm / rad


def test_a_batch_of_poses_is_each_of_them():
    part = vane()
    scan, truth = ideal_scan(part)
    points = scan.points[::7].astype(np.float64)
    poses = [disturbed(part, truth, 2.0 + k, 3.0, seed=k) for k in range(3)]
    for measured in (model(part), SurfaceMatching(model(part).surface, 20.0)):
        together = measured.residuals(batch(*poses), points)
        for h, pose in enumerate(poses):
            alone = measured.residuals(batch(pose), points)
            for field in dataclasses.fields(alone):
                np.testing.assert_array_equal(
                    getattr(together, field.name)[h], getattr(alone, field.name)[0]
                )


# --- surface ------------------------------------------------------------------------------------


def test_matching_gives_the_height_above_the_nearest_face():
    part = box()
    measured = SurfaceMatching(model(part).surface, reach_mm=15.0)
    rng = np.random.default_rng(3)
    height = rng.uniform(-5, 5, 300)
    target = np.stack([rng.uniform(-20, 30, 300), rng.uniform(-15, 10, 300), 26 + height], axis=1)
    pose = motion(part, [10, 20, -30], [4, 5, 6])
    residuals = measured.residuals(batch(pose), pose.inverse().apply(target))
    assert residuals.hit.all()
    np.testing.assert_allclose(residuals.deviation_mm[0], height, atol=1e-5)
    np.testing.assert_array_equal(residuals.cosine, 1.0)
    up = np.broadcast_to([0.0, 0.0, 1.0], target.shape)
    expected = np.concatenate([np.cross(target - part.center, up), up], axis=1)
    np.testing.assert_allclose(residuals.jacobian[0], expected, atol=1e-4)


def test_matching_beyond_its_reach_has_the_distance():
    part = box()
    measured = SurfaceMatching(model(part).surface, reach_mm=15.0)
    target = np.array([[7.0, -4.0, 26 + 40.0], [47 + 30.0, -4.0, 11.0]])
    residuals = measured.residuals(batch(RigidTransform.identity(dtype=np.float64)), target)
    assert not residuals.hit.any()
    np.testing.assert_allclose(
        residuals.deviation_mm[0], [40, 30], atol=0.05
    )  # 0.6 mm aside at 30 mm
    np.testing.assert_allclose(np.linalg.norm(residuals.jacobian[0, :, 3:], axis=1), 1, atol=1e-12)
    assert residuals.jacobian[0, 0, 5] > 0.99
    assert residuals.jacobian[0, 1, 3] > 0.99


def test_jacobian_of_matching_against_finite_differences():
    part = vane()
    scan, truth = ideal_scan(part)
    points = with_noise(scan.points[::3].astype(np.float64), 0.5, 0)
    pose = batch(disturbed(part, truth, 2.0, 1.0, seed=1))
    measured = SurfaceMatching(model(part).surface, reach_mm=10.0)
    residuals = measured.residuals(pose, points)
    assert residuals.hit.all()
    numeric = finite_differences(
        lambda poses: measured.residuals(poses, points).deviation_mm[0], 1e-6, pose, part
    )
    off = np.abs(numeric - residuals.jacobian[0]).max(axis=1)
    # the normal stays; a point between two samples may change its partner within the step
    assert np.mean(off < 1e-3) > 0.995


# --- small motions ------------------------------------------------------------------------------

POSE = batch(motion(box(), [20, -50, 70], [3, -5, 400]))
deltas = arrays(np.float64, (1, 6), elements=st.floats(-1.5, 1.5)).map(
    lambda d: d * [[1, 1, 1, 20, 20, 20]]
)


@settings(deadline=None, max_examples=50)
@given(delta=deltas)
def test_moved_is_a_turn_about_the_centre_and_then_a_shift(delta):
    part = box()
    there = moved(part, POSE, delta)
    points = np.random.default_rng(0).normal(0, 50, (5, 3))
    by_hand = motion(part, np.degrees(delta[0, :3]), delta[0, 3:])
    expected = by_hand.apply(POSE.apply(points[None])[0])
    np.testing.assert_allclose(there.apply(points[None])[0], expected, atol=1e-10)
    gram = there.rotation[0] @ there.rotation[0].T
    np.testing.assert_allclose(gram, np.eye(3), atol=1e-13)


@settings(deadline=None, max_examples=50)
@given(delta=deltas)
def test_moved_back_returns(delta):
    """The turn comes first, so its inverse is: shift back, then turn back."""
    part = box()
    turn, shift = delta.copy(), delta.copy()
    turn[:, 3:], shift[:, :3] = 0, 0
    back = moved(part, moved(part, moved(part, POSE, delta), -shift), -turn)
    np.testing.assert_allclose(back.rotation, POSE.rotation, atol=1e-13)
    np.testing.assert_allclose(back.translation, POSE.translation, atol=1e-10)
