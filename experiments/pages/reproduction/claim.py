"""A claim and its verdict, computed from the records alone.

The paper's numbers stand in the claims and in the studies that compare with them
(`methods.TABLE_1`, `position_report.PAPER`, the series of `robustness.json`).
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

Report = Mapping[str, Any]
Results = Mapping[str, Report]
VISIBLE = 1.1  # FFMDE over that at the true pose, from which on it tells of the pose


class Verdict(enum.Enum):
    """The verdict on a claim after our measurement."""

    BETTER = "better"
    MET = "met"
    PARTLY = "partly met"
    MISSED = "not met"
    INCOMPARABLE = "not comparable"
    UNKNOWN = "not measured"


@dataclasses.dataclass(frozen=True)
class Finding:
    """Our value, the verdict, and one sentence why."""

    ours: str
    verdict: Verdict
    because: str


@dataclasses.dataclass(frozen=True)
class Claim:
    """A statement of the paper, or a goal of this project where the paper has none.

    Attributes:
      says: in words.
      published: the paper's value, or the goal; a function of the records where they hold it.
      judge: the finding from the records.
      records: that it rests on, the arguments of both; a missing one leaves it not measured.
      place: in the paper, such as "Table 1"; empty for a goal.
    """

    says: str
    published: str | Callable[..., str]
    judge: Callable[..., Finding]
    records: tuple[str, ...] = ()
    place: str = ""

    @property
    def words(self) -> str:
        """Where it stands and what it says."""
        return f"{self.place}: {self.says}" if self.place else self.says

    def value(self, results: Results) -> str:
        """The paper's value, or the goal, in words."""
        if isinstance(self.published, str):
            return self.published
        return "–" if self.missing(results) else self.published(*self._reports(results))

    def finding(self, results: Results) -> Finding:
        """Judged, or not measured."""
        if missing := self.missing(results):
            return Finding("–", Verdict.UNKNOWN, f"There is no result {', '.join(missing)}.")
        return self.judge(*self._reports(results))

    def missing(self, results: Results) -> list[str]:
        """The records that it needs and that are not there."""
        return [name for name in self.records if name not in results]

    def _reports(self, results: Results) -> list[Report]:
        return [results[name] for name in self.records]


@dataclasses.dataclass(frozen=True)
class Topic:
    """A section of the report: its heading, and its claims, all of the paper or all goals."""

    name: str
    title: str
    claims: Sequence[Claim]

    @property
    def of_paper(self) -> bool:
        """Whether the claims are the paper's."""
        return all(claim.place for claim in self.claims)


def claim(
    says: str, published: str | Callable[..., str], *records: str, place: str = ""
) -> Callable[[Callable[..., Finding]], Claim]:
    """Makes a claim of the function below that judges it: its arguments are the records."""
    return lambda judge: Claim(says, published, judge, records, place)


def met_if(met: bool, *, partly: bool = False) -> Verdict:
    """Met, or else partly met, or else not."""
    return Verdict.MET if met else Verdict.PARTLY if partly else Verdict.MISSED


def met_by_count(count: int, total: int) -> Verdict:
    """Met where all are as claimed, partly where some are."""
    return met_if(count == total, partly=count > 0)


def better_if(better: bool) -> Verdict:
    """Better than the paper, or not as good."""
    return Verdict.BETTER if better else Verdict.MISSED


def over_floor(value: float, floor: float, paper: float, why: str) -> Finding:
    """Whether a metric (mm) is better than the paper's, where the pose decides it.

    ``floor`` is the metric at the true pose: a value up to `VISIBLE` times it is not comparable,
    and ``why`` says what decides the metric there.
    """
    side = "Below" if value < paper else "Above"
    ours = f"{digits(value, 3)} mm"
    at_truth = f"{side} the paper's; the true pose itself has {digits(floor, 3)} mm here: "
    if value <= VISIBLE * floor:
        return Finding(ours, Verdict.INCOMPARABLE, f"{at_truth}{why} decide it, not the pose.")
    return Finding(ours, better_if(value < paper), f"{at_truth}the pose makes the rest.")


def digits(value: float | None, places: int = 2) -> str:
    """Significant digits, without an exponent."""
    if value is None or not np.isfinite(value):
        return "–"
    rounded = float(f"{value:.{places}g}")
    decimals = 0 if rounded == 0 else places - 1 - int(np.floor(np.log10(abs(rounded))))
    return f"{rounded:,.{max(0, decimals)}f}"
