"""The report as one HTML file for screen and paper: no script, no request, every picture inside."""

from __future__ import annotations

import base64
import datetime
import html
import io
import re
from collections.abc import Sequence
from pathlib import Path

import jinja2
from markdown_it import MarkdownIt
from markdown_it.token import Token
from matplotlib.image import imread

from experiments.pages.reproduction.claim import Verdict
from experiments.pages.reproduction.document import TITLE, Document, Folded, Part, Picture
from experiments.runner.machine import cores, cpu_model, git_commit
from experiments.runner.markdown import slug

PICTURE_DPI = 110
_FOLDER = Path(__file__).parent
_MARKDOWN = MarkdownIt("commonmark", {"html": False}).enable("table")
_NUMBER = re.compile(r"[+−-]?[\d.,]+ ?%?")
_SHORT = re.compile(r"`[^` ]{1,30}`|\d{4}-\d\d-\d\d")
_WIDE = 8  # columns from which a table is set smaller
_LONG = 60  # characters of a cell from which a narrow screen shows the rows as blocks
_COLORS = {
    Verdict.BETTER.value: "good",
    Verdict.MET.value: "good",
    Verdict.PARTLY.value: "half",
    Verdict.MISSED.value: "bad",
    Verdict.INCOMPARABLE.value: "none",
    Verdict.UNKNOWN.value: "none",
    "failed": "bad",
    "not run": "none",
}


def to_page(report: Document) -> str:
    """The HTML file's text."""
    machine = f"{cpu_model()}, {cores()} cores"
    time = datetime.datetime.now().astimezone().isoformat(sep=" ", timespec="minutes")
    template = jinja2.Template((_FOLDER / "page.html").read_text(), autoescape=True)
    body, name = [], TITLE
    for part in report.parts:
        headings = re.findall("^## (.+)$", part, re.M) if isinstance(part, str) else []
        body.append(_html(part, report, name))
        name = headings[-1] if headings else name
    markdown = "\n".join(part for part in report.parts if isinstance(part, str))
    return template.render(
        title=TITLE,
        lead=report.lead,
        made=f"Made {time}, commit {(git_commit() or 'unknown')[:11]}, {machine}.",
        style=(_FOLDER / "page.css").read_text(),
        headings=re.findall("^## (.+)$", markdown, re.M),
        slug=slug,
        body="\n".join(body),
    )


def _html(part: Part, report: Document, name: str) -> str:
    if isinstance(part, Picture):
        return _figure(part, report)
    if isinstance(part, Folded):
        summary = html.escape(part.title)
        return f"<details><summary>{summary}</summary>\n{to_html(part.body, name)}</details>"
    return to_html(part, name)


def to_html(text: str, name: str) -> str:
    """Markdown as HTML, without any HTML of its own.

    The section's ``name`` labels its tables and blocks that scroll.
    """
    tokens = _MARKDOWN.parse(text)
    for place, token in enumerate(tokens):
        if token.type == "heading_open":
            token.attrSet("id", slug(tokens[place + 1].content))
        elif token.type == "table_open":
            last = next(k for k in range(place, len(tokens)) if tokens[k].type == "table_close")
            _style_table(tokens[place:last])
    made = _MARKDOWN.renderer.render(tokens, _MARKDOWN.options, {"name": name})
    for words, color in _COLORS.items():
        badge = f'<strong class="verdict {color}">{words}</strong>'
        made = made.replace(f"<strong>{words}</strong>", badge)
    return made


def _style_table(tokens: Sequence[Token]) -> None:
    """Columns of numbers stand to the right; cells know their column's head, for narrow screens."""
    rows: list[list[tuple[Token, str]]] = []
    for place, token in enumerate(tokens):
        if token.type == "tr_open":
            rows.append([])
        elif token.type in ("th_open", "td_open"):
            rows[-1].append((token, tokens[place + 1].content))
    head, *body = rows
    if any(len(text) > _LONG for row in body for _, text in row):
        tokens[0].attrSet("class", "stack")
    elif len(head) > _WIDE:
        tokens[0].attrSet("class", "wide")
    for (title, words), *cells in zip(head, *body, strict=True):
        title.attrSet("scope", "col")
        texts = [text for _, text in cells if text]
        kind = next(
            (k for k, form in (("n", _NUMBER), ("k", _SHORT)) if all(map(form.fullmatch, texts))),
            None,
        )
        for cell in (title, *(cell for cell, _ in cells)):
            if texts and kind:
                cell.attrSet("class", kind)
        for cell, _ in cells:
            cell.attrSet("data-head", words)


def _region(env: dict[str, str], what: str) -> str:
    """A box that scrolls sideways, for the keyboard too."""
    label = html.escape(f"{env['name']}: {what}")
    return f'<div class="scroll" role="region" tabindex="0" aria-label="{label}">'


def _table_open(self, tokens, index, options, env) -> str:
    return _region(env, "table") + self.renderToken(tokens, index, options, env)


def _table_close(self, tokens, index, options, env) -> str:
    return self.renderToken(tokens, index, options, env) + "</div>\n"


def _fence(self, tokens, index, options, env) -> str:
    """Aligned text; its width is an attribute, by which the style fits it to paper."""
    text = tokens[index].content.rstrip("\n")
    columns = max(map(len, text.splitlines()), default=1)
    body = html.escape(text, quote=False)
    return f'{_region(env, "text")}<pre style="--columns: {columns}">{body}</pre></div>\n'


_MARKDOWN.add_render_rule("table_open", _table_open)
_MARKDOWN.add_render_rule("table_close", _table_close)
_MARKDOWN.add_render_rule("fence", _fence)


def _figure(picture: Picture, report: Document) -> str:
    """A picture with its caption; nothing where it was not made."""
    if picture.draw is not None:
        buffer = io.BytesIO()
        picture.draw().savefig(buffer, format="png", dpi=PICTURE_DPI, metadata={"Software": None})
        data = buffer.getvalue()
    else:
        folders = ((report.run, picture.run), (report.docs, picture.docs))
        paths = [folder / name for folder, name in folders if folder is not None and name]
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            return ""
        data = path.read_bytes()
    height, width = imread(io.BytesIO(data)).shape[:2]
    address = "data:image/png;base64," + base64.b64encode(data).decode("ascii")
    return (
        f'<figure><img src="{address}" width="{width}" height="{height}" '
        f'style="--width: {width}px" alt="{html.escape(picture.alt)}">'
        f"<figcaption>{html.escape(picture.caption)}</figcaption></figure>"
    )
