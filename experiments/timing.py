"""How things are timed: the scan that all timings share, repeats, ratios, a table."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments import study
from experiments.vane_views import VaneViews, beside, magnitudes, pose_error, with_noise
from vanejax.measured_scan import MeasuredScan
from vanejax.model_file import TrainedMatcher, load_model
from vanejax.rigid import RigidTransform

NOISE_MM, START_DEG, START_MM = 0.1, 5.0, 5.0
PIXELS = 128  # across, of the scans that are only counted


@dataclasses.dataclass(frozen=True)
class Figure:
    """One thing timed.

    Attributes:
      name: of it, unique.
      seconds: of each repeat, warm unless the note says otherwise; empty where it was skipped.
      against: name of the figure that its median is divided by.
      goal_s: what the median should not exceed on two cores.
      note: what else there is to say, such as the pose's error, or why it was skipped.
    """

    name: str
    seconds: Sequence[float]
    against: str | None = None
    goal_s: float | None = None
    note: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class Bench:
    """What is timed, made when asked for.

    Attributes:
      repeats: of each timing.
      seed: of noise and rough pose.
      weights: file of a trained matcher for the guide vane, or None.
      views: of the guide vane.
    """

    repeats: int
    seed: int
    weights: Path | None
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
        """part_from_camera beside the true one."""
        rng = np.random.default_rng([self.seed, 1])
        truth = self.views.truth(self.view)
        return beside(truth, self.views.part, deg=START_DEG, mm=START_MM, rng=rng)

    @functools.cached_property
    def matcher(self) -> TrainedMatcher | None:
        """The weights, read."""
        return None if self.weights is None else load_model(self.weights)

    def time(self, function: Callable[[], Any]) -> tuple[list[float], Any]:
        """Seconds of each repeat after a first one that does not count, and what was returned."""
        result, seconds = function(), []
        for _ in range(self.repeats):
            began = time.perf_counter()
            result = function()
            seconds.append(time.perf_counter() - began)
        return seconds, result

    def error(self, part_from_camera: RigidTransform) -> str:
        """How far a pose is off, in words."""
        truth, center = self.views.truth(self.view), self.views.part.center
        degrees, mm = magnitudes(pose_error(part_from_camera, truth, center))
        return f"{degrees:.4f} deg, {mm:.4f} mm off"


def summarize(figures: Sequence[Figure]) -> list[dict[str, Any]]:
    """Rows with median, range and ratio; None where something was skipped."""
    medians = {figure.name: np.median(figure.seconds) for figure in figures if figure.seconds}
    rows = []
    for figure in figures:
        there = figure.name in medians and figure.against in medians
        rows.append(
            {
                "name": figure.name,
                "seconds": study.spread(figure.seconds) if figure.seconds else None,
                "repeats": len(figure.seconds),
                "against": figure.against,
                "ratio": float(medians[figure.name] / medians[figure.against]) if there else None,
                "goal_s": figure.goal_s,
                "note": figure.note,
            }
        )
    return rows


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as aligned text."""
    lines = [f"{'':<38}{'median (s)':>11}{'min - max':>16}{'goal':>7}{'ratio':>8}  against"]
    for row in rows:
        cells = f"{'-':>11}{'':>16}"
        if row["seconds"]:
            span = f"{row['seconds']['min']:.3f} - {row['seconds']['max']:.3f}"
            cells = f"{row['seconds']['median']:>11.3f}{span:>16}"
        goal = "" if row["goal_s"] is None else f"{row['goal_s']:g}"
        ratio = "" if row["ratio"] is None else f"{row['ratio']:.2f}"
        against = row["against"] or ""
        lines.append(f"{row['name']:<38}{cells}{goal:>7}{ratio:>8}  {against}".rstrip())
        if row["note"]:
            lines.append(f"    {row['note']}")
    return "\n".join(lines)
