"""Every generated block of Markdown by its name, and the pages of README.md and docs/ with them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from experiments.pages import tables
from experiments.pages.reproduction.studies import ROOT
from experiments.runner.markdown import provenance, text_block, with_blocks
from experiments.studies.ablation import table as ablation_table
from experiments.studies.any_pose import study as any_pose
from experiments.studies.castings import report as castings_report
from experiments.studies.comparison import table as comparison_table
from experiments.studies.density import report as density_report
from experiments.studies.fine import study as fine
from experiments.studies.position import report as position_report
from experiments.studies.public_vs_virtual import study as public_vs_virtual
from experiments.studies.real_scans import study as real_scans
from experiments.studies.robustness import report as robustness_report
from experiments.studies.sensor_fit import study as sensor_fit
from experiments.studies.sensor_transfer import study as sensor_transfer
from experiments.studies.verdicts import report as verdict_report
from vanejax.files import write_text

Report = Mapping[str, Any]
PAPER_SERIES = ("distance", "angle", "light")  # of robustness.json: the paper's Fig. 11


def series(report: Report, names: Iterable[str]) -> Report:
    """A record of robustness with these series alone."""
    return {**report, "series": [s for s in report["series"] if s["name"] in names]}


def other_series(report: Report) -> list[str]:
    """The names of the series that the paper has not."""
    return [s["name"] for s in report["series"] if s["name"] not in PAPER_SERIES]


def _text(table: Callable[[Any], str]) -> Callable[[Any], str]:
    """A table of aligned text as Markdown."""
    return lambda report: text_block(table(report))


def _density(report: Report) -> str:
    texts = [*map(density_report.table, report["sweeps"]), density_report.LEGEND]
    return f"{report['verdict']}\n\n" + text_block("\n\n".join(texts))


def _robustness(report: Report, names: Iterable[str]) -> str:
    return robustness_report.markdown(series(report, names))


# by the name of the block: the record, and what makes the Markdown of it
BLOCKS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "vane": ("vane", tables.evaluation_table),
    "table 1": ("comparison", comparison_table.table),
    "tuning": ("tuning", tables.tuning_table),
    "public": ("public_vs_virtual", public_vs_virtual.table),
    "density": ("density", _density),
    "neighbors": ("ablation_neighbors", _text(ablation_table.table)),
    "noise": ("ablation_noise", _text(ablation_table.table)),
    "series": ("robustness", robustness_report.markdown),
    "paper series": ("robustness", lambda report: _robustness(report, PAPER_SERIES)),
    "other series": ("robustness", lambda report: _robustness(report, other_series(report))),
    "random": ("robustness", lambda report: robustness_report.random_lines(report["random"])),
    "position": ("position", position_report.table),
    "fine": ("fine", _text(lambda report: fine.table(report["levels"]))),
    "verdicts": ("verdicts", _text(verdict_report.table)),
    "any pose": ("any_pose", _text(any_pose.table)),
    "castings": ("castings", castings_report.table),
    "real scans": ("real_scans", _text(real_scans.table)),
    "known sensor": ("real_scans", real_scans.sensor_table),
    "table": ("sensor_fit", sensor_fit.table),
    "trained on": ("sensor_transfer", sensor_transfer.table),
    "times": ("benchmark", tables.benchmark_table),
    "scaling": ("scaling", tables.scaling_table),
}
GROUPS = {"figures": ("times", "scaling")}  # blocks of several


def block(name: str, results: Mapping[str, Report]) -> str:
    """The body of a block with the provenance of its record below; KeyError for an unknown name."""
    if name == "measured":
        return tables.summary_table(results)
    if name in GROUPS:
        return "\n\n".join(block(part, results) for part in GROUPS[name])
    record, table = BLOCKS[name]
    return f"{table(results[record]).strip()}\n\n{provenance(record, results[record])}"


def pages() -> list[Path]:
    """The README and the pages of docs/ that have generated blocks."""
    paths = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    return [path for path in paths if "<!-- end of " in path.read_text()]


def page(path: Path, results: Mapping[str, Report]) -> str:
    """A page with its blocks made anew."""
    return with_blocks(path.read_text(), lambda name: block(name, results))


def write_pages(results: Mapping[str, Report]) -> None:
    """Rewrites the blocks of all pages."""
    for path in pages():
        write_text(path, page(path, results))
