"""The study of verdicts: ROC against brute force, wrong poses that are wrong, the judge's steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.studies.verdicts import study
from experiments.studies.verdicts.challenge_parts import VANE, challenge_parts, names_of_parts
from experiments.studies.verdicts.report import area_under_roc, picture, roc, summarize, table
from experiments.studies.verdicts.study import OTHER_PART, RIGHT, other_parts
from experiments.studies.verdicts.wrong_poses import (
    MOST_POINTS,
    SENSORS,
    WHITE_MM,
    PosedScan,
    posed_scan,
    wrong_poses,
)
from vanejax.errors import InputError
from vanejax.localization import RayCasting, assess, measurement_model, refine, register
from vanejax.localization.pose_batch import stack
from vanejax.scans import MeasuredScan


@pytest.fixture(scope="module")
def parts():
    return challenge_parts([VANE, "pump_housing"])


@pytest.fixture(scope="module")
def model(parts) -> RayCasting:
    return measurement_model(parts[VANE].part, np.zeros(3))


@pytest.fixture(scope="module")
def scan(parts, model: RayCasting) -> PosedScan:
    return posed_scan(VANE, parts[VANE], model.scanner, "white", 0)


@pytest.mark.parametrize("seed", range(2))
def test_the_area_counts_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    right, wrong = rng.integers(2, 9, 13).astype(float), rng.integers(0, 7, 22).astype(float)
    pairs = [(r > w) + 0.5 * (r == w) for r in right for w in wrong]
    assert area_under_roc(right, wrong) == pytest.approx(np.mean(pairs))
    # and is the area under the curve, with straight lines through ties
    false_accepts, true_accepts = roc(right, wrong)
    assert np.trapezoid(true_accepts, false_accepts) == pytest.approx(np.mean(pairs))
    assert (np.diff(false_accepts) >= 0).all()
    assert (np.diff(true_accepts) >= 0).all()
    assert (false_accepts[0], true_accepts[0]) == (0, 0)
    assert (false_accepts[-1], true_accepts[-1]) == (1, 1)


def test_infinite_figures_have_their_rank() -> None:
    assert area_under_roc(np.array([np.inf, 2.0]), np.array([1.0, -np.inf])) == 1.0


@pytest.mark.parametrize("sensor", SENSORS)
def test_scans_lie_on_the_part(parts, model: RayCasting, sensor: str) -> None:
    one = posed_scan(VANE, parts[VANE], model.scanner, sensor, 3)
    again = posed_scan(VANE, parts[VANE], model.scanner, sensor, 3)
    np.testing.assert_array_equal(one.points, again.points)
    assert 800 < len(one.points) <= MOST_POINTS
    assert one.is_right(one.truth)
    batch = stack(one.truth)
    deviation = np.abs(model.residuals(batch, one.points).deviation_mm[0])
    # white noise at the normal is smaller by the cosine; a depth camera is 1 to 2 mm off
    most = {"white": WHITE_MM, "depth_camera": 3.0}.get(sensor, 0.2)
    assert np.median(deviation) < most


def test_wrong_poses_are_wrong(scan: PosedScan) -> None:
    kinds = []
    for kind, pose in wrong_poses(scan, np.random.default_rng(0)):
        kinds.append(kind)
        assert not scan.is_right(pose), kind
    assert set(kinds) >= {"one pitch off", "upside down", "turned"}
    assert (kinds.count("one pitch off"), kinds.count("upside down")) == (2, 3)


def test_a_pitch_is_the_distance_of_the_vanes(scan: PosedScan) -> None:
    starts = wrong_poses(scan, np.random.default_rng(0))
    errors = [scan.error(pose) for kind, pose in starts if kind == "one pitch off"]
    assert errors
    for turn, shift in errors:
        assert turn == pytest.approx(360 / 54, abs=1e-6)
        # the part's centre is at mid-span: 300 mm from the engine's axis, within the rails' height
        assert shift == pytest.approx(300 * np.radians(360 / 54), rel=0.05)


def test_a_part_is_never_sought_in_its_own_scan_or_its_neighbours() -> None:
    names = (VANE, *names_of_parts())
    for place, name in enumerate(names):
        others = other_parts(place, names)
        assert len(others) == 2
        near = {names[place - 1], name, names[(place + 1) % len(names)]}
        assert not near & set(others)
    assert other_parts(0, ["only"]) == []
    assert other_parts(1, ["one", "two"]) == ["one"]


def test_a_pose_is_judged_as_register_judges_it(parts, model: RayCasting, scan: PosedScan) -> None:
    """The same tolerance, shares and verdict: this study calibrates what is used."""
    measured = MeasuredScan(scan.points, None, np.zeros(3), "scan")
    result = register(measured, parts[VANE].part)
    again = refine(model, scan.points, result.part_from_camera)
    found = assess(model, scan.points, again, stack(again.part_from_camera))
    theirs, mine = result.verification, found.verification
    # the pose moves by a fraction of its noise when refined once more
    assert mine.tolerance_mm == pytest.approx(theirs.tolerance_mm, rel=1e-2)
    assert mine.inlier_share == pytest.approx(theirs.inlier_share, abs=2e-3)
    assert mine.violation_share == pytest.approx(theirs.violation_share, abs=2e-3)
    assert mine.unmeasured_share == pytest.approx(theirs.unmeasured_share, abs=5e-3)
    assert mine.score == pytest.approx(theirs.score, abs=1e-2)
    assert found.verdict.status == result.verdict.status == "accepted"
    assert found.competing == ()


def test_competing_hypotheses_count(model: RayCasting, scan: PosedScan) -> None:
    ends = [
        refine(model, scan.points, pose)
        for kind, pose in wrong_poses(scan, np.random.default_rng(0))
        if kind == "upside down"
    ]
    wrong = next(end for end in ends if not scan.is_right(end.part_from_camera))
    true = refine(model, scan.points, scan.truth)
    poses = stack(true.part_from_camera, wrong.part_from_camera)
    right, off = (assess(model, scan.points, end, poses) for end in (true, wrong))
    assert right.verdict.status == "accepted"
    assert off.verdict.status != "accepted"
    assert right.competing[0].preference > 4
    assert off.competing[0].preference < 0


def judged(kind: str, score: float, verdict: str, *, right: bool = False) -> dict:
    return {
        "part": "p", "sensor": "white", "kind": kind, "right": right, "rotation_deg": 1.0,
        "translation_mm": 1.0, "score": score, "inlier_share": score, "violation_share": 1 - score,
        "unmeasured_share": 0.5, "preference": np.inf if right else -3.0, "tolerance_mm": 0.3,
        "verdict": verdict, "verdict_alone": "accepted", "reason": "so",
    }  # fmt: skip


def run(verdict: str, *, right: bool, listed: bool = False) -> dict:
    return {
        "part": "p", "sensor": "white", "right": right, "right_listed": listed,
        "rotation_deg": 1.0, "translation_mm": 1.0, "verdict": verdict, "reason": "so",
        "seconds": 1.0,
    }  # fmt: skip


def test_what_is_reported() -> None:
    poses = [
        judged(RIGHT, 0.9, "accepted", right=True),
        judged(RIGHT, 0.6, "ambiguous", right=True),
        judged("turned", 0.7, "rejected"),
        judged("turned", 0.2, "rejected"),
        judged(OTHER_PART, 0.3, "accepted") | {"sought": "gear"},
    ]
    runs = [
        run("accepted", right=True),
        run("accepted", right=False),
        run("ambiguous", right=False, listed=True),
        run("ambiguous", right=False),
        run("rejected", right=False),
    ]
    report = summarize(poses, runs)
    assert report["poses"] == {"right": 2, "wrong": 3, "truth_lost": 0}
    score = report["figures"]["score"]
    assert score["auc"] == pytest.approx(5 / 6)
    assert score["true_accepts_at_no_false"] == 0.5
    # 0.9 and 0.6 against 0.7, 0.3 and 0.2: up, across, up, across
    assert score["curve"] == [[0.0, 0.0, 0.3333, 0.3333, 1.0], [0.0, 0.5, 0.5, 1.0, 1.0]]
    assert [row["kind"] for row in report["accepted_wrong"]] == [OTHER_PART]
    assert score["auc_by_kind"] == pytest.approx({"turned": 0.75, OTHER_PART: 1.0})
    # fewer violations are better, equal figures tell nothing
    assert report["figures"]["violation_share"]["auc"] == pytest.approx(5 / 6)
    assert report["figures"]["unmeasured_share"]["auc"] == 0.5
    assert report["verdicts_by_kind"]["turned"] == {
        "accepted": 0, "ambiguous": 0, "rejected": 2, "accepted_alone": 2,
    }  # fmt: skip
    assert report["verdicts_by_sensor"]["white"]["wrong"]["accepted"] == 1
    assert report["register"]["white"] == {
        "accepted_right": 1,
        "accepted_wrong": 1,
        "ambiguous": 2,
        "ambiguous_right_not_given": 1,
        "rejected_right": 0,
        "rejected_wrong": 1,
    }
    words = table(report)
    assert "ACCEPTED AND WRONG: p, white: taken for gear" in words
    assert "ACCEPTED AND WRONG: p, white: register, 1.00 deg, 1.00 mm off" in words
    assert "verification score" in words
    picture(report).canvas.draw()


@pytest.mark.slow
def test_the_study_runs(record, tmp_path: Path, capsys) -> None:
    report = record(study, "verdicts", "--parts", "box,wedge", "--sensors", "white")
    assert (tmp_path / "verdicts.png").stat().st_size > 10_000
    assert report["poses"]["right"] == 2
    assert report["poses"]["wrong"] > 4
    assert report["verdicts_by_kind"][OTHER_PART]["accepted"] == 0
    assert sum(count["accepted_wrong"] for count in report["register"].values()) == 0
    assert "register, no guess" in capsys.readouterr().out


def test_unknown_names_are_refused(record) -> None:
    with pytest.raises(InputError, match="no sensor lidar"):
        record(study, "verdicts", "--sensors", "lidar")
    with pytest.raises(InputError, match="no challenge part"):
        record(study, "verdicts", "--parts", "spoon")
