"""One word on a pose, with its reason: accepted, ambiguous or rejected."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

from vanejax.localization.pose_result import (
    BEYOND_EDGES_MM,
    FormDeviation,
    MaterialRegion,
    Uncertainty,
    Verdict,
    Verification,
)
from vanejax.rigid import RigidTransform

MOST_OF_THEM = 0.9  # of the points: so many are not few
ROUGH = 0.25  # of the part's radius: a distortion, or a sensor's error, is smoother


@dataclasses.dataclass(frozen=True)
class Limits:
    """What a pose must show to be accepted.

    The defaults were set on virtual scans with right and wrong poses (`experiments.verdicts`).

    Attributes:
      least_inlier_share: of the points; clutter and other parts count against it.
      most_violation_share: of the points, those seen through material.
      most_missing_share: of the surface that should have been measured within the region that was.
      most_noise: standard deviation of the inliers' deviations, of the part's radius; above it
        the pose is rejected.
      doubtful_noise: likewise; above it no pose is certain, since a sensor that is off by so much
        seldom is so at random.
      least_support: `Verification.support`; below it no pose is certain: another part that shares
        a corner with this one gets so far.
      least_inliers: points.
      least_preference: how many standard errors the patches of the scan must prefer the pose to
        each other pose that was tried.
      tolerance_deg, tolerance_mm: what the job needs: the 95 % bounds of the pose are to be
        within.
      most_scale_error: of a scan against the CAD model; above it the part is another one.
      most_field_mm: standard deviation of a smooth deviation of form; above it, and a quarter of
        ``tolerance_mm``, no pose is certain, since a deviation that large is seldom random: it is
        stock on one side, or a bend.
      most_rough_mm: likewise, of a distortion or a sensor's error that changes within a few
        millimetres (`ROUGH` of the part's radius), which neither does; it is false stock.
      most_beyond_edges_share: of the points, those that lie beyond the part's edges; three times as
        many with stock, where edges are less sharp; of no matter where ``tolerance_mm`` is as large
        as they may be off.
      most_unexplained_share: of the scan's patches, those that no model of its form explains.
    """

    least_inlier_share: float = 0.6
    most_violation_share: float = 0.12
    most_missing_share: float = 0.35
    most_noise: float = 0.04
    doubtful_noise: float = 0.02
    least_support: float = 0.7
    least_inliers: int = 40
    least_preference: float = 4.0
    tolerance_deg: float = 0.5
    tolerance_mm: float = 1.0
    most_scale_error: float = 0.035
    most_field_mm: float = 0.25
    most_rough_mm: float = 0.03
    most_beyond_edges_share: float = 0.001
    most_unexplained_share: float = 0.05


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
    form: FormDeviation | None = None,
    limits: Limits | None = None,
) -> Verdict:
    """The verdict on a refined pose; the first reason that holds is given.

    How the part differs from its CAD model is named in every verdict that is not a rejection, and
    where material is missing or extra also in that of a pose that most of the points lie on.
    """
    limits = limits or Limits()
    material = "".join(f"; {_in_words(region)}" for region in verification.regions)
    for reason in _faults(verification, form, radius_mm, limits):
        most = verification.inlier_share >= limits.least_inlier_share
        return Verdict("rejected", reason + (material if most else ""))
    differences = "".join(f"; {words}" for words in in_words(form)) + material
    if uncertainty.free_axis is not None:
        differences += f"; the rotation about {_axis(uncertainty.free_axis)} is free by symmetry"
    for reasons in (
        _doubts(verification, competing, radius_mm, limits),
        _doubts_of_form(form, radius_mm, limits),
        _doubts_of_bounds(uncertainty, form, limits),
    ):
        for reason in reasons:
            return Verdict("ambiguous", reason + differences)
    return Verdict(
        "accepted",
        f"{verification.inlier_share:.1%} of the points lie on the part within "
        f"{verification.tolerance_mm:.3g} mm, and no other pose comes near{differences}",
    )


def in_words(form: FormDeviation | None) -> Iterator[str]:
    """How a part as scanned differs from its CAD model, each difference with its figure."""
    if form is None:
        return
    if form.stock_mm:
        known = f"+- {form.stock_sigma_mm:.3f} mm" if form.stock_sigma_mm else "mm, its largest"
        yield f"stock {form.stock_mm:.3f} {known}"
    if form.scale_error:
        word = "larger" if form.scale_error > 0 else "smaller"
        yield (
            f"the scan is {abs(form.scale_error):.3%} +- {form.scale_sigma:.3%} {word} than the "
            "CAD model"
        )
    if form.focal_error:
        yield (
            f"the camera's focal length is off by {form.focal_error:+.3%} +- {form.focal_sigma:.3%}"
        )
    if form.field != "none":
        what = {
            "form": "the surface varies",
            "displacement": "the part is distorted",
            "range": "the sensor's range varies",
            "facing": "faces of different directions are offset",
        }[form.field]
        length = f" over {form.field_length_mm:.0f} mm" if form.field_length_mm else ""
        yield f"{what} by {form.field_mm:.2g} mm{length}"


def _in_words(region: MaterialRegion) -> str:
    """Where material is missing or extra, and how much."""
    x, y, z = region.center
    area = f"{float(f'{region.area_mm2:.2g}'):,.0f}"  # two figures are certain at most
    where = f"{region.share:.1%} of the scan (some {area} mm^2 about "
    where += f"({x:.0f}, {y:.0f}, {z:.0f}) mm in the part's frame)"
    if region.is_missing:
        return (
            f"{where} was seen up to {region.depth_mm:.2g} mm deep through material of the CAD "
            "model: that is missing, or it is another part"
        )
    return (
        f"{where} lies up to {region.depth_mm:.2g} mm outside the CAD model: extra material, "
        "something that touches the part, or another part"
    )


def _faults(
    verification: Verification, form: FormDeviation | None, radius_mm: float, limits: Limits
) -> Iterator[str]:
    """What is wrong with a pose, the worst first."""
    inliers = round(verification.inlier_share * len(verification.checked))
    if inliers < limits.least_inliers:
        yield (
            f"only {inliers} points lie on the part: another part, a wrong unit, or next to "
            "nothing of it in the scan"
        )
    if verification.inlier_share < limits.least_inlier_share:
        yield (
            f"only {verification.inlier_share:.0%} of the points lie on the part (within "
            f"{verification.tolerance_mm:.3g} mm): another part, or too much else in the scan"
        )
    if verification.violation_share > limits.most_violation_share:
        yield (
            f"{verification.violation_share:.0%} of the points would have been seen through "
            "the part's material: another part, missing material, or a wrong place of the "
            "sensor"
        )
    if verification.missing_share > limits.most_missing_share:
        yield (
            f"{verification.missing_share:.0%} of the surface that the sensor should have seen "
            "between the measured points was not measured: another part, or shine and shadow"
        )
    noise = verification.tolerance_mm / 3
    if noise > limits.most_noise * radius_mm:
        yield (
            f"the points lie {noise:.2g} mm off the surface: the part is not like its CAD model, "
            "or it is another part"
        )
    if form is not None and abs(form.scale_error) > limits.most_scale_error:
        yield (
            f"{size_in_words(form.scale_error)}: it is a part of another size, or the scale of the "
            "scan or of the CAD file is wrong"
        )


def size_in_words(scale_error: float) -> str:
    """How much larger or smaller the scan is than the CAD model."""
    word = "larger" if scale_error > 0 else "smaller"
    return f"the scan is {abs(scale_error):.1%} {word} than the CAD model"


def _doubts(
    verification: Verification,
    competing: Sequence[CompetingHypothesis],
    radius_mm: float,
    limits: Limits,
) -> Iterator[str]:
    """Why a pose without fault may still be another one, the gravest first."""
    weak = verification.support < limits.least_support
    off_the_part = weak and verification.inlier_share < MOST_OF_THEM
    if off_the_part:
        yield _weak_support(verification)
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
    if weak and not off_the_part:
        yield _weak_support(verification)
    noise = verification.tolerance_mm / 3
    if noise > limits.doubtful_noise * radius_mm:
        yield (
            f"the points lie {noise:.2g} mm off the surface, {noise / radius_mm:.1%} of the part's "
            "radius: the pose is the best one, but may be off by more than its uncertainty says"
        )


def _weak_support(verification: Verification) -> str:
    """Points and surface that do not agree."""
    unmeasured = ""
    if not math.isnan(verification.unmeasured_share):
        unmeasured = (
            f", and {verification.unmeasured_share:.0%} of the surface that the sensor should have "
            "seen was not measured"
        )
    only = "only " if verification.inlier_share < MOST_OF_THEM else ""
    return (
        f"{only}{verification.inlier_share:.0%} of the points lie on the part{unmeasured}: crop "
        "the scan to the part, see that all of it is in the scan, and that it is not another part"
    )


def _doubts_of_form(form: FormDeviation | None, radius_mm: float, limits: Limits) -> Iterator[str]:
    """Why what the part differs by leaves the pose open."""
    if form is None:
        return
    if not form.is_told:
        yield (
            "too little smooth surface was measured to tell whether the part is like its CAD model"
        )
    if form.unexplained_share > limits.most_unexplained_share:
        yield (
            f"{form.unexplained_share:.0%} of the surface is not where the CAD model has it, and "
            "no smooth deviation explains that: missing or extra material, or another part"
        )
    # another size moves all edges, as it should
    tight = limits.tolerance_mm < BEYOND_EDGES_MM and not form.scale_error
    most = limits.most_beyond_edges_share * (3 if form.stock_mm else 1)
    if form.beyond_edges_share > most and tight:
        yield (
            f"{form.beyond_edges_share:.2%} of the points lie beyond the part's edges: it may have "
            "stock on one side, which moves the pose by as much, or something touches it"
        )
    if form.field == "facing":
        yield (
            f"faces that look in different directions are offset by some {form.field_mm:.2g} mm, "
            "as by stock on a few faces only: the pose may be off by as much"
        )
    elif form.field_mm > max(limits.most_field_mm, limits.tolerance_mm / 4):
        yield (
            f"the part differs from its CAD model by {form.field_mm:.2g} mm: so much is seldom "
            "random, and the pose may be off by as much"
        )
    rough = form.field in ("displacement", "range") and form.field_length_mm < ROUGH * radius_mm
    if rough and form.field_mm > limits.most_rough_mm:
        yield (
            f"deviations change by {form.field_mm:.2g} mm within {form.field_length_mm:.0f} mm, as "
            "by stock on one side only: the pose may be off by as much stock as there is"
        )
    if not form.converged:
        yield (
            "the part differs from its CAD model in a way that no model of its form explains: the "
            "estimate did not converge"
        )


def _doubts_of_bounds(
    uncertainty: Uncertainty, form: FormDeviation | None, limits: Limits
) -> Iterator[str]:
    """Why the pose is not as certain as the job needs."""
    help_ = "a view of other sides would help"
    if form is not None and form.scale_error:
        help_ = (
            "a single view does not tell a part of another size from a camera with a wrong scale: "
            "check the camera on a gauge, and the unit"
        )
    elif form is not None and form.is_as_designed:
        help_ += ", or to know that the part has no stock (--max-allowance-mm 0)"
    deg, mm = uncertainty.rotation_bound_deg, uncertainty.translation_bound_mm
    if deg > limits.tolerance_deg:
        yield (
            f"the rotation is known to {deg:.2g} deg only (95 %), least about "
            f"{_axis(uncertainty.weakest_rotation_axis)}, and the job needs "
            f"{limits.tolerance_deg:g} deg: {help_}"
        )
    if mm > limits.tolerance_mm:
        yield (
            f"the position is known to {mm:.2g} mm only (95 %), least along "
            f"{_axis(uncertainty.weakest_translation_axis)}, and the job needs "
            f"{limits.tolerance_mm:g} mm: {help_}"
        )


def _axis(axis: object) -> str:
    """An axis of the part's frame in words."""
    x, y, z = axis
    for name, unit in (("x", abs(x)), ("y", abs(y)), ("z", abs(z))):
        if unit > 0.99:
            return f"the part's {name}"
    return f"({x:.2f}, {y:.2f}, {z:.2f}) in the part's frame"
