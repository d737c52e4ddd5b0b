"""The HTML page: whole, accessible, on a screen, on a phone and on paper."""

from __future__ import annotations

import html.parser
import itertools
import re
from pathlib import Path

import pytest
from headless_browser import CHROMIUM, HeadlessBrowser

from experiments import reproduce
from experiments.pages.reproduction.document import document
from experiments.pages.reproduction.page import to_page
from experiments.pages.reproduction.studies import recorded


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("page") / "reproduction.html"
    path.write_text(to_page(document(recorded(), "Recorded.", docs=reproduce.DOCS)))
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
