"""The README's table of measured figures says what the records say."""

from __future__ import annotations

import copy
import json

import pytest

from experiments.pages import summary_table as headline
from experiments.results_page import RESULTS

RECORDS = {name: json.loads((RESULTS / f"{name}.json").read_text()) for name in headline.NEEDS}


@pytest.mark.parametrize(
    ("record", "place", "value", "said"),
    [
        ("fine", ("levels", 1, "rotation_deg", "rms"), 0.1234, "0.1234 deg"),
        ("fine", ("levels", 1, "translation_mm", "ratio"), 7.77, "and 7.77 times the Cramer-Rao"),
        (
            "position",
            ("cameras", 0, "rotation", "rows", 3, "error_deg"),
            -9.5,
            "9.500 largest (paper",
        ),
        ("any_pose", ("verdicts", "accepted", "wrong"), 3, "203 accepted, 3 of them wrong"),
        ("any_pose", ("right",), 0.5, "100 right"),
        ("robustness", ("random", "translation_mm", "max"), 8.25, "and 8.25; "),
        ("real_scans", ("accepted_wrong",), 2, "7 accepted, 2 of them wrong"),
        ("real_scans", ("sensor", "near"), 13, "(13 with `--sensor`)"),
        (
            "verdicts",
            ("verdicts_by_sensor", "clutter", "wrong", "accepted"),
            4,
            "1,054 wrong poses | 4 accepted",
        ),
        ("verdicts", ("register", "white", "accepted_wrong"), 5, "32 accepted, 5 of them wrong"),
    ],
)
def test_a_figure_that_changes_is_told(record: str, place: tuple, value: float, said: str) -> None:
    assert said not in headline.table(RECORDS)
    changed = copy.deepcopy(RECORDS)
    inner = changed[record]
    for step in place[:-1]:
        inner = inner[step]
    assert place[-1] in inner or isinstance(inner, list)
    inner[place[-1]] = value
    assert said in headline.table(changed)


def test_times_are_those_of_their_rows() -> None:
    changed = copy.deepcopy(RECORDS)
    for row in changed["benchmark"]["rows"]:
        if row["name"] == "refine":
            row["seconds"]["median"] = 44.0
            for entry in row["against"]:
                entry["ratio"] = {"small_gicp, point to plane": 9.9}.get(entry["name"], 8.8)
    told = headline.table(changed)
    assert "44 s: 8.8 times as fast as Open3D's ICP, 9.9 times small_gicp's" in told
