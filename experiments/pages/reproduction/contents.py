"""What the report consists of: its topics in their order, and the tables of claims and verdicts."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence

from experiments.pages.reproduction.claim import Claim, Results, Verdict
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.topic import Part, Topic
from experiments.pages.reproduction.topics.density import DENSITY
from experiments.pages.reproduction.topics.methods import METHODS
from experiments.pages.reproduction.topics.poses import ANY_POSE, BOUND, VERDICT
from experiments.pages.reproduction.topics.position import POSITION
from experiments.pages.reproduction.topics.real_scans import REAL_SCANS
from experiments.pages.reproduction.topics.scanner import SCANNER
from experiments.pages.reproduction.topics.sensing import CLUTTER, SENSING
from experiments.pages.reproduction.topics.speed import SPEED
from experiments.pages.reproduction.topics.training import ABLATIONS, PUBLIC_SHAPES
from experiments.pages.reproduction.topics.views import VIEWS
from experiments.runner.markdown import table

# as their claims are listed
OF_PAPER = (SCANNER, DENSITY, METHODS, VIEWS, ABLATIONS, PUBLIC_SHAPES, SENSING, POSITION)
OF_OURS = (BOUND, ANY_POSE, VERDICT, REAL_SCANS, CLUTTER, SPEED)
# as their sections stand on the page
TOPICS = (
    SCANNER,
    DENSITY,
    METHODS,
    VIEWS,
    PUBLIC_SHAPES,
    ABLATIONS,
    SENSING,
    POSITION,
    BOUND,
    VERDICT,
    ANY_POSE,
    REAL_SCANS,
    CLUTTER,
    SPEED,
)
CLAIMS = tuple(claim for topic in OF_PAPER for claim in topic.claims)
GOALS = tuple(claim for topic in OF_OURS for claim in topic.claims)


@dataclasses.dataclass(frozen=True, eq=False)
class Section:
    """A topic as some results make it: its claims, judged, then its body."""

    topic: Topic
    parts: Sequence[Part]


def sections(results: Results, live: Live | None = None) -> list[Section]:
    """All sections, those without any result too: they say so."""
    return [
        Section(topic, [_judged(topic, results), *topic.parts(results, live)]) for topic in TOPICS
    ]


def summary(topics: Sequence[Topic], results: Results) -> str:
    """How the claims stand, all the paper's or all ours: a count, and a table that leads on."""
    rows = [
        [*_row(claim, results), f"[{topic.title.split(':')[0]}](#{topic.anchor})"]
        for topic in topics
        for claim in topic.claims
    ]
    head = ["claim of the paper", "paper"] if topics[0].of_paper else ["what", "goal"]
    return f"{_counts(topics, results)}.\n\n" + table([*head, "ours", "verdict", "where"], rows)


def _counts(topics: Sequence[Topic], results: Results) -> str:
    """How many claims stand how, in words."""
    verdicts = [claim.finding(results).verdict for topic in topics for claim in topic.claims]
    found = Counter(verdicts)
    told = [f"{found[verdict]} {verdict.value}" for verdict in Verdict if found[verdict]]
    return f"{len(verdicts)} in all: {', '.join(told)}"


def _judged(topic: Topic, results: Results) -> str:
    """The claims of a topic, each with the sentence why."""
    rows = [[*_row(claim, results), claim.finding(results).because] for claim in topic.claims]
    whose = "paper" if topic.of_paper else "goal"
    return table(["claim", whose, "ours", "verdict", "because"], rows)


def _row(claim: Claim, results: Results) -> list[str]:
    """What it says, the paper's value or the goal, ours, and the verdict."""
    found = claim.finding(results)
    return [claim.words, claim.value(results), found.ours, f"**{found.verdict.value}**"]
