"""Poses from no guess: rotations that cover SO(3), each converged by ray casting.

The basin of `robust_gauss_newton` is tens of degrees wide, so a few hundred rotations reach every
pose; points whose ray misses the part are pulled to its surface, which more than doubles the share
of the initial poses that arrive. Candidates are sorted by what the scan says for them
(`verification.evidence`). The best is then moved by the part's near symmetries, to the poses at
which the part may look alike: the symmetry hypotheses.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.cad.declared_symmetry import PartSymmetry
from vanejax.localization.fine_registration import robust_gauss_newton, subset
from vanejax.localization.pose_batch import concatenate, distinct, select
from vanejax.localization.residuals import MeasurementModel, RayCasting
from vanejax.localization.scan_patches import view_of
from vanejax.localization.self_similarity import moved_by, self_similar_motions
from vanejax.localization.verification import evidence
from vanejax.rigid import RigidTransform
from vanejax.scans.robust_statistics import robust_sigma

INITIAL_ROTATIONS = 400
INITIAL_POINTS = 400
INITIAL_ITERATIONS = 12
MOST_CANDIDATES = 16
CANDIDATE_POINTS = 3_000
CANDIDATE_ITERATIONS = 15
SYMMETRY_SEEDS = 3  # of the best candidates, those whose similar poses are tried
MOST_SYMMETRY_HYPOTHESES = 12
SYMMETRY_POINTS = 600
SYMMETRY_ITERATIONS = 10
LEAST_SCORE = 0.6  # of the best score: what ends below competes no more
LEAST_TOLERANCE = 0.005  # of the part's radius, while poses are still on their way
NEAR = 0.1  # of the part's radius: what is farther away is clutter


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


def uniform_rotations(count: int) -> np.ndarray:
    """[count, 3, 3] rotations that cover SO(3) evenly: the super-Fibonacci spiral.

    Source: Alexa, Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3), CVPR 2022.
    """
    s = np.arange(count) + 0.5
    r, big_r = np.sqrt(s / count), np.sqrt(1 - s / count)
    a, b = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    quaternion = np.stack([r * np.sin(a), r * np.cos(a), big_r * np.sin(b), big_r * np.cos(b)], 1)
    return Rotation.from_quat(quaternion).as_matrix()


def initial_poses(
    model: MeasurementModel, points: np.ndarray, rotations: np.ndarray
) -> RigidTransform:
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
    count: int = INITIAL_ROTATIONS,
    seed: int = 0,
    symmetry: PartSymmetry | None = None,
) -> Candidates:
    """The poses that explain the scan best, from no guess.

    Args:
      model: predicts points.
      points: [N, 3] mm, camera frame.
      extra: [E] poses to try beside the uniform ones.
      count: how many rotations to start from; 0 takes ``extra`` alone.
      seed: of the subsets of points.
      symmetry: of the part; of the poses that it makes one, the best is a candidate.
    """
    sample = points[subset(points, INITIAL_POINTS, seed)]
    poses = None
    if count:
        poses, _ = robust_gauss_newton(
            model,
            initial_poses(model, sample, uniform_rotations(count)),
            sample,
            iterations=INITIAL_ITERATIONS,
            min_step_deg=0.5,
        )
    if extra is not None:
        poses = extra if poses is None else concatenate(extra, poses)
    tolerance = 0.03 * model.part.radius
    residuals = model.residuals(poses, sample, precision="grid")
    score = np.clip(1 - (residuals.deviation_mm / tolerance) ** 2, 0, None)
    score[residuals.hit & (residuals.deviation_mm < -tolerance)] = -0.5
    best = _best_first(model, poses, score.mean(axis=1), MOST_CANDIDATES, symmetry)
    return converge(model, points, best.part_from_camera, seed=seed, symmetry=symmetry)


def converge(
    model: MeasurementModel,
    points: np.ndarray,
    poses: RigidTransform,
    *,
    seed: int = 0,
    symmetry: PartSymmetry | None = None,
) -> Candidates:
    """Converges poses with more points, merges those that meet, and sorts them."""
    sample = points[subset(points, CANDIDATE_POINTS, seed + 1)]
    poses, _ = robust_gauss_newton(
        model, poses, sample, iterations=CANDIDATE_ITERATIONS, min_step_deg=0.02
    )
    return _best_first(model, poses, _scores(model, poses, sample), len(poses.rotation), symmetry)


def add_symmetry_hypotheses(
    model: MeasurementModel,
    points: np.ndarray,
    candidates: Candidates,
    *,
    seed: int = 0,
    symmetry: PartSymmetry | None = None,
) -> Candidates:
    """The candidates, and the best moved by the part's own similarities, sorted anew."""
    sample = points[subset(points, SYMMETRY_POINTS, seed + 4)]
    motions = self_similar_motions(model.part)
    seeds = range(min(SYMMETRY_SEEDS, len(candidates)))
    symmetric, _ = robust_gauss_newton(
        model,
        concatenate(*(moved_by(motions, candidates.pose(k)) for k in seeds)),
        sample,
        iterations=SYMMETRY_ITERATIONS,
        min_step_deg=0.2,
    )
    known = select(candidates.part_from_camera, slice(0, MOST_SYMMETRY_HYPOTHESES))
    poses = concatenate(known, symmetric)
    scores = _scores(model, poses, sample)
    ranked = _best_first(model, poses, scores, MOST_SYMMETRY_HYPOTHESES, symmetry)
    best = ranked.score[0]
    kept = ranked.score >= best - (1 - LEAST_SCORE) * abs(best)
    return Candidates(select(ranked.part_from_camera, kept), ranked.score[kept])


def noise_level(model: MeasurementModel, poses: RigidTransform, points: np.ndarray) -> np.ndarray:
    """[H] robust standard deviation along the normal of the points near the part, mm."""
    deviation = np.abs(model.residuals(poses, points, precision="samples").deviation_mm)
    near = np.where(deviation < NEAR * model.part.radius, deviation, np.nan)
    near[:, 0] = np.where(np.isnan(near).all(axis=1), NEAR * model.part.radius, near[:, 0])
    return robust_sigma(near, axis=1, ignore_nan=True)


def _scores(model: MeasurementModel, poses: RigidTransform, points: np.ndarray) -> np.ndarray:
    """[H] what all the points say for each pose, at a tolerance that the best one sets."""
    tolerance = 3 * float(noise_level(model, poses, points).min())
    tolerance = max(tolerance, LEAST_TOLERANCE * model.part.radius)
    view = view_of(model, points)
    return evidence(model, poses, points, tolerance_mm=tolerance, view=view).total


def _best_first(
    model: MeasurementModel,
    poses: RigidTransform,
    score: np.ndarray,
    most: int,
    symmetry: PartSymmetry | None,
) -> Candidates:
    """At most ``most`` distinct poses, the best first."""
    order = np.argsort(-score, kind="stable")
    order = order[distinct(select(poses, order), model.part, most, symmetry)]
    return Candidates(select(poses, order), score[order])
