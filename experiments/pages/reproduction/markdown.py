"""The Markdown that our tables are written in, as HTML: headings, lists, tables, code, pictures.

No more than `experiments` itself writes: everything else of the language is plain text here, and
every text is escaped.
"""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Iterator, Sequence

from experiments.runner.markdown import slug

_INLINE = re.compile(r"`([^`]+)`|\*\*(.+?)\*\*|\[([^\]]+)\]\(([^)\s]+)\)")
_NUMBER = re.compile(r"[+−-]?[\d.,]+ ?%?")
_SHORT = re.compile(r"`[^` ]{1,30}`|\d{4}-\d\d-\d\d")
_WIDE = 8  # columns from which a table is set smaller


def inline(text: str) -> str:
    """A line's code, emphasis and links."""
    parts, end = [], 0
    for match in _INLINE.finditer(text):
        parts.append(html.escape(text[end : match.start()], quote=False))
        code, strong, words, address = match.groups()
        if code:
            parts.append(f"<code>{html.escape(code, quote=False)}</code>")
        elif strong:
            parts.append(f"<strong>{inline(strong)}</strong>")
        else:
            parts.append(f'<a href="{html.escape(address)}">{inline(words)}</a>')
        end = match.end()
    return "".join(parts) + html.escape(text[end:], quote=False)


def to_html(text: str, *, name: str = "") -> str:
    """Blocks of Markdown as HTML.

    Args:
      text: Markdown.
      name: of what it belongs to: tables and code that scroll are called by it.
    """
    return "\n".join(_blocks(text.splitlines(), name))


def _blocks(lines: Sequence[str], name: str) -> Iterator[str]:
    place = 0
    while place < len(lines):
        line, end = lines[place], place + 1
        if line.startswith("```"):
            while end < len(lines) and not lines[end].startswith("```"):
                end += 1
            yield _code(lines[place + 1 : end], name)
            end += 1
        elif heading := re.match(r"(#{1,6}) (.+)", line):
            level, words = len(heading[1]), heading[2]
            yield f'<h{level} id="{slug(words)}">{inline(words)}</h{level}>'
        elif line.startswith("|"):
            end = _while(lines, end, lambda row: row.startswith("|"))
            yield _table(lines[place:end], name)
        elif line.startswith("- "):
            end = _while(lines, end, lambda row: row.startswith(("- ", "  ")))
            items = "\n".join(lines[place:end]).removeprefix("- ").split("\n- ")
            yield "<ul>" + "".join(f"<li>{inline(_joined(item))}</li>" for item in items) + "</ul>"
        elif line.strip():
            end = _while(lines, end, lambda row: row.strip() and not _starts(row))
            yield f"<p>{inline(_joined(' '.join(lines[place:end])))}</p>"
        place = end


def _while(lines: Sequence[str], place: int, holds: Callable[[str], object]) -> int:
    while place < len(lines) and holds(lines[place]):
        place += 1
    return place


def _starts(line: str) -> bool:
    """Whether another kind of block begins."""
    return line.startswith(("```", "|", "- ")) or re.match(r"#{1,6} ", line) is not None


def _joined(text: str) -> str:
    return re.sub(r"\s+", " ", text).strip()


def _code(lines: Sequence[str], name: str) -> str:
    """Aligned text; how wide it is is told to the style, which fits it to paper."""
    columns = max((len(line) for line in lines), default=1)
    text = html.escape("\n".join(lines), quote=False)
    return f'<div {_region(name, "text")}><pre style="--columns: {columns}">{text}</pre></div>'


def _table(lines: Sequence[str], name: str) -> str:
    head, rows = cells(lines[0]), [cells(line) for line in lines[2:]]
    kind = ' class="wide"' if len(head) > _WIDE else ""
    places = [_kind([row[column] for row in rows]) for column in range(len(head))]
    titles = "".join(
        f'<th scope="col"{place}>{inline(cell)}</th>'
        for cell, place in zip(head, places, strict=True)
    )
    body = "".join(
        "<tr>"
        + "".join(f"<td{p}>{inline(cell)}</td>" for cell, p in zip(row, places, strict=True))
        + "</tr>"
        for row in rows
    )
    table = f"<table{kind}><thead><tr>{titles}</tr></thead><tbody>{body}</tbody></table>"
    return f"<div {_region(name, 'table')}>{table}</div>"


def _region(name: str, what: str) -> str:
    """A box that scrolls sideways, for the keyboard too."""
    label = html.escape(f"{name}: {what}" if name else what)
    return f'class="scroll" role="region" tabindex="0" aria-label="{label}"'


def cells(line: str) -> list[str]:
    """The cells of a table's row; a bar after a backslash is part of one."""
    parts = re.split(r"(?<!\\)\|", line.strip())[1:-1]
    return [part.strip().replace("\\|", "|") for part in parts]


def _kind(column: Sequence[str]) -> str:
    """Columns of numbers stand to the right, short codes and dates in one line."""
    told = [cell for cell in column if cell]
    if told and all(_NUMBER.fullmatch(cell) for cell in told):
        return ' class="n"'
    if told and all(_SHORT.fullmatch(cell) for cell in told):
        return ' class="k"'
    return ""
