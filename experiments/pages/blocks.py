"""The generated blocks of README.md and docs/: every block by its name, every page that has one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from experiments.pages import tables
from experiments.pages.reproduction.studies import ROOT
from experiments.pages.summary_table import summary_table
from experiments.runner.markdown import provenance, text_block, with_blocks
from experiments.studies.ablation import table as ablation_table
from experiments.studies.comparison import table as comparison_table
from experiments.studies.density import report as density_report
from experiments.studies.public_vs_virtual import study as public_vs_virtual
from experiments.studies.real_scans import study as real_scans
from experiments.studies.robustness import report as robustness_report
from experiments.studies.sensor_fit import study as sensor_fit
from experiments.studies.sensor_transfer import study as sensor_transfer
from vanejax.files import write_text

Results = Mapping[str, Any]


def _ablation(report: Results) -> str:
    return text_block(ablation_table.table(report))


def _density(report: Results) -> str:
    sweeps = "\n\n".join(density_report.table(sweep) for sweep in report["sweeps"])
    return f"{report['verdict']}\n\n{text_block(sweeps)}"


# by the name of the block: what makes the Markdown, and the records that it takes
BLOCKS: dict[str, tuple[Callable[..., str], tuple[str, ...]]] = {
    "vane": (tables.evaluation_table, ("vane",)),
    "table 1": (comparison_table.table, ("comparison",)),
    "tuning": (tables.tuning_table, ("tuning",)),
    "public": (public_vs_virtual.table, ("public_vs_virtual",)),
    "density": (_density, ("density",)),
    "neighbors": (_ablation, ("ablation_neighbors",)),
    "noise": (_ablation, ("ablation_noise",)),
    "series": (robustness_report.markdown, ("robustness",)),
    "random": (lambda report: robustness_report.random_lines(report["random"]), ("robustness",)),
    "table": (sensor_fit.table, ("sensor_fit",)),
    "known sensor": (real_scans.sensor_table, ("real_scans",)),
    "trained on": (sensor_transfer.table, ("sensor_transfer",)),
    "figures": (tables.performance_table, ("benchmark", "scaling")),
}


def block(name: str, results: Results) -> str:
    """The body of a block.

    Args:
      name: between its marks.
      results: records by name.

    Raises:
      KeyError: no block has this name.
    """
    if name == "measured":
        return summary_table(results)
    table, records = BLOCKS[name]
    body = table(*(results[record] for record in records))
    if name == "random" or len(records) > 1:  # beside "series"; with dates of their own
        return body
    return f"{body}\n\n{provenance(results[records[0]])}"


def pages() -> list[Path]:
    """The README and the pages of docs/ that have generated blocks."""
    found = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    return [path for path in found if "<!-- end of " in path.read_text()]


def page(path: Path, results: Results) -> str:
    """A page with its blocks made anew."""
    return with_blocks(path.read_text(), lambda name: block(name, results))


def write_pages(results: Results, paths: Iterable[Path] | None = None) -> None:
    """Rewrites the blocks of some pages, of all by default."""
    for path in pages() if paths is None else paths:
        write_text(path, page(path, results))
