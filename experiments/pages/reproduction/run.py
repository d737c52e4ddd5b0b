"""A run of the studies: one after the other, each in its own process and folder.

A study that the same command finished before is not run again; one that fails is named and does
not stop the rest.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.pages.reproduction.studies import INPUTS, Outcome, Study
from experiments.runner.machine import git_commit
from vanejax.errors import InputError
from vanejax.files import read_json, write_json

_EXCERPT = 300  # characters of a log's last line


def measured(studies: Sequence[Study], out: Path) -> dict[str, Any]:
    """The records that the studies left under ``out``, by name."""
    return {
        study.record: read_json(study.folder(out) / study.written)
        for study in studies
        if study.record and finished(study, out)
    }


def estimate(studies: Sequence[Study], out: Path, inputs: Mapping[str, str]) -> str:
    """The plan: what would be done and how long it takes, as aligned text."""
    lines, total = [], 0.0
    for study in studies:
        missing = [name for name in study.inputs if name not in inputs]
        state = f"{study.hours:5.2f} h"
        if missing:
            state = f"needs --{missing[0].replace('_', '-')}"
        elif finished(study, out):
            state = "done before"
        else:
            total += study.hours
        lines.append(f"{study.name:<20}{state:<20}{study.title}".rstrip())
    return "\n".join([*lines, f"{'together, about':<20}{total:5.2f} h on two cores"])


def finished(study: Study, out: Path) -> bool:
    """Whether this very command ended well in ``out`` and its result is still there."""
    stamp = _stamp(study, out)
    if not (stamp.is_file() and (study.folder(out) / study.written).is_file()):
        return False
    return read_json(stamp).get("arguments") == list(study.arguments)


def run_studies(
    studies: Sequence[Study],
    out: Path,
    inputs: Mapping[str, str],
    *,
    say: Callable[[str], None] = print,
) -> list[Outcome]:
    """Runs the studies in order, those needed by others first; every one has its outcome.

    Each has its own folder in ``out``, beside logs/NAME.txt and ended/NAME.json; ``say`` receives
    the lines of progress. Raises InputError where the folder cannot be written.
    """
    make_folders(out, "logs", "ended")
    outcomes: dict[str, Outcome] = {}
    for number, study in enumerate(studies, 1):
        say(f"[{number}/{len(studies)}] {study.name}: {study.title}")
        outcomes[study.name] = outcome = _outcome(study, out, inputs, outcomes)
        say(f"    {outcome.state}" + (f": {outcome.why}" if outcome.why else ""))
    return list(outcomes.values())


def make_folders(out: Path, *names: str) -> None:
    """Makes a folder and those in it; InputError where that cannot be."""
    try:
        for folder in (out, *(out / name for name in names)):
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be used as a folder ({error.strerror})") from error


def _outcome(
    study: Study, out: Path, inputs: Mapping[str, str], before: Mapping[str, Outcome]
) -> Outcome:
    if missing := [name for name in study.inputs if name not in inputs]:
        return Outcome(study, "not run", f"needs {INPUTS[missing[0]]}")
    if finished(study, out):
        return Outcome(study, "done before", seconds=read_json(_stamp(study, out))["seconds"])
    for name in study.needs:
        if name in before and not before[name].ended:
            return Outcome(study, "not run", f"needs {name}, which {before[name].state}")
    words = study.words({"out": out, **inputs})
    log = out / "logs" / f"{study.name}.txt"
    began = time.perf_counter()
    with open(log, "w") as file:
        done = subprocess.run(
            [sys.executable, "-m", *words], stdout=file, stderr=subprocess.STDOUT, check=False
        )
    seconds = time.perf_counter() - began
    if done.returncode:
        return Outcome(study, "failed", f"exit code {done.returncode}: {_last(log)}", seconds)
    if not (study.folder(out) / study.written).is_file():
        return Outcome(
            study, "failed", f"ended without an error, but wrote no {study.written}", seconds
        )
    stamp = {"arguments": study.arguments, "seconds": round(seconds, 1), "commit": git_commit()}
    write_json(_stamp(study, out), stamp)
    return Outcome(study, "done", seconds=seconds)


def _stamp(study: Study, out: Path) -> Path:
    return out / "ended" / f"{study.name}.json"


def _last(log: Path) -> str:
    """The last line of a log."""
    lines = log.read_text(errors="replace").strip().splitlines() or ["it printed nothing"]
    return lines[-1].strip()[-_EXCERPT:]
