"""The studies that the report rests on, from studies.toml, and the records that they made."""

from __future__ import annotations

import dataclasses
import re
import tomllib
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
      title: what it measures, for the reader.
      arguments: after ``python -m``; ``{folder}`` is its own folder, ``{out}`` that of all studies,
        others are of `INPUTS`.
      written: the file in its folder that exists once it has ended.
      record: its name under experiments/results; empty where nothing is recorded.
      hours: about, on two cores.
    """

    name: str
    title: str
    arguments: tuple[str, ...]
    written: str
    record: str
    hours: float

    @property
    def needs(self) -> tuple[str, ...]:
        """The studies from whose folders it takes files."""
        return tuple(dict.fromkeys(re.findall(r"\{out\}/(\w+)", " ".join(self.arguments))))

    @property
    def inputs(self) -> tuple[str, ...]:
        """What the user has to give."""
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
    """The state of a study ("done", "done before", "failed", "not run"), and why in a line."""

    study: Study
    state: str
    why: str = ""
    seconds: float = 0.0

    @property
    def ended(self) -> bool:
        """Whether its results are there."""
        return self.state in ("done", "done before")


def _studies() -> Iterator[Study]:
    table = tomllib.loads(Path(__file__).with_name("studies.toml").read_text())
    for name, row in table.items():
        yield Study(
            name,
            row["title"],
            tuple(row["command"].split()),
            row.get("written", f"{name}.json"),
            row.get("record", name),
            row["hours"],
        )


STUDIES = tuple(_studies())
BY_RECORD = {study.record: study for study in STUDIES if study.record}


def recorded(folder: Path = RESULTS) -> dict[str, Any]:
    """Results by record's name, as far as they are there."""
    paths = {name: folder / f"{name}.json" for name in BY_RECORD}
    return {name: read_json(path) for name, path in paths.items() if path.is_file()}


def chosen(names: str | None) -> tuple[Study, ...]:
    """Studies by name, with those that they need, in the table's order; all where None."""
    if names is None:
        return STUDIES
    by_name = {study.name: study for study in STUDIES}
    wanted = set(names.split(","))
    if unknown := sorted(wanted - set(by_name)):
        raise InputError(f"no study {', '.join(unknown)}; there are {', '.join(by_name)}")
    for study in reversed(STUDIES):
        if study.name in wanted:
            wanted |= set(study.needs)
    return tuple(study for study in STUDIES if study.name in wanted)
