"""The pages say what the recorded results say."""

from __future__ import annotations

import copy
import re

import pytest

from experiments.marked_page import with_block
from experiments.results_page import (
    NAMES,
    PAGES,
    RESULTS,
    blocks,
    brief_table,
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
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", path.read_text())
    assert pictures
    for name in pictures:
        assert (path.parent / name).stat().st_size > 10_000


def test_the_tables_follow_the_figures() -> None:
    results = recorded()
    assert set(results) == set(NAMES)
    changed = copy.deepcopy(results)
    changed["vane"]["summary"]["rotation_error_deg"]["p95"] = 12.34
    assert "12.34" in vane_table(changed["vane"])
    assert "12.34" not in vane_table(results["vane"])
    figures = changed["comparison"]["methods"][0]["alone"]["summary"]
    figures["ffmde_abs_mm"]["mean"] = 98.76
    assert "98.76" in brief_table(changed["comparison"])
    for path, bodies in blocks(results).items():
        text = path.read_text()
        for name in bodies:
            assert f"<!-- {name} -->" in text
            assert f"<!-- end of {name} -->" in text


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
