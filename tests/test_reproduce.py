"""The reproduction: its page is current, its verdicts follow the figures, its run goes on."""

from __future__ import annotations

import copy
import dataclasses
import html.parser
import importlib
import itertools
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from headless_browser import CHROMIUM, HeadlessBrowser

from experiments import reproduce
from experiments.configs import smoke, vane
from experiments.public_vs_virtual import PUBLIC, VIRTUAL
from experiments.reproduction import live as live_module
from experiments.reproduction import studies
from experiments.reproduction.claim import Claim, Verdict, digits
from experiments.reproduction.contents import (
    CLAIMS,
    GOALS,
    OF_OURS,
    OF_PAPER,
    TOPICS,
    sections,
)
from experiments.reproduction.document import document, to_markdown
from experiments.reproduction.live import Live, check_recipe, side_by_side
from experiments.reproduction.markdown import cells, inline, slug, table, to_html
from experiments.reproduction.page import to_page
from experiments.reproduction.run import estimate, run_studies
from experiments.reproduction.studies import (
    BY_RECORD,
    RESULTS,
    STUDIES,
    Study,
    chosen,
    recorded,
)
from experiments.reproduction.topics.training import axis_errors
from experiments.reproduction.topics.views import VIEWS
from vanejax.errors import InputError
from vanejax.metrics import mean_per_axis, mean_per_view
from vanejax.vane import guide_vane

QUICK_FINE = Study(
    "fine",
    "a view at one noise",
    ("experiments.fine", "--views", "0", "--noise-mm", "0.1", "--out", "{folder}"),
    "fine.json",
    "fine",
    0.01,
)


@pytest.fixture(scope="module")
def results() -> dict[str, Any]:
    return recorded()


# ---------------------------------------------------------------- the committed page


def test_the_page_is_current() -> None:
    """If this is red: python -m experiments.reproduce --docs"""
    assert reproduce.docs_page() == reproduce.PAGE.read_text()


def test_every_picture_and_anchor_of_the_page_is_there() -> None:
    text = reproduce.PAGE.read_text()
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert len(pictures) > 5
    for name in pictures:
        assert (reproduce.PAGE.parent / name).stat().st_size > 10_000
    headings = [slug(title) for title in re.findall(r"^#+ (.+)$", text, re.M)]
    assert len(set(headings)) == len(headings)
    links = re.findall(r"\]\(#([^)]+)\)", text)
    assert len(links) >= len(CLAIMS) + len(GOALS)
    assert set(links) <= set(headings)


def test_a_new_record_changes_the_page(results) -> None:
    changed = copy.deepcopy(results)
    changed["vane"]["summary"]["rotation_error_deg"]["p95"] = 12.34
    text = to_markdown(document(changed, ""))
    assert "12.34" in text
    assert "12.34" not in to_markdown(document(results, ""))


def test_every_record_has_a_study_and_every_study_a_record() -> None:
    there = {path.stem for path in RESULTS.glob("*.json")}
    assert there <= set(BY_RECORD)


# ---------------------------------------------------------------- claims


def claim(words: str) -> Claim:
    (found,) = [one for one in (*CLAIMS, *GOALS) if words in one.says]
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


def position(turn: float, shift: float) -> dict[str, Any]:
    """A record of the stand with given errors, the signs of the turns alternating."""
    one = {
        "rotation": {"rows": [{"error_deg": turn}, {"error_deg": -turn / 2}]},
        "translation": [{"against_probe_mm": shift, "origin_mm": 9.0}],
    }
    return {"cameras": [one, one], "positions": 3, "method": "m"}


@pytest.mark.parametrize(
    ("turn", "shift", "mean", "largest"),
    [(0.1, 0.5, Verdict.BETTER, Verdict.BETTER), (0.28, 0.8, Verdict.MISSED, Verdict.BETTER),
     (0.4, 0.9, Verdict.MISSED, Verdict.MISSED)],
)  # fmt: skip
def test_position_is_judged_by_mean_and_largest_error(turn, shift, mean, largest) -> None:
    results = {"position": position(turn, shift)}
    for words, expected in (("mean error of the", mean), ("largest error of the", largest)):
        for what in ("rotation", "translation"):
            assert claim(f"{words} {what}").finding(results).verdict is expected
    found = claim("mean error of the rotation").finding(results).ours
    assert found == f"{digits(0.75 * turn)} deg"  # the size counts, not the sign


def test_what_is_missing_is_said_to_be(results) -> None:
    for one in (*CLAIMS, *GOALS):
        assert (one.finding({}).verdict is Verdict.UNKNOWN) is bool(one.records), one.says
    text = to_markdown(document({}, ""))
    for study in BY_RECORD.values():
        if study.record not in ("sensor_effects", "growth", "tuning"):  # told of with others
            assert f"there is no result {study.record}." in text, study.name


def test_every_topic_is_on_the_page_with_claims_of_one_kind() -> None:
    assert len(TOPICS) == len(set(TOPICS))
    assert set(TOPICS) == {*OF_PAPER, *OF_OURS}
    assert all(topic.claims for topic in TOPICS)
    assert all(one.place for one in CLAIMS)
    assert not any(one.place for one in GOALS)


@pytest.mark.parametrize(
    ("value", "words"),
    [(0.142, "0.14"), (0.00070, "0.00070"), (1234.5, "1,200"), (9.96, "10"), (0.0, "0"),
     (None, "–"), (float("nan"), "–")],
)  # fmt: skip
def test_digits(value, words) -> None:
    assert digits(value) == words


# ---------------------------------------------------------------- pictures from means


def test_the_axis_errors_drawn_have_the_recorded_means(results, monkeypatch) -> None:
    drawn = {}
    monkeypatch.setattr("vanejax.plotting.axis_errors", lambda series: drawn.update(series))
    report = results["public_vs_virtual"]
    for views in ("hardest", "all"):
        axis_errors(report, views)
        for source in (PUBLIC, VIRTUAL):
            errors = drawn[report["trained_on"][source]["title"]]
            found = report[f"{views}_views"][source]
            for values, name, unit in (
                (errors.rotation_deg, "mre", "deg"),
                (errors.translation_mm, "mte", "mm"),
            ):
                # six digits are recorded
                np.testing.assert_allclose(
                    mean_per_axis(values), found[f"{name}_per_axis_{unit}"], rtol=1e-5
                )
                np.testing.assert_allclose(
                    mean_per_view(values), found[f"{name}_per_view_{unit}"], rtol=1e-5
                )


# ---------------------------------------------------------------- live against recorded


def test_live_figures_are_held_against_the_record() -> None:
    same = side_by_side({"a": (1.0, 1.01), "b": (2.0, 1.99)})
    assert "All 2 figures are the recorded ones within 2%." in same
    apart = side_by_side({"a": (1.0, 1.01), "b": (2.0, 1.8), "c": (1.0, 1.05)})
    assert "2 of 3 figures differ from the record by more than 2%, most the b (10%)." in apart
    assert "| b | 2.00 | 1.80 | -10.0% |" in apart


def test_the_page_tells_of_another_network(results) -> None:
    report = copy.deepcopy(results["vane"])
    report["summary"]["rotation_error_deg"]["max"] *= 2
    live = Live(report, "w.npz", "0123456789abc", 60.0)
    parts = next(s for s in sections(results, live) if s.topic is VIEWS).parts
    text = "\n".join(part for part in parts if isinstance(part, str))
    assert "most the rotation error (deg), max (100%)" in text
    assert "these weights were trained from commit 0123456789." in text


@dataclasses.dataclass(frozen=True)
class FakeMatcher:
    """What `check_recipe` and `evaluate_live` look at."""

    model: Any
    iterations: int
    voxel_mm: float
    drawing: Any
    variables: Any = "weights"
    trained: Any = dataclasses.field(default_factory=lambda: {"commit": "abc"})

    def check_part(self, part) -> None:
        assert part.sha256 == guide_vane().sha256


def matcher_of(config, **other) -> FakeMatcher:
    network = config.make_network()
    fields = {
        "model": network.model,
        "iterations": network.iterations,
        "voxel_mm": config.data.voxel_mm,
        "drawing": dataclasses.make_dataclass("D", ["num_reference"])(config.data.num_reference),
    }
    return FakeMatcher(**fields | other)


def test_weights_of_another_recipe_are_refused() -> None:
    config = vane.get_config()
    check_recipe(matcher_of(config), config)
    with pytest.raises(InputError, match=r"voxel_mm is 3\.0, not 1\.5"):
        check_recipe(matcher_of(config, voxel_mm=3.0), config)
    with pytest.raises(InputError, match="iterations is 2, not 5"):
        check_recipe(matcher_of(config, iterations=2), config)


def test_the_live_evaluation_scans_anew_with_the_weights_given(tmp_path, monkeypatch) -> None:
    asked = {}

    def evaluate(config, scans, variables, folder, *, part, progress):
        asked.update(scans=scans, variables=variables, folder=folder)
        return {"views": len(scans.test)}

    monkeypatch.setattr(live_module, "evaluate", evaluate)
    config = smoke.get_config()
    live = live_module.evaluate_live(
        matcher_of(config), "w.npz", tmp_path, config=config, progress=False
    )
    assert asked["variables"] == "weights"
    assert asked["folder"] == tmp_path / "vane"
    assert live.report["views"] == len(asked["scans"].test) > 0
    assert (live.weights, live.trained, live.position) == ("w.npz", "abc", None)


# ---------------------------------------------------------------- Markdown


def test_markdown_becomes_html() -> None:
    text = """### A & b

One **bold** `a<b` [link](#x)
goes on.

- first
  more
- second

| a | b |
|---|---|
| x \\| y | 1.5 |

```text
 <pre>
```"""
    made = to_html(text, name="N")
    for words in (
        '<h3 id="a--b">A &amp; b</h3>',
        '<p>One <strong>bold</strong> <code>a&lt;b</code> <a href="#x">link</a> goes on.</p>',
        "<ul><li>first more</li><li>second</li></ul>",
        '<td>x | y</td><td class="n">1.5</td>',
        '<pre style="--columns: 6"> &lt;pre&gt;</pre>',
        'aria-label="N: table"',
    ):
        assert words in made, words


def test_text_is_no_code() -> None:
    evil = "<script>alert(1)</script>"
    for text in (
        evil,
        f"{evil} `x`",
        f"- {evil}",
        f"| {evil} |\n|---|\n| {evil} |",
        f"```\n{evil}\n```",
        f"`{evil}`",
        f"### {evil}",
    ):
        assert "<script>" not in to_html(text)
    assert '"' not in re.sub(r'href="[^"]*"', "", inline('[a](x"onclick=)'))


def test_tables_survive_bars() -> None:
    made = table(["a|b", "c"], [["1|2", "3"]])
    assert [cells(line) for line in made.splitlines()] == [["a|b", "c"], ["---"] * 2, ["1|2", "3"]]


# ---------------------------------------------------------------- the run


def arguments_of(study: Study) -> dict[str, Any]:
    """What the command's own parser makes of a study's arguments."""
    parser = importlib.import_module(study.arguments[0]).make_parser()
    words = study.words({"out": "o", "real_scans": "r", "shapes": "solids"})[1:]
    values = vars(parser.parse_args(words))
    return json.loads(json.dumps(values, default=str))


@pytest.mark.parametrize("study", [s for s in STUDIES if s.record], ids=lambda study: study.name)
def test_the_command_is_the_one_that_made_the_record(study, results) -> None:
    if study.record not in results:
        pytest.skip(f"{study.record} is not recorded yet")
    config = results[study.record].get("config", {})
    if "out" in config:
        mine = arguments_of(study)
        # files and folders lie elsewhere; what an older record lacks has its default since
        paths = {"out", "weights", "folder"} | ({"only"} if study.name == "growth" else set())
        for name in set(mine) & set(config) - paths:
            assert mine[name] == config[name], name
        if isinstance(mine.get("weights"), list):
            names = [[word.split("=")[0] for word in c["weights"]] for c in (mine, config)]
            assert names[0] == names[1]
    for argument in study.arguments:
        if argument.startswith("--config.") and "{" not in argument:
            path, value = argument.removeprefix("--config.").split("=")
            for name in path.split("."):
                config = config[name]
            assert str(config) == value
    if "--sweep" in study.arguments:
        (sweep,) = results[study.record]["sweeps"]
        field, values = study.arguments[study.arguments.index("--sweep") + 1].split("=")
        assert field == sweep["field"]
        assert [float(v) for v in values.split(",")] == sweep["values"]


def test_studies_come_after_what_they_need() -> None:
    for place, study in enumerate(STUDIES):
        before = {other.name for other in STUDIES[:place]}
        assert set(study.needs) <= before
        used = {a.split("}/")[1].split("/")[0] for a in study.arguments if "{out}/" in a}
        assert used <= set(study.needs) | {study.name}
    assert [s.name for s in chosen("any_pose")] == ["vane", "vane_weights", "any_pose"]
    with pytest.raises(InputError, match="no study nothing; there are vane"):
        chosen("nothing")


def test_the_plan_says_what_is_done_and_left_out(tmp_path) -> None:
    text = estimate(STUDIES, tmp_path, {"shapes": "solids"})
    total = sum(study.hours for study in STUDIES if "real_scans" not in study.inputs)
    assert f"{total:.2f} h on two cores" in text
    assert text.count("needs --real-scans") == 3
    assert (
        reproduce.main(reproduce.make_parser().parse_args(["--plan", "--out", str(tmp_path)])) == 0
    )
    assert list(tmp_path.iterdir()) == []


def test_a_run_goes_on_and_names_what_failed(tmp_path, monkeypatch, capsys) -> None:
    """Real studies in processes of their own: one that works, one that fails, one in need of it."""
    broken = dataclasses.replace(
        QUICK_FINE,
        name="any_pose",
        record="any_pose",
        arguments=("experiments.any_pose", "--weights", "no.npz", "--out", "{folder}"),
        written="any_pose.json",
    )
    needy = dataclasses.replace(QUICK_FINE, name="needy", record="", needs=("any_pose",))
    asked = dataclasses.replace(
        QUICK_FINE, name="asked", arguments=("x", "{real_scans}"), record=""
    )
    monkeypatch.setattr(studies, "STUDIES", (broken, QUICK_FINE, needy, asked))
    settings = reproduce.make_parser().parse_args(["--out", str(tmp_path)])
    assert reproduce.main(settings) == 1
    page = (tmp_path / reproduce.FILE).read_text()
    for words in ("no.npz", "needs any_pose, which failed", "What was run", "failed</strong>"):
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
        there["position"] = position(0.2, 0.5) | {"date": "2026-01-01", "commit": "abc"}
    live = Live(results["vane"], "w.npz", None, 1.0)
    now = position(0.1, 0.5) | {"date": "2026-01-02", "commit": "abd"}
    given = {}
    for name, value in {
        "recorded": lambda: there,
        "find_weights": lambda *_: None,
        "evaluate_live": lambda *_: live,
        "measure_position": lambda _: now,
        "to_page": lambda report: given.setdefault("page", report) and "",
    }.items():
        monkeypatch.setattr(reproduce, name, value)
    monkeypatch.setattr("experiments.position_report.table", lambda report: "| TABLE |")
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


# ---------------------------------------------------------------- the HTML page


@pytest.fixture(scope="module")
def page(tmp_path_factory, results) -> Path:
    path = tmp_path_factory.mktemp("page") / "reproduction.html"
    path.write_text(to_page(document(results, "Recorded.", docs=reproduce.DOCS)))
    return path


class Elements(html.parser.HTMLParser):
    """Every element with its attributes."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.found if name == tag]


def test_the_page_is_whole_and_accessible(page) -> None:
    elements = Elements(page)
    assert elements.of("html") == [{"lang": "en"}]
    assert not elements.of("script")
    images = elements.of("img")
    assert len(images) > 8
    for image in images:
        assert image["src"].startswith("data:image/png;base64,")
        assert len(image["alt"]) > 20
    levels = [int(tag[1]) for tag, _ in elements.found if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(b <= a + 1 for a, b in itertools.pairwise(levels))
    ids = [attributes["id"] for _, attributes in elements.found if "id" in attributes]
    assert len(set(ids)) == len(ids)
    links = [link["href"] for link in elements.of("a")]
    assert {link.removeprefix("#") for link in links} <= set(ids)
    for cell in elements.of("th"):
        assert cell["scope"] == "col"


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no chromium or google-chrome on the PATH")
    with HeadlessBrowser() as one:
        yield one


@pytest.mark.parametrize("width", [1280, 390])
def test_it_asks_for_nothing_and_shows_every_picture(browser, page, width) -> None:
    browser.open(page, width=width)
    assert browser.complaints() == []
    assert browser.requests() == [page.as_uri()]
    seen = "[...document.images].map(i => [i.naturalWidth, i.getBoundingClientRect().width])"
    for natural, shown in browser.evaluate(seen):
        assert natural > 300
        assert shown > 0.6 * min(width, 500)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width


def test_on_paper_nothing_is_cut_off(browser, page) -> None:
    browser.call("Emulation.setEmulatedMedia", media="print")
    try:
        # A4 less its margins: 182 mm at 96 pixels an inch
        browser.open(page, width=688)
        wide = (
            "[...document.querySelectorAll('table, pre, img, .scroll')].filter(e => "
            "e.scrollWidth > e.clientWidth + 1 || e.getBoundingClientRect().right > 692).length"
        )
        assert browser.evaluate(wide) == 0
        made = browser.call("Page.printToPDF", preferCSSPageSize=True)["data"]
        assert made.startswith("JVBERi")  # %PDF-
    finally:
        browser.call("Emulation.setEmulatedMedia", media="")
