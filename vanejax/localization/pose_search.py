"""Poses from nowhere: rotations that cover SO(3), each followed down by ray casting.

The basin of `refine.descend` is tens of degrees wide, so a few hundred rotations reach every pose;
points whose ray misses the part are pulled to its surface, which more than doubles the share of the
starts that arrive. What arrives is sorted by what the scan says for it (`verification.evidence`),
and the best is then challenged: turned about its own axes, and shifted along them, to the poses
at which a part of that shape may look alike.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.cad.part import Part
from vanejax.cad.surface import Surface
from vanejax.localization.fine_registration import descend, subset
from vanejax.localization.residuals import MeasurementModel, RayCasting
from vanejax.localization.verification import View, evidence
from vanejax.rigid import RigidTransform
from vanejax.scans.robust_statistics import robust_sigma

STARTS = 400
START_POINTS = 400
START_ITERATIONS = 12
KEPT = 16
KEPT_POINTS = 3_000
KEPT_ITERATIONS = 15
CHALLENGED = 12
HOPELESS = 0.6  # of the best score: what ends below is no rival
# symmetries of order 2 to 12, and of gears
TURNS_DEG = (
    180,
    *(sign * turn for turn in (120, 90, 72, 60, 45, 36, 30, 20, 15) for sign in (1, -1)),
)
CHALLENGE_POINTS = 600
CHALLENGE_ITERATIONS = 10
LEAST_TOLERANCE = 0.005  # of the part's radius, while poses are still on their way
NEAR = 0.1  # of the part's radius: what is farther away is clutter
SAME_DEG, SAME_SHIFT = 3.0, 0.03  # poses nearer than both (of the part's radius) are one


@dataclasses.dataclass(frozen=True, eq=False)
class Candidates:
    """Distinct poses, best first.

    Attributes:
      part_from_camera: [H, 3, 3] and [H, 3] mm.
      score: [H].
    """

    part_from_camera: RigidTransform
    score: np.ndarray

    def __len__(self) -> int:
        return len(self.score)

    def pose(self, index: int) -> RigidTransform:
        """One of them."""
        return select(self.part_from_camera, index)


def select(poses: RigidTransform, which: int | np.ndarray | slice) -> RigidTransform:
    """Some of a batch of poses."""
    return RigidTransform(poses.rotation[which], poses.translation[which])


def concatenate(*batches: RigidTransform) -> RigidTransform:
    """Batches of poses, one after the other."""
    return RigidTransform(
        np.concatenate([b.rotation for b in batches]),
        np.concatenate([b.translation for b in batches]),
    )


def spread_rotations(count: int) -> np.ndarray:
    """[count, 3, 3] rotations that cover SO(3) evenly: the super-Fibonacci spiral.

    Source: Alexa, Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3), CVPR 2022.
    """
    s = np.arange(count) + 0.5
    r, big_r = np.sqrt(s / count), np.sqrt(1 - s / count)
    a, b = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    quaternion = np.stack([r * np.sin(a), r * np.cos(a), big_r * np.sin(b), big_r * np.cos(b)], 1)
    return Rotation.from_quat(quaternion).as_matrix()


def starts(model: MeasurementModel, points: np.ndarray, rotations: np.ndarray) -> RigidTransform:
    """Poses with the given rotations [H, 3, 3] that put the scan's middle where it belongs.

    With a known sensor that is the middle of the surface that faces it; else of all the surface.
    """
    surface = model.surface
    middle = points.mean(axis=0)
    samples, normals = surface.points[:1000], surface.normals[:1000]
    if isinstance(model, RayCasting):
        view = middle - model.sensor_origin
        facing = -(normals @ (rotations @ (view / np.linalg.norm(view))).T)
        facing = np.maximum(facing if model.part.closed else np.abs(facing), 0) + 1e-6
    else:
        facing = np.ones((len(samples), len(rotations)))
    visible = (facing / facing.sum(axis=0)).T @ samples
    return RigidTransform(rotations, visible - rotations @ middle)


def search(
    model: MeasurementModel,
    points: np.ndarray,
    *,
    extra: RigidTransform | None = None,
    count: int = STARTS,
    seed: int = 0,
) -> Candidates:
    """The poses that explain the scan best, from no guess.

    Args:
      model: predicts points.
      points: [N, 3] mm, camera frame.
      extra: [E] poses to try beside the spread ones.
      count: how many rotations to start from; 0 takes ``extra`` alone.
      seed: of the subsets of points.
    """
    few = points[subset(points, START_POINTS, seed)]
    poses = starts(model, few, spread_rotations(count)) if count else None
    if poses is not None:
        poses, _ = descend(model, poses, few, iterations=START_ITERATIONS, settled_deg=0.5)
    if extra is not None:
        poses = extra if poses is None else concatenate(extra, poses)
    tolerance = 0.03 * model.part.radius
    now = model.residuals(poses, few, precision="grid")
    quick = np.clip(1 - (now.deviation_mm / tolerance) ** 2, 0, None)
    quick[now.hit & (now.deviation_mm < -tolerance)] = -0.5
    order = np.argsort(-quick.mean(axis=1), kind="stable")
    poses = select(poses, order[distinct(select(poses, order), model.part, KEPT)])
    return settle(model, points, poses, seed=seed)


def settle(
    model: MeasurementModel, points: np.ndarray, poses: RigidTransform, *, seed: int = 0
) -> Candidates:
    """Follows poses down with more points, merges those that meet, and sorts them."""
    some = points[subset(points, KEPT_POINTS, seed + 1)]
    poses, _ = descend(model, poses, some, iterations=KEPT_ITERATIONS, settled_deg=0.02)
    view = View(some, model.sensor_origin) if isinstance(model, RayCasting) else None
    tolerance = 3 * float(noise_level(model, poses, some).min())
    tolerance = max(tolerance, LEAST_TOLERANCE * model.part.radius)
    score = evidence(model, poses, some, tolerance_mm=tolerance, view=view).total
    order = np.argsort(-score, kind="stable")
    order = order[distinct(select(poses, order), model.part, len(order))]
    return Candidates(select(poses, order), score[order])


def noise_level(model: MeasurementModel, poses: RigidTransform, points: np.ndarray) -> np.ndarray:
    """[H] robust standard deviation along the normal of the points near the part, mm."""
    deviation = np.abs(model.residuals(poses, points, precision="samples").deviation_mm)
    near = np.where(deviation < NEAR * model.part.radius, deviation, np.nan)
    near[:, 0] = np.where(np.isnan(near).all(axis=1), NEAR * model.part.radius, near[:, 0])
    return robust_sigma(near, axis=1, ignore_nan=True)


def challengers(surface: Surface, best: RigidTransform) -> RigidTransform:
    """Poses where a part of this shape may look as at the best one, turned and shifted.

    Turned by `TURNS_DEG` about the three principal axes of its surface, and by 180 deg about the
    diagonals between them, as parts have symmetries, about the middle of the surface; and shifted
    along the three axes by an eighth and a quarter of the length: the pitch of repeated features.
    """
    middle, axes = surface.moments
    turns = [axis * np.radians(angle) for axis in axes for angle in TURNS_DEG]
    for i, j in ((0, 1), (1, 2), (0, 2)):
        for sign in (1, -1):
            diagonal = (axes[i] + sign * axes[j]) / np.sqrt(2)
            turns.append(np.pi * diagonal)
    turn = Rotation.from_rotvec(np.stack(turns)).as_matrix()
    turned = RigidTransform(turn @ best.rotation, turn @ (best.translation - middle) + middle)
    along = np.ptp(surface.points @ axes.T, axis=0)
    shifts = np.stack(
        [s * along[k] * axes[k] for k in range(3) for s in (0.125, -0.125, 0.25, -0.25)]
    )
    rotation = np.broadcast_to(best.rotation, (len(shifts), 3, 3))
    return concatenate(turned, RigidTransform(rotation, best.translation + shifts))


def challenge(
    model: MeasurementModel, points: np.ndarray, found: Candidates, *, seed: int = 0
) -> Candidates:
    """The candidates and the best of those `challengers` that end elsewhere, sorted anew."""
    few = points[subset(points, CHALLENGE_POINTS, seed + 4)]
    rivals, _ = descend(
        model,
        challengers(model.surface, found.pose(0)),
        few,
        iterations=CHALLENGE_ITERATIONS,
        settled_deg=0.2,
    )
    every = concatenate(select(found.part_from_camera, slice(0, CHALLENGED)), rivals)
    tolerance = 3 * float(noise_level(model, every, few).min())
    tolerance = max(tolerance, LEAST_TOLERANCE * model.part.radius)
    view = View(few, model.sensor_origin) if isinstance(model, RayCasting) else None
    score = evidence(model, every, few, tolerance_mm=tolerance, view=view).total
    order = np.argsort(-score, kind="stable")
    order = order[distinct(select(every, order), model.part, CHALLENGED)]
    best = score[order[0]]
    order = order[score[order] >= best - (1 - HOPELESS) * abs(best)]
    return Candidates(select(every, order), score[order])


def is_same(turn_deg: np.ndarray, shift_mm: np.ndarray, part: Part) -> np.ndarray:
    """Whether poses at these `distances` count as one."""
    return (turn_deg < SAME_DEG) & (shift_mm < SAME_SHIFT * part.radius)


def distinct(poses: RigidTransform, part: Part, most: int) -> np.ndarray:
    """Indices of at most ``most`` poses that are not near one before them."""
    kept: list[int] = []
    for index in range(len(poses.rotation)):
        turn, shift = distances(select(poses, np.array(kept, int)), select(poses, index), part)
        if not is_same(turn, shift, part).any():
            kept.append(index)
        if len(kept) == most:
            break
    return np.array(kept, int)


def distances(
    poses: RigidTransform, other: RigidTransform, part: Part
) -> tuple[np.ndarray, np.ndarray]:
    """[H] deg and [H] mm between H poses and one other; the shift is of the part's centre."""
    between = other.rotation @ poses.rotation.swapaxes(-1, -2)
    turn = np.degrees(Rotation.from_matrix(between.reshape(-1, 3, 3)).magnitude())
    # where the other pose puts what each pose has at the centre
    camera = np.einsum("hji,hj->hi", poses.rotation, part.center - poses.translation)
    shift = camera @ other.rotation.T + other.translation - part.center
    return turn, np.linalg.norm(shift, axis=-1)
