"""The folder of one training run: its config, what it ran on, its log and its lock."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.runner.experiment import Experiment
from experiments.runner.machine import git_commit, timestamp, versions
from vanejax.cad import Part
from vanejax.errors import InputError
from vanejax.files import read_json, write_json, write_text
from vanejax.settings import values_of, with_defaults

CLOCK = "clock.json"
VALIDATION = ("validation_rotation_error_deg", "validation_translation_error_mm")
FLAT = 0.1  # a curve is flat where the last quarter of the steps lowers the error by less


class RunFolder:
    """Owns a work folder while a run lasts; use as a context manager.

    Raises:
      InputError: the folder cannot be written, or another process is training in it.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._events: Any = None

    def __enter__(self) -> RunFolder:
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock = open(self.path / ".lock", "w")
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"{self.path}: another process is training there; choose another --workdir"
            ) from None
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be used as a work folder ({error.strerror}); "
                "choose another --workdir"
            ) from error
        return self

    def __exit__(self, *_: object) -> None:
        if self._events is not None:
            self._events.close()
        self._lock.close()

    @property
    def checkpoints(self) -> Path:
        """Where the checkpoints are."""
        return self.path / "checkpoints"

    @property
    def metrics(self) -> Path:
        """The JSONL log."""
        return self.path / "metrics.jsonl"

    def claim(self, config: Experiment, part: Part) -> None:
        """Records what runs here, or refuses what differs from what ran here before."""
        settings = json.loads(json.dumps(dataclasses.asdict(config)))
        mine = {"config": settings, "part": {"name": part.name, "sha256": part.sha256}}
        record = self.path / "run.json"
        if record.exists():
            theirs = read_record(self.path, config)
            changed = list(differences(theirs, mine))
            if changed:
                raise InputError(
                    f"{self.path} holds a run of another experiment: {'; '.join(changed)}. "
                    "Choose another --workdir, or give the config that it was started with."
                )
            return
        environment = {
            "versions": versions(),
            "python": platform.python_version(),
            "commit": git_commit(),
            "started": timestamp(),
        }
        write_json(record, mine | environment)

    def claim_shapes(self, title: str, sha256: str) -> None:
        """Records which generic shapes a run is trained on, or refuses others than before."""
        record, mine = self.path / "shapes.json", {"title": title, "sha256": sha256}
        if not record.exists():
            write_json(record, mine)
        elif changed := list(differences(read_json(record), mine)):
            raise InputError(f"{self.path} was begun with other shapes: {'; '.join(changed)}")

    @property
    def seconds(self) -> float:
        """Time spent on training up to the last checkpoint, over all resumptions."""
        return _read_seconds(self.path)

    @seconds.setter
    def seconds(self, value: float) -> None:
        write_json(self.path / CLOCK, {"seconds": value})

    def open_log(self, step: int) -> None:
        """Readies the log for the rows after ``step``: what a killed run wrote beyond it goes."""
        from tensorboardX import SummaryWriter  # takes a second to import

        rows = [row for row in read_log(self.path) if row["step"] <= step]
        text = "".join(json.dumps(row) + "\n" for row in rows)
        write_text(self.metrics, text)
        self._events = SummaryWriter(str(self.path / "events"), purge_step=step + 1)

    def log(self, step: int, values: dict[str, float]) -> None:
        """Appends a row to the JSONL log and to the TensorBoard events."""
        with open(self.metrics, "a") as file:
            file.write(json.dumps({"step": step} | values) + "\n")
        for name, value in values.items():
            self._events.add_scalar(name, value, step)


def read_record(folder: Path, config: Experiment) -> dict[str, Any]:
    """The run.json of a folder, its config in today's form.

    A run of an earlier version lacks fields that came since; they have their defaults. Online
    scans were called endless, and the settings of a baseline's loss stood beside its network's.
    """
    record = read_json(folder / "run.json")
    theirs = dict(record.get("config", {}))
    if "endless" in theirs:
        theirs["online"] = theirs.pop("endless")
    for name in ("dcp", "pointnetlk", "pcrnet"):
        group, loss = theirs.get(name, {}), getattr(config, name).loss
        if "loss" not in group:
            of_loss = {key: group[key] for key in values_of(type(loss), loss) if key in group}
            rest = {key: value for key, value in group.items() if key not in of_loss}
            theirs[name] = rest | {"loss": of_loss}
    defaults = json.loads(json.dumps(dataclasses.asdict(type(config)())))
    return record | {"config": with_defaults(theirs, defaults)}


def read_log(folder: str | os.PathLike[str]) -> list[dict[str, float]]:
    """The rows of a run's JSONL log; a last line cut off by a kill is left out."""
    path = Path(folder) / "metrics.jsonl"
    rows = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict) and isinstance(row.get("step"), int):
            rows.append(row)
    return rows


@dataclasses.dataclass(frozen=True)
class TrainingRecord:
    """How long a run was trained: the rows of its log, and the seconds over all resumptions."""

    rows: Sequence[Mapping[str, float]]
    seconds: float

    @property
    def curve(self) -> list[dict[str, float]]:
        """Step and validation errors."""
        names = ("step", *VALIDATION)
        return [{name: row[name] for name in names} for row in self.rows if VALIDATION[0] in row]

    def summary(self, wanted_steps: int) -> dict[str, Any]:
        """For a report on a run that should have had ``wanted_steps``: would more have helped?

        ``ended_by`` is "budget" where fewer steps were done. ``fall_in_last_quarter`` is of the
        validation's rotation error: its mean over the last quarter of the steps against that over
        the third; NaN where too few were validated.
        """
        steps = int(self.rows[-1]["step"]) if self.rows else 0

        def mean_error(first: float, last: float) -> float:
            within = [row for row in self.curve if first * steps < row["step"] <= last * steps]
            return float(np.mean([row[VALIDATION[0]] for row in within])) if within else np.nan

        fall = 1.0 - mean_error(0.75, 1.0) / mean_error(0.5, 0.75)
        return {
            "steps": steps,
            "wanted_steps": wanted_steps,
            "ended_by": "budget" if steps < wanted_steps else "steps",
            "hours": self.seconds / 3600,
            "fall_in_last_quarter": fall,
            "flat": bool(fall < FLAT),
        }


def training_record(folder: str | os.PathLike[str]) -> TrainingRecord:
    """What the folder of a run knows of its training."""
    return TrainingRecord(rows=read_log(folder), seconds=_read_seconds(Path(folder)))


def _read_seconds(folder: Path) -> float:
    clock = folder / CLOCK
    return float(read_json(clock)["seconds"]) if clock.exists() else 0.0


def differences(old: Any, new: Any, path: str = "") -> Iterator[str]:
    """Which fields of ``new`` differ from ``old``, as readable sentences."""
    if isinstance(new, dict) and isinstance(old, dict):
        for key in new:
            yield from differences(old.get(key), new[key], f"{path}.{key}" if path else key)
    elif old != new:
        yield f"{path} was {old!r}, now {new!r}"
