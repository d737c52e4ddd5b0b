"""The pages say what the recorded results say."""

from __future__ import annotations

import copy
import re

import pytest

from experiments import docs
from experiments.benchmarks.scaling import Series, summarize_scaling
from experiments.benchmarks.timing import Figure, summarize
from experiments.pages import blocks, tables
from experiments.pages.blocks import page, pages
from experiments.pages.reproduction.studies import RESULTS, recorded
from experiments.pages.tables import summary_table
from experiments.runner.markdown import provenance, with_blocks

PAGES = pages()
RECORDS = recorded()


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_the_pages_are_current(path) -> None:
    """If this is red: python -m experiments.docs"""
    text = path.read_text()
    assert page(path, RECORDS) == text
    for name in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text):
        assert (path.parent / name).stat().st_size > 10_000


def test_the_command_rewrites_the_pages_and_draws_if_asked(monkeypatch) -> None:
    written, drawn = {}, []
    for module in (blocks, docs):
        monkeypatch.setattr(module, "write_text", written.__setitem__)
    monkeypatch.setattr(docs, "draw", drawn.append)
    docs.main(docs.make_parser().parse_args([]))
    assert written == {path: path.read_text() for path in (*PAGES, docs.RESULTS_PAGE)}
    assert not drawn
    docs.main(docs.make_parser().parse_args(["--pictures"]))
    assert drawn == [docs.DOCS]


def changed(record: str, place: tuple, value: float) -> dict:
    """The records with another value at one place."""
    results = copy.deepcopy(RECORDS)
    inner = results[record]
    for step in place[:-1]:
        inner = inner[step]
    assert inner[place[-1]] != value
    inner[place[-1]] = value
    return results


@pytest.mark.parametrize(
    ("record", "place", "value", "words"),
    [
        ("fine", ("levels", 1, "rotation_deg", "rms"), 0.1234, "0.1234 deg and"),
        ("fine", ("levels", 1, "translation_mm", "ratio"), 7.77, "and 7.77 times the Cramer-Rao"),
        ("position", ("cameras", 0, "rotation", "rows", 3, "error_deg"), -9.5, "9.500 largest"),
        ("any_pose", ("accepted_wrong",), 3, "3 wrong poses accepted; 1.0 s"),
        ("any_pose", ("right",), 0.5, "100 right"),
        ("robustness", ("random", "seconds", "median"), 8.25, "accepted; 8.2 s each"),
        ("real_scans", ("accepted_wrong",), 2, "7 accepted, 2 of them wrong"),
        ("verdicts", ("verdicts_by_sensor", "clutter", "wrong", "accepted"), 4, "| 4 accepted"),
    ],
)
def test_the_summary_follows_the_records(record, place, value, words) -> None:
    assert words not in summary_table(RECORDS)
    assert words in summary_table(changed(record, place, value))
    assert len(summary_table(RECORDS).splitlines()) <= 2 + 8


def test_the_tables_follow_the_records() -> None:
    results = changed("vane", ("summary", "rotation_error_deg", "p95"), 12.34)
    assert "12.34" in tables.evaluation_table(results["vane"])
    assert "12.34" not in tables.evaluation_table(RECORDS["vane"])
    made = provenance("x", {"date": "2026-01-02T03:04", "commit": "0123456789abcdef",
                            "machine": {"cpu": "A processor", "cores": 2}})  # fmt: skip
    assert made == "Record `x.json`: A processor, 2 cores; 2026-01-02, commit 0123456789."


def test_times_have_their_peers_limits_and_goals() -> None:
    figures = [
        Figure("a limit", [0.025, 0.05, 0.1]),
        Figure("a thing", [0.1], {"a peer": 6.0, "another": 1.0}, {"a limit": None}, goal_s=0.05),
        Figure("a peer", [0.62]),
        Figure("another", [], note="skipped: missing"),
    ]
    report = {
        "machine": {"matmul_flops_per_second": 2.04e11},
        "rows": summarize(figures),
        "scaling": summarize_scaling([Series("cost", "points", [1000, 20000], [[0.1], [2.0]])]),
    }
    lines = (tables.benchmark_table(report) + "\n" + tables.scaling_table(report)).splitlines()
    assert lines[0] == "Medians of at least 1 repeats; 204 GFLOP/s in a large f32 product."
    assert "| a limit | 0.0500 | 0.0250 to 0.100 |  |  |" in lines
    assert (
        "| a thing | 0.100 | 0.100 to 0.100 | 0.05 s: missed | 6.20 times as fast as a peer "
        "(at least 6: met); not compared with another; 2.00 times as long as a limit |"
    ) in lines
    assert "| another |  |  |  | skipped: missing |" in lines
    assert "| cost | 1,000, 20,000 points | 0.100, 2.000 | 1.00 |" in lines


def sentences() -> list[tuple[str, str]]:
    """Page and words: where a sentence that nobody generates names a recorded figure."""
    results = RECORDS
    effects = results["sensor_effects"]["effects"]
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
    verdicts = RECORDS["verdicts"]
    assert verdicts["accepted_wrong"] == []
    assert not any(count["accepted_wrong"] for count in verdicts["register"].values())


def test_every_method_of_the_paper_is_in_the_recorded_table() -> None:
    methods = {method["title"] for method in RECORDS["comparison"]["methods"]}
    assert {"ICP", "SAC-IA + ICP", "FGR", "DCP", "PointNetLK", "PCRNet", "RPM-Net"} <= methods


def test_results_name_no_folder_of_the_machine_that_made_them() -> None:
    for path in RESULTS.glob("*.json"):
        assert not re.search(r'"/(work|tmp|home|root)\b', path.read_text()), path.name


def test_a_block_is_replaced_between_its_marks_and_nowhere_else() -> None:
    text = "a\n<!-- one -->\nold\n<!-- end of one -->\nb\n"
    made = with_blocks(text, {"one": "new\n"}.__getitem__)
    assert made == "a\n<!-- one -->\nnew\n<!-- end of one -->\nb\n"
    assert with_blocks("a\n<!-- a remark -->\n", {}.__getitem__) == "a\n<!-- a remark -->\n"
    for broken in ("<!-- end of one -->", "<!-- end of one -->\n<!-- one -->", text + text[2:20]):
        with pytest.raises(ValueError, match="one"):
            with_blocks(broken, {}.__getitem__)
