"""Cubes and the frame between two instruments: exact ones, noisy ones, wrong ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.machine.calibration import averaged, calibrate, matched
from vanejax.machine.calibration_cube import Cube, cube_faces, cube_of, fit_face
from vanejax.rigid import RigidTransform

MACHINE_FROM_CAMERA = RigidTransform(
    Rotation.from_euler("xyz", [70, -20, 130], degrees=True).as_matrix(),
    np.array([800.0, -400.0, 1500.0]),
)
# outward normals and the faces' points: the corner is the origin, the material at x, y, z < 0
FACES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
SQUARE = np.eye(3)


def face_points(k: int, places: np.ndarray) -> np.ndarray:
    """Points of face k at places [N, 2] within (-60, 0)."""
    points = np.zeros((len(places), 3))
    points[:, FACES[k][1:]] = places
    return points


def placement(rng: np.random.Generator) -> RigidTransform:
    """camera_from_cube: its corner towards the camera, which looks along -z."""
    corner_up = Rotation.align_vectors([[0, 0, 1]], [[1, 1, 1]])[0]
    tilt = Rotation.from_rotvec(np.radians(rng.uniform(-20, 20, 3)))
    spin = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])
    middle = np.array([*rng.uniform(-40, 40, 2), -400 + rng.uniform(-30, 30)])
    return RigidTransform((tilt * spin * corner_up).as_matrix(), middle)


def placements(
    seed: int,
    count: int = 8,
    *,
    camera_mm: float = 0.0,
    probe_mm: float = 0.0,
    touched: int = 9,
    shape: np.ndarray = SQUARE,
) -> tuple[list[Cube], list[Cube]]:
    """Cubes of camera and machine, the camera's faces named as it happens."""
    rng = np.random.default_rng(seed)
    cubes: tuple[list[Cube], list[Cube]] = ([], [])
    for _ in range(count):
        camera_from_cube = placement(rng)
        machine_from_cube = MACHINE_FROM_CAMERA @ camera_from_cube
        for mine, frame, noise, number in (
            (cubes[0], camera_from_cube, camera_mm, 300),
            (cubes[1], machine_from_cube, probe_mm, touched),
        ):
            points = []
            for k in range(3):
                exact = face_points(k, rng.uniform(-58, -2, (number, 2)))
                exact[:, k] += noise * rng.standard_normal(number)
                points.append(frame.apply(exact @ shape.T))
            shift = rng.integers(3) if mine is cubes[0] else 0
            points = points[shift:] + points[:shift]
            mine.append(cube_of(points, noise_mm=noise, form_mm=0.0))
    return cubes


def error(found: RigidTransform, center: np.ndarray) -> np.ndarray:
    """[6] about ``center`` in the machine's frame: the truth after what was found."""
    left = MACHINE_FROM_CAMERA @ found.inverse()
    shift = left.rotation @ center + left.translation - center
    return np.concatenate([Rotation.from_matrix(left.rotation).as_rotvec(), shift])


def test_strays_do_not_move_a_plane():
    rng = np.random.default_rng(1)
    points = face_points(2, rng.uniform(-60, 0, (500, 2)))
    points[:, 2] += 0.04 * rng.standard_normal(500)
    points[:10, 2] += rng.uniform(5, 20, 10)
    face = fit_face(points)
    assert np.degrees(np.arccos(abs(face.normal[2]))) < 0.02
    assert abs(face.center[2]) < 0.01
    assert abs(np.mean(points[:, 2])) > 0.1, "the strays would have moved a plain mean"


@pytest.mark.parametrize("count", [3, 4, 9])
def test_a_plane_knows_its_error(count):
    """Monte Carlo of a few probe points, whose own scatter says little."""
    rng = np.random.default_rng(count)
    places = rng.uniform(-60, 0, (count, 2))
    tilts, offsets = [], []
    for _ in range(2000):
        points = face_points(2, places)
        points[:, 2] += 0.015 * rng.standard_normal(count)
        face = fit_face(points, noise_mm=0.015)
        normal = face.normal * np.sign(face.normal[2])
        tilts.append(normal[:2])
        offsets.append(face.center @ normal)
    sure = fit_face(face_points(2, places), noise_mm=0.015)
    # 2,000 draws: 3 % of a variance
    drawn = np.cov(np.array(tilts).T)
    np.testing.assert_allclose(drawn, sure.normal_covariance[:2, :2], atol=0.12 * np.trace(drawn))
    center = places.mean(axis=0)
    at_center = np.array(offsets) - np.array(tilts) @ center
    assert np.var(at_center) == pytest.approx(0.015**2 / count, rel=0.15)
    assert sure.offset_variance == pytest.approx(0.015**2 / count)


def test_form_does_not_average_out():
    many = face_points(2, np.random.default_rng(2).uniform(-60, 0, (5000, 2)))
    assert fit_face(many, form_mm=0.006).offset_variance == pytest.approx(0.006**2 / 9)


@pytest.mark.parametrize(
    ("points", "says"),
    [
        (np.zeros((2, 3)), "at least 3"),
        (np.outer(np.arange(5.0), [1, 2, 3]), "one line"),
        (np.zeros((5, 3)), "one line"),
        (np.full((5, 3), np.nan), "finite"),
    ],
)
def test_points_that_fix_no_plane_are_refused(points, says):
    with pytest.raises(InputError, match=says):
        fit_face(points)


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0)])
def test_a_cube_has_its_frame_whatever_the_order_of_its_faces(order):
    rng = np.random.default_rng(3)
    frame = placement(rng)
    points = [frame.apply(face_points(k, rng.uniform(-58, -2, (4, 2)))) for k in order]
    cube = cube_of(points)
    found = cube.world_from_cube
    np.testing.assert_allclose(cube.corner, frame.translation, atol=1e-9)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    # its axes are the cube's own, in turn
    same = np.abs(frame.rotation.T @ found.rotation)
    np.testing.assert_allclose(same.max(axis=0), 1, atol=1e-9)
    for face, other in ((0, 1), (1, 2), (2, 0)):
        assert cube.faces[face].height_mm(cube.faces[other].center[None])[0] < 0


def test_what_is_no_cube_is_refused():
    rng = np.random.default_rng(4)
    points = [face_points(k, rng.uniform(-58, -2, (9, 2))) for k in range(3)]
    leaning = points[2] @ Rotation.from_rotvec([0.05, 0, 0]).as_matrix()
    for wrong, words in (
        (points[:2], "three of its faces, got 2"),
        ([*points[:2], leaning], r"2\.86 deg from square"),
        ([np.concatenate(points[:2]), *points[1:]], "from square"),
    ):
        with pytest.raises(InputError, match=words):
            cube_of(wrong)


def scan(seed: int, noise_mm: float = 0.05, faces: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Points of a cube's scan with strays and mixed pixels, and their face; -1 for those."""
    rng = np.random.default_rng(seed)
    points, labels = [], []
    for k, count in zip(range(faces), (3000, 1500, 600), strict=False):
        exact = face_points(k, rng.uniform(-60, 0, (count, 2)))
        exact[:, k] += noise_mm * rng.standard_normal(count)
        points.append(exact)
        labels.append(np.full(count, k))
    points.append(rng.uniform(-60, 10, (40, 3)))
    labels.append(np.full(40, -1))
    return placement(rng).apply(np.concatenate(points)), np.concatenate(labels)


@pytest.mark.parametrize("seed", range(3))
def test_the_faces_of_a_scan_are_told_apart(seed):
    points, truth = scan(seed)
    found = cube_faces(points, seed=seed)
    mine = found >= 0
    # largest first; a stray that lies on a face cannot be told
    assert np.mean(found[mine & (truth >= 0)] == truth[mine & (truth >= 0)]) == 1
    assert np.mean(mine[truth >= 0]) > 0.9
    assert np.count_nonzero(mine & (truth < 0)) <= 6
    faces = [points[found == k] for k in range(3)]
    assert max(np.std(fit_face(face).height_mm(face)) for face in faces) < 0.07
    cube_of(faces)  # square to each other


def test_a_scan_of_two_faces_is_refused():
    with pytest.raises(InputError, match="shows 2 of the cube's faces"):
        cube_faces(scan(0, faces=2)[0])
    with pytest.raises(InputError, match=r"scan \[N, 3\]"):
        cube_faces(np.zeros((4, 3)))


@pytest.mark.parametrize("method", [calibrate, averaged])
@pytest.mark.parametrize("touched", [3, 9])
def test_exact_cubes_give_the_exact_frame(method, touched):
    found = method(*placements(5, touched=touched))
    # 1e-9 of the normals over 1,700 mm
    np.testing.assert_allclose(
        found.machine_from_camera.as_matrix(), MACHINE_FROM_CAMERA.as_matrix(), atol=1e-5
    )
    assert found.rotation_deg.shape == (8,)
    assert max(found.corner_mm.max(), found.rotation_deg.max()) < 1e-6


@pytest.mark.slow
def test_the_joint_fit_is_honest_and_better_than_the_mean():
    """Both over 40 sets of 8 placements: errors by their covariance, and side by side."""
    joint, mean, chi, spread = [], [], [], []
    for seed in range(40):
        cubes = placements(100 + seed, camera_mm=0.05, probe_mm=0.015, touched=5)
        found, other = calibrate(*cubes), averaged(*cubes)
        e = error(found.machine_from_camera, found.center)
        chi.append(e @ np.linalg.solve(found.covariance / max(1, found.misfit**2), e))
        joint.append(e)
        mean.append(error(other.machine_from_camera, other.center))
        spread.append(np.diag(other.covariance))
        assert 0.6 < found.misfit < 1.6  # 66 freedoms: 1 +- 0.09
    # chi square of 6 freedoms, 40 times: 6 +- 0.55
    assert 4.3 < np.mean(chi) < 7.7
    rms = [np.sqrt(np.mean(np.square(errors), axis=0)) for errors in (joint, mean)]
    assert np.linalg.norm(rms[0][:3]) < 0.95 * np.linalg.norm(rms[1][:3])
    assert np.linalg.norm(rms[0][3:]) < 0.95 * np.linalg.norm(rms[1][3:])
    assert 0.6 < np.mean(np.square(rms[1]) / np.mean(spread, axis=0)) < 1.6


def test_a_cube_that_is_not_square_does_not_matter():
    """Both instruments see the same planes, leaning by 0.1 deg."""
    lean = np.eye(3)
    lean[0, 1], lean[2, 0] = np.radians([0.1, -0.1])
    found = calibrate(*placements(6, 4, shape=lean))
    e = error(found.machine_from_camera, found.center)
    assert np.degrees(np.linalg.norm(e[:3])) < 1e-5
    assert np.linalg.norm(e[3:]) < 1e-5


def test_cubes_that_do_not_match_are_refused():
    camera, machine = placements(7, 3)
    for cubes, words in (
        ((camera, machine[:2]), "3 cubes of the camera and 2"),
        (([], []), "at least one"),
        ((camera, [machine[1], machine[0], machine[2]]), "do not match"),
    ):
        with pytest.raises(InputError, match=words):
            calibrate(*cubes)


def test_faces_cannot_be_told_where_the_cube_stays():
    camera, machine = placements(8, 1)
    assert matched(camera, machine)[0] is not None  # as it is given
    with pytest.raises(InputError, match="which face of the cube is which cannot be told"):
        calibrate(camera * 2, machine * 2)
