"""The reproduction of the paper: every table and figure with our values, in one HTML page.

python -m experiments.reproduce --quick [--weights FILE] [--out runs/reproduce]
python -m experiments.reproduce [--real-scans FOLDER] [--shapes PATH] [--only NAME,...] [--plan]

``--quick`` shows the recorded results of experiments/results, evaluates the pretrained weights on
the 54 test views and runs the virtual stand again: minutes. Without it everything is trained and
measured again, each study in its own folder under ``--out``: many hours, ``--plan`` says how many.
Give the same command again to go on: finished studies are kept. A study that fails is named in the
page, the others go on, and the exit code is 1. Results: reproduction.html in ``--out``, which needs
no network and no other file.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

from experiments.pages.reproduction.document import Document, document
from experiments.pages.reproduction.live import evaluate_live, measure_position
from experiments.pages.reproduction.page import to_page
from experiments.pages.reproduction.run import estimate, make_folders, measured, run_studies
from experiments.pages.reproduction.studies import ROOT, Outcome, chosen, recorded
from experiments.runner import study_command as study
from vanejax.cad import guide_vane
from vanejax.errors import InputError
from vanejax.files import check_writable, write_json, write_text
from vanejax.training.weight_file import PRETRAINED, find_weights

FILE = "reproduction.html"
SOLIDS = "solids"  # what public.py itself trains on where there is no ModelNet40


def quick(out: Path, weights: str) -> None:
    """Writes the page of the recorded results, with the weights evaluated again."""
    page = _page(out)
    matcher = find_weights(weights, guide_vane())
    words = "those that come with the package" if weights == PRETRAINED else Path(weights).name
    live = evaluate_live(matcher, words, out)
    live = dataclasses.replace(live, position=measure_position(out))
    results = recorded()
    results.setdefault("position", live.position)
    mode = (
        "Results are the recorded ones of experiments/results. For this page the weights were "
        "evaluated and the virtual stand was run again."
    )
    _write(page, document(results, mode, live=live, docs=ROOT / "docs", run=out))


def full(out: Path, inputs: dict[str, str], only: str | None) -> list[Outcome]:
    """Trains and measures everything again, and writes the page."""
    page = _page(out)
    outcomes = run_studies(chosen(only), out, inputs, say=lambda text: print(text, flush=True))
    rows = [
        {"study": o.study.name, "state": o.state, "why": o.why, "seconds": round(o.seconds, 1)}
        for o in outcomes
    ]
    write_json(out / "outcomes.json", rows)
    mode = "All results were trained and measured for this page."
    _write(page, document(measured(chosen(None), out), mode, outcomes=outcomes, run=out))
    return outcomes


def _page(out: Path) -> Path:
    """The page's path, after a check that it can be written."""
    make_folders(out)
    check_writable(out / FILE)
    return out / FILE


def _write(page: Path, report: Document) -> None:
    text = to_page(report)
    write_text(page, text)
    print(f"{page}: {len(text) / 1e6:.1f} MB")


def main(settings: argparse.Namespace) -> int:
    """The command; its exit code."""
    if settings.quick:
        for name in ("real_scans", "shapes", "only"):
            if getattr(settings, name):
                raise InputError(f"--{name.replace('_', '-')} has no meaning with --quick")
        quick(settings.out, settings.weights)
        return 0
    if settings.weights != PRETRAINED:
        raise InputError("--weights is for --quick; without it every network is trained")
    inputs: dict[str, Any] = {"shapes": settings.shapes or SOLIDS}
    if settings.real_scans:
        inputs["real_scans"] = settings.real_scans
    print(estimate(chosen(settings.only), settings.out, inputs), flush=True)
    if settings.plan:
        return 0
    outcomes = full(settings.out, inputs, settings.only)
    # a study without an input of the user is no failure; one whose needed study failed is
    failed = [
        o.study.name for o in outcomes if not o.ended and (o.state == "failed" or o.study.needs)
    ]
    if failed:
        print(f"not everything could be measured: {', '.join(failed)}")
    return 1 if failed else 0


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("reproduce", __doc__)
    parser.add_argument("--quick", action="store_true", help="recorded results, minutes")
    parser.add_argument(
        "--weights", default=PRETRAINED, help="evaluated by --quick; default: pretrained"
    )
    parser.add_argument("--real-scans", metavar="FOLDER", help="as experiments.real_scans")
    parser.add_argument(
        "--shapes", metavar="PATH", help="public shapes to train on: ModelNet40, a file (solids)"
    )
    parser.add_argument("--only", metavar="NAMES", help="these studies and what they need")
    parser.add_argument("--plan", action="store_true", help="print the studies and end")
    return parser


if __name__ == "__main__":
    study.run(lambda settings: sys.exit(main(settings)), make_parser())
