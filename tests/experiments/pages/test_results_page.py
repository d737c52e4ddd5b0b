"""The pages say what the recorded results say."""

from __future__ import annotations

import copy
import json
import re

import pytest

from experiments.pages.marked_page import with_block
from experiments.results_page import (
    NAMES,
    PAGES,
    RESULTS,
    blocks,
    page,
    recorded,
    vane_table,
)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_the_pages_are_current(path) -> None:
    """If this is red: python -m experiments.results_page"""
    assert page(path, recorded()) == path.read_text()


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_every_picture_of_the_pages_is_there(path) -> None:
    for name in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", path.read_text()):
        assert (path.parent / name).stat().st_size > 10_000


def test_the_tables_follow_the_figures() -> None:
    results = recorded()
    assert set(results) == set(NAMES)
    changed = copy.deepcopy(results)
    changed["vane"]["summary"]["rotation_error_deg"]["p95"] = 12.34
    assert "12.34" in vane_table(changed["vane"])
    assert "12.34" not in vane_table(results["vane"])
    for path, bodies in blocks(results).items():
        text = path.read_text()
        for name in bodies:
            assert f"<!-- {name} -->" in text
            assert f"<!-- end of {name} -->" in text


def sentences() -> list[tuple[str, str]]:
    """Page and words: where a sentence that nobody generates names a recorded figure."""
    results = recorded()
    effects = json.loads((RESULTS / "sensor_effects.json").read_text())["effects"]
    fine = next(level for level in results["fine"]["levels"] if level["noise_mm"] == 0.1)
    angle, shift = fine["rotation_deg"], fine["translation_mm"]
    verdicts, vane = results["verdicts"], results["vane"]
    wrong = verdicts["poses"]["wrong"]
    parts = len({row["part"] for row in verdicts["registered"]})
    times = {row["name"]: row["seconds"] for row in results["benchmark"]["rows"]}
    lone, led = (times[f"register, {name}any pose"]["median"] for name in ("", "weights, "))
    alone = results["sensor_transfer"]["summary"]["all"]
    counts = [
        round(alone[name]["alone"]["right"] * alone[name]["alone"]["registrations"])
        for name in ("consumer_depth", "ideal")
    ]
    return [
        (
            "docs/virtual_scans.md",
            f"take {effects['all']['ratio']:.1f} times as long as ideal scanning",
        ),
        ("docs/training.md", f"cores and took {60 * vane['training']['hours']:.0f} minutes"),
        (
            "docs/training.md",
            f"give {_mean(vane, 'rmse_mm'):.2f} and {_mean(vane, 'ffmde_abs_mm'):.2f} mm",
        ),
        ("docs/quick_start.md", f"None of {wrong:,} wrong poses of {parts} parts was accepted"),
        ("docs/quick_start.md", f"`register` takes {lone:.1f} s without and {led:.1f} s with one"),
        ("docs/how_it_works.md", f"Of {wrong:,} wrong poses of {parts} parts, most"),
        (
            "docs/how_it_works.md",
            f"{angle['rms']:.4f} deg and {shift['rms']:.4f} mm rms over the {fine['views']} test "
            f"views, {angle['ratio']:.2f} and {shift['ratio']:.2f} times the bound",
        ),
        ("docs/real_scans.md", f"{counts[0]} against {counts[1]}."),
    ]


def _mean(vane, name: str) -> float:
    return vane["at_true_pose"][name]["mean"]


@pytest.mark.parametrize(("page_name", "words"), sentences())
def test_sentences_say_what_the_records_say(page_name: str, words: str) -> None:
    text = (RESULTS.parents[1] / page_name).read_text()
    assert words in " ".join(text.split())


def test_no_wrong_pose_was_accepted_as_the_pages_say() -> None:
    verdicts = recorded()["verdicts"]
    assert verdicts["accepted_wrong"] == []
    assert not any(count["accepted_wrong"] for count in verdicts["register"].values())


def test_every_method_of_the_paper_is_in_the_recorded_table() -> None:
    methods = {method["title"] for method in recorded()["comparison"]["methods"]}
    assert {"ICP", "SAC-IA + ICP", "FGR", "DCP", "PointNetLK", "PCRNet", "RPM-Net"} <= methods


def test_results_name_no_folder_of_the_machine_that_made_them() -> None:
    for path in RESULTS.glob("*.json"):
        assert not re.search(r'"/(work|tmp|home|root)\b', path.read_text()), path.name


def test_a_block_is_replaced_between_its_marks_and_nowhere_else() -> None:
    text = "a\n<!-- one -->\nold\n<!-- end of one -->\nb\n"
    assert with_block(text, "one", "new\n") == "a\n<!-- one -->\nnew\n<!-- end of one -->\nb\n"
    for broken in ("a", "<!-- one -->", "<!-- end of one --><!-- one -->"):
        with pytest.raises(ValueError, match="one"):
            with_block(broken, "one", "new")
