"""Measured afresh, against the record: the pretrained network and the stand."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.configs import vane
from experiments.evaluate import evaluate
from experiments.pages.reproduction.claim import digits
from experiments.runner.experiment import Experiment
from experiments.runner.markdown import table
from experiments.studies.position import study as position
from experiments.train import load_or_scan
from vanejax.errors import InputError
from vanejax.training.weight_file import TrainedMatcher

FOLDER = "vane"  # as that of the study whose pictures these are
SAME = 0.02  # relative: a live figure that differs by less is called the same


@dataclasses.dataclass(frozen=True, eq=False)
class Live:
    """An evaluation of a network made for the report.

    Attributes:
      report: what evaluation.json holds.
      weights: the network's file or origin, in words.
      trained: the commit that it was trained from, as far as known.
      seconds: scans, registrations and pictures.
      position: what `experiments.position` found, where it was run.
    """

    report: dict[str, Any]
    weights: str
    trained: str | None
    seconds: float
    position: dict[str, Any] | None = None


def evaluate_live(
    matcher: TrainedMatcher,
    weights: str,
    out: Path,
    *,
    config: Experiment | None = None,
    progress: bool = True,
) -> Live:
    """Scans the test views anew and registers them, as `experiments.evaluate` does.

    Args:
      matcher: of the guide vane.
      weights: where it is from, for the reader.
      out: evaluation.json and pictures go to its folder vane.
      config: the recipe, `vane.py` if not given; its views and points.
      progress: whether to show progress bars.

    Raises:
      InputError: weights for another part, or of a network that `config` does not describe.
    """
    config = vane.get_config() if config is None else config
    part = config.make_part()
    matcher.check_part(part)
    began = time.perf_counter()
    folder = out / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    scans = load_or_scan(config, part, folder / "scans.npz")
    check_recipe(matcher, config)
    report = evaluate(config, scans, matcher.variables, folder, part=part, progress=progress)
    seconds = time.perf_counter() - began
    return Live(report, weights, matcher.trained.get("commit"), seconds)


def measure_position(out: Path) -> dict[str, Any]:
    """The study of the virtual stand as it is recorded; its files go to the folder position."""
    settings = position.make_parser().parse_args(["--out", str(out / "position")])
    return position.main(settings)


def check_recipe(matcher: TrainedMatcher, config: Experiment) -> None:
    """Refuses weights whose network or thinning differs from the config's.

    Raises:
      InputError: names what differs.
    """
    network = config.make_network()
    mine = {
        "model": network.model,
        "iterations": network.iterations,
        "voxel_mm": config.data.voxel_mm,
        "num_reference": config.data.num_reference,
    }
    theirs = {
        "model": matcher.model,
        "iterations": matcher.iterations,
        "voxel_mm": matcher.voxel_mm,
        "num_reference": matcher.sampling.num_reference,
    }
    found = [
        f"{name} is {theirs[name]}, not {value}"
        for name, value in mine.items()
        if theirs[name] != value
    ]
    if found:
        raise InputError(
            f"the weights are of another recipe than {config.name}: {'; '.join(found)}; "
            "give weights exported from a run of it"
        )


def side_by_side(pairs: Mapping[str, tuple[float, float]]) -> str:
    """Recorded and live figures, and in a sentence whether they are the same."""
    rows, apart = [], []
    for words, (old, new) in pairs.items():
        change = new / old - 1
        rows.append([words, digits(old, 3), digits(new, 3), f"{change:+.1%}"])
        if abs(change) > SAME:
            apart.append((abs(change), words))
    told = f"All {len(rows)} figures are the recorded ones within {SAME:.0%}."
    if apart:
        size, words = max(apart)
        told = (
            f"{len(apart)} of {len(rows)} figures differ from the record by more than {SAME:.0%}, "
            f"most the {words} ({size:.0%})."
        )
    return table(["", "recorded", "live", "difference"], rows) + "\n\n" + told
