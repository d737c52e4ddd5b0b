"""Symmetries of parts: exact groups, near ones by search, and pose errors modulo symmetry.

Every symmetry is a proper rigid motion of the part's own frame, [4, 4] f64 in mm, that maps the
surface to itself. A pose part_from_camera is then as right as ``symmetry @ part_from_camera``.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vanejax.cad.part import Part
from vanejax.rigid import RigidTransform

Axis = tuple[np.ndarray, np.ndarray]

ORIGIN = np.zeros(3)
SURFACE_SAMPLES, SAMPLES_PER_QUERY = 60_000, 3
SCREENED_POINTS, POLISHED_POINTS, SCORED_POINTS = 150, 400, 2000
POLISHING_STEPS = 6
SAME_TURN_DEG, SAME_SHIFT = 10.0, 0.1  # of the radius: what counts as one near symmetry
LARGEST_SHARE = 0.02  # of the radius, what the mean surface distance of a near one may reach


def rotation_about(axis: np.ndarray, angle_deg: float, point: np.ndarray) -> np.ndarray:
    """[4, 4]: right-handed turn about the line through ``point`` [3] along ``axis`` [3]."""
    axis = np.asarray(axis, np.float64)
    turn = Rotation.from_rotvec(math.radians(angle_deg) * axis / np.linalg.norm(axis)).as_matrix()
    return RigidTransform(turn, point - turn @ point).as_matrix()


def cyclic(order: int, axis: np.ndarray, point: np.ndarray = ORIGIN) -> np.ndarray:
    """The group C_n [n, 4, 4]: turns by 360/n deg about a line; the identity comes first."""
    return np.stack([rotation_about(axis, 360 * i / order, point) for i in range(order)])


def dihedral(order: int, axis: np.ndarray, flip: np.ndarray) -> np.ndarray:
    """The group D_n [2n, 4, 4] about the origin: C_n, and half turns like that about ``flip``."""
    turns = cyclic(order, axis)
    return np.concatenate([turns, turns @ rotation_about(flip, 180, ORIGIN)])


class DenseSurface:
    """Distances to a part's surface by dense samples that stand for small discs.

    With discs as large as samples are apart, a part's exact symmetries give no more than the sag of
    its facets; the price is that an edge seems to reach that much (0.3 to 0.6 mm) farther.
    """

    def __init__(self, part: Part) -> None:
        self.part = part
        self._points, self._normals, _ = part.sample(SURFACE_SAMPLES, seed=0)
        self._spacing_mm = math.sqrt(part.mesh.area / SURFACE_SAMPLES)
        self._tree = cKDTree(self._points)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nearest samples [N, 3] of points [N, 3] mm, distances to the discs [N], normals."""
        _, sample = self._tree.query(points, k=SAMPLES_PER_QUERY)
        offset = points[:, None] - self._points[sample]
        height = np.einsum("nki,nki->nk", offset, self._normals[sample])
        aside = np.sqrt(np.maximum(np.einsum("nki,nki->nk", offset, offset) - height**2, 0))
        distance = np.hypot(height, np.maximum(aside - 1.5 * self._spacing_mm, 0))
        best = sample[np.arange(len(points)), np.argmin(distance, axis=1)]
        return self._points[best], distance.min(axis=1), self._normals[best]

    def mismatch_mm(self, matrix: np.ndarray, count: int = SCORED_POINTS) -> float:
        """Symmetric mean distance of the surface and its image under ``matrix`` [4, 4]."""
        points, _, _ = self.part.sample(count, seed=1)
        transform = RigidTransform.from_matrix(matrix)
        there, back = transform.apply(points), transform.inverse().apply(points)
        return float(np.mean(self.nearest(np.concatenate([there, back]))[1]))

    def polish(self, matrix: np.ndarray) -> np.ndarray:
        """[4, 4]: point-to-plane ICP of the surface to itself, started at ``matrix``."""
        points, _, _ = self.part.sample(POLISHED_POINTS, seed=2)
        for _ in range(POLISHING_STEPS):
            moved = RigidTransform.from_matrix(matrix).apply(points)
            target, _, normals = self.nearest(moved)
            middle = moved.mean(axis=0)
            # rotations count as the distances they move, so that the six columns compare
            lever = np.cross((moved - middle) / self.part.radius, normals)
            jacobian = np.concatenate([lever, normals], axis=1)
            residual = np.sum(normals * (target - moved), axis=1)
            # the cut-off keeps still what the surface does not hold, as a turned part's angle
            step = np.linalg.lstsq(jacobian, residual, rcond=1e-2)[0]
            turn = Rotation.from_rotvec(step[:3] / self.part.radius).as_matrix()
            step = RigidTransform(turn, middle - turn @ middle + step[3:])
            matrix = step.as_matrix() @ matrix
        return matrix


def _candidates(part: Part) -> np.ndarray:
    """Rotations [K, 4, 4] about the surface's centroid among which near symmetries are sought.

    Multiples of 15 deg about the part's and the surface's principal axes, alone and after a half
    turn about another of these axes, and the 60 icosahedral rotations.
    """
    points, _, _ = part.sample(20_000, seed=0)
    center = points.mean(axis=0)
    _, principal = np.linalg.eigh(np.cov((points - center).T))
    principal[:, 0] *= np.linalg.det(principal)
    steps = np.arange(24) * (math.pi / 12)
    turns = []
    for frame in (np.eye(3), principal):
        for i in range(3):
            about = Rotation.from_rotvec(steps[:, None] * frame[:, i])
            flip = Rotation.from_rotvec(math.pi * frame[:, (i + 1) % 3])
            turns += [about.as_matrix(), (about * flip).as_matrix()]
        turns.append(frame @ Rotation.create_group("I").as_matrix() @ frame.T)
    rotations = np.concatenate(turns)
    cosine = 0.5 * (np.einsum("aij,bij->ab", rotations, rotations) - 1)
    # an earlier one within 1 deg is the same
    same = np.tril(cosine > math.cos(math.radians(1)), -1)
    rotations = rotations[~same.any(axis=1)]
    return RigidTransform(rotations, center - rotations @ center).as_matrix()


def near_symmetries(
    part: Part,
    symmetries: np.ndarray,
    *,
    continuous_axis: Axis | None = None,
    more: np.ndarray | None = None,
) -> np.ndarray:
    """Motions that nearly map the part to itself, found numerically.

    They are local minima of the mismatch. Of the motions that differ by an exact symmetry only
    (`pose_error` tells no difference) one is listed; where the part is nearly turned, one every
    15 deg or so.

    Args:
      symmetries, continuous_axis: the exact ones, as for `pose_error`.
      more: [K, 4, 4] further motions to try.

    Returns:
      Motions [M, 4, 4], by ascending symmetric mean surface distance.
    """
    surface, limit = DenseSurface(part), LARGEST_SHARE * part.radius
    near: list[tuple[float, np.ndarray]] = []
    tried: list[np.ndarray] = []

    def is_new(matrix: np.ndarray, known: list[np.ndarray], angle_deg: float) -> bool:
        frame = {"center": part.center, "radius_mm": part.radius}
        pose, *others = map(RigidTransform.from_matrix, [matrix, *known])
        errors = (
            pose_error(pose, other, symmetries, continuous_axis=continuous_axis, **frame)
            for other in others
        )
        return all(e[0] > angle_deg or e[1] > SAME_SHIFT * part.radius for e in errors)

    def coarse(matrix: np.ndarray) -> float:
        return surface.mismatch_mm(matrix, POLISHED_POINTS)

    every = _candidates(part) if more is None else np.concatenate([_candidates(part), more])
    for matrix in every:
        # what is far off before the polish will not come near enough by it
        far_off = surface.mismatch_mm(matrix, SCREENED_POINTS) > 3 * limit
        if far_off or not is_new(matrix, [np.eye(4), *tried], 1.0):
            continue
        tried.append(matrix)
        matrix = min(matrix, surface.polish(matrix), key=coarse)
        far_off = coarse(matrix) > 1.5 * limit
        if far_off or not is_new(matrix, [np.eye(4), *(m for _, m in near)], 1.0):
            continue
        # it may still be on its way to a better one
        matrix = min(matrix, surface.polish(matrix), key=coarse)
        distance = surface.mismatch_mm(matrix)
        if distance < limit:
            near.append((distance, matrix))
    kept: list[tuple[float, np.ndarray]] = []
    for distance, matrix in sorted(near, key=lambda pair: pair[0]):
        if is_new(matrix, [np.eye(4), *(m for _, m in kept)], SAME_TURN_DEG):
            kept.append((distance, matrix))
    return np.array([m for _, m in kept]).reshape(-1, 4, 4)


def nearest_equivalents(
    part_from_camera: RigidTransform,
    other: RigidTransform,
    symmetries: np.ndarray,
    *,
    center: np.ndarray,
    radius_mm: float,
    continuous_axis: Axis | None = None,
) -> RigidTransform:
    """Of all poses that are as right as each of a batch, the nearest to one other pose.

    With E = part_from_camera @ other^-1, a motion of the part's frame, and a symmetry S, what is
    left is S^-1 E: its angle, and by how much it moves the part's centre. That symmetry is taken
    for which angle in radians times radius plus that distance is smallest. About a continuous axis
    u the turn that leaves the smallest angle is taken out first: of the quaternion (w, v) the twist
    2 atan2(v.u, w).

    Args:
      part_from_camera: poses [H, 3, 3] and [H, 3], mm.
      other: one pose.
      symmetries: [S, 4, 4] in the part's frame, identity included.
      center, radius_mm: `Part.center` and `Part.radius`.
      continuous_axis: point [3] and unit direction [3] in the part's frame, or None.

    Returns:
      Poses [H, 3, 3] and [H, 3].
    """
    error = (part_from_camera @ other.inverse()).as_matrix()
    rest = np.linalg.inv(symmetries) @ error[:, None]
    if continuous_axis is not None:
        point, direction = continuous_axis
        quaternion = Rotation.from_matrix(rest[..., :3, :3].reshape(-1, 3, 3)).as_quat()
        twist = 2 * np.arctan2(quaternion[:, :3] @ direction, quaternion[:, 3])
        turn = Rotation.from_rotvec(-twist[:, None] * direction[None]).as_matrix()
        back = RigidTransform(turn, point - turn @ point).as_matrix()
        rest = back.reshape(rest.shape) @ rest
    angle = Rotation.from_matrix(rest[..., :3, :3].reshape(-1, 3, 3)).magnitude()
    shift = np.linalg.norm(rest[..., :3, :3] @ center + rest[..., :3, 3] - center, axis=-1)
    best = np.argmin(angle.reshape(shift.shape) * radius_mm + shift, axis=1)
    return RigidTransform.from_matrix(rest[np.arange(len(rest)), best]) @ other


def pose_error(
    part_from_camera: RigidTransform,
    truth: RigidTransform,
    symmetries: np.ndarray,
    *,
    center: np.ndarray,
    radius_mm: float,
    continuous_axis: Axis | None = None,
) -> tuple[float, float]:
    """How far a pose is from the nearest of all right ones.

    Args:
      part_from_camera, truth: the pose and a right one, mm.
      symmetries, center, radius_mm, continuous_axis: as for `nearest_equivalents`.

    Returns:
      rotation_deg in [0, 180], translation_mm at the centre.
    """
    batch = RigidTransform(part_from_camera.rotation[None], part_from_camera.translation[None])
    nearest = nearest_equivalents(
        batch,
        truth,
        symmetries,
        center=center,
        radius_mm=radius_mm,
        continuous_axis=continuous_axis,
    )
    rest = nearest @ truth.inverse()
    angle = Rotation.from_matrix(rest.rotation[0]).magnitude()
    shift = np.linalg.norm(rest.apply(center[None])[0, 0] - center)
    return math.degrees(angle), float(shift)
