"""Markdown made from records: tables, aligned text, folded parts, generated blocks, provenance."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

_BLOCK = re.compile(r"<!-- ([^>]+?) -->\n(?:.*?\n)??<!-- end of \1 -->", re.DOTALL)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; bars inside cells are escaped."""
    return "\n".join([_row(head), "|" + "---|" * len(head), *map(_row, rows)])


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def text_block(text: str) -> str:
    """Aligned text in a fixed-width block."""
    return f"```text\n{text.rstrip()}\n```"


def folded(title: str, body: str) -> str:
    """A part that is closed until the reader opens it, on GitHub and in the documentation site."""
    return f'<details markdown="1">\n<summary>{title}</summary>\n\n{body.strip()}\n\n</details>'


def slug(title: str) -> str:
    """The anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def with_blocks(page: str, body_of: Callable[[str], str]) -> str:
    """A page with every block between ``<!-- NAME -->`` and ``<!-- end of NAME -->`` made anew.

    ``body_of`` gives the text of a block by its name, or KeyError. Raises ValueError for a mark
    without its partner and for an unknown name.
    """
    names = [match[1] for match in _BLOCK.finditer(page)]
    ends = re.findall(r"<!-- end of (.+?) -->", page)
    if sorted(names) != sorted(ends):
        raise ValueError(f"marks without a partner: {', '.join({*names} ^ {*ends})}")

    def made(match: re.Match[str]) -> str:
        try:
            body = body_of(match[1])
        except KeyError:
            raise ValueError(f"no block is called {match[1]}") from None
        return f"<!-- {match[1]} -->\n{body.strip()}\n<!-- end of {match[1]} -->"

    return _BLOCK.sub(made, page)


def provenance(name: str, report: Mapping[str, Any]) -> str:
    """Name, machine, date and commit of a record, in a line."""
    commit = str(report["commit"] or "unknown")[:10]
    return f"Record `{name}.json`: {machine_of(report)}; {report['date'][:10]}, commit {commit}."


def machine_of(report: Mapping[str, Any]) -> str:
    """The machine of a record, as far as the record names it."""
    machine = report.get("machine", {})
    name = machine.get("cpu") or machine.get("processor") or report.get("device") or "unknown"
    cores = machine.get("cores")
    return f"{name}, {cores} core{'s' if cores != 1 else ''}" if cores else str(name)
