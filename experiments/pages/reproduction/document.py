"""The report: one list of parts, from which docs/results.md and the HTML page are written.

Its text is the template report.md; verdicts, tables and pictures are made from the records.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.figure import Figure

from experiments.pages.blocks import BLOCKS, GROUPS, block
from experiments.pages.reproduction.claim import Results, Topic, Verdict
from experiments.pages.reproduction.claims import networks, poses, scans
from experiments.pages.reproduction.live import Live, against_evaluation, against_position
from experiments.pages.reproduction.studies import BY_RECORD, Outcome
from experiments.runner.markdown import folded, machine_of, provenance, slug, table
from experiments.studies.ablation import picture as ablation_picture
from experiments.studies.castings import report as castings_report
from experiments.studies.comparison import pictures as comparison_pictures
from experiments.studies.density import report as density_report
from experiments.studies.fine import study as fine
from experiments.studies.position import report as position_report
from experiments.studies.public_vs_virtual import study as public_vs_virtual
from experiments.studies.robustness import report as robustness_report
from experiments.studies.verdicts import report as verdict_report

TITLE = "Reproduction of the paper"
PAPER = (
    "“Simulation of Self-Occlusion Virtual Dataset Method for Robust Point Matching Algorithm, "
    "With Applications to Positioning of Guide Vanes”"
)
TOPICS = {topic.name: topic for topic in (*scans.TOPICS, *networks.TOPICS, *poses.TOPICS)}
# by record, and by what of it where there are several: the picture that is drawn
PICTURES: dict[str, Callable[[Any], Figure]] = {
    "density": lambda report: density_report.picture(report["sweeps"]),
    "comparison": comparison_pictures.error_shares,
    "comparison/maps": comparison_pictures.error_maps,
    "public_vs_virtual/hardest": lambda report: public_vs_virtual.picture(report, "hardest"),
    "public_vs_virtual/all": lambda report: public_vs_virtual.picture(report, "all"),
    "ablation_neighbors": ablation_picture.picture,
    "ablation_noise": ablation_picture.picture,
    "robustness": robustness_report.picture,
    "position": position_report.picture,
    "fine": lambda report: fine.picture(report["levels"]),
    "verdicts": verdict_report.picture,
    "castings": castings_report.picture,
}


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """A figure of the report: drawn from a record, or made by a study.

    Attributes:
      alt: what it shows, for readers who cannot see it.
      caption: what to look for.
      docs: its name under docs, where the picture of the record is.
      run: its path under a run's folder.
      draw: makes it from the record; Markdown needs the file under docs all the same.
    """

    alt: str
    caption: str
    docs: str = ""
    run: str = ""
    draw: Callable[[], Figure] | None = None


@dataclasses.dataclass(frozen=True)
class Folded:
    """Markdown that is closed until the reader opens it: raw tables."""

    title: str
    body: str


Part = str | Picture | Folded


@dataclasses.dataclass(frozen=True, eq=False)
class Document:
    """What the report says.

    Attributes:
      lead: the first paragraph, as text.
      parts: Markdown, pictures and folded tables, in order.
      docs, run: folders of pictures, as far as there are any.
    """

    lead: str
    parts: Sequence[Part]
    docs: Path | None = None
    run: Path | None = None


def document(
    results: Results,
    mode: str,
    *,
    live: Live | None = None,
    outcomes: Sequence[Outcome] = (),
    docs: Path | None = None,
    run: Path | None = None,
) -> Document:
    """The report of some records, by name.

    ``mode`` says how they were made, ``live`` is what was measured for the report, ``outcomes`` are
    of the studies of a run; ``docs`` and ``run`` are as in `Document`.
    """
    kept: list[Picture | Folded] = []

    def keep(part: Picture | Folded) -> str:
        kept.append(part)
        return f"\x00{len(kept) - 1}\x00"

    def picture(alt: str, caption: str, *, draw: str = "", **files: str) -> str:
        if not draw:
            return keep(Picture(alt, caption, **files))
        record = draw.partition("/")[0]
        if record not in results:
            return ""
        drawn = functools.partial(PICTURES[draw], results[record])
        return keep(Picture(alt, caption, **files, draw=drawn))

    def shown_block(name: str) -> str:
        records = [BLOCKS[part][0] for part in GROUPS.get(name, (name,))]
        absent = [record for record in records if record not in results]
        return missing(absent[0]) if absent else block(name, results)

    def raw_table(title: str, name: str) -> str:
        body = shown_block(name)
        return body if body.startswith("**Not measured") else keep(Folded(title, body))

    template = jinja2.Template(Path(__file__).with_name("report.md").read_text())
    text = template.render(
        results=results,
        live=live,
        outcomes=outcomes,
        summary=functools.partial(summary, results),
        section=lambda name: f"## {TOPICS[name].title}\n\n{judged(TOPICS[name], results)}",
        picture=picture,
        block=shown_block,
        table=raw_table,
        provenance=lambda name: provenance(name, results[name]),
        live_evaluation=lambda: against_evaluation(results.get("vane"), live),
        live_position=lambda: against_position(results.get("position"), live),
        studies=lambda: _outcomes(outcomes),
        sources=lambda: keep(
            Folded("Record, date, commit, machine, seed and command", _sources(results))
        ),
    )
    parts: list[Part] = []
    for place, piece in enumerate(text.split("\x00")):
        if place % 2:
            parts.append(kept[int(piece)])
        elif piece.strip():
            parts.append(re.sub(r"\n{3,}", "\n\n", piece.strip()))
    lead = f"{PAPER}: every table and figure, with the paper's value, ours, and a verdict. {mode}"
    return Document(lead, parts, docs, run)


def to_markdown(report: Document) -> str:
    """docs/results.md: no date and no machine but those of the records."""
    blocks = [f"# {TITLE}", report.lead]
    for part in report.parts:
        if isinstance(part, Folded):
            blocks.append(folded(part.title, part.body))
        elif isinstance(part, str):
            blocks.append(part)
        elif part.docs:
            blocks.append(f"![{part.alt}]({part.docs})\n\n{part.caption}")
    return "\n\n".join(blocks) + "\n"


def missing(name: str) -> str:
    """The sentence in place of a record."""
    return (
        f"**Not measured yet:** there is no result {name}. `{BY_RECORD[name].command()}` makes it."
    )


def summary(results: Results, of_paper: bool) -> str:
    """All claims of the paper, or all goals, with their verdicts and how many there are of each."""
    rows, counts = [], Counter()
    for topic in TOPICS.values():
        if topic.of_paper is of_paper:
            where = f"[{topic.title.partition(':')[0]}](#{slug(topic.title)})"
            for row in _judged(topic, results):
                rows.append([*row[:4], where])
                counts[row[3]] += 1
    kinds = [f"**{verdict.value}**" for verdict in Verdict]
    counted = ", ".join(f"{counts[kind]} {kind.strip('*')}" for kind in kinds if counts[kind])
    return f"{len(rows)} in all: {counted}.\n\n{table(_head(of_paper, 'section'), rows)}"


def judged(topic: Topic, results: Results) -> str:
    """A topic's claims with their verdicts and why."""
    return table(_head(topic.of_paper, "because"), _judged(topic, results))


def _judged(topic: Topic, results: Results) -> list[list[str]]:
    rows = []
    for claim in topic.claims:
        finding = claim.finding(results)
        verdict = f"**{finding.verdict.value}**"
        rows.append([claim.words, claim.value(results), finding.ours, verdict, finding.because])
    return rows


def _head(of_paper: bool, last: str) -> list[str]:
    words = ("claim of the paper", "paper") if of_paper else ("what", "goal")
    return [*words, "ours", "verdict", last]


def _outcomes(outcomes: Sequence[Outcome]) -> str:
    rows = [
        [o.study.name, o.study.title, o.state if o.ended else f"**{o.state}**", o.why,
         f"{o.seconds / 60:.1f}"]
        for o in outcomes
    ]  # fmt: skip
    return table(["study", "measures", "state", "why", "minutes"], rows)


def _sources(results: Results) -> str:
    rows = []
    for name, report in results.items():
        seed = report.get("seed", report.get("seeds", report.get("config", {}).get("seed", "–")))
        rows.append(
            [
                f"`{name}.json`",
                str(report["date"])[:10],
                f"`{str(report['commit'] or 'unknown')[:11]}`",
                machine_of(report),
                ", ".join(map(str, seed)) if isinstance(seed, list) else str(seed),
                f"`{BY_RECORD[name].command()}`",
            ]
        )
    return table(["record", "date", "commit", "machine", "seed", "command"], rows)
