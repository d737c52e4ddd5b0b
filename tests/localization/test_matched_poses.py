"""Poses from a network: the icosahedral starts, and the way between millimetres and unit sphere."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from example_scans import batch, disturbed, exact_points, ideal_scan, random_view, vane
from scipy.spatial.transform import Rotation

from vanejax.localization import matched_poses
from vanejax.localization.matched_poses import icosahedral_rotations, match_poses
from vanejax.matching.rpmnet import RpmNet
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Camera
from vanejax.scans.measured_scan import clean_scan
from vanejax.scans.voxels import voxel_thin
from vanejax.training import PairSampling, TrainedMatcher

MODEL = RpmNet(num_neighbors=8, radius=0.5, sinkhorn_iterations=2, feature_width=8)


def _matcher(voxel_mm: float = 4.0) -> TrainedMatcher:
    """A network of random weights for the vane, as `vanejax export` would describe it."""
    part = vane()
    points, normals, _ = part.sample(8000, seed=0)
    thinned = voxel_thin(points, voxel_mm=voxel_mm)
    sampling = PairSampling(num_reference=128, num_source=96)
    cloud = PointCloud.create(
        np.zeros((sampling.num_reference, 3), np.float32),
        np.zeros((sampling.num_reference, 3), np.float32),
    )
    shapes = jax.eval_shape(
        lambda *args: MODEL.init(*args, 1),
        jax.random.key(0),
        cloud,
        cloud,
        RigidTransform.identity(),
    )
    rng = np.random.default_rng(0)
    variables = jax.tree.map(lambda leaf: rng.normal(0, 0.1, leaf.shape).astype(np.float32), shapes)
    return TrainedMatcher(
        model=MODEL,
        variables=variables,
        iterations=2,
        sampling=sampling,
        voxel_mm=voxel_mm,
        center=part.center,
        radius_mm=part.radius,
        reference_points=points[thinned].astype(np.float32),
        reference_normals=normals[thinned].astype(np.float32),
        part_name=part.name,
        part_sha256=part.sha256,
        camera=Camera(),
    )


@pytest.fixture(scope="module")
def matcher() -> TrainedMatcher:
    return _matcher()


@pytest.fixture(scope="module")
def scan():
    ideal, truth = ideal_scan(vane())
    return clean_scan(exact_points(vane(), ideal)), truth


def guesses(truth: RigidTransform, first: int = 0) -> RigidTransform:
    """Four rough poses; always four, for each number of them is compiled anew."""
    return batch(*(disturbed(vane(), truth, 10 + k, 3, seed=k) for k in range(first, first + 4)))


# --- the icosahedron ----------------------------------------------------------------------------


def test_the_60_rotations_are_a_group():
    group = icosahedral_rotations()
    assert group.shape == (60, 3, 3)
    np.testing.assert_allclose(np.linalg.det(group), 1, atol=1e-12)
    products = np.einsum("aij,bjk->abik", group, group).reshape(-1, 9)
    distance = np.linalg.norm(products[:, None] - group.reshape(1, 60, 9), axis=-1)
    assert distance.min(axis=1).max() < 1e-12
    assert len(np.unique(np.round(group.reshape(60, 9), 6), axis=0)) == 60


def test_every_rotation_is_within_44_5_deg_of_one():
    probes = Rotation.random(20_000, random_state=0).as_matrix()
    trace = np.einsum("aij,bij->ab", probes, icosahedral_rotations()).max(axis=1)
    nearest = np.degrees(np.arccos((trace - 1) / 2))
    assert nearest.max() < 44.5  # the covering radius is 44.48 deg
    assert nearest.max() > 41  # and 20,000 of them come near it


# --- units and frames ---------------------------------------------------------------------------


def test_a_network_that_changes_nothing_gives_the_guess_back(matcher, scan, monkeypatch):
    """Into the unit sphere and out again; float32 holds 1e-7 of 400 mm, twice."""
    monkeypatch.setattr(matched_poses, "_match", lambda *arguments: arguments[-1])
    measured, truth = scan
    asked = guesses(truth)
    found = match_poses(matcher, measured, asked, iterations=1)
    np.testing.assert_allclose(found.rotation, asked.rotation, atol=1e-6)
    np.testing.assert_allclose(found.translation, asked.translation, atol=1e-3)


def test_at_the_true_pose_the_clouds_that_the_network_sees_lie_on_each_other(
    matcher, scan, monkeypatch
):
    seen = {}

    def look(*arguments):
        seen.update(zip(("source", "target", "inits"), arguments[-3:], strict=True))
        return arguments[-1]

    monkeypatch.setattr(matched_poses, "_match", look)
    measured, truth = scan
    match_poses(matcher, measured, batch(truth), iterations=1)
    source, target, inits = seen["source"], seen["target"], seen["inits"]
    rotation, translation = np.asarray(inits.rotation)[0], np.asarray(inits.translation)[0]
    mask = np.asarray(source.mask)
    there = np.asarray(source.xyz)[mask] @ rotation.T + translation
    reference = np.asarray(target.xyz)
    assert np.linalg.norm(reference, axis=1).max() <= 1 + 1e-6  # the unit sphere
    assert np.linalg.norm(there, axis=1).max() <= 1 + 1e-4
    # every scan point has a reference point near: 128 of them on the surface, 0.15 apart
    gap = np.linalg.norm(there[:, None] - reference[None], axis=-1).min(axis=1)
    assert np.mean(gap) < 0.15
    normals = np.asarray(source.normals)[mask]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-4)
    assert not np.asarray(source.xyz)[~mask].any()
    # as in training: num_reference X / Y of the X thinned points
    thinned = len(voxel_thin(measured.points, voxel_mm=matcher.voxel_mm))
    wanted = round(128 * thinned / len(matcher.reference_points))
    assert mask.sum() == np.clip(wanted, 16, 96)


def test_normals_of_the_scan_are_used_and_turned_to_the_sensor(matcher, scan, monkeypatch):
    seen = {}

    def look(*arguments):
        seen.update(source=arguments[-3])
        return arguments[-1]

    monkeypatch.setattr(matched_poses, "_match", look)
    measured, truth = scan
    ideal, _ = ideal_scan(vane())
    # marked, so that they are known again
    marked = np.zeros((len(measured.points), 3), np.float32)
    marked[:, 2] = 1
    given = clean_scan(measured.points, marked)
    match_poses(matcher, given, batch(truth), iterations=1)
    normals = np.asarray(seen["source"].normals)[np.asarray(seen["source"].mask)]
    np.testing.assert_array_equal(normals, np.broadcast_to([0, 0, 1], normals.shape))
    match_poses(matcher, measured, batch(truth), iterations=1)
    estimated = np.asarray(seen["source"].normals)[np.asarray(seen["source"].mask)]
    assert (estimated[:, 2] > 0).mean() > 0.9  # the camera looks along -z
    assert len(ideal.points) >= len(measured.points)


# --- the network itself -------------------------------------------------------------------------


def test_an_untrained_network_gives_rigid_finite_poses(matcher, scan):
    measured, truth = scan
    found = match_poses(matcher, measured, guesses(truth), iterations=1)
    assert found.rotation.shape == (4, 3, 3)
    assert found.translation.shape == (4, 3)
    assert found.rotation.dtype == np.float64
    assert np.isfinite(found.translation).all()
    for rotation in found.rotation:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
    again = match_poses(matcher, measured, guesses(truth), iterations=1)
    np.testing.assert_array_equal(found.rotation, again.rotation)
    # it moved them: the network was asked
    assert not np.allclose(found.rotation, guesses(truth).rotation, atol=1e-3)


def test_a_guess_does_not_depend_on_the_others(matcher, scan):
    measured, truth = scan
    here = match_poses(matcher, measured, guesses(truth, 0), iterations=1)
    there = match_poses(matcher, measured, guesses(truth, 2), iterations=1)
    np.testing.assert_allclose(here.rotation[2:], there.rotation[:2], atol=1e-5)
    np.testing.assert_allclose(here.translation[2:], there.translation[:2], atol=0.01)


def test_the_place_of_the_scan_does_not_matter(matcher, scan):
    """The scan shifted and the guess against it: the same points of the part, the same answer."""
    measured, truth = scan
    asked = guesses(truth)
    # sums without rounding, so that ties in thinning stay ties; and whole voxels of 4 mm
    measured = dataclasses.replace(measured, points=np.round(measured.points * 1024) / 1024)
    shift = np.array([64.0, -128.0, 32.0])
    away = dataclasses.replace(
        measured, points=measured.points + shift, sensor_origin=measured.sensor_origin + shift
    )
    moved = RigidTransform(asked.rotation, asked.translation - asked.rotation @ shift)
    here = match_poses(matcher, measured, asked, iterations=1)
    there = match_poses(matcher, away, moved, iterations=1)
    back = there.translation + there.rotation @ shift
    np.testing.assert_allclose(there.rotation, here.rotation, atol=1e-3)
    np.testing.assert_allclose(back, here.translation, atol=0.1)


def test_weights_of_nan_give_the_guess_back(matcher, scan):
    measured, truth = scan
    broken = dataclasses.replace(
        matcher, variables=jax.tree.map(lambda x: np.full_like(x, np.nan), matcher.variables)
    )
    asked = guesses(truth)
    found = match_poses(broken, measured, asked, iterations=1)
    np.testing.assert_array_equal(found.rotation, asked.rotation)
    np.testing.assert_array_equal(found.translation, asked.translation)


def test_a_scan_without_a_sensor_or_with_few_points_is_matched_too(matcher):
    ideal, truth = ideal_scan(vane(), random_view(vane(), seed=1))
    some = ideal.points[:: len(ideal.points) // 60].astype(np.float64)
    for origin in ("auto", "unknown"):
        few = clean_scan(some + np.array([5.0, 5.0, 5.0]), sensor_origin=origin)
        found = match_poses(matcher, few, guesses(truth), iterations=1)
        assert np.isfinite(found.rotation).all()
        assert np.isfinite(found.translation).all()
