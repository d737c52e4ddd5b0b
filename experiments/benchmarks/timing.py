"""Timing: the scan that is timed, repeats, peers and limits, and the table."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.runner import study_command as study
from experiments.runner.vane_views import VaneViews, magnitudes, perturb, pose_error, with_noise
from vanejax.rigid import RigidTransform
from vanejax.scans import MeasuredScan
from vanejax.training import TrainedMatcher, find_weights

NOISE_MM, START_DEG, START_MM = 0.1, 5.0, 5.0
LONG_S = 10.0  # from here on cold caches hardly count
PIXELS = 128  # across, of the scans that are only counted


@dataclasses.dataclass(frozen=True)
class Figure:
    """The times of one operation.

    Attributes:
      name: unique.
      seconds: of each repeat, warm unless the note says otherwise; empty where it was skipped.
      peers: figures of other programs that do the same, by name; with each, how many times as fast
        this should be, or None for no goal.
      limits: figures of the least time that this could take, by name; with each, how many times as
        long this may take, or None.
      goal_s: upper bound of the median on two cores.
      note: such as the pose's error, or why it was skipped.
    """

    name: str
    seconds: Sequence[float]
    peers: Mapping[str, float | None] = dataclasses.field(default_factory=dict)
    limits: Mapping[str, float | None] = dataclasses.field(default_factory=dict)
    goal_s: float | None = None
    note: str = ""


def peer(name: str) -> Callable[..., Callable[..., Figure]]:
    """Makes a figure of a function that times another program: seconds and note.

    Where the program is not installed, the figure has no seconds and says so.
    """

    def decorate(function: Callable[..., tuple[Sequence[float], str]]) -> Callable[..., Figure]:
        @functools.wraps(function)
        def figure(*arguments: Any) -> Figure:
            try:
                seconds, note = function(*arguments)
            except ImportError as error:
                return Figure(name, [], note=f"skipped: {error}")
            return Figure(name, seconds, note=note)

        return figure

    return decorate


@dataclasses.dataclass(frozen=True, eq=False)
class Bench:
    """What is timed, made when asked for: a view of the guide vane with noise, and a rough pose.

    ``weights`` are the file of a trained matcher; ``large`` is for sizes that take minutes, too.
    """

    repeats: int
    seed: int
    weights: Path | None
    large: bool = False
    views: VaneViews = dataclasses.field(default_factory=VaneViews)

    @functools.cached_property
    def view(self) -> int:
        """The test view with most points, as seen at few pixels."""
        camera = self.views.camera
        coarse = dataclasses.replace(self.views, camera=camera.scaled(PIXELS / camera.width))
        return max(self.views.select("test"), key=lambda view: len(coarse.points(view)))

    @functools.cached_property
    def points(self) -> np.ndarray:
        """[N, 3] f64, mm, with noise."""
        rng = np.random.default_rng(self.seed)
        return with_noise(self.views.points(self.view), NOISE_MM, rng)

    @property
    def scan(self) -> MeasuredScan:
        """The points as `register` takes them."""
        return MeasuredScan(self.points, None, np.zeros(3), f"view {self.view}")

    @functools.cached_property
    def rough(self) -> RigidTransform:
        """part_from_camera, near the true one."""
        rng = np.random.default_rng([self.seed, 1])
        truth = self.views.truth(self.view)
        return perturb(truth, self.views.part, deg=START_DEG, mm=START_MM, rng=rng)

    @functools.cached_property
    def matcher(self) -> TrainedMatcher | None:
        """The weights, read."""
        return None if self.weights is None else find_weights(self.weights, self.views.part)

    def time(self, function: Callable[[], Any]) -> tuple[list[float], Any]:
        """Seconds of each repeat after a first one that does not count, and what was returned."""
        result, seconds = function(), []
        for _ in range(self.repeats):
            result = None  # what is large need not be in memory twice
            began = time.perf_counter()
            result = function()
            seconds.append(time.perf_counter() - began)
        return seconds, result

    def time_sparingly(self, function: Callable[[], Any]) -> list[float]:
        """Seconds of each repeat as `time`; what takes longer than `LONG_S` is run once only.

        For what compiles nothing.
        """
        began = time.perf_counter()
        function()
        first = time.perf_counter() - began
        return [first] if first > LONG_S else self.time(function)[0]

    def error(self, part_from_camera: RigidTransform) -> str:
        """How far a pose is off, in words."""
        truth, center = self.views.truth(self.view), self.views.part.center
        degrees, mm = magnitudes(pose_error(part_from_camera, truth, center))
        return f"{degrees:.4f} deg, {mm:.4f} mm off"


def summarize(figures: Sequence[Figure]) -> list[dict[str, Any]]:
    """Rows with median, range and what each is compared with; None where something was skipped.

    The ratio to a peer is how many times faster, that to a limit how many times as long.
    """
    medians = {
        figure.name: float(np.median(figure.seconds)) for figure in figures if figure.seconds
    }
    rows = []
    for figure in figures:
        mine = medians.get(figure.name)
        against = []
        for kind, others in (("peer", figure.peers), ("limit", figure.limits)):
            for name, goal in others.items():
                theirs, ratio = medians.get(name), None
                if mine is not None and theirs is not None:
                    ratio = theirs / mine if kind == "peer" else mine / theirs
                met = _word(ratio, goal, at_least=kind == "peer")
                against.append(
                    {"name": name, "kind": kind, "ratio": ratio, "goal": goal, "met": met}
                )
        rows.append(
            {
                "name": figure.name,
                "seconds": study.spread(figure.seconds) if figure.seconds else None,
                "repeats": len(figure.seconds),
                "goal_s": figure.goal_s,
                "met": _word(mine, figure.goal_s, at_least=False),
                "against": against,
                "note": figure.note,
            }
        )
    return rows


def _word(value: float | None, goal: float | None, *, at_least: bool) -> str | None:
    """Whether a goal was "met" or "missed"; None where there is no goal or no value."""
    if value is None or goal is None:
        return None
    return "met" if (value >= goal if at_least else value <= goal) else "missed"


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as aligned text, at most 100 columns wide but for long notes."""
    lines = [f"{'':<46}{'median (s)':>11}{'min - max':>20}  goal (s)"]
    for row in rows:
        cells = spread_cells(row["seconds"]) if row["seconds"] else f"{'-':>11}{'':>20}"
        goal = ""
        if row["goal_s"] is not None:
            goal = f"  {row['goal_s']:g}" + (f": {row['met']}" if row["met"] else "")
        lines.append(f"{row['name']:<46}{cells}{goal}".rstrip())
        lines += [f"    {comparison(entry)}" for entry in row["against"]]
        if row["note"]:
            lines.append(f"    {row['note']}")
    return "\n".join(lines)


def comparison(entry: Mapping[str, Any]) -> str:
    """Such as "6.21 times as fast as Open3D (at least 6: met)"."""
    if entry["ratio"] is None:
        return f"not compared with {entry['name']}"
    peer = entry["kind"] == "peer"
    words = f"{entry['ratio']:.2f} times as {'fast' if peer else 'long'} as {entry['name']}"
    if entry["met"] is None:
        return words
    return f"{words} ({'at least' if peer else 'at most'} {entry['goal']:g}: {entry['met']})"


def spread_cells(seconds: Mapping[str, float]) -> str:
    """The columns of a median and its range."""
    median, least, most = (shown(seconds[key]) for key in ("median", "min", "max"))
    return f"{median:>11}{f'{least} - {most}':>20}"


def shown(seconds: float) -> str:
    """A time for the table: to the millisecond, short ones to a tenth of it."""
    return f"{seconds:.3f}" if seconds >= 0.1 else f"{seconds:.4f}"
