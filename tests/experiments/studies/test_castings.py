"""The virtual casting line: cases that are what they say, and what is counted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.studies.castings.casting_line import (
    KINDS,
    MISSING_VOLUME,
    PAPER_CAMERA,
    PARTS,
    STOCK_MM,
    make_case,
    sought,
)
from experiments.studies.castings.report import is_wrong, picture, summarize, table
from experiments.studies.castings.study import accuracy, main, make_parser, nearest_error
from vanejax.errors import InputError
from vanejax.localization.pose_batch import stack
from vanejax.localization.pose_result import BOUND, Uncertainty
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


def test_an_error_is_compared_with_its_covariance() -> None:
    sigma = np.array([np.radians(0.1)] * 3 + [0.2] * 3)
    x = np.array([1.0, 0, 0])
    stated = Uncertainty(
        np.diag(sigma**2), np.zeros(3), np.full(3, 0.1), np.full(3, 0.2), x, 0.1, x, 0.2
    )
    found = accuracy(sigma * [1, -1, 0, 1, 1, 3], stated)
    assert found["squared"] == pytest.approx(13 / 6)
    assert found["covered"] == pytest.approx(5 / 6)
    assert found["rotation_over_bound"] == pytest.approx(np.sqrt(2) / BOUND)
    assert found["translation_mm"] == pytest.approx(0.2 * np.sqrt(11))


def row(kind: str, verdict: str, *, mm: float = 0.1, over: float = 0.5, deg: float = 0.1) -> dict:
    after = {
        "rotation_deg": deg, "translation_mm": mm, "squared": 1.0, "covered": 1.0,
        "rotation_over_bound": 0.1, "translation_over_bound": over,
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
        row("stock", "accepted", over=3.1 / BOUND),  # beyond what it says
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


@pytest.mark.slow
def test_the_study_runs(tmp_path: Path) -> None:
    words = ["--views", "1", "--parts", "l_bracket", "--kinds", "equal,other_part,crop"]
    report = main(make_parser().parse_args([*words, "--out", str(tmp_path)]))
    assert json.loads((tmp_path / "castings.json").read_text()) == report
    assert (tmp_path / "castings.png").stat().st_size > 10_000
    assert (report["all"]["cases"], report["all"]["accepted_wrong"]) == (2, 0)
    assert report["rows"][0]["verdict"] == "accepted"
    assert report["rows"][0]["after"]["translation_mm"] < 0.05
    assert table(report).count("\n| ") == 3
    picture(report).canvas.draw()


def test_unknown_names_are_refused(tmp_path: Path) -> None:
    parser = make_parser()
    for words, message in ((["--parts", "spoon"], "no part spoon"), (["--kinds", "x"], "no kind")):
        with pytest.raises(InputError, match=message):
            main(parser.parse_args([*words, "--out", str(tmp_path)]))
    assert parser.parse_args([]).parts == list(PARTS)
