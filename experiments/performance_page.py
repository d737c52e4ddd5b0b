"""Writes the tables of docs/performance.md from the recorded benchmark.

python -m experiments.performance_page

Run it after copying a run's benchmark.json to experiments/results, and the benchmark.json of a run
with ``--only scaling`` as scaling.json. `experiments.results_page` writes this page too.
"""

from __future__ import annotations

from experiments.pages import blocks
from experiments.pages.reproduction.studies import ROOT, recorded

PAGE = ROOT / "docs" / "performance.md"


def main() -> None:
    """Rewrites the page."""
    blocks.write_pages(recorded(), [PAGE])


if __name__ == "__main__":
    main()
