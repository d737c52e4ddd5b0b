"""A topic of the report: its claims, and a body of Markdown and pictures made from the results."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from matplotlib.figure import Figure

from experiments.pages.reproduction.claim import Claim, Results
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.studies import BY_RECORD
from experiments.runner.markdown import provenance, slug, text_block


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """A figure of the report: drawn from a result, or made by a study.

    Attributes:
      alt: what it shows, for who cannot see it.
      caption: what to look for.
      docs: its name under docs, where the recorded result's picture is.
      run: its path under a run's folder.
      draw: makes it from the results; then no file is needed but for Markdown.
    """

    alt: str
    caption: str
    docs: str = ""
    run: str = ""
    draw: Callable[[], Figure] | None = None


Part = str | Picture


@dataclasses.dataclass(frozen=True)
class Topic:
    """What a section of the report shows.

    Attributes:
      title: heading; its slug is the anchor.
      claims: that its figures bear out or not; all of the paper or all ours.
      body: Markdown and pictures, in order, from the results and what was measured afresh.
      needs: records without which there is no body.
    """

    title: str
    claims: tuple[Claim, ...]
    body: Callable[[Results, Live | None], list[Part]]
    needs: tuple[str, ...] = ()

    @property
    def anchor(self) -> str:
        """Of the heading."""
        return slug(self.title)

    @property
    def of_paper(self) -> bool:
        """Whether its claims are the paper's, not goals of ours."""
        return all(claim.place for claim in self.claims)

    def parts(self, results: Results, live: Live | None) -> list[Part]:
        """Its body, or the word that a result is missing."""
        for name in self.needs:
            if name not in results:
                return [missing(name)]
        return self.body(results, live)


def dated(results: Results, name: str, table: Callable[[Any], str]) -> str:
    """A record's Markdown with its origin below; a word where it is missing."""
    if name not in results:
        return missing(name)
    return f"{table(results[name])}\n\n{origin(results, name)}"


def dated_text(results: Results, name: str, table: Callable[[Any], str]) -> str:
    """The same of a table that is aligned text."""
    return dated(results, name, lambda report: text_block(table(report)))


def missing(name: str) -> str:
    """The word where a record is not there."""
    study = BY_RECORD[name]
    return f"**Not measured yet:** there is no result {name}. `{study.command()}` makes it."


def origin(results: Results, name: str) -> str:
    """Which record, from where."""
    return f"Record `{name}.json`: {provenance(results[name])}"
