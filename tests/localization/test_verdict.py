"""Every verdict and every reason, each by a case built to reach it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from example_result import example_result, pose
from scipy.linalg import block_diag

from vanejax.localization.pose_result import BOUND, FormDeviation, MaterialRegion, Verdict
from vanejax.localization.verdict import CompetingHypothesis, Limits, judge

RADIUS = 70.0
GOOD = example_result()
FAR = CompetingHypothesis(20.0, 180.0, 0.5, pose((180.0, 0.0, 0.0), (0.0, 0.0, 0.0)))


def verdict(
    *, competing=(FAR,), limits=None, uncertainty=None, form=None, **verification
) -> Verdict:
    """Of a result in which all is well but what is given."""
    said = {
        "inlier_share": 0.95,
        "violation_share": 0.01,
        "unmeasured_share": 0.03,
        "missing_share": 0.03,
        "tolerance_mm": 0.3,
        "checked": np.arange(1000),
    }
    return judge(
        dataclasses.replace(GOOD.verification, **(said | verification)),
        dataclasses.replace(GOOD.uncertainty, **(uncertainty or {})),
        competing,
        radius_mm=RADIUS,
        form=form,
        limits=limits,
    )


def test_all_well_is_accepted_and_says_why():
    found = verdict()
    assert found.status == "accepted"
    assert "95.0%" in found.reason
    assert "0.3 mm" in found.reason
    assert verdict(competing=()).status == "accepted"


def test_a_free_rotation_is_named_in_the_verdict():
    free = {"free_axis": np.array([0.0, 0.0, 1.0])}
    found = verdict(uncertainty=free)
    assert found.status == "accepted"
    assert found.reason.endswith("; the rotation about the part's z is free by symmetry")
    doubt = verdict(inlier_share=0.65, uncertainty=free)
    assert doubt.status == "ambiguous"
    assert doubt.reason.endswith("is free by symmetry")


REJECTED = {
    "only 30 points": {"checked": np.arange(32)},
    "only 40% of the points lie on the part (within 0.3 mm)": {"inlier_share": 0.4},
    "30% of the points would have been seen through the part's material": {"violation_share": 0.3},
    "50% of the surface that the sensor should have seen between the measured points": {
        "missing_share": 0.5
    },
    "the points lie 3 mm off the surface": {"tolerance_mm": 9.0},
    "the scan is 7.0% larger than the CAD model: it is a part of another size": {
        "form": FormDeviation(scale_error=0.07, scale_sigma=0.001)
    },
}


@pytest.mark.parametrize("reason", REJECTED)
def test_each_fault_rejects_with_its_figure(reason):
    found = verdict(**REJECTED[reason])
    assert found.status == "rejected"
    assert reason in found.reason


def test_weak_support_is_no_certainty():
    """Another part that shares a corner fits 83 % of the points, 79 % of the surface."""
    assert verdict(inlier_share=0.83, unmeasured_share=0.15).status == "accepted"
    found = verdict(inlier_share=0.83, unmeasured_share=0.21)
    assert found.status == "ambiguous"
    assert "only 83% of the points" in found.reason
    assert "21% of the surface" in found.reason
    unknown = verdict(inlier_share=0.65, violation_share=np.nan, unmeasured_share=np.nan)
    assert unknown.status == "ambiguous"
    assert "surface" not in unknown.reason
    assert verdict(inlier_share=0.72, unmeasured_share=np.nan).status == "accepted"


def test_noise_is_doubtful_first_and_then_a_fault():
    limits = Limits()
    doubtful, fault = (3 * share * RADIUS for share in (limits.doubtful_noise, limits.most_noise))
    assert doubtful < fault
    assert verdict(tolerance_mm=doubtful - 1e-9).status == "accepted"
    found = verdict(tolerance_mm=doubtful + 1e-6)
    assert found.status == "ambiguous"
    assert "1.4 mm off the surface, 2.0% of the part's radius" in found.reason
    assert verdict(tolerance_mm=fault - 1e-9).status == "ambiguous"
    assert verdict(tolerance_mm=fault + 1e-6).status == "rejected"


def test_few_inliers_are_counted_not_shared():
    assert verdict(checked=np.arange(43), inlier_share=40 / 43).status == "accepted"
    found = verdict(checked=np.arange(43), inlier_share=39 / 43)
    assert found.status == "rejected"
    assert found.reason.startswith("only 39 points lie on the part")


def test_the_worst_fault_comes_first():
    found = verdict(inlier_share=0.1, violation_share=0.5, missing_share=0.9)
    assert found.reason.startswith("only 10% of the points")
    assert verdict(violation_share=0.5, missing_share=0.9).reason.startswith("50%")


def test_unknown_shares_do_not_count():
    """Without a sensor there is no violation and nothing unmeasured: NaN, and no fault."""
    found = verdict(violation_share=np.nan, unmeasured_share=np.nan, missing_share=np.nan)
    assert found.status == "accepted"


def other(preference: float, turn: float = 120.0, shift: float = 3.25) -> CompetingHypothesis:
    return CompetingHypothesis(preference, turn, shift, FAR.part_from_camera)


def test_another_pose_within_the_noise_is_ambiguous():
    found = verdict(competing=[FAR, other(1.0)])
    assert found.status == "ambiguous"
    assert "another pose" in found.reason
    assert "120.0 deg" in found.reason
    assert "3.25 mm" in found.reason


def test_the_nearest_other_pose_is_named_and_all_are_counted():
    found = verdict(competing=[other(3.0, 90), FAR, other(-0.5, 45), other(2.0, 60)])
    assert "3 other poses" in found.reason
    assert "45.0 deg" in found.reason


def test_another_pose_that_fits_better_is_called_so():
    limit = Limits().least_preference
    assert "another pose better: one is turned" in verdict(competing=[other(-limit - 0.1)]).reason
    assert "another pose nearly as well" in verdict(competing=[other(-limit)]).reason


def test_a_fault_outweighs_a_other():
    assert verdict(competing=[other(0.0)], inlier_share=0.1).status == "rejected"


@pytest.mark.parametrize(
    ("axis", "words"),
    [
        ([0.0, 0.0, 1.0], "the part's z"),
        ([-1.0, 0.0, 0.0], "the part's x"),
        ([0.0, 0.6, 0.8], "(0.00, 0.60, 0.80) in the part's frame"),
    ],
)
def test_a_weak_direction_is_ambiguous_and_named(axis, words):
    limits = Limits()
    along = block_diag(*[np.outer(axis, axis)] * 2)
    turn = {"weakest_rotation_axis": np.array(axis), "covariance": np.radians(2.5) ** 2 * along}
    found = verdict(uncertainty=turn)
    assert found.status == "ambiguous"
    assert f"is known to 4.9 deg only (95 %), least about {words}" in found.reason
    shift = np.diag([0, 0, 0, 1, 1, 1]) @ (1.25**2 * along)
    found = verdict(uncertainty={"weakest_translation_axis": np.array(axis), "covariance": shift})
    assert found.status == "ambiguous"
    assert f"is known to 2.4 mm only (95 %), least along {words}" in found.reason
    needed = np.repeat([np.radians(limits.tolerance_deg), limits.tolerance_mm], 3) / BOUND
    close = along * np.outer(0.99 * needed, 0.99 * needed)
    assert verdict(uncertainty={"covariance": close}).status == "accepted"


FORMS = [
    {"is_told": False},
    {"converged": False},
    {"unexplained_share": 0.08},
    {"beyond_edges_share": 0.012},
    {"field": "facing", "field_mm": 0.12},
    {"field": "form", "field_mm": 0.31},
    {"field": "displacement", "field_mm": 0.09, "field_length_mm": 0.2 * RADIUS},
]
WORDS = [
    "too little smooth surface was measured",
    "did not converge",
    "8% of the surface is not where the CAD model has it",
    "1.20% of the points lie beyond the part's edges",
    "offset by some 0.12 mm",
    "differs from its CAD model by 0.31 mm",
    "deviations change by 0.09 mm within",
]


@pytest.mark.parametrize(("form", "words"), zip(FORMS, WORDS, strict=True))
def test_a_form_that_no_model_explains_is_ambiguous(form, words):
    found = verdict(form=FormDeviation(**form))
    assert found.status == "ambiguous"
    assert words in found.reason


@pytest.mark.parametrize("form", [FORMS[3], FORMS[5]])
def test_what_moves_the_pose_by_less_than_the_job_needs_is_no_doubt(form):
    wide = Limits(tolerance_mm=5.0, tolerance_deg=5.0)
    assert verdict(form=FormDeviation(**form), limits=wide).status == "accepted"


def test_what_the_part_differs_by_is_named_with_its_figure():
    form = FormDeviation(stock_mm=0.5041, stock_sigma_mm=0.0012, field="form", field_mm=0.1)
    found = verdict(form=form)
    assert found.status == "accepted"
    assert "stock 0.504 +- 0.001 mm" in found.reason
    assert "the surface varies by 0.1 mm" in found.reason
    form = FormDeviation(scale_error=-0.0101, scale_sigma=0.0001, focal_error=0.003)
    found = verdict(form=form, uncertainty={"covariance": np.diag([0, 0, 0, 4.0, 0, 0])})
    assert found.status == "ambiguous"
    assert "1.010% +- 0.010% smaller than the CAD model" in found.reason
    assert "focal length is off by +0.300%" in found.reason
    assert "check the camera on a gauge" in found.reason


@pytest.mark.parametrize(
    ("limits", "case"),
    [
        (Limits(least_inlier_share=0.99), {}),
        (Limits(most_violation_share=0.001), {}),
        (Limits(most_missing_share=0.01), {}),
        (Limits(most_noise=0.001), {}),
        (Limits(doubtful_noise=0.001), {}),
        (Limits(doubtful_noise=0.03), {"tolerance_mm": 3 * 0.025 * RADIUS}),
        (Limits(least_inliers=2000), {}),
        (Limits(least_preference=30.0), {}),
        (Limits(tolerance_deg=1e-3), {}),
        (Limits(tolerance_mm=1e-3), {}),
        (Limits(least_support=0.99), {}),
        (Limits(least_support=0.5), {"inlier_share": 0.62}),
        (Limits(least_inlier_share=0.2, least_support=0.2), {"inlier_share": 0.3}),
        (Limits(most_violation_share=0.5), {"violation_share": 0.4}),
        (Limits(least_preference=-1.0), {"competing": [other(0.0)]}),
    ],
)
def test_limits_are_respected(limits, case):
    """Each turns the verdict that the defaults give."""
    before, after = verdict(**case), verdict(**case, limits=limits)
    assert (before.status == "accepted") != (after.status == "accepted")


def test_points_off_the_part_outweigh_other_poses():
    """Another part is seldom in one pose; of a crop the other poses are what counts."""
    assert verdict(inlier_share=0.65, competing=[other(0.0)]).reason.startswith("only 65%")
    half = verdict(inlier_share=0.78, unmeasured_share=0.36, competing=[other(0.0)])
    assert half.reason.startswith("only 78%")
    crop = verdict(inlier_share=0.97, unmeasured_share=0.4, competing=[other(0.0)])
    assert "another pose" in crop.reason
    crop = verdict(inlier_share=0.97, unmeasured_share=0.4)
    assert crop.reason.startswith("97% of the points lie on the part, and 40% of the surface")


REGION = MaterialRegion(True, 0.052, 364.0, np.array([12.4, -9.0, 11.0]), 14.2)
PLACE = "5.2% of the scan (some 360 mm^2 about (12, -9, 11) mm in the part's frame)"


@pytest.mark.parametrize(
    ("is_missing", "words"),
    [
        (True, f"{PLACE} was seen up to 14 mm deep through material of the CAD model"),
        (False, f"{PLACE} lies up to 14 mm outside the CAD model"),
    ],
)
def test_missing_and_extra_material_is_named_with_place_and_size(is_missing, words):
    regions = (dataclasses.replace(REGION, is_missing=is_missing),)
    accepted = verdict(regions=regions)
    assert accepted.status == "accepted"
    assert words in accepted.reason
    assert words in verdict(regions=regions, violation_share=0.3).reason  # rejected
    nowhere = verdict(regions=regions, inlier_share=0.4)  # no place is right at a wrong pose
    assert words not in nowhere.reason
