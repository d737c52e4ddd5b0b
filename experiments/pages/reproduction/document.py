"""What the report says, as one document, and that as Markdown for docs/results.md."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from experiments.pages.reproduction.claim import Results
from experiments.pages.reproduction.contents import OF_OURS, OF_PAPER, Section, sections, summary
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.studies import BY_RECORD, Outcome
from experiments.pages.reproduction.topic import Picture
from experiments.runner.markdown import machine_of, table

TITLE = "The paper, measured again"
PAPER = (
    "“Simulation of Self-Occlusion Virtual Dataset Method for Robust Point Matching Algorithm, "
    "With Applications to Positioning of Guide Vanes”"
)
HOW_TO_READ = (
    "The paper's figures are of its own vanes, camera and machine, which nobody else has; ours are "
    "of the parametric guide vane built in here, under virtual sensors unless a section says real. "
    "RMSE and FFMDE are not 0 at the true pose but what noise and the spacing of the points make "
    "of them: where ours is no more than that, the row says not comparable, whichever is lower. "
    "Every verdict and every sentence beside it is computed from the figures."
)
SUMMARIES = {"What the paper claims": OF_PAPER, "What the paper has not": OF_OURS}
WAS_RUN = "What was run"
SOURCES = "Where every number comes from"


@dataclasses.dataclass(frozen=True, eq=False)
class Document:
    """What the report says.

    Attributes:
      results: by record's name.
      mode: how they came about, in a sentence.
      sections: of the page.
      outcomes: of a run's studies; none where recorded results are shown.
      docs, run: folders of pictures, as far as there are any.
    """

    results: Results
    mode: str
    sections: Sequence[Section]
    outcomes: Sequence[Outcome] = ()
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
    """The report of some results; see `Document`."""
    return Document(results, mode, sections(results, live), outcomes, docs, run)


def to_markdown(report: Document) -> str:
    """docs/results.md: no date and no machine but those of the records."""
    blocks = [
        f"# {TITLE}",
        f"{PAPER}: every table and figure, with the paper's value, ours, and what follows. "
        f"{report.mode}",
        HOW_TO_READ,
        summaries(report),
    ]
    for section in report.sections:
        blocks.append(f"## {section.topic.title}")
        blocks += [_picture(part) if isinstance(part, Picture) else part for part in section.parts]
    blocks.append(closing(report))
    return "\n\n".join(block for block in blocks if block).rstrip() + "\n"


def summaries(report: Document) -> str:
    """The claims of the paper and our own goals, as Markdown."""
    return "\n\n".join(
        f"## {title}\n\n{summary(topics, report.results)}" for title, topics in SUMMARIES.items()
    )


def closing(report: Document) -> str:
    """Provenance and, of a run, what became of its studies, as Markdown."""
    parts = [f"## {WAS_RUN}", _outcomes(report.outcomes)] if report.outcomes else []
    return "\n\n".join(
        [
            *parts,
            f"## {SOURCES}",
            "Tables and sentences are made from these records and from nothing else; "
            "`python -m experiments.reproduce` runs all the commands, one after the other. A `+` "
            "after a commit: the source tree had changes.",
            _provenance(report.results),
        ]
    )


def _outcomes(outcomes: Sequence[Outcome]) -> str:
    """What became of the studies of a run."""
    rows = [
        [o.study.name, o.study.title, o.state if o.ended else f"**{o.state}**", o.why,
         f"{o.seconds / 60:.1f}"]
        for o in outcomes
    ]  # fmt: skip
    return table(["study", "finds", "state", "why", "minutes"], rows)


def _provenance(results: Results) -> str:
    """Where every number comes from: record, date, commit, machine, seed, command."""
    rows = []
    for name, report in results.items():
        config = report.get("config", {})
        seed = report.get("seed", report.get("seeds", config.get("seed", "–")))
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


def _picture(picture: Picture) -> str:
    return f"![{picture.alt}]({picture.docs})\n\n{picture.caption}" if picture.docs else ""
