"""A calibration cube: planes through the points of its faces, and the frame that three of them fix.

All is in the frame of the points. Host code, float64, mm.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.rigid import RigidTransform
from vanejax.scans.robust_statistics import robust_sigma

SIDE_MM = 60.0  # the paper's cube
FORM_MM = 0.02 / np.sqrt(12)  # deviation of a face that is anywhere within its flatness of 0.02 mm
FORM_PATCHES = 9  # of a face, over which errors of form are alike
MOST_ASKEW_DEG = 1.0  # of square; the paper's cube is square to 0.02 deg
REACH_MM = 0.4  # of a plane: what points on it may deviate, noise of a good camera and all
EDGE_MM = 1.5  # nearer to another face a pixel may have mixed both
TRIPLETS, TRIPLET_POINTS = 400, 3_000
LEAST_SHARE = 0.02  # of the scan, the smallest face
_LINE = 1e-3


class Face(NamedTuple):
    """A plane that was fitted to points.

    Attributes:
      normal: [3] unit.
      center: [3] mm, mean of the points.
      normal_covariance: [3, 3] rad^2, rank 2: the normal's error is square to it.
      offset_variance: mm^2, of the plane along its normal at the centre; not correlated with the
        normal's error there.
    """

    normal: np.ndarray
    center: np.ndarray
    normal_covariance: np.ndarray
    offset_variance: float

    def height_mm(self, points: np.ndarray) -> np.ndarray:
        """[N] of points [N, 3] above the plane."""
        return (points - self.center) @ self.normal


class Cube(NamedTuple):
    """Three faces of a cube, outward and right-handed: ``n0 x n1`` is along n2."""

    faces: tuple[Face, Face, Face]

    @property
    def corner(self) -> np.ndarray:
        """[3] mm: where the three planes meet."""
        normals = [face.normal for face in self.faces]
        return np.linalg.solve(normals, [face.normal @ face.center for face in self.faces])

    @property
    def world_from_cube(self) -> RigidTransform:
        """The cube's frame: origin at the corner, axes nearest (least squares) to the normals."""
        normals = [face.normal for face in self.faces]
        axes = Rotation.align_vectors(normals, np.eye(3))[0].as_matrix()
        return RigidTransform(axes, self.corner)

    def relabelled(self, shift: int) -> Cube:
        """The same cube, its faces named in turn: 0, 1 and 2 of the three ways to do so."""
        return Cube(tuple(self.faces[(k + shift) % 3] for k in range(3)))

    def moved(self, target_from_this: RigidTransform) -> Cube:
        """The same in another frame."""
        turn, shift = target_from_this
        faces = []
        for face in self.faces:
            tilt = turn @ face.normal_covariance @ turn.T
            center = turn @ face.center + shift
            faces.append(Face(turn @ face.normal, center, tilt, face.offset_variance))
        return Cube(tuple(faces))


def fit_face(points: np.ndarray, *, noise_mm: float = 0.0, form_mm: float = 0.0) -> Face:
    """The plane of least squared distances to points [N, 3]; outliers of many are left out.

    Args:
      points: at least 3, not on one line.
      noise_mm: of each point along the normal, at least; three points show none of their own.
      form_mm: deviation of the surface from a plane, the same over a ninth of the face.

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
        before, sigma = weight, max(float(robust_sigma(height)), 1e-9)
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
    return Face(axes[:, 0], center, tilts @ tilts.T, each)


def cube_of(
    points: Sequence[np.ndarray], *, noise_mm: float = 0.0, form_mm: float = FORM_MM
) -> Cube:
    """A cube from points [N, 3] on each of three faces that meet, in any order; see `fit_face`.

    Raises:
      InputError: not three planes, or not square to each other.
    """
    if len(points) != 3:
        raise InputError(f"a cube's frame needs three of its faces, got {len(points)}")
    faces = [fit_face(face, noise_mm=noise_mm, form_mm=form_mm) for face in points]
    for i, j in itertools.combinations(range(3), 2):
        cosine = np.clip(faces[i].normal @ faces[j].normal, -1, 1)
        askew = abs(float(np.degrees(np.arcsin(cosine))))
        if askew > MOST_ASKEW_DEG:
            raise InputError(
                f"faces {i} and {j} are {askew:.2f} deg from square, more than "
                f"{MOST_ASKEW_DEG:g}: are their points on one face each, and is it a cube?"
            )
    centers = np.stack([face.center for face in faces])
    # the other faces lie below each: a cube is convex
    outward = [
        face if face.height_mm(centers).sum() < 0 else face._replace(normal=-face.normal)
        for face in faces
    ]
    if np.linalg.det([face.normal for face in outward]) < 0:
        outward[1], outward[2] = outward[2], outward[1]
    return Cube(tuple(outward))


def cube_faces(points: np.ndarray, *, seed: int = 0) -> np.ndarray:
    """[N] i8: which of three faces a point of a cube's scan is on, largest first; -1 for none.

    Planes through three random points that most others lie on, the later ones square to the
    earlier to 5 deg. Points near a second plane are on none: they may be mixed. So are those
    farther from the corner than the cube's faces reach.

    Args:
      points: [N, 3] mm, of a scan of the cube and little else.
      seed: of the triplets: same seed, same result.

    Raises:
      InputError: fewer than three such planes.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 9:
        raise InputError(f"a cube needs a scan [N, 3] in mm, got {list(points.shape)}")
    rng = np.random.default_rng(seed)
    some = points[rng.permutation(len(points))[:TRIPLET_POINTS]]
    left = np.ones(len(some), bool)
    faces: list[Face] = []
    while len(faces) < 3:
        face = _likely_face(some[left], faces, rng)
        off = np.full(len(some), np.inf) if face is None else np.abs(face.height_mm(some))
        if np.mean((off < REACH_MM) & left) < LEAST_SHARE:
            raise InputError(
                f"the scan shows {len(faces)} of the cube's faces, three are needed: tilt the cube "
                "so that its corner points to the camera"
            )
        faces.append(face)
        left &= off > 2 * REACH_MM
    height = np.abs(np.stack([face.height_mm(points) for face in faces], axis=1))
    nearest, second, _ = np.sort(height, axis=1).T
    from_corner = np.linalg.norm(points - Cube(tuple(faces)).corner, axis=1)
    near = from_corner < SIDE_MM * np.sqrt(2) + EDGE_MM
    on = (nearest < REACH_MM) & (second > max(EDGE_MM, 2 * REACH_MM)) & near
    return np.where(on, np.argmin(height, axis=1), -1).astype(np.int8)


def _likely_face(
    points: np.ndarray, square_to: Sequence[Face], rng: np.random.Generator
) -> Face | None:
    """The plane that most of the points [N, 3] lie on, square to the faces known."""
    if len(points) < 9:
        return None
    a, b, c = points[rng.integers(len(points), size=(3, TRIPLETS))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal /= np.where(length > 0, length, 1.0)[:, None]
    cosine = np.abs(normal @ np.reshape([face.normal for face in square_to], (-1, 3)).T)
    fit = (length > 0) & (cosine < np.sin(np.radians(5))).all(axis=1)
    if not fit.any():
        return None
    normal, a = normal[fit], a[fit]
    on = np.abs(points @ normal.T - np.einsum("ti,ti->t", normal, a)) < REACH_MM
    mine = on[:, np.argmax(np.count_nonzero(on, axis=0))]
    return fit_face(points[mine]) if np.count_nonzero(mine) >= 3 else None
