"""Where the camera stands in the frame of a measuring machine, from a cube that both measured.

Section IV.B.2 of the paper: three faces of a cube, square to each other, are scanned by the camera
and touched by the machine's probe, at several placements. The paper registers the three faces of
each placement and puts the eight matrices together: `averaged`. `calibrate` asks for the one
motion that brings all planes of all placements onto each other, each weighted by how well it is
known. It does not need the cube to be square, since both see the same three planes.

Frames: ``camera`` and ``machine``; a face's plane holds the points x with ``n . (x - center) = 0``.
Host code, float64, mm.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.rigid_transform import RigidTransform

SIDE_MM = 60.0  # the paper's cube
FORM_MM = 0.02 / np.sqrt(12)  # deviation of a face that is anywhere within its flatness of 0.02 mm
FORM_PATCHES = 9  # of a face, over which errors of form are alike
MOST_ASKEW_DEG = 1.0  # of square; the paper's cube is square to 0.02 deg
REACH_MM = 0.4  # of a plane, while faces are sought; afterwards three of the noise's deviations
EDGE_MM = 1.5  # nearer to another face a pixel may have mixed both
TRIPLETS, TRIPLET_POINTS = 400, 3_000
LEAST_SHARE = 0.02  # of the scan, the smallest face
MOST_MISMATCH_MM = 2.0  # of corresponding cubes: more is another cube, or labels mixed up
CLEARER = 3.0  # how much better the right labels must fit than others
_LINE = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Face:
    """A plane that was fitted to points.

    Attributes:
      normal: [3] unit.
      center: [3] mm, mean of the points.
      normal_covariance: [3, 3] rad^2, rank 2: the normal's error is square to it.
      offset_variance: mm^2, of the plane along its normal at the centre; not correlated with the
        normal's error there.
      rms_mm: of the points from the plane.
      count: of the points.
    """

    normal: np.ndarray
    center: np.ndarray
    normal_covariance: np.ndarray
    offset_variance: float
    rms_mm: float
    count: int

    def height_mm(self, points: np.ndarray) -> np.ndarray:
        """[N] of points [N, 3] above the plane."""
        return (points - self.center) @ self.normal


@dataclasses.dataclass(frozen=True, eq=False)
class Cube:
    """Three faces of a cube, outward and right-handed: ``n0 x n1`` is along n2.

    Attributes:
      faces: the three.
    """

    faces: tuple[Face, Face, Face]

    @property
    def corner(self) -> np.ndarray:
        """[3] mm: where the three planes meet."""
        normals = np.stack([face.normal for face in self.faces])
        return np.linalg.solve(normals, [face.normal @ face.center for face in self.faces])

    @property
    def world_from_cube(self) -> RigidTransform:
        """The cube's frame: origin at the corner, axes nearest to the three normals.

        Nearest in the sum of squares, all three alike: no face is the first.
        """
        normals = np.stack([face.normal for face in self.faces])
        axes = Rotation.align_vectors(normals, np.eye(3))[0].as_matrix()
        return RigidTransform(axes, self.corner)

    def relabelled(self, shift: int) -> Cube:
        """The same cube, its faces named in turn: 0, 1 and 2 of the three ways to do so."""
        return Cube(tuple(self.faces[(k + shift) % 3] for k in range(3)))

    def moved(self, target_from_this: RigidTransform) -> Cube:
        """The same in another frame."""
        turn = target_from_this.rotation
        return Cube(
            tuple(
                dataclasses.replace(
                    face,
                    normal=turn @ face.normal,
                    center=turn @ face.center + target_from_this.translation,
                    normal_covariance=turn @ face.normal_covariance @ turn.T,
                )
                for face in self.faces
            )
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Calibration:
    """Where the camera is, and how well that is known.

    Attributes:
      machine_from_camera: T_b of eq. 13.
      covariance: [6, 6] of its error, a small motion in the machine's frame about ``center``
        applied after it, see `vanejax.positioning`; (rad, mm).
      center: [3] mm, machine frame: the middle of the cubes' corners.
      rotation_deg: [P], of each placement's cube frame, left over.
      corner_mm: [P], of its corner.
      misfit: root of chi square per degree of freedom: 1 where the cubes fit as well as their
        noise lets them. Above it the covariance has been enlarged by its square. NaN from
        `averaged`, which knows no noise.
    """

    machine_from_camera: RigidTransform
    covariance: np.ndarray
    center: np.ndarray
    rotation_deg: np.ndarray
    corner_mm: np.ndarray
    misfit: float

    @property
    def rotation_sigma_deg(self) -> float:
        """Root of the sum over three axes."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[:3, :3]))))

    @property
    def translation_sigma_mm(self) -> float:
        """The same, at ``center``."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))


def fit_face(points: np.ndarray, *, noise_mm: float = 0.0, form_mm: float = 0.0) -> Face:
    """The plane of least squared distances to points [N, 3]; outliers of many are left out.

    Args:
      points: at least 3, not on one line.
      noise_mm: of each point, along the normal, at least; three points show none of their own.
      form_mm: deviation of the surface from a plane. It does not average out over the points: it
        counts as the same over a ninth of the face.

    Raises:
      InputError: points that fix no plane.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 3:
        raise InputError(f"a plane needs at least 3 points [N, 3] in mm, got {list(points.shape)}")
    if not np.isfinite(points).all():
        raise InputError("a plane needs finite points, in mm")
    weight = np.ones(len(points))
    for _ in range(10 if len(points) >= 20 else 1):
        center = weight @ points / weight.sum()
        around = points - center
        values, axes = np.linalg.eigh(around.T @ (around * weight[:, None]))
        height = around @ axes[:, 0]
        before, sigma = weight, max(1.4826 * float(np.median(np.abs(height))), 1e-9)
        # Tukey's biweight: strays of a scan lie 20 mm off
        weight = np.maximum(1 - (height / (4.685 * sigma)) ** 2, 0) ** 2
        if len(points) < 20 or np.abs(weight - before).max() < 1e-3:
            weight = before
            break
    if values[1] < _LINE**2 * values[2] or values[2] <= 0:
        raise InputError(f"{len(points)} points on one line fix no plane; touch the face at others")
    count = float(weight.sum())
    rms = float(np.sqrt(max(weight @ height**2, 0.0) / count))
    # three of the points' freedoms are the plane's
    own = rms * np.sqrt(count / (count - 3)) if count > 3.5 else 0.0
    each = max(own, noise_mm) ** 2 / count + form_mm**2 / min(count, FORM_PATCHES)
    tilts = axes[:, 1:] * np.sqrt(each * count / values[1:])
    return Face(axes[:, 0], center, tilts @ tilts.T, each, rms, len(points))


def cube_of(
    points: Sequence[np.ndarray],
    *,
    noise_mm: float = 0.0,
    form_mm: float = FORM_MM,
    most_askew_deg: float = MOST_ASKEW_DEG,
) -> Cube:
    """A cube from points [N, 3] on each of three faces that meet, in any order.

    Args:
      points: three arrays, at least 3 points in each.
      noise_mm, form_mm: see `fit_face`.
      most_askew_deg: how far from square the faces may be.

    Raises:
      InputError: not three planes, or not square to each other.
    """
    if len(points) != 3:
        raise InputError(f"a cube's frame needs three of its faces, got {len(points)}")
    faces = [fit_face(some, noise_mm=noise_mm, form_mm=form_mm) for some in points]
    for (i, one), (j, other) in itertools.combinations(enumerate(faces), 2):
        askew = abs(float(np.degrees(np.arcsin(np.clip(one.normal @ other.normal, -1, 1)))))
        if askew > most_askew_deg:
            raise InputError(
                f"faces {i} and {j} are {askew:.2f} deg from square, more than "
                f"{most_askew_deg:g}: are their points on one face each, and is it a cube?"
            )
    outward = []
    for k, face in enumerate(faces):
        # the other faces lie below it: a cube is convex
        below = sum(face.height_mm(other.center[None])[0] for other in faces)
        normal = face.normal if below < 0 else -face.normal
        outward.append(dataclasses.replace(faces[k], normal=normal))
    if np.linalg.det(np.stack([face.normal for face in outward])) < 0:
        outward[1], outward[2] = outward[2], outward[1]
    return Cube(tuple(outward))


def find_cube(
    points: np.ndarray,
    *,
    side_mm: float = SIDE_MM,
    noise_mm: float = 0.0,
    form_mm: float = FORM_MM,
    most_askew_deg: float = MOST_ASKEW_DEG,
    seed: int = 0,
) -> Cube:
    """The cube in a scan of it alone that shows three of its faces.

    See `cube_faces` for how the points are told apart, `cube_of` for the rest.

    Raises:
      InputError: no three faces, or not square.
    """
    labels = cube_faces(points, side_mm=side_mm, seed=seed)
    return cube_of(
        [np.asarray(points, np.float64)[labels == k] for k in range(3)],
        noise_mm=noise_mm,
        form_mm=form_mm,
        most_askew_deg=most_askew_deg,
    )


def cube_faces(points: np.ndarray, *, side_mm: float = SIDE_MM, seed: int = 0) -> np.ndarray:
    """[N] i8: which of three faces a point of a cube's scan is on, largest first; -1 for none.

    Planes through three random points that most others lie on, the later ones square to the
    earlier to 5 deg. Points within 1.5 mm of a second plane are on none: they may be mixed.

    Args:
      points: [N, 3] mm, of a scan of the cube and little else.
      side_mm: of the cube; points farther from the corner than its faces reach are on none.
      seed: of the triplets: same seed, same result.

    Raises:
      InputError: fewer than three such planes.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 9:
        raise InputError(f"a cube needs a scan [N, 3] in mm, got {list(points.shape)}")
    rng = np.random.default_rng(seed)
    some = points[rng.permutation(len(points))[:TRIPLET_POINTS]]
    normals, anchors = np.zeros((0, 3)), np.zeros((0, 3))
    left = np.ones(len(some), bool)
    for number in range(3):
        plane = _likely_plane(some[left], normals, rng)
        if plane is None or np.mean(plane[2]) * np.mean(left) < LEAST_SHARE:
            raise InputError(
                f"the scan shows {number} of the cube's faces, three are needed: tilt the cube so "
                "that its corner points to the camera"
            )
        normals = np.concatenate([normals, plane[0][None]])
        anchors = np.concatenate([anchors, plane[1][None]])
        left &= np.abs((some - plane[1]) @ plane[0]) > 2 * REACH_MM
    height = np.abs(points @ normals.T - np.einsum("ki,ki->k", anchors, normals))
    order = np.sort(height, axis=1)
    corner = np.linalg.solve(normals, np.einsum("ki,ki->k", anchors, normals))
    near = np.linalg.norm(points - corner, axis=1) < side_mm * np.sqrt(2) + EDGE_MM
    on = (order[:, 0] < REACH_MM) & (order[:, 1] > EDGE_MM) & near
    return np.where(on, np.argmin(height, axis=1), -1).astype(np.int8)


def _likely_plane(
    points: np.ndarray, square_to: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Normal [3] and a point [3] of the plane most of the points lie on, and which those are."""
    if len(points) < 9:
        return None
    a, b, c = points[rng.integers(len(points), size=(3, TRIPLETS))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    fit = length > 0
    normal, a = normal[fit] / length[fit, None], a[fit]
    fit = (np.abs(normal @ square_to.T) < np.sin(np.radians(5))).all(axis=1)
    normal, a = normal[fit], a[fit]
    if not len(normal):
        return None
    on = np.abs(points @ normal.T - np.einsum("ti,ti->t", normal, a)) < REACH_MM
    mine = on[:, np.argmax(np.count_nonzero(on, axis=0))]
    if np.count_nonzero(mine) < 3:
        return None
    face = fit_face(points[mine])
    return face.normal, face.center, np.abs(face.height_mm(points)) < REACH_MM


def calibrate(camera_cubes: Sequence[Cube], machine_cubes: Sequence[Cube]) -> Calibration:
    """machine_from_camera from P placements of a cube: one least squares over all their planes.

    Each face gives three residuals: two tilts of its normal, and the distance of the machine's
    plane from the camera's where the probe touched it. They are weighted by the inverse of their
    covariance, both sides' together. Which face is which need not be said where there are two
    placements or more, see `matched`.

    Raises:
      InputError: no cubes, or cubes that do not match.
    """
    camera_cubes = matched(camera_cubes, machine_cubes)
    machine_from_camera, center = _aligned(camera_cubes, machine_cubes)
    for _ in range(20):
        information, gradient, chi = np.zeros((6, 6)), np.zeros(6), 0.0
        for seen, touched in zip(camera_cubes, machine_cubes, strict=True):
            for one, other in zip(
                seen.moved(machine_from_camera).faces, touched.faces, strict=True
            ):
                residual, jacobian, covariance = _disagreement(one, other, center)
                weighted = np.linalg.solve(covariance, np.column_stack([jacobian, residual]))
                information += jacobian.T @ weighted[:, :6]
                gradient += jacobian.T @ weighted[:, 6]
                chi += float(residual @ weighted[:, 6])
        step = -np.linalg.solve(information, gradient)
        machine_from_camera = _nudged(machine_from_camera, step, center)
        if step @ information @ step < 1e-12:
            break
    free = 9 * len(camera_cubes) - 6
    misfit = float(np.sqrt(chi / free))
    return _judged(
        machine_from_camera,
        np.linalg.inv(information) * max(1.0, misfit**2),
        center,
        camera_cubes,
        machine_cubes,
        misfit,
    )


def averaged(camera_cubes: Sequence[Cube], machine_cubes: Sequence[Cube]) -> Calibration:
    """machine_from_camera as the paper has it: the mean of one matrix for each placement.

    The rotation is the chordal mean (Hartley et al. 2013); Euler angles, which the paper averages,
    have no mean near their poles. The translation then brings the corners onto each other, rather
    than being the mean of eight, each of which carries its own rotation's error over 400 mm. The
    covariance is that of a mean of P alike: it is NaN for one placement.

    Raises:
      InputError: no cubes, or cubes that do not match.
    """
    camera_cubes = matched(camera_cubes, machine_cubes)
    frames = [
        (touched.world_from_cube, seen.world_from_cube)
        for seen, touched in zip(camera_cubes, machine_cubes, strict=True)
    ]
    turns = Rotation.from_matrix([b.rotation @ a.rotation.T for b, a in frames])
    rotation = turns.mean().as_matrix()
    shifts = np.stack([b.translation - rotation @ a.translation for b, a in frames])
    center = np.mean([b.translation for b, _ in frames], axis=0)
    errors = np.concatenate(
        [
            (turns * Rotation.from_matrix(rotation).inv()).as_rotvec(),
            shifts - shifts.mean(axis=0),
        ],
        axis=1,
    )
    count = len(frames)
    spread = errors.T @ errors / (count * (count - 1)) if count > 1 else np.full((6, 6), np.nan)
    return _judged(
        RigidTransform(rotation, shifts.mean(axis=0)),
        spread,
        center,
        camera_cubes,
        machine_cubes,
        float("nan"),
    )


def matched(camera_cubes: Sequence[Cube], machine_cubes: Sequence[Cube]) -> list[Cube]:
    """The camera's cubes with their faces named as the machine's.

    A cube looks the same in three attitudes. Placed twice at different tilts, or at different
    places, only one way of naming its faces lets one motion fit all. A single placement is taken as
    it is given.

    Raises:
      InputError: no cubes, not as many of each, or no way to name the faces that fits better than
        all others and to 2 mm.
    """
    if not camera_cubes or len(camera_cubes) != len(machine_cubes):
        raise InputError(
            f"a calibration needs the same placements from both, at least one; got "
            f"{len(camera_cubes)} cubes of the camera and {len(machine_cubes)} of the machine"
        )
    tried = []
    for first in range(3 if len(camera_cubes) > 1 else 1):
        rough = _aligned([camera_cubes[0].relabelled(first)], machine_cubes[:1])[0]
        named = [camera_cubes[0].relabelled(first)]
        for seen, touched in zip(camera_cubes[1:], machine_cubes[1:], strict=True):
            ways = [seen.relabelled(shift) for shift in range(3)]
            turns = [rough.rotation @ way.world_from_cube.rotation for way in ways]
            like = [np.trace(touched.world_from_cube.rotation.T @ turn) for turn in turns]
            named.append(ways[int(np.argmax(like))])
        both = _aligned(named, machine_cubes)[0]
        off = [
            both.apply(_corners(seen)) - _corners(touched)
            for seen, touched in zip(named, machine_cubes, strict=True)
        ]
        tried.append((float(np.sqrt(3 * np.mean(np.square(off)))), first, named))
    tried.sort(key=lambda found: found[:2])
    best = tried[0]
    if best[0] > MOST_MISMATCH_MM:
        raise InputError(
            f"the camera's cubes and the machine's do not match: their corners stay {best[0]:.2g} "
            "mm apart; is the order of the placements the same, and are the points of each face "
            "on that face?"
        )
    if len(tried) > 1 and tried[1][0] < CLEARER * max(best[0], 0.05):
        raise InputError(
            f"which face of the cube is which cannot be told: two ways fit to {best[0]:.2g} and "
            f"{tried[1][0]:.2g} mm; turn the cube between the placements"
        )
    return best[2]


def _corners(cube: Cube) -> np.ndarray:
    """[4, 3] mm: the corner and the next three of the cube's ideal shape."""
    offsets = -SIDE_MM * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    return cube.world_from_cube.apply(offsets)


def _aligned(
    camera_cubes: Sequence[Cube], machine_cubes: Sequence[Cube]
) -> tuple[RigidTransform, np.ndarray]:
    """The motion that brings the cubes' corners together, and the middle [3] of the machine's."""
    seen = np.concatenate([_corners(cube) for cube in camera_cubes])
    touched = np.concatenate([_corners(cube) for cube in machine_cubes])
    start, end = seen.mean(axis=0), touched.mean(axis=0)
    rotation = Rotation.align_vectors(touched - end, seen - start)[0].as_matrix()
    center = np.mean([cube.corner for cube in machine_cubes], axis=0)
    return RigidTransform(rotation, end - rotation @ start), center


def _disagreement(
    seen: Face, touched: Face, center: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residual [3], its derivative [3, 6] by a small motion of ``seen`` about ``center``, and its
    covariance [3, 3]; both faces in the machine's frame.

    Tilts ``U^T (n_b - n)`` in the touched plane's own axes U, then ``n . (x_b - x)`` at the middle
    x_b of the touched points.
    """
    normal, away = seen.normal, touched.center - seen.center
    axes = np.linalg.svd(touched.normal[None])[2][1:]  # [2, 3], U^T
    residual = np.append(axes @ (touched.normal - normal), normal @ away)
    jacobian = np.zeros((3, 6))
    # the normal turns by w x n: a row u of U^T sees -u . (w x n) = -(n x u) . w
    jacobian[:2, :3] = -np.cross(normal, axes)
    jacobian[2, :3] = np.cross(normal, touched.center - center)
    jacobian[2, 3:] = -normal
    tilt = seen.normal_covariance
    covariance = np.empty((3, 3))
    covariance[:2, :2] = axes @ (tilt + touched.normal_covariance) @ axes.T
    covariance[:2, 2] = covariance[2, :2] = -axes @ tilt @ away
    covariance[2, 2] = seen.offset_variance + touched.offset_variance + away @ tilt @ away
    # planes without noise would weigh without bounds
    return residual, jacobian, covariance + np.diag([1e-14, 1e-14, 1e-10])


def _nudged(pose: RigidTransform, step: np.ndarray, center: np.ndarray) -> RigidTransform:
    """The pose with a small motion [6] about ``center`` after it."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    return RigidTransform(
        turn @ pose.rotation, turn @ (pose.translation - center) + center + step[3:]
    )


def _judged(
    machine_from_camera: RigidTransform,
    covariance: np.ndarray,
    center: np.ndarray,
    camera_cubes: Sequence[Cube],
    machine_cubes: Sequence[Cube],
    misfit: float,
) -> Calibration:
    """With what is left over at each placement."""
    turn_deg, corner_mm = [], []
    for seen, touched in zip(camera_cubes, machine_cubes, strict=True):
        one, other = machine_from_camera @ seen.world_from_cube, touched.world_from_cube
        left = Rotation.from_matrix(other.rotation @ one.rotation.T)
        turn_deg.append(float(np.degrees(left.magnitude())))
        corner_mm.append(float(np.linalg.norm(other.translation - one.translation)))
    return Calibration(
        machine_from_camera, covariance, center, np.array(turn_deg), np.array(corner_mm), misfit
    )
