"""One word on a pose, with its reason: accepted, ambiguous or rejected."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

from vanejax.localization.pose_result import Uncertainty, Verdict, Verification
from vanejax.rigid import RigidTransform


@dataclasses.dataclass(frozen=True)
class Limits:
    """What a pose must show to be accepted.

    The defaults were set on virtual scans with right and wrong poses (`experiments.verdicts`).

    Attributes:
      least_inlier_share: of the points; clutter and other parts count against it.
      most_violation_share: of the points, those seen through material.
      most_unmeasured_share: of the surface that should have been measured.
      most_noise: standard deviation of the inliers' deviations, of the part's radius; above it
        the pose is rejected.
      doubtful_noise: likewise; above it no pose is certain, since a sensor that is off by so much
        seldom is so at random.
      least_support: `Verification.support`; below it no pose is certain: another part that shares
        a corner with this one gets so far.
      least_inliers: points.
      least_preference: how many standard errors the patches of the scan must prefer the pose to
        each other pose that was tried.
      most_rotation_sigma_deg, most_translation_sigma: in the weakest direction; the second of the
        part's radius.
    """

    least_inlier_share: float = 0.6
    most_violation_share: float = 0.12
    most_unmeasured_share: float = 0.35
    most_noise: float = 0.04
    doubtful_noise: float = 0.02
    least_support: float = 0.7
    least_inliers: int = 40
    least_preference: float = 4.0
    most_rotation_sigma_deg: float = 1.0
    most_translation_sigma: float = 0.01


@dataclasses.dataclass(frozen=True, eq=False)
class CompetingHypothesis:
    """Another pose, and how it compares with the refined one.

    Attributes:
      preference: standard errors by which the scan prefers the refined pose to this one.
      rotation_deg, translation_mm: how far away it is.
      part_from_camera: the other pose.
    """

    preference: float
    rotation_deg: float
    translation_mm: float
    part_from_camera: RigidTransform


def judge(
    verification: Verification,
    uncertainty: Uncertainty,
    competing: Sequence[CompetingHypothesis],
    *,
    radius_mm: float,
    limits: Limits | None = None,
) -> Verdict:
    """The verdict on a refined pose; the first reason that holds is given."""
    limits = limits or Limits()
    for reason in _faults(verification, radius_mm, limits):
        return Verdict("rejected", reason)
    for reason in _doubts(verification, uncertainty, competing, radius_mm, limits):
        return Verdict("ambiguous", reason)
    return Verdict(
        "accepted",
        f"{verification.inlier_share:.1%} of the points lie on the part within "
        f"{verification.tolerance_mm:.3g} mm, and no other pose comes near",
    )


def _faults(verification: Verification, radius_mm: float, limits: Limits) -> Iterator[str]:
    """What is wrong with a pose, the worst first."""
    inliers = round(verification.inlier_share * len(verification.checked))
    if inliers < limits.least_inliers:
        yield f"only {inliers} points lie on the part"
    if verification.inlier_share < limits.least_inlier_share:
        yield (
            f"only {verification.inlier_share:.0%} of the points lie on the part "
            f"(within {verification.tolerance_mm:.3g} mm)"
        )
    if verification.violation_share > limits.most_violation_share:
        yield (
            f"{verification.violation_share:.0%} of the points would have been seen through "
            "the part's material"
        )
    if verification.unmeasured_share > limits.most_unmeasured_share:
        yield (
            f"{verification.unmeasured_share:.0%} of the surface that the sensor should have "
            "seen was not measured"
        )
    noise = verification.tolerance_mm / 3
    if noise > limits.most_noise * radius_mm:
        yield (
            f"the points lie {noise:.2g} mm off the surface: the part is not like its CAD model, "
            "or it is another part"
        )


def _doubts(
    verification: Verification,
    uncertainty: Uncertainty,
    competing: Sequence[CompetingHypothesis],
    radius_mm: float,
    limits: Limits,
) -> Iterator[str]:
    """Why a pose without fault may still be another one, the gravest first."""
    near = [other for other in competing if other.preference < limits.least_preference]
    if near:
        best = min(near, key=lambda other: other.preference)
        better = "better" if len(near) == 1 else "as well or better"
        yield (
            f"the scan fits {'another pose' if len(near) == 1 else f'{len(near)} other poses'} "
            f"{better if best.preference < -limits.least_preference else 'nearly as well'}: "
            f"one is turned by {best.rotation_deg:.1f} deg and moved by "
            f"{best.translation_mm:.2f} mm; a view that shows where they differ, or a rough pose, "
            "decides"
        )
    if verification.support < limits.least_support:
        unmeasured = ""
        if not math.isnan(verification.unmeasured_share):
            unmeasured = (
                f", and {verification.unmeasured_share:.0%} of the surface that the sensor "
                "should have seen was not measured"
            )
        yield (
            f"only {verification.inlier_share:.0%} of the points lie on the part{unmeasured}: "
            "crop the scan to the part, and see that it is this part"
        )
    noise = verification.tolerance_mm / 3
    if noise > limits.doubtful_noise * radius_mm:
        yield (
            f"the points lie {noise:.2g} mm off the surface, {noise / radius_mm:.1%} of the part's "
            "radius: the pose is the best one, but may be off by more than its uncertainty says"
        )
    if uncertainty.weakest_rotation_sigma_deg > limits.most_rotation_sigma_deg:
        yield (
            "the scan hardly fixes the rotation about "
            f"{_axis(uncertainty.weakest_rotation_axis)}: "
            f"{uncertainty.weakest_rotation_sigma_deg:.2f} deg standard deviation"
        )
    if uncertainty.weakest_translation_sigma_mm > limits.most_translation_sigma * radius_mm:
        yield (
            "the scan hardly fixes the position along "
            f"{_axis(uncertainty.weakest_translation_axis)}: "
            f"{uncertainty.weakest_translation_sigma_mm:.2f} mm standard deviation"
        )


def _axis(axis: object) -> str:
    """An axis of the part's frame in words."""
    x, y, z = axis
    for name, unit in (("x", abs(x)), ("y", abs(y)), ("z", abs(z))):
        if unit > 0.99:
            return f"the part's {name}"
    return f"({x:.2f}, {y:.2f}, {z:.2f}) in the part's frame"
