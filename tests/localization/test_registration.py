"""The whole way from a scan and a CAD model to a pose, its verdict, and what is said about it."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
import trimesh
from example_result import example_result
from example_scans import (
    MIDDLE,
    batch,
    box,
    bracket,
    disturbed,
    measured_points,
    model,
    motion,
    pose_error,
    random_view,
    small_motion,
    vane,
)
from scipy.spatial.transform import Rotation

import vanejax
from vanejax.cad.part import Part, part_from_mesh
from vanejax.errors import InputError
from vanejax.localization import assessment, matched_poses, registration
from vanejax.localization.pose_result import PoseResult
from vanejax.localization.registration import register
from vanejax.localization.verdict import Limits
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Camera, look_at
from vanejax.scans.measured_scan import clean_scan
from vanejax.scans.scan_file import save_points
from vanejax.training.pairs import PairSampling
from vanejax.training.weight_file import TrainedMatcher


@functools.cache
def scan_of(name: str, seed: int) -> tuple[np.ndarray, RigidTransform]:
    """Points with 0.1 mm of noise from a random side, and the true part_from_camera."""
    part = {"vane": vane, "bracket": bracket, "box": box}[name]()
    return measured_points(part, random_view(part, seed))


@functools.cache
def found_bracket() -> PoseResult:
    return register(scan_of("bracket", 1)[0], bracket())


@functools.cache
def found_box() -> PoseResult:
    return register(scan_of("box", 5)[0], box())


def assert_right(
    result: PoseResult, part: Part, truth: RigidTransform, within: float = 0.1
) -> None:
    """Accepted, and within that many degrees and millimetres."""
    assert result.verdict.status == "accepted", result.verdict.reason
    assert max(pose_error(part, result.part_from_camera, truth)) < within


def bits(result: PoseResult) -> bytes:
    pose = result.part_from_camera
    return pose.rotation.tobytes() + pose.translation.tobytes()


# --- right answers ------------------------------------------------------------------------------


def test_a_vane_from_another_side_is_found():
    points, truth = scan_of("vane", 1)
    result = register(points, vane())
    assert_right(result, vane(), truth, within=0.03)
    assert result.alternatives == ()
    assert result.refinement.method == "ray casting"
    assert result.verification.inlier_share > 0.9
    e = small_motion(vane(), result.part_from_camera, truth)
    assert e @ np.linalg.solve(result.uncertainty.covariance, e) < 30  # one in 25,000


def test_the_result_tells_everything():
    points, truth = scan_of("bracket", 1)
    result = found_bracket()
    assert_right(result, bracket(), truth)
    np.testing.assert_array_equal(result.sensor_origin, np.zeros(3))
    np.testing.assert_array_equal(result.uncertainty.center, bracket().center)
    assert max(pose_error(bracket(), result.before, truth)) < 1
    identity = result.camera_from_part @ result.part_from_camera
    np.testing.assert_allclose(identity.as_matrix(), np.eye(4), atol=1e-9)
    assert {"read", "search", "refine", "verify"} <= set(result.seconds)
    assert min(result.seconds.values()) >= 0
    assert any("sensor" in note for note in result.notes)
    assert result.refinement.noise_mm == pytest.approx(0.1, rel=0.3)
    assert result.verification.status.shape == result.verification.checked.shape
    assert len(points) == result.refinement.num_points


def test_it_is_the_packages_own_function():
    assert vanejax.register is register


def test_a_guess_leads_to_the_same_answer():
    points, truth = scan_of("bracket", 1)
    init = disturbed(bracket(), truth, 5, 5, seed=0)
    result = register(points, bracket(), init=init)
    assert_right(result, bracket(), truth)
    np.testing.assert_array_equal(result.before.rotation, init.rotation)
    between = small_motion(bracket(), result.part_from_camera, found_bracket().part_from_camera)
    # both stop within a fraction of a standard deviation
    assert between @ np.linalg.solve(result.uncertainty.covariance, between) < 0.5


def test_the_same_seed_gives_the_same_bits():
    points, truth = scan_of("bracket", 1)
    init = disturbed(bracket(), truth, 5, 5, seed=0)
    one, two = (register(points, bracket(), init=init, seed=7) for _ in range(2))
    assert bits(one) == bits(two)
    np.testing.assert_array_equal(one.verification.status, two.verification.status)


def test_the_scan_is_not_changed():
    points, _ = scan_of("bracket", 1)
    before = points.copy()
    register(points, bracket(), init=scan_of("bracket", 1)[1])
    np.testing.assert_array_equal(points, before)


# --- files --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("suffix", "scale", "units"), [(".ply", 1.0, "mm"), (".xyz", 1e-3, "m")])
def test_two_files_are_enough(tmp_path, suffix, scale, units):
    points, truth = scan_of("bracket", 1)
    bracket().export(tmp_path / "part.stl")
    save_points(tmp_path / f"scan{suffix}", scale * points)
    for given in ({}, {"units_scan": units}):
        result = register(
            tmp_path / f"scan{suffix}", str(tmp_path / "part.stl"), init=truth, **given
        )
        assert_right(result, bracket(), truth)


def test_a_part_in_other_units(tmp_path):
    points, truth = scan_of("bracket", 1)
    mesh = bracket().mesh.copy()
    mesh.apply_scale(0.1)
    mesh.export(tmp_path / "part.stl")
    result = register(points, tmp_path / "part.stl", units_cad="cm", init=truth)
    assert_right(result, bracket(), truth)


def test_a_file_that_is_not_there(tmp_path):
    bracket().export(tmp_path / "part.stl")
    with pytest.raises(InputError, match=r"scan\.ply"):
        register(tmp_path / "scan.ply", tmp_path / "part.stl")
    with pytest.raises(InputError, match=r"part\.stp"):
        register(scan_of("bracket", 1)[0], tmp_path / "part.stp")


# --- doubt --------------------------------------------------------------------------------------


def test_a_symmetric_part_is_ambiguous_and_every_answer_fits():
    points, truth = scan_of("box", 5)
    result = found_box()
    assert result.verdict.status == "ambiguous"
    assert "3 other poses" in result.verdict.reason
    assert len(result.alternatives) == 3
    poses = [result.part_from_camera, *(a.part_from_camera for a in result.alternatives)]
    for pose in poses:
        moved = pose.apply(points)
        closest = model(box()).surface.exact(moved).points
        assert np.quantile(np.linalg.norm(moved - closest, axis=1), 0.98) < 0.4  # four sigma
    # they are the four symmetric ones: each the nearest to another
    nearest = set()
    for turn in (np.zeros(3), *(180 * np.eye(3))):
        symmetric = motion(box(), turn, np.zeros(3)) @ truth
        errors = [sum(pose_error(box(), pose, symmetric)) for pose in poses]
        assert min(errors) < 0.3
        nearest.add(int(np.argmin(errors)))
    assert nearest == {0, 1, 2, 3}
    for other in result.alternatives:
        assert other.rotation_deg == pytest.approx(180, abs=0.5)
        assert other.inlier_share > 0.9


@pytest.mark.parametrize("turn", [[0, 0, 0], [180, 0, 0]])
def test_a_rough_guess_decides_between_symmetric_poses(turn):
    points, truth = scan_of("box", 5)
    wanted = motion(box(), np.array(turn, float), np.zeros(3)) @ truth
    # three faces of a box do not tell stock from a motion
    init = disturbed(box(), wanted, 4, 3, seed=1)
    result = register(points, box(), init=init, max_allowance_mm=0.0)
    assert_right(result, box(), wanted)
    (note,) = (note for note in result.notes if "the guess rules" in note)
    assert note.startswith("3 other poses fit as well, one turned by 180.0 deg")


@pytest.mark.parametrize("turn", [None, [0, 0, 0], [180, 0, 0]])
def test_a_declared_symmetry_makes_one_pose_of_all_that_fit(turn):
    """Without a guess the least turned one is reported, with one the nearest."""
    points, truth = scan_of("box", 5)
    turns = [np.zeros(3), *(180 * np.eye(3))]
    right = [motion(box(), t, np.zeros(3)) @ truth for t in turns]
    wanted = min(right, key=lambda p: Rotation.from_matrix(p.rotation).magnitude())
    init = None
    if turn is not None:
        wanted = motion(box(), np.array(turn, float), np.zeros(3)) @ truth
        init = disturbed(box(), wanted, 4, 3, seed=1)
    result = register(points, box(), init=init, max_allowance_mm=0.0, symmetry="x:180,y:180")
    assert_right(result, box(), wanted)
    assert result.alternatives == ()
    assert max(pose_error(box(), result.before, wanted)) < 5.1
    (note,) = (note for note in result.notes if "symmetry" in note)
    assert note.startswith("symmetry x:180,y:180: 4 poses are one")
    assert ("nearest to the guess" in note) == (turn is not None)
    assert not any("the guess rules" in note for note in result.notes)
    e = small_motion(box(), result.part_from_camera, wanted)
    assert e @ np.linalg.solve(result.uncertainty.covariance, e) < 30


def test_half_a_symmetry_leaves_the_other_poses():
    """Of the box's four poses two are one by the declared turn; the others still compete."""
    points, _ = scan_of("box", 5)
    result = register(points, box(), max_allowance_mm=0.0, symmetry="z:180")
    assert result.verdict.status == "ambiguous"
    assert len(result.alternatives) == 1
    assert result.alternatives[0].rotation_deg == pytest.approx(180, abs=0.5)


@functools.cache
def shaft() -> Part:
    """Turned about z, with steps of 12, 20 and 15 mm radius: no other symmetry."""
    steps = [
        trimesh.creation.cylinder(r, segment=[[0, 0, z0], [0, 0, z1]], sections=96)
        for r, z0, z1 in ((12, 0, 40), (20, 40, 60), (15, 60, 120))
    ]
    mesh = trimesh.boolean.union(steps)
    return part_from_mesh(mesh.vertices + np.array([7.0, -4.0, 11.0]), mesh.faces, name="shaft")


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_rotation_of_a_shaft_is_free_and_the_rest_is_known(seed):
    points, truth = measured_points(shaft(), random_view(shaft(), seed), seed=seed)
    assert register(points, shaft(), max_allowance_mm=0.0).verdict.status == "ambiguous"
    result = register(points, shaft(), max_allowance_mm=0.0, symmetry="z:any")
    assert result.verdict.status == "accepted", result.verdict.reason
    assert result.verdict.reason.endswith("the rotation about the part's z is free by symmetry")
    assert result.alternatives == ()
    found, uncertainty = result.part_from_camera, result.uncertainty
    assert np.isinf(uncertainty.rotation_sigma_deg[2])
    right = result.symmetry.canonical(truth, found)  # of all right poses the nearest
    e = small_motion(shaft(), found, right)
    assert abs(e[2]) < 1e-6
    known = np.delete(np.arange(6), 2)
    covariance = uncertainty.covariance[np.ix_(known, known)]
    assert e[known] @ np.linalg.solve(covariance, e[known]) < 30
    assert uncertainty.rotation_bound_deg < 0.05
    np.testing.assert_allclose(
        result.symmetry.canonical(found).as_matrix(), found.as_matrix(), atol=1e-6
    )


def test_a_symmetry_that_the_cad_model_does_not_have_is_refused():
    with pytest.raises(InputError, match=r"symmetry z:180: the CAD model does not have it"):
        register(scan_of("bracket", 1)[0], bracket(), symmetry="z:180")


@pytest.mark.slow
def test_the_scan_of_another_part_is_not_accepted():
    result = register(scan_of("bracket", 1)[0], box(), sensor_origin=np.zeros(3))
    assert result.verdict.status != "accepted"


def test_the_scan_of_another_part_is_rejected():
    """A vane is nowhere flat enough for a box; with a guess only that is tried."""
    points, truth = scan_of("vane", 0)
    result = register(points, box(), sensor_origin=np.zeros(3), init=truth)
    assert result.verdict.status == "rejected"
    assert "%" in result.verdict.reason or "mm" in result.verdict.reason
    assert result.alternatives == ()


@pytest.mark.slow
def test_a_guess_far_from_the_truth_is_not_accepted_there():
    points, truth = scan_of("vane", 0)
    init = motion(vane(), [0, 90, 0], [0, 0, 0]) @ truth
    result = register(points, vane(), init=init)
    wrong = max(pose_error(vane(), result.part_from_camera, truth)) > 0.1
    assert (result.verdict.status == "accepted") != wrong


def test_limits_are_the_callers():
    points, truth = scan_of("bracket", 1)
    strict = Limits(least_inlier_share=0.9999)
    result = register(points, bracket(), init=truth, limits=strict)
    assert result.verdict.status == "rejected"


# --- where the sensor stands --------------------------------------------------------------------


@pytest.mark.slow
def test_a_sensor_that_is_nowhere_known():
    points, truth = scan_of("bracket", 1)
    result = register(points, bracket(), sensor_origin="unknown")
    assert_right(result, bracket(), truth)
    assert result.sensor_origin is None
    assert result.refinement.method == "point to plane"
    assert np.isnan(result.verification.violation_share)


def test_without_rays_the_other_side_of_a_wall_is_no_answer():
    """From 5 deg and 5 mm off, point to plane may end on the wrong side of a wall of 4 mm."""
    points, truth = measured_points(vane(), camera=MIDDLE)
    init = disturbed(vane(), truth, 5, 5, seed=0)
    result = register(points, vane(), sensor_origin="unknown", init=init)
    poses = [result.part_from_camera]
    if result.verdict.status != "accepted":
        poses += [other.part_from_camera for other in result.alternatives]
    assert min(max(pose_error(vane(), pose, truth)) for pose in poses) < 0.15


def test_a_sensor_that_stands_elsewhere():
    points, truth = scan_of("bracket", 1)
    away = np.array([200.0, -50.0, 30.0])
    result = register(points + away, bracket(), sensor_origin=away)
    assert result.verdict.status == "accepted"
    back = result.part_from_camera @ RigidTransform(np.eye(3), away)
    assert max(pose_error(bracket(), back, truth)) < 0.05
    np.testing.assert_array_equal(result.sensor_origin, away)
    between = small_motion(bracket(), back, found_bracket().part_from_camera)
    assert between @ np.linalg.solve(result.uncertainty.covariance, between) < 0.5


def turned_in_place(points: np.ndarray, turn_deg: list[float]) -> RigidTransform:
    """A turn about the cloud's middle: the file's origin is then no sensor any more."""
    rotation = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    middle = points.mean(axis=0)
    return RigidTransform(rotation, middle - rotation @ middle)


def test_a_scan_that_was_moved_is_found_by_its_shape():
    """Seen from the origin nothing fits; the rays are wrong, not the pose."""
    points, truth = scan_of("bracket", 1)
    frame = turned_in_place(points, [120.0, 0.0, 0.0])
    init = disturbed(bracket(), truth @ frame.inverse(), 3, 3, seed=0)
    result = register(frame.apply(points), bracket(), init=init)
    assert result.verdict.status == "ambiguous"  # what the rays refuse is not accepted without them
    assert "--sensor-origin unknown" in result.verdict.reason
    assert max(pose_error(bracket(), result.part_from_camera @ frame, truth)) < 0.1
    assert result.sensor_origin is None
    told = register(frame.apply(points), bracket(), init=init, sensor_origin="unknown")
    assert told.verdict.status == "accepted"


@pytest.mark.parametrize(("share", "status"), [(0.9, "ambiguous"), (1.1, "rejected")])
def test_a_shape_that_fits_loosely_is_no_reason_to_doubt_the_sensors_place(
    monkeypatch, share, status
):
    """``share`` is of the noise up to which the fit without rays counts."""
    tolerance_mm = 3 * share * Limits().doubtful_noise * bracket().radius

    def fits_without_rays(scan, task, rotations) -> PoseResult:
        if scan.sensor_origin is not None:
            return example_result("rejected")
        loose = example_result("accepted", sensor=False)
        checks = dataclasses.replace(loose.verification, tolerance_mm=tolerance_mm)
        return dataclasses.replace(loose, verification=checks)

    monkeypatch.setattr(registration, "_register_points", fits_without_rays)
    monkeypatch.setattr(registration, "_other_shapes", lambda *_: ())
    result = register(scan_of("bracket", 1)[0], bracket(), segment="off")
    assert result.verdict.status == status
    assert ("were the sensor's place unknown" in result.verdict.reason) == (status == "ambiguous")


def test_a_sensor_as_given_is_not_doubted():
    points, truth = scan_of("bracket", 1)
    frame = turned_in_place(points, [120.0, 0.0, 0.0])
    scan = clean_scan(frame.apply(points), sensor_origin=np.zeros(3))
    result = register(scan, bracket(), init=truth @ frame.inverse())
    assert result.verdict.status == "rejected"
    np.testing.assert_array_equal(result.sensor_origin, np.zeros(3))


@pytest.mark.slow
def test_a_centred_cloud_says_so_and_is_found():
    points, truth = scan_of("bracket", 1)
    middle = points.mean(axis=0)
    result = register(points - middle, bracket())
    back = result.part_from_camera @ RigidTransform(np.eye(3), -middle)
    assert max(pose_error(bracket(), back, truth)) < 0.1
    assert result.refinement.method == "point to plane"
    assert any("inside the cloud" in note for note in result.notes)


# --- a trained network --------------------------------------------------------------------------


def a_matcher(part: Part) -> TrainedMatcher:
    """Weights for a part, without weights: what `register` asks of them is stubbed here."""
    return TrainedMatcher(
        model=None,
        variables={},
        iterations=1,
        sampling=PairSampling(),
        voxel_mm=1.0,
        center=part.center,
        radius_mm=part.radius,
        reference_points=np.zeros((0, 3)),
        reference_normals=np.zeros((0, 3)),
        part_name=part.name,
        part_sha256=part.sha256,
        camera=Camera(),
    )


def test_weights_of_another_part_are_refused(tmp_path):
    points, _ = scan_of("bracket", 1)
    with pytest.raises(InputError, match=r"trained for box.*this part is bracket"):
        register(points, bracket(), weights=a_matcher(box()))
    with pytest.raises(InputError, match=r"none\.npz"):
        register(points, bracket(), weights=tmp_path / "none.npz")


def test_the_poses_of_the_network_are_refined(monkeypatch):
    points, truth = scan_of("bracket", 1)
    asked = []

    def good(matcher, scan, guesses, *, iterations, seed):
        asked.append(len(guesses.rotation))
        return batch(disturbed(bracket(), truth, 3, 3, seed=0))

    monkeypatch.setattr(matched_poses, "match_poses", good)
    monkeypatch.setattr(registration, "SEARCH_ROTATIONS", ())  # no search by ray casting
    result = register(points, bracket(), weights=a_matcher(bracket()))
    assert_right(result, bracket(), truth)
    assert asked == [60]
    assert "match" in result.seconds
    asked.clear()
    result = register(points, bracket(), weights=a_matcher(bracket()), init=truth)
    assert_right(result, bracket(), truth)
    assert asked == [1]


@pytest.mark.slow
def test_a_network_that_finds_nothing_does_no_harm(monkeypatch):
    points, truth = scan_of("bracket", 1)

    def useless(matcher, scan, guesses, *, iterations, seed):
        away = guesses.rotation @ np.array([0.0, 0.0, 1000.0])  # a metre farther off
        return RigidTransform(guesses.rotation, guesses.translation + away)

    monkeypatch.setattr(matched_poses, "match_poses", useless)
    result = register(points, bracket(), weights=a_matcher(bracket()))
    assert_right(result, bracket(), truth)
    near = disturbed(bracket(), truth, 5, 5, seed=0)
    result = register(points, bracket(), weights=a_matcher(bracket()), init=near)
    assert_right(result, bracket(), truth)


def test_the_network_is_not_asked_about_a_scan_whose_rays_are_wrong(monkeypatch):
    """It was trained on normals that face the sensor, whose place is then unknown."""
    points, truth = scan_of("bracket", 1)
    frame = turned_in_place(points, [120.0, 0.0, 0.0])
    init = disturbed(bracket(), truth @ frame.inverse(), 3, 3, seed=0)
    origins = []

    def as_guessed(matcher, scan, guesses, *, iterations, seed):
        origins.append(scan.sensor_origin)
        return guesses

    monkeypatch.setattr(matched_poses, "match_poses", as_guessed)
    result = register(
        frame.apply(points), bracket(), weights=a_matcher(bracket()), init=init, segment="off"
    )
    assert result.verdict.status == "ambiguous"
    assert result.sensor_origin is None
    assert len(origins) == 1
    assert origins[0] is not None


# --- what makes no sense ------------------------------------------------------------------------

NOT_POSES = {
    "NaN rotation": RigidTransform(np.full((3, 3), np.nan), np.zeros(3)),
    "NaN translation": RigidTransform(np.eye(3), np.array([0, np.nan, 0])),
    "inf": RigidTransform(np.eye(3), np.array([0, 0, np.inf])),
    "mirror": RigidTransform(np.diag([1.0, 1.0, -1.0]), np.zeros(3)),
    "scaled": RigidTransform(2 * np.eye(3), np.zeros(3)),
    "many": RigidTransform(np.eye(3)[None], np.zeros((1, 3))),
}


@pytest.mark.parametrize("name", NOT_POSES)
def test_a_guess_that_is_no_pose(name):
    with pytest.raises(InputError, match="init"):
        register(scan_of("bracket", 1)[0], bracket(), init=NOT_POSES[name])


def test_a_guess_in_single_precision_is_welcome():
    points, truth = scan_of("bracket", 1)
    single = RigidTransform(truth.rotation.astype(np.float32), truth.translation.astype(np.float32))
    result = register(points, bracket(), init=single)
    assert_right(result, bracket(), truth)
    assert result.part_from_camera.rotation.dtype == np.float64


def test_fifty_points_get_an_answer_but_49_do_not():
    points, truth = scan_of("bracket", 1)
    few = points[np.random.default_rng(0).choice(len(points), 50, replace=False)]
    result = register(few, bracket(), init=disturbed(bracket(), truth, 3, 2, seed=0))
    assert np.isfinite(result.part_from_camera.translation).all()
    if result.verdict.status == "accepted":
        assert max(pose_error(bracket(), result.part_from_camera, truth)) < 1
    assert register(few, bracket()).verdict.status in ("accepted", "ambiguous", "rejected")
    with pytest.raises(InputError, match="at least 50"):
        register(few[:49], bracket())


def test_points_on_a_line_are_refused():
    line = np.linspace([0, 0, -300], [50, 10, -350], 200)
    with pytest.raises(InputError, match="line"):
        register(line, bracket())


def test_what_is_no_scan_at_all():
    with pytest.raises(InputError, match=r"\[N, 3\]"):
        register(np.zeros((100, 2)), bracket())
    with pytest.raises(InputError, match="sensor_origin"):
        register(scan_of("bracket", 1)[0], bracket(), sensor_origin="somewhere")


def test_points_without_a_measurement_are_dropped():
    points, truth = scan_of("bracket", 1)
    holes = np.concatenate([points, np.full((100, 3), np.nan), np.zeros((50, 3)), points[:20]])
    result = register(holes, bracket(), init=truth)
    assert_right(result, bracket(), truth)
    assert result.refinement.num_points == len(points)
    assert sum("dropped" in note for note in result.notes) == 3


@pytest.mark.slow
def test_a_million_points():
    points, truth = scan_of("bracket", 1)
    rng = np.random.default_rng(0)
    many = np.repeat(points, 1_000_000 // len(points) + 1, axis=0)
    many *= 1 + rng.normal(0, 0.05 / 400, (len(many), 1))
    assert len(many) >= 1_000_000
    result = register(many, bracket(), init=disturbed(bracket(), truth, 3, 3, seed=0))
    assert max(pose_error(bracket(), result.part_from_camera, truth)) < 0.1
    assert result.verdict.status == "accepted"
    assert result.refinement.num_points < len(many)  # more would not help


def test_the_pose_near_the_guess_is_judged_though_a_far_one_fits_better():
    """A box with a boss at one end, guessed end for end: the far pose is named, not returned."""
    boss = trimesh.creation.box(bounds=[[20, -10, 15], [34, 10, 24]])
    solid = trimesh.boolean.union([trimesh.creation.box((80.0, 50.0, 30.0)), boss])
    part = part_from_mesh(solid.vertices, solid.faces, name="bossed box")
    view = look_at(np.array([135.0, 180.0, 390.0]), part.center)
    points, truth = measured_points(part, view)
    guess = motion(part, [0, 0, 180.0], np.zeros(3)) @ truth
    result = register(points, part, init=guess)
    turned, moved_by = pose_error(part, result.part_from_camera, guess)
    assert turned < assessment.GUESS_DEG
    assert moved_by < assessment.GUESS_SHIFT * part.radius
    assert result.verdict.status == "ambiguous"
    nearest = min(pose_error(part, a.part_from_camera, truth)[0] for a in result.alternatives)
    assert nearest < 0.5  # the true pose, followed with a part of the points


@pytest.mark.parametrize("second", [0.9, 0.6, 0.3])
def test_a_weakly_supported_pose_is_no_reason_to_stop(second, monkeypatch):
    """The next source is asked, and the better supported of all is the answer."""
    good = found_bracket()

    def supported(share: float) -> PoseResult:
        shares = {"inlier_share": share, "unmeasured_share": 0.0}
        return dataclasses.replace(
            good, verification=dataclasses.replace(good.verification, **shares)
        )

    results = {0.5: supported(0.5), second: supported(second)}
    monkeypatch.setattr(registration, "_search", lambda *_: iter([0.5, second]))
    monkeypatch.setattr(registration, "_localize", lambda model, scan, found, *_: results[found])
    points, _ = scan_of("bracket", 1)
    found = register(points, bracket(), sensor_origin=np.zeros(3))
    assert found is results[max(0.5, second)]
