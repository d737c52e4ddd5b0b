"""A claim, and how it stands: judged from the figures alone.

The paper's numbers stand beside the claims and in the studies that compare with them
(`methods.TABLE_1`, `position_report.PAPER`, the series of `robustness.json`). A sentence follows
from the results by code, so that a new record changes it.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Report = Mapping[str, Any]
Results = Mapping[str, Report]
VISIBLE = 1.1  # FFMDE over that at the true pose, from which on it tells of the pose


class Verdict(enum.Enum):
    """How a claim stands after our measurement."""

    BETTER = "better"
    MET = "met"
    PARTLY = "partly met"
    MISSED = "not met"
    INCOMPARABLE = "not comparable"
    UNKNOWN = "not measured"


@dataclasses.dataclass(frozen=True)
class Finding:
    """What was found about a claim: our value, the verdict, and one sentence why."""

    ours: str
    verdict: Verdict
    because: str


@dataclasses.dataclass(frozen=True)
class Claim:
    """A statement of the paper, or a goal of ours where the paper has none.

    Attributes:
      says: in words.
      published: the paper's value, or the goal; from the results where it stands in them.
      records: that it rests on; where one is missing it is not measured.
      judge: the finding from all results.
      place: in the paper, such as "Table 1"; empty for a goal of ours.
    """

    says: str
    published: str | Callable[[Results], str]
    records: tuple[str, ...]
    judge: Callable[[Results], Finding]
    place: str = ""

    @property
    def words(self) -> str:
        """Where it stands and what it says."""
        return f"{self.place}: {self.says}" if self.place else self.says

    def value(self, results: Results) -> str:
        """The paper's value, or the goal, in words."""
        if isinstance(self.published, str):
            return self.published
        return "–" if self.missing(results) else self.published(results)

    def finding(self, results: Results) -> Finding:
        """Judged, or not measured."""
        if missing := self.missing(results):
            return Finding("–", Verdict.UNKNOWN, f"There is no result {', '.join(missing)}.")
        return self.judge(results)

    def missing(self, results: Results) -> list[str]:
        """The records that it needs and that are not there."""
        return [name for name in self.records if name not in results]


def met_if(met: bool, *, partly: bool = False) -> Verdict:
    """Met, or else partly so, or else not."""
    return Verdict.MET if met else Verdict.PARTLY if partly else Verdict.MISSED


def met_by_count(count: int, total: int) -> Verdict:
    """Met where all are as claimed, partly where some are."""
    return met_if(count == total, partly=count > 0)


def better_if(better: bool) -> Verdict:
    """Better than the paper, or not as good."""
    return Verdict.BETTER if better else Verdict.MISSED


def over_floor(value: float, floor: float, paper: float, why: str) -> Finding:
    """Whether a metric (mm) is better than the paper's, where it tells anything of the pose.

    It does not where the true pose scores nearly as much.

    Args:
      value: measured.
      floor: the metric at the true pose.
      paper: its figure.
      why: what decides the metric where the pose does not.
    """
    side = "Below" if value < paper else "Above"
    told = f"{side} the paper's, and the true pose itself scores {digits(floor, 3)} mm here: "
    ours = f"{digits(value, 3)} mm"
    if value <= VISIBLE * floor:
        return Finding(ours, Verdict.INCOMPARABLE, f"{told}{why} decide it, not the pose.")
    return Finding(ours, better_if(value < paper), f"{told}the rest is the pose's.")


def digits(value: float | None, places: int = 2) -> str:
    """Significant digits, without an exponent."""
    if value is None or not np.isfinite(value):
        return "–"
    return f"{float(f'{value:.{places}g}'):,.{_decimals(value, places)}f}"


def _decimals(value: float, places: int) -> int:
    if value == 0:
        return 0
    return max(0, places - 1 - int(np.floor(np.log10(abs(float(f"{value:.{places}g}"))))))
