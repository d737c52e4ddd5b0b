"""The command: a run goes on, arguments that cannot be."""

from __future__ import annotations

import dataclasses
import json
import re

import pytest
from example_position import stand_record

from experiments import docs, reproduce
from experiments.pages.blocks import BLOCKS
from experiments.pages.reproduction import studies
from experiments.pages.reproduction.document import TOPICS, to_markdown
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.run import estimate, run_studies
from experiments.pages.reproduction.studies import STUDIES, Study
from experiments.runner.markdown import slug
from vanejax.errors import InputError

QUICK_FINE = Study(
    "fine",
    "a view at one noise",
    ("experiments.fine", "--views", "0", "--noise-mm", "0.1", "--out", "{folder}"),
    "fine.json",
    "fine",
    0.01,
)


def test_every_picture_and_anchor_of_the_page_is_there() -> None:
    text = docs.RESULTS_PAGE.read_text()
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert len(pictures) > 5
    for name in pictures:
        assert (docs.DOCS / name).stat().st_size > 10_000
    headings = [slug(title) for title in re.findall(r"^#+ (.+)$", text, re.M)]
    assert len(set(headings)) == len(headings)
    links = re.findall(r"\]\(#([^)]+)\)", text)
    assert len(links) == sum(len(topic.claims) for topic in TOPICS.values())
    assert set(links) <= set(headings)


def test_the_plan_says_what_is_done_and_left_out(tmp_path) -> None:
    text = estimate(STUDIES, tmp_path, {"shapes": "solids"})
    total = sum(study.hours for study in STUDIES if "real_scans" not in study.inputs)
    assert f"{total:.2f} h on two cores" in text
    assert text.count("needs --real-scans") == 3
    assert (
        reproduce.main(reproduce.make_parser().parse_args(["--plan", "--out", str(tmp_path)])) == 0
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_run_goes_on_and_names_what_failed(tmp_path, monkeypatch, capsys) -> None:
    """Real studies in processes of their own: one that works, one that fails, one in need of it."""
    broken = dataclasses.replace(
        QUICK_FINE,
        name="any_pose",
        record="any_pose",
        arguments=("experiments.any_pose", "--weights", "no.npz", "--out", "{folder}"),
        written="any_pose.json",
    )
    needy = dataclasses.replace(
        QUICK_FINE, name="needy", record="", arguments=("x", "{out}/any_pose/any_pose.json")
    )
    asked = dataclasses.replace(
        QUICK_FINE, name="asked", arguments=("x", "{real_scans}"), record=""
    )
    monkeypatch.setattr(studies, "STUDIES", (broken, QUICK_FINE, needy, asked))
    settings = reproduce.make_parser().parse_args(["--out", str(tmp_path)])
    assert reproduce.main(settings) == 1
    page = (tmp_path / reproduce.FILE).read_text()
    for words in (
        "no.npz",
        "needs any_pose, which failed",
        "Studies of this run",
        "failed</strong>",
    ):
        assert words in page, words
    assert page.count("data:image/png") == 1  # of the study that worked
    states = {o["study"]: o for o in json.loads((tmp_path / "outcomes.json").read_text())}
    assert {name: o["state"] for name, o in states.items()} == {
        "any_pose": "failed", "fine": "done", "needy": "not run", "asked": "not run",
    }  # fmt: skip
    assert "no such file" in states["any_pose"]["why"]
    assert "not everything could be measured: any_pose, needy" in capsys.readouterr().out
    # again: what ended is kept, byte for byte
    record = tmp_path / "fine" / "fine.json"
    before = record.stat().st_mtime_ns
    (again,) = run_studies([QUICK_FINE], tmp_path, {}, say=lambda _: None)
    assert (again.state, record.stat().st_mtime_ns) == ("done before", before)
    # another command is another study
    other = dataclasses.replace(QUICK_FINE, arguments=("experiments.fine", "--views", "999"))
    (failed,) = run_studies([other], tmp_path, {}, say=lambda _: None)
    assert failed.state == "failed"
    assert "exit code 2: error: views '999'" in failed.why


@pytest.mark.parametrize("known", [False, True])
def test_quick_puts_live_figures_beside_recorded_ones(
    tmp_path, monkeypatch, results, known
) -> None:
    there = {name: report for name, report in results.items() if name != "position"}
    if known:
        there["position"] = stand_record(0.2, 0.5) | {"date": "2026-01-01", "commit": "abc"}
    live = Live(results["vane"], "w.npz", None, 1.0)
    now = stand_record(0.1, 0.5) | {"date": "2026-01-02", "commit": "abd"}
    given = {}
    for name, value in {
        "recorded": lambda: there,
        "find_weights": lambda *_: None,
        "evaluate_live": lambda *_: live,
        "measure_position": lambda _: now,
        "to_page": lambda report: given.setdefault("page", report) and "",
    }.items():
        monkeypatch.setattr(reproduce, name, value)
    monkeypatch.setitem(BLOCKS, "position", ("position", lambda report: "| TABLE |"))
    settings = reproduce.make_parser().parse_args(["--quick", "--out", str(tmp_path)])
    assert reproduce.main(settings) == 0
    text = to_markdown(given["page"])
    assert "All 12 figures are the recorded ones" in text
    assert "| TABLE |" in text
    if known:
        assert "2 of 4 figures differ from the record by more than 2%" in text
        assert "| rotation (deg), mean | 0.150 | 0.0750 | -50.0% |" in text
    else:
        assert "There is no record of this study; it was run for this page." in text
    assert ("0.15 deg" if known else "0.075 deg") in text


@pytest.mark.parametrize(
    ("words", "told"),
    [(["--quick", "--only", "fine"], "--only has no meaning"),
     (["--weights", "w.npz"], "--weights is for --quick")],
)  # fmt: skip
def test_arguments_that_do_not_go_together_are_refused(words, told, tmp_path) -> None:
    settings = reproduce.make_parser().parse_args([*words, "--out", str(tmp_path)])
    with pytest.raises(InputError, match=told):
        reproduce.main(settings)
