"""Search from no guess: how rotations are spread, which poses count as one, and who is tried."""

from __future__ import annotations

import numpy as np
import pytest
from example_scans import (
    batch,
    box,
    bracket,
    measured_points,
    model,
    motion,
    pose_error,
    random_view,
    vane,
)
from scipy.spatial.transform import Rotation

from vanejax.localization.pose_batch import (
    SAME_DEG,
    SAME_SHIFT,
    concatenate,
    distances,
    distinct,
    select,
)
from vanejax.localization.pose_search import (
    MOST_SYMMETRY_HYPOTHESES,
    Candidates,
    add_symmetry_hypotheses,
    converge,
    initial_poses,
    noise_level,
    search,
    uniform_rotations,
)
from vanejax.localization.residuals import SurfaceMatching
from vanejax.localization.verification import Evidence
from vanejax.rigid import RigidTransform

IDENTITY = RigidTransform(np.eye(3), np.zeros(3))


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[A, B] angles between rotations."""
    trace = np.einsum("aij,bij->ab", a, b)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


# --- rotations ----------------------------------------------------------------------------------


def test_uniform_rotations_cover_all_rotations():
    """400 balls of angle t hold all of SO(3) where 400 (t - sin t) = pi: 20.7 deg.

    Balls that cover it overlap, so they are larger: half as large again is a good cover.
    """
    count, cover_deg = 400, 34.0
    spread = uniform_rotations(count)
    assert spread.shape == (count, 3, 3)
    gram = spread @ spread.swapaxes(1, 2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(spread), 1, atol=1e-12)
    probes = Rotation.random(5000, random_state=0).as_matrix()
    nearest = angle_deg(probes, spread).min(axis=1)
    assert nearest.max() < cover_deg
    between = (angle_deg(spread, spread) + 360 * np.eye(count)).min(axis=1)
    assert between.min() > 0.5 * np.median(between)  # no two are the same


def test_starts_put_the_middle_of_the_scan_where_it_belongs():
    points, truth = measured_points(vane())
    found = initial_poses(model(vane()), points, np.stack([truth.rotation, np.eye(3)]))
    right = select(found, 0)
    # the seen surface's middle, up to self-occlusion: a fifth of the radius
    assert pose_error(vane(), right, truth)[1] < 0.25 * vane().radius
    measured = SurfaceMatching(model(vane()).surface, reach_mm=20.0)
    found = initial_poses(measured, points, truth.rotation[None])
    middle = select(found, 0).apply(points.mean(axis=0)[None])[0]
    np.testing.assert_allclose(middle, measured.surface.points[:1000].mean(axis=0), atol=1e-6)


# --- distances ----------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [0.0, 1e-3, 3.0, 90.0, 180.0])
def test_distances_are_those_of_the_motion_between(turn):
    part = box()
    pose = random_view(part, seed=1).inverse()
    shift = np.array([1.0, -2.0, 0.5])
    other = motion(part, turn * np.array([0.6, 0.0, 0.8]), shift) @ pose
    for a, b in ((pose, other), (other, pose)):
        angle, moved = distances(batch(a), b, part)
        assert angle[0] == pytest.approx(turn, abs=1e-5)  # f64 at 180 deg
        assert moved[0] == pytest.approx(np.linalg.norm(shift), abs=1e-9)


def test_distinct_keeps_the_first_of_those_that_are_near():
    part = box()
    near_deg, near_mm = 0.9 * SAME_DEG, 0.9 * SAME_SHIFT * part.radius
    poses = batch(
        IDENTITY,
        motion(part, [near_deg, 0, 0], [near_mm, 0, 0]),  # as the first
        motion(part, [1.2 * SAME_DEG, 0, 0], [0, 0, 0]),  # turned too far
        motion(part, [0, 0, 0], [0, 1.2 * SAME_SHIFT * part.radius, 0]),  # moved too far
        motion(part, [0, 0, 180], [0, 0, 0]),
        motion(part, [0, 0, 180 + near_deg], [0, 0, 0]),  # as the one before
    )
    np.testing.assert_array_equal(distinct(poses, part, 10), [0, 2, 3, 4])
    np.testing.assert_array_equal(distinct(poses, part, 2), [0, 2])


def test_concatenate_and_select_are_each_others_inverse():
    a, b = (batch(*(random_view(box(), s) for s in seeds)) for seeds in ((1, 2), (3,)))
    every = concatenate(a, b)
    np.testing.assert_array_equal(select(every, slice(0, 2)).rotation, a.rotation)
    np.testing.assert_array_equal(select(every, 2).translation, b.translation[0])
    found = Candidates(every, np.array([3.0, 2.0, 1.0]))
    assert len(found) == 3
    np.testing.assert_array_equal(found.pose(1).rotation, a.rotation[1])


# --- symmetry hypotheses -------------------------------------------------------------------------


def test_challenge_finds_the_boxs_other_poses():
    points, truth = measured_points(box(), random_view(box(), seed=5), noise_mm=0.05)
    found = Candidates(batch(truth), np.array([1.0]))
    pool = add_symmetry_hypotheses(model(box()), points, found)
    for axis in np.eye(3):
        symmetric = motion(box(), 180 * axis, np.zeros(3)) @ truth
        angle, shift = distances(pool.part_from_camera, symmetric, box())
        rank = int(np.argmin(angle + shift))
        assert angle[rank] < 0.5
        assert shift[rank] < 0.5
        assert pool.score[rank] > pool.score[0] - 0.1
    assert len(pool) <= MOST_SYMMETRY_HYPOTHESES
    assert (np.diff(pool.score) <= 0).all()


def test_challenge_keeps_the_best_where_nothing_is_alike():
    points, truth = measured_points(bracket(), random_view(bracket(), seed=2), noise_mm=0.05)
    found = Candidates(batch(truth), np.array([1.0]))
    pool = add_symmetry_hypotheses(model(bracket()), points, found)
    angle, shift = distances(batch(pool.pose(0)), truth, bracket())
    assert angle[0] < 0.01
    assert shift[0] < 0.01


# --- search -------------------------------------------------------------------------------------


def test_the_vane_is_found_from_nothing():
    points, truth = measured_points(vane(), random_view(vane(), 0))
    found = search(model(vane()), points)
    angle, shift = pose_error(vane(), found.pose(0), truth)
    assert angle < 0.1
    assert shift < 0.1
    assert found.score[0] > found.score[1] + 0.1
    turned, moved = distances(found.part_from_camera, found.pose(0), vane())
    assert ((turned > SAME_DEG) | (moved > SAME_SHIFT * vane().radius))[1:].all()
    assert (np.diff(found.score) <= 0).all()


@pytest.mark.slow
def test_a_box_is_found_in_all_its_four_poses():
    points, truth = measured_points(box(), random_view(box(), seed=5), noise_mm=0.05)
    found = search(model(box()), points)
    for turns in ([0, 0, 0], [180, 0, 0], [0, 180, 0], [0, 0, 180]):
        symmetric = motion(box(), np.array(turns, float), np.zeros(3)) @ truth
        angle, shift = distances(found.part_from_camera, symmetric, box())
        assert np.min(angle + shift) < 1.0


@pytest.mark.slow
def test_without_a_sensor_the_part_is_found_too():
    points, truth = measured_points(bracket(), random_view(bracket(), seed=1), noise_mm=0.05)
    frame = motion(box(), [50, 60, -70], [100, 200, 300])
    measured = SurfaceMatching(model(bracket()).surface, reach_mm=0.3 * bracket().radius)
    found = search(measured, frame.apply(points))
    best = [pose_error(bracket(), found.pose(k) @ frame, truth) for k in range(min(4, len(found)))]
    assert min(angle + shift for angle, shift in best) < 0.5


def test_extra_poses_are_tried_beside_the_spread_ones_or_alone():
    points, truth = measured_points(vane())
    near = motion(vane(), [0, 3, 0], [1, 0, 0]) @ truth
    alone = search(model(vane()), points, extra=batch(near), count=0)
    assert len(alone) == 1
    assert max(pose_error(vane(), alone.pose(0), truth)) < 0.1
    few = search(model(vane()), points, extra=batch(near), count=20)
    assert max(pose_error(vane(), few.pose(0), truth)) < 0.1
    assert len(few) > 1


def test_the_seed_decides_everything():
    points, _ = measured_points(vane())
    one, two = (search(model(vane()), points, count=60, seed=3) for _ in range(2))
    np.testing.assert_array_equal(one.score, two.score)
    np.testing.assert_array_equal(one.part_from_camera.rotation, two.part_from_camera.rotation)
    other = search(model(vane()), points, count=60, seed=4)
    assert not np.array_equal(one.score[:1], other.score[:1])


def test_settle_merges_poses_that_meet():
    points, truth = measured_points(vane())
    near = [motion(vane(), 4 * a, [0, 0, 1]) @ truth for a in (*np.eye(3), -np.eye(3)[0])]
    found = converge(model(vane()), points, batch(*near))
    assert len(found) == 1
    assert max(pose_error(vane(), found.pose(0), truth)) < 0.1


def test_noise_level_is_that_of_the_points_near_the_part():
    points, truth = measured_points(vane(), noise_mm=0.4)
    wrong = motion(vane(), [0, 90, 0], [0, 0, 0]) @ truth
    level = noise_level(model(vane()), batch(truth, wrong), points)
    assert 0.1 < level[0] < 0.4  # along the normal
    assert level[1] > 1.0
    rng = np.random.default_rng(0)
    clutter = rng.uniform([-200, -200, -700], [200, 200, -500], (len(points) // 2, 3))
    same = noise_level(model(vane()), batch(truth), np.concatenate([points, clutter]))
    assert same[0] == pytest.approx(level[0], rel=0.2)
    # nothing near at all: the largest that is near
    lost = noise_level(model(vane()), batch(truth), clutter + np.array([0, 0, -1000.0]))
    assert lost[0] == pytest.approx(1.4826 * 0.1 * vane().radius)


def test_a_challenge_keeps_the_best_even_where_nothing_fits(monkeypatch):
    """Where every score is negative, a share of the best one is above it."""

    def nothing_fits(model, poses, points, *, tolerance_mm, view):
        count = len(poses.rotation)
        nothing = np.zeros((count, 1))
        return Evidence(np.zeros(1), nothing, nothing, -np.linspace(0.1, 0.9, count))

    monkeypatch.setattr("vanejax.localization.pose_search.evidence", nothing_fits)
    points, pose = measured_points(box(), random_view(box(), seed=3))
    kept = add_symmetry_hypotheses(model(box()), points, Candidates(batch(pose), np.array([-0.5])))
    assert kept.score[0] == -0.1
    assert (kept.score >= -0.1 * 1.4 - 1e-12).all()
