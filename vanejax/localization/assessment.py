"""How a refined pose is judged: the one way, of `register` and of the study of its verdicts.

The poses that compete with it are compared by the same points, each of the scan's points says
whether it lies on the part, and the covariance says how well the scan fixes the pose.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vanejax.cad.declared_symmetry import PartSymmetry
from vanejax.localization.covariance import uncertainty
from vanejax.localization.deviation_patches import as_designed, scaled_pose
from vanejax.localization.fine_registration import robust_gauss_newton, subset
from vanejax.localization.material import material_regions
from vanejax.localization.pose_batch import concatenate, distances, distinct, is_same, select, stack
from vanejax.localization.pose_result import (
    Alternative,
    FormDeviation,
    Refinement,
    Uncertainty,
    Verdict,
    Verification,
)
from vanejax.localization.pose_search import Candidates, add_symmetry_hypotheses, noise_level
from vanejax.localization.residuals import MeasurementModel
from vanejax.localization.scan_patches import view_of
from vanejax.localization.verdict import CompetingHypothesis, Limits, judge
from vanejax.localization.verification import evidence, verify
from vanejax.rigid import RigidTransform

MOST_HYPOTHESES = 8  # poses beside the best that are converged and compared with it
COMPARED_POINTS = 8_000
VERIFIED_POINTS = 100_000
# of the part's radius: a casting is no truer to its model than the first, and what is farther off
# than the second is not on the part
LEAST_TOLERANCE, MOST_TOLERANCE = 0.001, 0.12
# a guess is good to this; a pose farther away that fits as well is no reason to doubt it
GUESS_DEG, GUESS_SHIFT = 30.0, 0.3
ALIKE = 0.95  # of the inliers: other poses with as many are listed


@dataclasses.dataclass(frozen=True, eq=False)
class Assessment:
    """What is known of one refined pose of a scan.

    Attributes:
      verification: what every checked point says.
      uncertainty: covariance and its weakest directions.
      competing: the other poses and how much less the scan prefers them.
      ruled_out: poses that fit as well, but are far from the guess; none of ``competing``.
      alternatives: of ``competing``, those that the scan allows, best first; of an ambiguous pose.
      verdict: on the pose.
    """

    verification: Verification
    uncertainty: Uncertainty
    competing: tuple[CompetingHypothesis, ...]
    ruled_out: tuple[CompetingHypothesis, ...]
    alternatives: tuple[Alternative, ...]
    verdict: Verdict


def compared_points(points: np.ndarray, seed: int) -> np.ndarray:
    """Those of the points [N, 3] by which poses are compared."""
    return points[subset(points, COMPARED_POINTS, seed + 2)]


def competing_hypotheses(
    model: MeasurementModel,
    points: np.ndarray,
    candidates: Candidates,
    *,
    seed: int = 0,
    symmetry: PartSymmetry | None = None,
) -> Candidates:
    """The best candidates and symmetry hypotheses, converged and scored by the same points.

    Not sorted, nor are poses that met left out: see `choose`.
    """
    pool = add_symmetry_hypotheses(model, points, candidates, seed=seed, symmetry=symmetry)
    sample = compared_points(points, seed)
    poses = select(pool.part_from_camera, slice(0, 1 + MOST_HYPOTHESES))
    poses = converge_fully(model, poses, sample)
    tolerance = float(inlier_tolerance_mm(model, poses, sample).min())
    view = view_of(model, sample)
    score = evidence(model, poses, sample, tolerance_mm=tolerance, view=view).total
    return Candidates(poses, score)


def choose(
    model: MeasurementModel,
    hypotheses: Candidates,
    guess: RigidTransform | None = None,
    symmetry: PartSymmetry | None = None,
) -> RigidTransform:
    """Distinct poses [H, 3, 3] in the order in which they are tried: near the guess, then score."""
    poses, score = hypotheses.part_from_camera, hypotheses.score
    far = np.zeros(len(score), bool)
    if guess is not None:
        far = ~_is_near_guess(*distances(poses, guess, model.part, symmetry), model)
    order = np.lexsort((-score, far))  # the last key counts most
    kept = distinct(select(poses, order), model.part, len(order), symmetry)
    return select(poses, order[kept])


def assess(
    model: MeasurementModel,
    points: np.ndarray,
    refinement: Refinement,
    hypotheses: RigidTransform,
    *,
    guess: RigidTransform | None = None,
    limits: Limits | None = None,
    seed: int = 0,
    symmetry: PartSymmetry | None = None,
) -> Assessment:
    """Verifies a refined pose, compares it with hypotheses, and judges it.

    Args:
      model: predicts points.
      points: [N, 3] f64, mm, camera frame.
      refinement: of these points.
      hypotheses: [H, 3, 3] and [H, 3], from `converge_fully`; those that are the pose do not count.
      guess: rough part_from_camera; hypotheses far from it count where they fit better only.
      limits: of the verdict.
      seed: of the subsets of points.
      symmetry: of the part; poses that it makes one do not compete.
    """
    limits = limits or Limits()
    part, pose = model.part, refinement.part_from_camera
    sample = compared_points(points, seed)
    tolerance = float(inlier_tolerance_mm(model, stack(pose), sample)[0])
    competing, ruled_out = _compare(
        model, sample, concatenate(stack(pose), hypotheses), tolerance, guess, limits, symmetry
    )
    verification = _verify(model, points, refinement, tolerance, seed)
    free_axis = None if symmetry is None else symmetry.free_axis
    sigma = uncertainty(refinement, part.center, free_axis)
    verdict = judge(
        verification,
        sigma,
        competing,
        radius_mm=part.radius,
        form=refinement.form,
        limits=limits,
    )
    alternatives = ()
    if verdict.status == "ambiguous":
        listed = [(other, _alternative(model, other, sample, tolerance)) for other in competing]
        # a pose that explains the points as well may be right where the scan was cropped
        least = ALIKE * verification.inlier_share
        listed = [
            (other.preference, alternative)
            for other, alternative in listed
            if other.preference < limits.least_preference or alternative.inlier_share >= least
        ]
        listed.sort(key=lambda pair: pair[0])
        alternatives = tuple(alternative for _, alternative in listed)
    return Assessment(verification, sigma, competing, ruled_out, alternatives, verdict)


def converge_fully(
    model: MeasurementModel, poses: RigidTransform, points: np.ndarray
) -> RigidTransform:
    """H poses [H, 3, 3] where they explain the points [n, 3] best: to be compared with others.

    A pose from `refine` may have slid where the scan hardly holds it, and is compared after this.
    """
    return robust_gauss_newton(
        model,
        poses,
        points,
        iterations=8,
        precision="samples",
        floor_mm=LEAST_TOLERANCE * model.part.radius,
        min_step_deg=0.02,
    )[0]


def inlier_tolerance_mm(
    model: MeasurementModel, poses: RigidTransform, points: np.ndarray
) -> np.ndarray:
    """[H] largest deviation of an inlier, mm: three robust standard deviations, within bounds."""
    radius = model.part.radius
    level = 3 * noise_level(model, poses, points)
    return np.clip(level, LEAST_TOLERANCE * radius, MOST_TOLERANCE * radius)


def _compare(
    model: MeasurementModel,
    points: np.ndarray,
    poses: RigidTransform,
    tolerance_mm: float,
    guess: RigidTransform | None,
    limits: Limits,
    symmetry: PartSymmetry | None,
) -> tuple[tuple[CompetingHypothesis, ...], tuple[CompetingHypothesis, ...]]:
    """The poses that compete with the first one, and those that only the guess rules out."""
    view = view_of(model, points)
    scores = evidence(model, poses, points, tolerance_mm=tolerance_mm, view=view)
    if symmetry is not None:
        poses = symmetry.nearest(poses, select(poses, 0))
    angle_deg, shift_mm = distances(poses, select(poses, 0), model.part)
    near_guess = np.ones(len(angle_deg), bool)
    if guess is not None:
        near_guess = _is_near_guess(*distances(poses, guess, model.part, symmetry), model)
    competing, ruled_out = [], []
    for k in np.flatnonzero(~is_same(angle_deg, shift_mm, model.part)):
        other = CompetingHypothesis(
            scores.preference(0, k), float(angle_deg[k]), float(shift_mm[k]), select(poses, k)
        )
        if near_guess[k] or other.preference <= -limits.least_preference:
            competing.append(other)
        elif other.preference < limits.least_preference:
            ruled_out.append(other)
    return tuple(competing), tuple(ruled_out)


def _verify(
    model: MeasurementModel,
    points: np.ndarray,
    refinement: Refinement,
    tolerance_mm: float,
    seed: int,
) -> Verification:
    """What the points say: of a casting, whether the part is there under its stock."""
    checked = subset(points, VERIFIED_POINTS, seed + 3)
    form = refinement.form
    model, points, pose = without_form_deviation(model, points, refinement.part_from_camera, form)
    if form is not None and not form.is_as_designed:
        tolerance_mm = float(inlier_tolerance_mm(model, stack(pose), points[checked])[0])
    view = view_of(model, points[checked])
    found = verify(model, pose, points, checked, tolerance_mm=tolerance_mm, view=view)
    regions = material_regions(
        model, pose, points[checked], found.status, tolerance_mm=tolerance_mm
    )
    return dataclasses.replace(found, regions=regions)


def without_form_deviation(
    model: MeasurementModel,
    points: np.ndarray,
    part_from_camera: RigidTransform,
    form: FormDeviation | None,
) -> tuple[MeasurementModel, np.ndarray, RigidTransform]:
    """Model, points [N, 3] mm and pose as if the part had no stock and everything its true size.

    Args:
      model: of the scan as it is.
      points: [N, 3] f64, mm, camera frame.
      part_from_camera: the pose of the scan as it is.
      form: its stock, scale and focal length are taken out; the smooth field stays.
    """
    if form is None or form.is_as_designed:
        return model, points, part_from_camera
    terms = np.array([form.stock_mm, form.scale_error, form.focal_error])
    pose = scaled_pose(part_from_camera, model.part.center, 1 / (1 + form.scale_error))
    return *as_designed(model, points, pose, terms), pose


def _is_near_guess(
    angle_deg: np.ndarray, shift_mm: np.ndarray, model: MeasurementModel
) -> np.ndarray:
    return (angle_deg <= GUESS_DEG) & (shift_mm <= GUESS_SHIFT * model.part.radius)


def _alternative(
    model: MeasurementModel, other: CompetingHypothesis, points: np.ndarray, tolerance_mm: float
) -> Alternative:
    """A competing hypothesis as the result lists it."""
    pose = stack(other.part_from_camera)
    deviation = model.residuals(pose, points, precision="samples").deviation_mm
    return Alternative(
        part_from_camera=other.part_from_camera,
        rotation_deg=other.rotation_deg,
        translation_mm=other.translation_mm,
        inlier_share=float(np.mean(np.abs(deviation) <= tolerance_mm)),
    )
