"""The studies that the report rests on: command, what it writes, record, and how long it takes."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vanejax.errors import InputError
from vanejax.files import read_json

ROOT = Path(__file__).parents[3]
RESULTS = ROOT / "experiments" / "results"
INPUTS = {
    "real_scans": "a folder as `experiments.real_scans` reads it (--real-scans)",
    "shapes": "ModelNet40 or a file of shapes (--shapes)",
}
PLACES = {"out": "runs/reproduce", "real_scans": "FOLDER", "shapes": "SHAPES"}


@dataclasses.dataclass(frozen=True)
class Study:
    """One command of the reproduction.

    Attributes:
      name: of the study and of its folder.
      title: what it finds, for the reader.
      arguments: after ``python -m``; ``{folder}`` is its own folder, ``{out}`` that of all studies,
        others are of `INPUTS`.
      written: the file in its folder that tells that it ended.
      record: its name under experiments/results; empty where nothing is recorded.
      hours: about, on two cores.
      needs: studies that must have ended before.
    """

    name: str
    title: str
    arguments: tuple[str, ...]
    written: str
    record: str
    hours: float
    needs: tuple[str, ...] = ()

    @property
    def inputs(self) -> tuple[str, ...]:
        """What the user has to bring for it."""
        return tuple(name for name in INPUTS if any(f"{{{name}}}" in a for a in self.arguments))

    def folder(self, out: Path) -> Path:
        """Where it works."""
        return out / self.name

    def words(self, places: Mapping[str, Any]) -> list[str]:
        """The arguments with the places filled in: ``out``, and the inputs that it takes."""
        return [a.format(folder=f"{places['out']}/{self.name}", **places) for a in self.arguments]

    def command(self) -> str:
        """As a reader would give it."""
        return " ".join(["python -m", *self.words(PLACES)])


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a study.

    Attributes:
      study: which.
      state: "done", "done before", "failed" or "not run".
      why: of the last two, in a line.
      seconds: that it took.
    """

    study: Study
    state: str
    why: str = ""
    seconds: float = 0.0

    @property
    def ended(self) -> bool:
        """Whether its results are there."""
        return self.state in ("done", "done before")


def _study(
    name: str,
    title: str,
    command: str,
    hours: float,
    *,
    written: str = "{name}.json",
    record: str = "{name}",
) -> Study:
    """A study by its command's words; it needs those whose folders it takes files from."""
    needs = tuple(dict.fromkeys(re.findall(r"\{out\}/(\w+)", command)))
    written, record = written.format(name=name), record.format(name=name)
    return Study(name, title, tuple(command.split()), written, record, hours, needs)


def _weights(name: str) -> Study:
    """The weights of a training's run."""
    command = f"vanejax export {{out}}/{name} --out {{folder}}/weights.npz"
    title = "its weights in a file"
    return _study(f"{name}_weights", title, command, 0.01, written="weights.npz", record="")


def _ablation(name: str, title: str, sweep: str) -> Study:
    command = (
        f"experiments.ablate --config vane.py --sweep {sweep} --config.training.steps=250 "
        "--workdir {folder}"
    )
    return _study(name, title, command, 0.4, written="ablation.json")


_VANE = "{out}/vane_weights/weights.npz"
_ROBUST = "{out}/vane_robust_weights/weights.npz"
_TIMED = "scan,step,inference,compile,evaluate,start,refine,register,command"

STUDIES = (
    _study(
        "vane",
        "RPM-Net trained on virtual scans, on the 54 test views",
        "experiments.train --config vane.py --workdir {folder}",
        1.3,
        written="evaluation.json",
    ),
    _weights("vane"),
    _study(
        "vane_robust",
        "RPM-Net trained on scans of a real sensor's kind",
        "experiments.train --config vane_robust.py --workdir {folder}",
        1.2,
        written="evaluation.json",
        record="",
    ),
    _weights("vane_robust"),
    _study(
        "tuning",
        "settings of the classical methods, on training views",
        "experiments.tune --config table1.py --workdir {folder}",
        0.5,
    ),
    _study(
        "comparison",
        "every method of the paper on the same scans",
        "experiments.compare --config table1.py --trained rpmnet={out}/vane --workdir {folder}",
        1.0,
    ),
    _study(
        "public_vs_virtual",
        "trained on generic shapes against virtual scans",
        "experiments.public_vs_virtual --config public.py --config.data.shapes={shapes} "
        "--workdir {folder}",
        0.9,
    ),
    _study(
        "density",
        "RMSE and FFMDE over the density of the points",
        "experiments.density --out {folder}",
        0.2,
    ),
    _ablation("ablation_neighbors", "the number of neighbours", "model.num_neighbors=8,16,32,64"),
    _ablation("ablation_noise", "the noise of training", "data.noise=0,0.005,0.01,0.02"),
    _study(
        "robustness",
        "distance, angle, light, clutter, castings",
        f"experiments.robustness --weights ideal={_VANE} --weights robust={_ROBUST} --views 6 "
        "--random 1000 --out {folder}",
        0.6,
    ),
    _study(
        "position",
        "turns and moves of a part on a virtual stand",
        "experiments.position --out {folder}",
        0.1,
    ),
    _study(
        "fine",
        "fine registration against the Cramer-Rao bound",
        "experiments.fine --out {folder}",
        0.1,
    ),
    _study(
        "any_pose",
        "registration from random rotations",
        f"experiments.any_pose --weights {_VANE} --out {{folder}}",
        0.2,
    ),
    _study(
        "verdicts",
        "whether the verdict tells right poses from wrong ones",
        "experiments.verdicts --out {folder}",
        1.0,
    ),
    _study(
        "sensor_effects",
        "what each effect of the sensor does and costs",
        "experiments.sensor_effects --views 216 --out {folder}",
        0.1,
    ),
    _study(
        "real_scans",
        "real depth-camera scans, no training",
        "experiments.real_scans {real_scans} --sensor consumer_depth --out {folder}",
        0.02,
    ),
    _study(
        "sensor_fit",
        "how alike virtual and real scans are",
        "experiments.sensor_fit {real_scans} --out {folder}",
        0.02,
    ),
    _study(
        "sensor_transfer",
        "networks by the sensor of their training, on real scans",
        "experiments.sensor_transfer {real_scans} --out {folder}",
        2.0,
    ),
    _study(
        "benchmark",
        "times beside other programs and the machine's limits",
        f"experiments.benchmark --only {_TIMED} --weights {_VANE} --out {{folder}}",
        0.2,
    ),
    _study(
        "scaling",
        "how costs grow",
        f"experiments.benchmark --only scaling --weights {_VANE} --out {{folder}}",
        0.2,
        written="benchmark.json",
    ),
)
BY_RECORD = {study.record: study for study in STUDIES if study.record}


def recorded(folder: Path = RESULTS) -> dict[str, Any]:
    """Results by record's name, as far as they are there."""
    paths = {name: folder / f"{name}.json" for name in BY_RECORD}
    return {name: read_json(path) for name, path in paths.items() if path.is_file()}


def chosen(words: str | None) -> tuple[Study, ...]:
    """Studies by name, with those that they need, in the table's order; all where None.

    Raises:
      InputError: a name that is none.
    """
    if words is None:
        return STUDIES
    by_name = {study.name: study for study in STUDIES}
    wanted = set(words.split(","))
    if unknown := sorted(wanted - set(by_name)):
        raise InputError(f"no study {', '.join(unknown)}; there are {', '.join(by_name)}")
    return tuple(study for study in STUDIES if study.name in set(_with_needs(wanted, by_name)))


def _with_needs(names: set[str], by_name: Mapping[str, Study]) -> Iterator[str]:
    for name in names:
        yield name
        yield from _with_needs(set(by_name[name].needs), by_name)
