"""The study of random rotations: rays stay rays, and what is counted."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.runner.vane_views import VaneViews
from experiments.studies.any_pose import study as any_pose
from experiments.studies.any_pose.study import summarize, table, turned_scan
from vanejax.errors import InputError
from vanejax.localization.pose_batch import stack
from vanejax.scanner import Camera


@pytest.fixture(scope="module")
def views() -> VaneViews:
    return VaneViews(camera=Camera().scaled(0.25))


def test_a_turned_scan_is_one_that_a_turned_sensor_would_take(views: VaneViews) -> None:
    turn = Rotation.random(rng=np.random.default_rng(1)).as_matrix()
    scan, truth = turned_scan(views, 40, turn, noise_mm=0.1, rng=np.random.default_rng(2))
    still, untouched = turned_scan(views, 40, np.eye(3), noise_mm=0.1, rng=np.random.default_rng(2))
    np.testing.assert_allclose(truth.apply(scan.points), untouched.apply(still.points), atol=1e-9)
    assert (scan.sensor_origin == 0).all()
    now = views.model.residuals(stack(truth), scan.points)
    along = now.deviation_mm[0] / now.cosine[0]
    assert now.hit.mean() > 0.99
    # the noise, along the ray
    assert np.std(along[now.hit[0]]) == pytest.approx(0.1, rel=0.05)


def row(number: int, verdict: str, *, right: bool) -> dict:
    return {
        "number": number, "view": 0, "rotation_deg": 0.01 if right else 90.0,
        "translation_mm": 0.01, "right": right, "verdict": verdict, "reason": "so", "score": 0.9,
        "points": 10, "seconds": 2.0, "stages": {"search": 1.0} if number else {"match": 1.5},
    }  # fmt: skip


def test_what_is_wrong_is_counted_and_listed() -> None:
    rows = [row(n, "accepted", right=True) for n in range(99)]
    good = summarize([*rows, row(99, "rejected", right=False)])
    assert (good["right"], good["accepted_wrong"], good["wrong"]) == (0.99, 0, [99])
    assert good["verdicts"]["rejected"] == {"right": 0, "wrong": 1}
    assert good["stages"]["match"] == {"median": 0.0, "min": 0.0, "max": 1.5}
    words = table(good)
    assert "wrong: number 99, view 0: 90.000 deg" in words
    assert words.splitlines()[-1].startswith("met")
    bad = summarize([*rows, row(99, "accepted", right=False)])
    assert bad["accepted_wrong"] == 1
    assert table(bad).splitlines()[-1].startswith("MISSED")
    few = summarize([row(0, "accepted", right=True), row(1, "ambiguous", right=False)])
    assert table(few).splitlines()[-1].startswith("MISSED")


def test_the_command_writes_what_it_found(views: VaneViews, record, monkeypatch) -> None:
    monkeypatch.setattr(any_pose, "VaneViews", lambda: views)
    report = record(any_pose, "any_pose", "--count", "1")
    (row,) = report["rows"]
    assert row["right"]
    assert row["verdict"] == "accepted"
    assert row["rotation_deg"] < 0.05
    assert row["view"] == views.select("test")[0]
    assert set(row["stages"]) >= {"search", "refine", "verify"}
    assert report["method"].endswith("no training")
    with pytest.raises(InputError, match=r"no_such\.npz"):
        record(any_pose, "any_pose", "--weights", "no_such.npz")
