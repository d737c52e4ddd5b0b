"""Writes what is generated in README.md and docs: blocks, docs/results.md and, if asked, pictures.

python -m experiments.docs [--pictures]

Run it after copying a run's JSON to experiments/results under the name of the record
(`experiments.pages.reproduction.studies` lists them). A test checks that the pages are current.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from experiments.pages import blocks, how_it_works
from experiments.pages.reproduction.document import Picture, document, to_markdown
from experiments.pages.reproduction.studies import ROOT, recorded
from experiments.runner import study_command as study
from vanejax.files import write_text
from vanejax.plotting import save_figure

DOCS = ROOT / "docs"
RESULTS_PAGE = DOCS / "results.md"


def results_page() -> str:
    """docs/results.md as the recorded results make it."""
    mode = (
        "Made by `python -m experiments.docs` from the recorded results in `experiments/results`; "
        "`python -m experiments.reproduce --quick` makes an HTML page of it, with more pictures "
        "and the pretrained weights evaluated again."
    )
    return to_markdown(document(recorded(), mode))


def record_pictures() -> dict[str, Picture]:
    """By file name: the pictures that are drawn from the recorded results."""
    parts = document(recorded(), "").parts
    return {p.docs: p for p in parts if isinstance(p, Picture) and p.docs and p.draw}


def draw(folder: Path) -> None:
    """Draws what the records and the pretrained weights suffice for, as PNG."""
    figures = {name: picture.draw() for name, picture in record_pictures().items()}
    for name, figure in (figures | how_it_works.pictures()).items():
        save_figure(figure, folder / name)
        (folder / name).with_suffix(".pdf").unlink()  # Markdown shows none
        print(folder / name)


def main(settings: argparse.Namespace) -> None:
    """Writes the pages, and the pictures if asked."""
    blocks.write_pages(recorded())
    write_text(RESULTS_PAGE, results_page())
    if settings.pictures:
        draw(DOCS)


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pictures", action="store_true", help="draw docs/*.png, too: two minutes")
    return parser


if __name__ == "__main__":
    study.run(main, make_parser())
