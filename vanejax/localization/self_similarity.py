"""Motions of a part after which much of it lies on itself: where a wrong pose looks right.

Half turns and flips are sought by turning the part about the principal axes of its surface. A pitch
along a ring or a row is sought along the part's slippable motions (Gelfand and Guibas, Shape
Segmentation Using Local Slippage Analysis, SGP 2004): the screws that leave most of the surface in
itself, as a turn about the engine's axis does with the platforms of a vane segment.
"""

from __future__ import annotations

import functools

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from vanejax.cad.part import Part
from vanejax.cad.surface import Surface
from vanejax.localization.fine_registration import robust_gauss_newton
from vanejax.localization.pose_batch import concatenate, distances, distinct, select
from vanejax.localization.random_fields import ways_of_motion
from vanejax.localization.residuals import SurfaceMatching
from vanejax.rigid import RigidTransform

# symmetries of order 2 to 12, and of gears
TURNS_DEG = (
    180,
    *(sign * turn for turn in (120, 90, 72, 60, 45, 36, 30, 20, 15) for sign in (1, -1)),
)
SHIFTS = (-0.25, -0.125, 0.125, 0.25)  # of the length along each principal axis
POINTS, SCREENED = 500, 200
ITERATIONS = (5, 8)
MOST = 32
TOLERANCE = 0.02  # of the radius
LEAST_TURN_DEG, LEAST_SHIFT = 15.0, 0.15  # of the radius: what is nearer is no motion
# slippable motions
SLIDES, LEAST_SLIPPING = 3, 0.3  # how many; share of the surface that stays in itself
SLIP = 0.05  # of a point's way: what goes along the normal, where it counts as slipping
STEPS, PEAKS = 121, 6
STILL = RigidTransform(np.eye(3), np.zeros(3))


@functools.lru_cache(maxsize=16)
def self_similar_motions(part: Part) -> RigidTransform:
    """Motions of the part's frame, [K, 3, 3] and [K, 3] mm, that put much of it onto itself.

    At most `MOST`: slides first, then turns, by overlap; none that leaves the part nearly still.
    """
    surface = Surface(part)
    model = SurfaceMatching(surface, reach_mm=0.3 * part.radius)
    sample = surface.points[:POINTS]
    motions, _ = robust_gauss_newton(
        model, _turns_and_shifts(surface), sample[:SCREENED], iterations=ITERATIONS[0]
    )
    motions = _best(model, motions, sample[:SCREENED], MOST)
    motions, _ = robust_gauss_newton(
        model,
        motions,
        sample,
        iterations=ITERATIONS[1],
        # half of the part may be off itself: no kernel as wide as the residuals
        ceiling_mm=0.01 * part.radius,
        min_step_deg=0.1,
    )
    motions = concatenate(_slides(surface, model), _best(model, motions, sample, MOST))
    return select(motions, distinct(motions, part, MOST))


def moved_by(motions: RigidTransform, part_from_camera: RigidTransform) -> RigidTransform:
    """Poses [K]: one pose, then each of the motions [K] of the part's frame."""
    return RigidTransform(
        motions.rotation @ part_from_camera.rotation,
        motions.rotation @ part_from_camera.translation + motions.translation,
    )


def _best(
    model: SurfaceMatching, motions: RigidTransform, points: np.ndarray, most: int
) -> RigidTransform:
    """Distinct motions by falling overlap, without those that hardly move the part."""
    part = model.part
    angle_deg, shift_mm = distances(motions, STILL, part)
    far = (angle_deg > LEAST_TURN_DEG) | (shift_mm > LEAST_SHIFT * part.radius)
    motions = select(motions, far)
    motions = select(motions, np.argsort(-_overlap(model, motions, points), kind="stable"))
    return select(motions, distinct(motions, part, most))


def _overlap(model: SurfaceMatching, motions: RigidTransform, points: np.ndarray) -> np.ndarray:
    """[K] share of the points that a motion puts onto the surface."""
    deviation = model.residuals(motions, points, precision="samples").deviation_mm
    return np.mean(np.abs(deviation) < TOLERANCE * model.part.radius, axis=1)


def _turns_and_shifts(surface: Surface) -> RigidTransform:
    """Turns by `TURNS_DEG` about the principal axes, by 180 deg between them, and shifts along."""
    middle, axes = surface.moments
    turns = [axis * np.radians(angle) for axis in axes for angle in TURNS_DEG]
    for i, j in ((0, 1), (1, 2), (0, 2)):
        turns += [np.pi * ((axes[i] + sign * axes[j]) / np.sqrt(2)) for sign in (1, -1)]
    turn = Rotation.from_rotvec(np.stack(turns)).as_matrix()
    length = np.ptp(surface.points @ axes.T, axis=0)
    shifts = np.stack([s * length[k] * axes[k] for k in range(3) for s in SHIFTS])
    still = np.tile(np.eye(3), (len(shifts), 1, 1))
    return concatenate(RigidTransform(turn, middle - turn @ middle), RigidTransform(still, shifts))


def _slides(surface: Surface, model: SurfaceMatching) -> RigidTransform:
    """Motions [K] along the slippable screws that put what does not slip onto itself best."""
    part = surface.part
    points, normals = surface.points[:POINTS] - part.center, surface.normals[:POINTS]
    found = []
    for screw in _slippable_screws(points / part.radius, normals):
        free = points[_slip(points / part.radius, normals, screw) > 4 * SLIP][:SCREENED]
        if len(free) < SCREENED // 8:
            continue  # all of it slips, as a cylinder: any motion along is as good
        screw = screw * np.repeat([1 / part.radius, 1.0], 3)
        way_mm = np.linspace(-1, 1, STEPS) * 0.8 * np.linalg.norm(part.extent_mm)
        motions = _along(part, screw, way_mm)
        overlap = _overlap(model, motions, free + part.center)
        inner = overlap[1:-1]
        peaks = 1 + np.flatnonzero((inner >= overlap[:-2]) & (inner >= overlap[2:]))
        peaks = peaks[np.abs(way_mm[peaks]) > LEAST_SHIFT * part.radius]
        found.append(select(motions, peaks[np.argsort(-overlap[peaks], kind="stable")[:PEAKS]]))
    return concatenate(_still(0), *found)


def _still(count: int) -> RigidTransform:
    return RigidTransform(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))


def _along(part: Part, screw: np.ndarray, way_mm: np.ndarray) -> RigidTransform:
    """Motions [K] along a screw (rad and mm about the part's centre for each mm of way)."""
    turn, shift = screw[:3], screw[3:]
    angle = np.linalg.norm(turn)
    if angle * np.abs(way_mm).max() < 1e-3:
        return RigidTransform(_still(len(way_mm)).rotation, way_mm[:, None] * shift)
    axis = turn / angle
    point = np.cross(axis, shift) / angle + part.center
    rotation = Rotation.from_rotvec(way_mm[:, None] * turn).as_matrix()
    rise = (axis @ shift) * way_mm[:, None] * axis
    return RigidTransform(rotation, point - rotation @ point + rise)


def _slippable_screws(points: np.ndarray, normals: np.ndarray) -> list[np.ndarray]:
    """Screws [6] that move points [n, 3] by one on average and most of them within the surface.

    Reweighted least squares: the smallest generalised eigenvector of the squared way along the
    normals against the squared way, from each of the six of all points.
    """
    columns = np.concatenate([np.cross(points, normals), normals], axis=1)
    ways = ways_of_motion(points)
    way = np.einsum("nij,nik->jk", ways, ways) / len(points)
    screws = []
    for start in eigh(columns.T @ columns, way)[1].T:
        screw = start
        for width in np.geomspace(0.2, SLIP / 2, 24):  # narrower and narrower, to one set of faces
            weight = 1 / (1 + (_slip(points, normals, screw) / width) ** 2) ** 2
            screw = eigh((columns * weight[:, None]).T @ columns, way)[1][:, 0]
        share = np.mean(_slip(points, normals, screw) < SLIP)
        alike = [min(np.linalg.norm(screw - s), np.linalg.norm(screw + s)) for _, s in screws]
        if share > LEAST_SLIPPING and min(alike, default=1.0) > 0.1:
            screws.append((share, screw))
    screws.sort(key=lambda pair: -pair[0])
    return [screw for _, screw in screws[:SLIDES]]


def _slip(points: np.ndarray, normals: np.ndarray, screw: np.ndarray) -> np.ndarray:
    """[n] share of a point's way that goes along the normal; of a short way, in tenths of one."""
    way = np.cross(screw[:3], points) + screw[3:]
    along = np.abs(np.sum(way * normals, axis=1))
    return along / np.maximum(np.linalg.norm(way, axis=1), 0.1)
