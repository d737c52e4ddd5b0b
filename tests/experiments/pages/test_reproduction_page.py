"""The HTML page: whole, accessible, on a screen, on a phone and on paper."""

from __future__ import annotations

import html.parser
import itertools
import re
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from experiments import docs
from experiments.pages.reproduction.document import PICTURES, Picture, document, to_markdown
from experiments.pages.reproduction.page import to_html, to_page
from experiments.pages.reproduction.studies import recorded


def small_picture(*_: object) -> Figure:
    figure = Figure((4, 3))
    figure.add_subplot().plot([0, 1])
    return figure


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    """With small pictures: the studies' own tests draw the real ones."""
    path = tmp_path_factory.mktemp("page") / "reproduction.html"
    with pytest.MonkeyPatch.context() as patch:
        for name in PICTURES:
            patch.setitem(PICTURES, name, small_picture)
        patch.setattr("experiments.studies.robustness.report.picture", small_picture)
        path.write_text(to_page(document(recorded(), "Recorded.", docs=docs.DOCS)))
    return path


@pytest.mark.slow
def test_every_picture_is_drawn_of_its_record() -> None:
    report = document(recorded(), "")
    drawn = [part.draw() for part in report.parts if isinstance(part, Picture) and part.draw]
    assert len(drawn) == len(PICTURES)  # each once
    assert all(figure.axes for figure in drawn)


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
    assert len(elements.of("details")) == to_markdown(document(recorded(), "")).count("<details")


def test_markdown_becomes_html() -> None:
    text = """### A & b

One **met** `a<b` [link](#x)

| a | b | c |
|---|---|---|
| x \\| y | 1.5 | `k` |

```text
 <pre>
```"""
    made = to_html(text, "N")
    for words in (
        '<h3 id="a--b">A &amp; b</h3>',
        '<p>One <strong class="verdict good">met</strong> <code>a&lt;b</code> <a href="#x">',
        '<td data-head="a">x | y</td>\n<td class="n" data-head="b">1.5</td>',
        '<td class="k" data-head="c">',
        '<pre style="--columns: 6"> &lt;pre&gt;</pre>',
        'aria-label="N: table"',
    ):
        assert words in made, words
    long = to_html(text.replace("x", 61 * "x"), "N")
    assert ('<table class="stack">' in made, '<table class="stack">' in long) == (False, True)


@pytest.mark.parametrize(
    "text", ["{}", "{} `x`", "- {}", "| {} |\n|---|\n| {} |", "```\n{}\n```", "`{}`", "### {}"]
)
def test_text_is_no_html(text) -> None:
    assert "<script>" not in to_html(text.replace("{}", "<script>alert(1)</script>"), "N")


def test_what_is_folded_is_folded_in_both_writings() -> None:
    """The first look is claims and pictures: every raw table is closed."""
    open_text = re.sub(r"<details.*?</details>", "", docs.results_page(), flags=re.DOTALL)
    assert "```" not in open_text
    assert max(map(len, re.findall(r"(?:^\|.*\n)+", open_text, re.MULTILINE))) < 6000
    assert len(open_text.splitlines()) < 330


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
        hidden = "[...document.querySelectorAll('details')].filter(e => e.offsetHeight < 60).length"
        assert browser.evaluate(hidden) == 0
        wide = (
            "[...document.querySelectorAll('table, pre, img, .scroll')].filter(e => "
            "e.scrollWidth > e.clientWidth + 1 || e.getBoundingClientRect().right > 692).length"
        )
        assert browser.evaluate(wide) == 0
        made = browser.call("Page.printToPDF", preferCSSPageSize=True)["data"]
        assert made.startswith("JVBERi")  # %PDF-
    finally:
        browser.call("Emulation.setEmulatedMedia", media="")
