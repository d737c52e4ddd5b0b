"""Generated blocks inside written pages, each between two marks: ``<!-- name -->``."""

from __future__ import annotations


def with_block(text: str, name: str, body: str) -> str:
    """The page with the block of this name replaced.

    Raises:
      ValueError: the page lacks one of the two marks, or they stand in the wrong order.
    """
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    before, found, rest = text.partition(begin)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"the page has no {begin} ... {end}")
    return f"{before}{begin}\n{body.rstrip()}\n{end}{after}"
