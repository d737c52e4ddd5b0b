"""Measured again for the report: the pretrained network and the virtual stand."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.configs import vane
from experiments.evaluate import evaluate
from experiments.pages.reproduction.claim import Report, digits
from experiments.pages.tables import MEASURES, evaluation_table
from experiments.runner.experiment import Experiment
from experiments.runner.markdown import table
from experiments.studies.position import study as position
from experiments.studies.position.report import compared
from experiments.train import load_or_scan
from vanejax.errors import InputError
from vanejax.training import TrainedMatcher

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
      position: the record of `experiments.position`, where it was run.
    """

    report: dict[str, Any]
    weights: str
    trained: str | None
    seconds: float
    position: dict[str, Any] | None = None


def evaluate_live(
    matcher: TrainedMatcher, weights: str, out: Path, *, config: Experiment | None = None
) -> Live:
    """Scans the test views anew and registers them, as `experiments.evaluate` does.

    The recipe is `vane.py` if no ``config`` is given. Raises InputError for weights of another part
    or recipe.
    """
    config = vane.get_config() if config is None else config
    part = config.make_part()
    matcher.check_part(part)
    began = time.perf_counter()
    folder = out / FOLDER
    scans = load_or_scan(config, part, folder / "scans.npz")
    check_recipe(matcher, config)
    report = evaluate(config, scans, matcher.variables, folder, part=part)
    seconds = time.perf_counter() - began
    return Live(report, weights, matcher.trained.get("commit"), seconds)


def measure_position(out: Path) -> dict[str, Any]:
    """The study of the virtual stand as it is recorded; its files go to the folder position."""
    settings = position.make_parser().parse_args(["--out", str(out / "position")])
    return position.main(settings)


def check_recipe(matcher: TrainedMatcher, config: Experiment) -> None:
    """Refuses weights whose network or thinning differs from the config's, and names what does."""
    network, data = config.make_network(), config.data
    sampling = matcher.sampling
    fields = {
        "model": (matcher.model, network.model),
        "iterations": (matcher.iterations, network.iterations),
        "voxel_mm": (matcher.voxel_mm, data.voxel_mm),
        "num_reference": (sampling.num_reference, data.num_reference),
    }
    differences = [
        f"{name} is {theirs}, not {ours}"
        for name, (theirs, ours) in fields.items()
        if theirs != ours
    ]
    if differences:
        raise InputError(
            f"the weights are of another recipe than {config.name}: {'; '.join(differences)}; "
            "give weights exported from a run of it"
        )


def position_errors(report: Report) -> dict[str, dict[str, float]]:
    """Mean and largest error of all cameras' turns about the R axis and moves against the probe."""
    return {
        name: {"mean": float(errors.mean()), "max": float(errors.max())}
        for name, errors in compared(report).items()
    }


def against_evaluation(record: Report | None, live: Live) -> str:
    """The evaluation for this page, side by side with the record of experiments.train."""
    made = (
        f"The weights ({live.weights}) registered the {live.report['views']} test views again in "
        f"{live.seconds:.0f} s, new scans included ({live.report['date'][:10]}, commit "
        f"{str(live.report['commit'])[:10]})."
    )
    if record is None:
        return f"{made}\n\n{evaluation_table(live.report)}"
    pairs = {
        f"{label}, {column}": tuple(r["summary"][name][column] for r in (record, live.report))
        for name, label in MEASURES.items()
        if name != "time_s"
        for column in ("mean", "median", "max")
    }
    return (
        f"{made}\n\n{side_by_side(pairs)} The record was made at commit "
        f"{str(record['commit'])[:10]}; these weights were trained from commit "
        f"{str(live.trained)[:10]}."
    )


def against_position(record: Report | None, live: Live | None) -> str:
    """The stand that was run for this page, side by side with the record; nothing if it was not."""
    if live is None or live.position is None or record is None:
        return ""
    if record is live.position:
        return "There is no record of this study; it was run for this page."
    old, new = map(position_errors, (record, live.position))
    pairs = {
        f"{words}, {column}": (old[name][column], new[name][column])
        for name, words in (("turns", "rotation (deg)"), ("moves", "translation (mm)"))
        for column in ("mean", "max")
    }
    return "The stand was run again for this page.\n\n" + side_by_side(pairs)


def side_by_side(pairs: Mapping[str, tuple[float, float]]) -> str:
    """Recorded and live figures, and in a sentence whether they are the same."""
    rows, apart = [], []
    for words, (old, new) in pairs.items():
        change = new / old - 1
        rows.append([words, digits(old, 3), digits(new, 3), f"{change:+.1%}"])
        if abs(change) > SAME:
            apart.append((abs(change), words))
    sentence = f"All {len(rows)} figures are the recorded ones within {SAME:.0%}."
    if apart:
        size, words = max(apart)
        sentence = (
            f"{len(apart)} of {len(rows)} figures differ from the record by more than {SAME:.0%}, "
            f"most the {words} ({size:.0%})."
        )
    return table(["", "recorded", "live", "difference"], rows) + "\n\n" + sentence
