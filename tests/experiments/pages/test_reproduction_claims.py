"""Verdicts follow the figures, and what is missing is said to be."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from example_position import stand_record

from experiments.pages.reproduction.claim import Claim, Verdict, digits
from experiments.pages.reproduction.document import TOPICS, document, to_markdown
from experiments.pages.reproduction.studies import BY_RECORD

CLAIMS = [claim for topic in TOPICS.values() for claim in topic.claims]


def claim(words: str) -> Claim:
    (found,) = [claim for claim in CLAIMS if words in claim.says]
    return found


def series(results: dict[str, Any], name: str) -> dict[str, Any]:
    return next(s for s in results["robustness"]["series"] if s["name"] == name)


def set_method(results: dict[str, Any], name: str, measure: str, value: float) -> None:
    method = next(m for m in results["comparison"]["methods"] if m["name"] == name)
    method["alone"]["summary"][measure]["mean"] = value


def raise_changes(results: dict[str, Any]) -> None:
    for sweep in results["density"]["sweeps"]:
        changes = sweep["rmse_mm"]["coarsest_over_finest"]
        changes[:] = [1.0] * len(changes)


def lower_k(results: dict[str, Any]) -> None:
    for point in results["ablation_neighbors"]["points"]:
        best = point["overrides"]["model.num_neighbors"] == 32
        for name in ("rotation_error_deg", "translation_error_mm"):
            point["tests"]["own"][name]["mean"]["mean"] = 0.1 if best else 2.0


def spoil_light(results: dict[str, Any]) -> None:
    series(results, "light")["steps"][-1]["rows"][0]["robust"]["refined"]["rotation_deg"] = 0.7


def far_ffmde(results: dict[str, Any], value: float, truth: float) -> None:
    for step in series(results, "distance")["steps"]:
        for row in step["rows"]:
            row["robust"]["refined"]["ffmde_abs_mm"] = value
            row["truth"]["ffmde_abs_mm"] = truth


CHANGES = {
    "RMSE does not fall": ("RMSE falls", raise_changes, Verdict.MISSED),
    "another method is first": (
        "best of the seven",
        lambda r: [set_method(r, "icp", name, 1e-3) for name in
                   ("ffmde_abs_mm", "rmse_mm", "rotation_error_deg", "translation_error_mm")],
        Verdict.MISSED,
    ),
    "RPM-Net is first in all": (
        "best of the seven", lambda r: set_method(r, "rpmnet", "rmse_mm", 0.1), Verdict.MET,
    ),
    "nine tenths": (
        "in place of ModelNet40",
        lambda r: r["public_vs_virtual"]["hardest_views"]["reduction"].update(combined=0.9),
        Verdict.MET,
    ),
    "public shapes are better": (
        "in place of ModelNet40",
        lambda r: r["public_vs_virtual"]["hardest_views"]["reduction"].update(combined=-0.1),
        Verdict.MISSED,
    ),
    "k = 32 is best": ("k = 32", lower_k, Verdict.MET),
    "one scan in light is off": ("over strong light", spoil_light, Verdict.MISSED),
    "FFMDE tells, and is better": (
        "mean FFMDE over the distances", lambda r: far_ffmde(r, 0.3, 0.1), Verdict.BETTER,
    ),
    "FFMDE tells, and is worse": (
        "mean FFMDE over the distances", lambda r: far_ffmde(r, 0.5, 0.1), Verdict.MISSED,
    ),
    "FFMDE is the floor": (
        "mean FFMDE over the distances", lambda r: far_ffmde(r, 0.2, 0.19), Verdict.INCOMPARABLE,
    ),
    "beyond the bound": (
        "Cramer-Rao",
        lambda r: r["fine"]["levels"][0]["rotation_deg"].update(ratio=1.5),
        Verdict.MISSED,
    ),
    "a wrong pose is accepted": (
        "that the verdict accepts",
        lambda r: r["verdicts"]["verdicts_by_sensor"]["white"]["wrong"].update(accepted=1),
        Verdict.MISSED,
    ),
    "a real scan is lost": (
        "real depth-camera scans", lambda r: r["real_scans"].update(right=14), Verdict.MISSED,
    ),
    "slower than the paper": (
        "time of one registration",
        lambda r: next(m for m in r["comparison"]["methods"] if m["name"] == "rpmnet")["alone"][
            "summary"]["time_s"].update(median=5.0),
        Verdict.MISSED,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_a_verdict_follows_from_the_figures(name, results) -> None:
    words, change, expected = CHANGES[name]
    before = claim(words).finding(results)
    changed = copy.deepcopy(results)
    change(changed)
    after = claim(words).finding(changed)
    assert after.verdict is expected
    assert (after.ours, after.because, after.verdict) != (
        before.ours,
        before.because,
        before.verdict,
    )


@pytest.mark.parametrize(
    ("turn", "shift", "mean", "largest"),
    [(0.1, 0.5, Verdict.BETTER, Verdict.BETTER), (0.28, 0.8, Verdict.MISSED, Verdict.BETTER),
     (0.4, 0.9, Verdict.MISSED, Verdict.MISSED)],
)  # fmt: skip
def test_position_is_judged_by_mean_and_largest_error(turn, shift, mean, largest) -> None:
    results = {"position": stand_record(turn, shift)}
    for words, expected in (("mean error of the", mean), ("largest error of the", largest)):
        for what in ("rotation", "translation"):
            assert claim(f"{words} {what}").finding(results).verdict is expected
    found = claim("mean error of the rotation").finding(results).ours
    assert found == f"{digits(0.75 * turn)} deg"  # the size counts, not the sign


def test_what_is_missing_is_said_to_be(results) -> None:
    for one in CLAIMS:
        assert (one.finding({}).verdict is Verdict.UNKNOWN) is bool(one.records), one.says
    text = to_markdown(document({}, ""))
    for study in BY_RECORD.values():
        if study.record not in ("sensor_effects", "scaling"):  # shown with others
            assert f"there is no result {study.record}." in text, study.name


def test_every_topic_is_on_the_page_with_claims_of_one_kind(results) -> None:
    text = to_markdown(document(results, ""))
    for topic in TOPICS.values():
        assert text.count(f"\n## {topic.title}\n") == 1
        assert topic.claims
        assert {bool(claim.place) for claim in topic.claims} == {topic.of_paper}


@pytest.mark.parametrize(
    ("value", "words"),
    [(0.142, "0.14"), (0.00070, "0.00070"), (1234.5, "1,200"), (9.96, "10"), (0.0, "0"),
     (None, "–"), (float("nan"), "–")],
)  # fmt: skip
def test_digits(value, words) -> None:
    assert digits(value) == words
