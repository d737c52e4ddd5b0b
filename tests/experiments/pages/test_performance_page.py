"""docs/performance.md says what the recorded benchmark says."""

from __future__ import annotations

from experiments import performance_page
from experiments.performance_page import PAGE, figures, page, recorded

REPORT = {
    "date": "2026-01-02T03:04:05+00:00",
    "commit": "0123456789abcdef",
    "machine": {"cpu": "A processor", "cores": 2, "matmul_flops_per_second": 2.04e11},
    "rows": [
        {
            "name": "a limit",
            "seconds": {"median": 0.05, "min": 0.04, "max": 0.2},
            "repeats": 5,
            "goal_s": None,
            "met": None,
            "against": [],
            "note": "",
        },
        {
            "name": "a thing",
            "seconds": {"median": 0.1, "min": 0.1, "max": 0.3},
            "repeats": 7,
            "goal_s": 0.05,
            "met": "missed",
            "against": [
                {"name": "a peer", "kind": "peer", "ratio": 6.2, "goal": 6, "met": "met"},
                {"name": "a limit", "kind": "limit", "ratio": 2.0, "goal": None, "met": None},
                {"name": "another", "kind": "peer", "ratio": None, "goal": 1, "met": None},
            ],
            "note": "",
        },
        {
            "name": "a peer",
            "seconds": None,
            "repeats": 0,
            "goal_s": None,
            "met": None,
            "against": [],
            "note": "skipped: not installed",
        },
    ],
    "growth": [
        {
            "name": "cost",
            "unit": "points",
            "exponent": 1.04,
            "points": [
                {"size": 1000, "seconds": {"median": 0.1, "min": 0.1, "max": 0.1}},
                {"size": 20000, "seconds": {"median": 2.0, "min": 2.0, "max": 2.0}},
            ],
        }
    ],
}


def test_figures_stand_beside_peer_limit_and_goal():
    lines = figures(REPORT, REPORT).splitlines()
    assert lines[0] == (
        "A processor, 2 cores, 204 GFLOP/s in a large f32 product; 2026-01-02, commit 0123456789, "
        "medians of at least 5 repeats."
    )
    assert "| a limit | 0.0500 | 0.0400 to 0.200 |  |  |" in lines
    assert (
        "| a thing | 0.100 | 0.100 to 0.300 | 0.05 s: missed | 6.20 times as fast as a peer "
        "(at least 6: met); 2.00 times as long as a limit; not compared with another |"
    ) in lines
    assert "| a peer | | | | skipped: not installed |" in lines
    assert "| cost | 1,000, 20,000 points | 0.100, 2.000 | 1.04 |" in lines


def test_only_what_is_between_the_marks_is_replaced():
    text = "before\n<!-- figures -->\nold\n<!-- end of figures -->\nafter\n"
    found = page(text, REPORT, REPORT)
    assert found.startswith("before\n<!-- figures -->\nA processor")
    assert found.endswith("|\n<!-- end of figures -->\nafter\n")
    assert "old" not in found
    assert page(found, REPORT, REPORT) == found


def test_the_command_rewrites_the_page(tmp_path, monkeypatch):
    copy = tmp_path / "performance.md"
    copy.write_text(PAGE.read_text().replace("times as", "apples as"))
    monkeypatch.setattr(performance_page, "PAGE", copy)
    performance_page.main()
    assert copy.read_text() == PAGE.read_text()


def test_the_page_is_current():
    assert page(PAGE.read_text(), *recorded()) == PAGE.read_text()
