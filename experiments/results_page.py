"""Writes every generated block and page from the recorded results: README.md and docs/*.md.

python -m experiments.results_page

Run it after copying a run's JSON to experiments/results under the name of the record
(`experiments.pages.reproduction.studies` lists them) and its pictures to docs. A test checks that
the pages are current.
"""

from __future__ import annotations

from experiments import reproduce
from experiments.pages import blocks
from experiments.pages.reproduction.studies import recorded


def main() -> None:
    """Rewrites the pages."""
    blocks.write_pages(recorded())
    reproduce.write_docs()


if __name__ == "__main__":
    main()
