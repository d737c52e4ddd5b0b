"""Puts the recorded comparison with real scans into docs/real_scans.md, between its marks.

python -m experiments.sensor_fit_page

Run it after copying a run's sensor_fit.json to experiments/results and its real_scans.png to docs;
a test checks that the page is current.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.marked_page import with_block
from experiments.results_page import made_by
from experiments.sensor_fit import table
from vanejax.whole_file import write_text

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "real_scans.md"
RECORDED = ROOT / "experiments" / "results" / "sensor_fit.json"


def recorded() -> dict[str, Any]:
    """The recorded comparison."""
    return json.loads(RECORDED.read_text())


def page(text: str, report: Mapping[str, Any]) -> str:
    """The page with its table replaced."""
    return with_block(text, "table", f"{table(report)}\n\n{made_by(report)}")


def main() -> None:
    """Rewrites the page."""
    write_text(PAGE, page(PAGE.read_text(), recorded()))


if __name__ == "__main__":
    main()
