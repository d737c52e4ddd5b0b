"""The virtual casting line: cases that are what they say, and what is counted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from experiments.studies.castings.casting_line import (
    KINDS,
    MISSING_VOLUME,
    PAPER_CAMERA,
    PARTS,
    STOCK_MM,
    make_case,
    sought,
)
from experiments.studies.castings.report import HEAD, is_wrong, summarize, table
from experiments.studies.castings.study import (
    accuracy,
    beyond_by_chance,
    case_names,
    is_a_pitch_off,
    kept_rows,
    main,
    make_parser,
    nearest_error,
    times_cramer_rao,
)
from vanejax.errors import InputError
from vanejax.localization.pose_batch import stack
from vanejax.localization.pose_result import Uncertainty
from vanejax.localization.residuals import measurement_model
from vanejax.rigid import RigidTransform

# median and largest offset of a scan's smooth surface from the CAD model at the true pose, mm
OFFSETS = {
    "equal": (0.0, 0.2), "paper": (0.0, 0.5), "bend": (0.0, 0.2), "camera_scale": (0.0, 0.2),
    "size": (0.0, 0.2), "varying": (0.3, 0.6), "warped": (0.0, 0.5), "broken": (0.0, 0.2),
    "paper_varying": (0.3, 0.8),
}  # fmt: skip


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "crop"])
def test_a_case_is_reproducible_and_has_its_true_pose(kind: str) -> None:
    case, again = (make_case("l_bracket", kind, 1, 0) for _ in range(2))
    np.testing.assert_array_equal(case.points, again.points)
    other = make_case("l_bracket", kind, 2, 0)
    assert len(other.points) != len(case.points)
    assert len(case.points) > 3000
    assert case.calibration == (PAPER_CAMERA if "paper" in kind else None)
    if kind == "other_part":
        assert case.truth is None
        return
    points = case.points / (1 + case.scale_error)  # about the camera; the part's centre stays
    model = measurement_model(case.challenge.part, np.zeros(3))
    if kind == "size":  # about the part's centre
        center = case.truth.inverse().apply(case.challenge.part.center[None])
        points = center + (case.points - center) / (1 + case.scale_error)
    deviation = model.residuals(stack(case.truth), points).deviation_mm[0]
    if kind in OFFSETS:
        middle, most = OFFSETS[kind]
        assert np.median(deviation) == pytest.approx(middle, abs=0.15)
        assert np.percentile(np.abs(deviation), 80) < most
    if kind.endswith("stock"):
        assert STOCK_MM[0] < case.stock_mm < STOCK_MM[1]
        assert np.median(deviation) == pytest.approx(case.stock_mm, abs=0.1)
    if kind == "one_side":
        assert np.percentile(deviation, 10) < 0.1
        assert np.mean(np.abs(deviation - 1) < 0.1) > 0.05
    assert (case.scale_error != 0) == (kind in ("size", "camera_scale"))


def test_a_corner_is_missing() -> None:
    part = sought("bearing_block").part
    for seed in range(3):
        rng = np.random.default_rng(seed)
        rest = KINDS["broken"].cast(part, np.array([0, 0, 1.0]), rng).part
        low, high = MISSING_VOLUME
        assert low < 1 - rest.mesh.volume / part.mesh.volume < high


def test_vanes_are_cropped_along_the_ring() -> None:
    case = make_case("vane_4", "crop", 0, 0)
    span = np.ptp(case.truth.apply(case.points), axis=0) / case.challenge.part.extent_mm
    assert span[0] < 0.9
    assert span[0] < span[1:].min()


def test_any_right_pose_of_a_symmetric_part_counts() -> None:
    challenge = sought("elbow")
    assert len(challenge.symmetries) == 2
    truth = RigidTransform(Rotation.random(rng=np.random.default_rng(1)).as_matrix(), np.ones(3))
    for symmetry in challenge.symmetries:
        pose = RigidTransform.from_matrix(symmetry) @ truth
        np.testing.assert_allclose(nearest_error(challenge, pose, truth), 0, atol=1e-6)
    moved = RigidTransform(truth.rotation, truth.translation + 0.3 * np.eye(3)[0])
    error = nearest_error(challenge, moved, truth)
    assert np.linalg.norm(error[3:]) == pytest.approx(challenge.pose_error(moved, truth)[1])


def test_a_pitch_off_is_not_half_a_turn_off() -> None:
    challenge = sought("vane_4")
    truth = RigidTransform(Rotation.random(rng=np.random.default_rng(1)).as_matrix(), np.ones(3))
    two_pitches = RigidTransform.from_matrix(challenge.also_tried[-1]) @ truth
    assert is_a_pitch_off(challenge, two_pitches, truth)
    assert not is_a_pitch_off(challenge, truth, truth)
    half_a_turn = RigidTransform(np.diag([-1.0, -1, 1]), np.zeros(3)) @ truth
    assert not is_a_pitch_off(challenge, half_a_turn, truth)
    assert not is_a_pitch_off(sought("elbow"), half_a_turn, truth)


SIGMA = np.array([np.radians(0.1)] * 3 + [0.2] * 3)


def stated_by(sigma: np.ndarray) -> Uncertainty:
    """Three equal sigmas of rotation, rad, then what those of translation are, mm."""
    x, deg, mm = np.array([1.0, 0, 0]), np.degrees(sigma[:3]), sigma[3:]
    weakest = x, deg.max(), x, mm.max()
    return Uncertainty(np.diag(sigma**2), np.zeros(3), deg, mm, *weakest)


def test_an_error_is_compared_with_its_covariance() -> None:
    found = accuracy(SIGMA * [1, -1, 0, 1, 1, 3], stated_by(SIGMA))
    assert found["squared"] == pytest.approx(13 / 6)
    assert found["covered"] == pytest.approx(5 / 6)
    assert found["rotation_over_bound"] == pytest.approx(np.sqrt(2 / chi2.ppf(0.95, 3)))
    assert found["over_sigma"] == pytest.approx(np.sqrt(11))
    assert found["translation_mm"] == pytest.approx(0.2 * np.sqrt(11))


def test_what_chance_does_to_magnitudes() -> None:
    found = beyond_by_chance(stated_by(SIGMA))  # three axes that are known equally well
    assert found == pytest.approx(1 - chi2.cdf(9, 3) ** 2, abs=0.003)
    one_axis = stated_by(SIGMA * [1, 1e-3, 1e-3, 1, 1e-3, 1e-3])
    assert beyond_by_chance(one_axis) == pytest.approx(2 * 0.0027, abs=0.001)
    assert beyond_by_chance(one_axis) == beyond_by_chance(one_axis)


def test_an_error_is_compared_with_the_least_possible() -> None:
    case = make_case("elbow", "equal", 0, 0)  # that has two right poses
    assert times_cramer_rao(case, case.truth) == pytest.approx(0, abs=1e-6)
    for symmetry in case.challenge.symmetries:
        pose = RigidTransform.from_matrix(symmetry) @ case.truth
        off = [
            RigidTransform(pose.rotation, pose.translation + mm * np.array([1.0, 0, 0]))
            for mm in (0.001, 0.002)
        ]
        once, twice = (times_cramer_rao(case, each) for each in off)
        assert 0.1 < once < 10  # a micrometre is about what thousands of points of 0.1 mm tell
        assert twice == pytest.approx(2 * once, rel=1e-6)


def row(
    kind: str,
    verdict: str,
    *,
    mm: float = 0.1,
    over: float = 0.5,
    deg: float = 0.1,
    squared: float = 1.0,
) -> dict:
    after = {
        "rotation_deg": deg, "translation_mm": mm, "squared": squared, "covered": 1.0,
        "rotation_over_bound": 0.1, "translation_over_bound": over, "over_sigma": 2 * over,
        "beyond_by_chance": 0.01,
    }  # fmt: skip
    if kind == "other_part":
        after = None
    before = after and {**after, "translation_mm": 10 * mm, "covered": 0.5}
    return {
        "part": "elbow", "kind": kind, "number": 0, "verdict": verdict, "reason": "so",
        "listed": after is not None, "after": after, "before": before, "seconds": 2.0,
    }  # fmt: skip


def test_what_is_counted() -> None:
    rows = [
        row("equal", "accepted"),
        row("equal", "accepted", mm=0.3),
        row("stock", "accepted", mm=1.1),  # beyond the need
        row("stock", "accepted", squared=21 / 6),  # beyond what it says
        row("stock", "ambiguous", deg=90.0, mm=30.0),  # wrong, and not accepted
        row("other_part", "rejected"),
    ]
    assert [is_wrong(r) for r in rows] == [False, False, True, True, True, True]
    report = summarize(rows)
    equal, stock = report["kinds"]["equal"], report["kinds"]["stock"]
    assert (equal["cases"], equal["accepted"], equal["accepted_wrong"]) == (2, 2, 0)
    assert equal["after"]["translation_mm"] == pytest.approx({"median": 0.2, "mean": 0.2})
    assert equal["before"]["covered"]["mean"] == 0.5
    assert (stock["accepted_wrong"], stock["ambiguous"], stock["found"]) == (2, 1, 2)
    assert report["all"]["accepted_wrong"] == len(report["accepted_wrong"]) == 2
    assert report["kinds"]["other_part"]["rejected"] == 1
    assert list(report["kinds"]) == ["equal", "stock", "other_part"]
    assert table(report).count("- accepted and wrong") == 2


def test_three_sigma_are_counted_beside_what_chance_gives() -> None:
    rows = [row("equal", "accepted", over=over) for over in (0.1, 1.01, 1.6)]
    summary = summarize(rows)["all"]
    assert (summary["accepted_wrong"], summary["accepted_beyond"]) == (0, 1)
    assert summary["within_bounds_accepted"] == pytest.approx([1, 1 / 3])
    for each, ratio in zip(rows, (0.8, 1.0, 2.0), strict=True):
        each["after"] |= {"times_cramer_rao": ratio}
    text = table({"rows": rows})
    assert "| 1 (0.03) |" in text
    assert "100.0% and 33.3% of the accepted poses" in text
    assert "1.37 times the Cramér-Rao bound (root mean square of 3; median 1.00)" in text


def test_crops_are_counted() -> None:
    right = row("crop", "accepted")
    pitch = row("crop", "accepted", deg=7.2, mm=30.0) | {"pitch_off": True, "listed": True}
    text = table({"rows": [right, right, pitch]})
    assert "of 3, 3 are accepted, 1 of these a pitch off; the right pose is first in 2, " in text
    assert "competing ones in 3" in text
    assert "accepted and wrong" in text.rpartition("- ")[2]


def test_the_table_is_narrow() -> None:
    assert len(HEAD) <= 14


def test_there_are_enough_cases() -> None:
    settings = make_parser().parse_args([])
    names = case_names(settings.views, settings.parts, settings.kinds)
    assert len(set(names)) == len(names)
    crops = [name for name in names if name.kind == "crop"]
    assert len(crops) >= 100
    assert len(names) - len(crops) >= 400
    # of more views, the first cases are those of fewer
    assert case_names(1, settings.parts, settings.kinds) == names[: len(names) // settings.views]


def test_a_record_is_gone_on_with_if_the_source_is_the_same(tmp_path: Path) -> None:
    head = {"seed": 0, "commit": "abc", "versions": {"numpy": "2"}}
    path = tmp_path / "castings.json"
    assert kept_rows(path, head) == {}
    path.write_text(json.dumps(head | {"rows": [row("equal", "accepted")]}))
    assert kept_rows(path, head) == {("elbow", "equal", 0): row("equal", "accepted")}
    for other in ({"commit": "abd"}, {"seed": 1}, {"versions": {"numpy": "3"}}, {"commit": None}):
        assert kept_rows(path, head | other) == {}
    changed = head | {"commit": "abc+"}  # by what, no commit says
    path.write_text(json.dumps(changed | {"rows": [row("equal", "accepted")]}))
    assert kept_rows(path, changed) == {}


@pytest.mark.slow
def test_the_study_runs(tmp_path: Path) -> None:
    words = ["--views", "1", "--parts", "l_bracket", "--kinds", "equal,other_part,crop"]
    reports = [
        main(make_parser().parse_args([*words, "--jobs", jobs, "--out", str(tmp_path / jobs)]))
        for jobs in ("1", "2")
    ]
    for report in reports:
        for each in report["rows"]:
            assert each.pop("cpu_seconds") > 0
            del each["seconds"]
    assert reports[0]["rows"] == reports[1]["rows"]
    assert len(json.loads((tmp_path / "1" / "castings.json").read_text())["rows"]) == 2
    assert (tmp_path / "1" / "castings.png").stat().st_size > 10_000
    assert (report["all"]["cases"], report["all"]["accepted_wrong"]) == (2, 0)
    equal = report["rows"][0]
    assert equal["verdict"] == "accepted"
    assert equal["after"]["translation_mm"] < 0.05
    assert equal["after"]["times_cramer_rao"] < 3


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    parser = make_parser()
    for words, message in ((["--parts", "spoon"], "no part spoon"), (["--kinds", "x"], "no kind")):
        with pytest.raises(InputError, match=message):
            main(parser.parse_args([*words, "--out", str(tmp_path)]))
    assert parser.parse_args([]).parts == list(PARTS)
