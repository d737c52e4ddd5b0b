"""A mirrored part and one of another size are called that, and no right part is."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
from example_result import example_result
from example_scans import box, disturbed, measured_points, model, motion, random_view, vane

from vanejax.cad.part import load_part
from vanejax.localization import misfit, registration
from vanejax.localization.pose_result import FormDeviation, PoseResult, Verdict
from vanejax.localization.registration import register
from vanejax.localization.verdict import Limits
from vanejax.rigid import RigidTransform
from vanejax.scans import MeasuredScan, clean_scan, load_scan

CASES = Path(__file__).parents[3] / "shared" / "cases" / "castings"


@functools.cache
def scan_of_vane() -> tuple[MeasuredScan, RigidTransform]:
    points, truth = measured_points(vane(), random_view(vane(), 1))
    return clean_scan(points, sensor_origin=np.zeros(3)), truth


def test_the_mirror_image_is_found_where_the_part_does_not_fit():
    scan, _ = scan_of_vane()
    found = misfit.mirror_image(model(vane()), misfit.times(scan, -1), own_support=0.6)
    points = scan.points  # mirrored twice
    assert misfit.support(model(vane()), found.pose(0), points) > 0.9
    assert misfit.mirror_image(model(vane()), scan, own_support=0.6) is None  # of the right part


@pytest.mark.parametrize("size", [0.9, 25.4])
def test_the_size_is_found_that_fits(size):
    scan, _ = scan_of_vane()
    large = misfit.times(scan, size)
    seen = dataclasses.replace(model(vane()), sensor_origin=large.sensor_origin)
    factor, candidates = misfit.other_size(seen, large, own_support=0.6)
    assert factor * size == pytest.approx(1, abs=0.005)
    assert misfit.support(model(vane()), candidates.pose(0), factor * large.points) > 0.9


def test_a_part_of_its_size_is_of_no_other():
    assert misfit.other_size(model(vane()), scan_of_vane()[0], own_support=0.6) is None


SAID = {
    -1.0: "the scan fits the mirror image of the CAD model: 75% of the points lie on that",
    1 / 0.9: "the scan is 10.0% smaller than the CAD model: 75% of the points lie on a part of",
    1 / 25.4: "the scan is 25.4 times as large as the CAD model: 75%",
    1000.0: "the scan is 1/1000 times as large as the CAD model: 75%",
}


@pytest.mark.parametrize("factor", SAID)
def test_what_is_said_has_the_figures(factor):
    said = misfit.in_words(factor, example_result(), example_result("rejected"))
    assert said.startswith(SAID[factor])
    assert "75% on the part itself (within 0.31 mm)" in said


def named(factor: float) -> Verdict:
    """What is said of a vane that is ``factor`` times as large, or mirrored."""
    scan, truth = scan_of_vane()
    # a guess, so that only the other shapes are sought among all rotations
    away = factor * (truth.translation - vane().center)
    guess = RigidTransform(truth.rotation, vane().center + away)
    return register(misfit.times(scan, factor), vane(), init=guess, segment="off").verdict


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (-1, "the scan fits the mirror image of the CAD model: 99%"),
        (0.9, "the scan is 10.0% smaller than the CAD model"),
        (1.07, "the scan is 7.0% larger than the CAD model"),
        (25.4, "the scan is 25.4 times as large as the CAD model"),
        (1 / 25.4, "the scan is 1/25.4 times as large as the CAD model"),
    ],
)
def test_another_shape_is_called_that_and_rejected(factor, words):
    found = named(factor)
    assert found.status == "rejected"
    assert words in found.reason


@pytest.mark.slow
def test_a_right_part_is_never_called_another():
    """Here it is rejected for a guess that leads nowhere: elsewhere the scan fits it well."""
    scan, truth = scan_of_vane()
    far = motion(vane(), np.array([0.0, 180.0, 0.0]), np.zeros(3)) @ truth
    result = register(scan, vane(), init=far, segment="off")
    assert result.verdict.status != "accepted"
    assert "other shapes" in result.seconds
    assert "mirror" not in result.verdict.reason
    assert "than the CAD model" not in result.verdict.reason


def test_an_accepted_scan_pays_nothing(monkeypatch):
    monkeypatch.setattr(registration, "_other_shapes", None)
    scan, truth = scan_of_vane()
    init = disturbed(vane(), truth, 2, 2, seed=0)
    assert register(scan, vane(), init=init).verdict.status == "accepted"


def test_a_part_that_is_its_own_mirror_image_is_never_called_mirrored():
    assert misfit.is_own_mirror_image(box())
    assert not misfit.is_own_mirror_image(vane())
    points, _ = measured_points(box(), random_view(box(), 5))
    scan = clean_scan(points, sensor_origin=np.zeros(3))
    assert misfit.mirror_image(model(box()), scan, own_support=0.0) is None


def ambiguous(**checks) -> PoseResult:
    """With figures of its verification."""
    result = example_result("ambiguous")
    checks = {"tolerance_mm": 0.3, "inlier_share": 0.95} | checks
    verification = dataclasses.replace(result.verification, **checks)
    return dataclasses.replace(result, verification=verification)


def test_what_leaves_much_open_fits_badly():
    def fits_badly(result: PoseResult) -> bool:
        return misfit.fits_badly(result, vane(), Limits())

    assert fits_badly(example_result("rejected"))
    assert not fits_badly(example_result("accepted"))
    assert not fits_badly(ambiguous())
    assert fits_badly(ambiguous(inlier_share=0.65))
    assert not fits_badly(ambiguous(unmeasured_share=0.5))  # a crop that lies on the part
    assert fits_badly(ambiguous(tolerance_mm=0.07 * vane().radius))
    large = FormDeviation(scale_error=0.07)  # it is named in the verdict already
    result = ambiguous(inlier_share=0.95, unmeasured_share=0.0)
    refinement = dataclasses.replace(result.refinement, form=large)
    verdict = Verdict("rejected", "the scan is 7.0% larger")
    result = dataclasses.replace(result, refinement=refinement, verdict=verdict)
    assert not fits_badly(result)
    for form in (FormDeviation(converged=False), FormDeviation(unexplained_share=0.06)):
        result = ambiguous()
        refinement = dataclasses.replace(result.refinement, form=form)
        assert fits_badly(dataclasses.replace(result, refinement=refinement))


@pytest.mark.slow
@pytest.mark.parametrize("scan", ["clean.ply", "cast.ply"])
def test_the_mirrored_bracket_is_called_that_with_and_without_stock(scan):
    if not CASES.exists():
        pytest.skip("shared/cases/castings is not there")
    part = load_part(CASES / "bracket_mirrored.stl", units="mm")
    result = register(load_scan(CASES / scan, units="mm"), part)
    assert result.verdict.status == "rejected"
    assert "fits the mirror image of the CAD model" in result.verdict.reason


def test_another_shape_that_fits_poorly_too_is_not_named(monkeypatch):
    """As of another part: its mirror image may fit a little better, and is as wrong."""
    scan, truth = scan_of_vane()
    poor = ambiguous(inlier_share=0.65, unmeasured_share=0.0)
    rejected = dataclasses.replace(ambiguous(inlier_share=0.5), verdict=Verdict("rejected", "so"))
    tried = []

    def localize(model, scan, candidates, task) -> PoseResult:
        tried.append(scan)
        return rejected if len(tried) == 1 else poor

    monkeypatch.setattr(registration, "_localize", localize)
    monkeypatch.setattr(registration, "_other_shapes", lambda *_: [(-1.0, scan, None)])
    result = register(scan, vane(), init=truth, segment="off")
    assert len(tried) == 2
    assert result.verdict.reason == "so"
