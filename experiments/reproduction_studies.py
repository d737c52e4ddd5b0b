"""The studies that the report rests on: command, what it writes, record, and how long it takes.

`run_studies` does them one after the other, each in its own process and folder. What was finished
before by the same command is not done again; what fails is told and does not stop the rest.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.run_folder import git_commit, read_json, write_json
from vanejax.errors import InputError

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "experiments" / "results"
INPUTS = {
    "real_scans": "a folder as `experiments.real_scans` reads it (--real-scans)",
    "shapes": "ModelNet40 or a file of shapes (--shapes)",
}
PLACES = {"out": "runs/reproduce", "real_scans": "FOLDER", "shapes": "SHAPES"}
_EXCERPT = 300  # characters of a log's last line


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


_VANE = "{out}/vane_weights/weights.npz"
_ROBUST = "{out}/vane_robust_weights/weights.npz"
_TIMED = "scan,step,inference,compile,evaluate,start,refine,register,command"


def _ablation(name: str, title: str, sweep: str) -> Study:
    return Study(
        name,
        title,
        ("experiments.ablate", "--config", "vane.py", "--sweep", sweep,
         "--config.training.steps=250", "--workdir", "{folder}"),
        "ablation.json",
        name,
        0.4,
    )  # fmt: skip


STUDIES = (
    Study(
        "vane",
        "RPM-Net trained on virtual scans, on the 54 test views",
        ("experiments.train", "--config", "vane.py", "--workdir", "{folder}"),
        "evaluation.json",
        "vane",
        1.3,
    ),
    Study(
        "vane_weights",
        "its weights in a file",
        ("vanejax", "export", "{out}/vane", "--out", "{folder}/weights.npz"),
        "weights.npz",
        "",
        0.01,
        ("vane",),
    ),
    Study(
        "vane_robust",
        "RPM-Net trained on scans of a real sensor's kind",
        ("experiments.train", "--config", "vane_robust.py", "--workdir", "{folder}"),
        "evaluation.json",
        "",
        1.2,
    ),
    Study(
        "vane_robust_weights",
        "its weights in a file",
        ("vanejax", "export", "{out}/vane_robust", "--out", "{folder}/weights.npz"),
        "weights.npz",
        "",
        0.01,
        ("vane_robust",),
    ),
    Study(
        "tuning",
        "settings of the classical methods, on training views",
        ("experiments.tune", "--config", "table1.py", "--workdir", "{folder}"),
        "tuning.json",
        "tuning",
        0.5,
    ),
    Study(
        "comparison",
        "every method of the paper on the same scans",
        (
            "experiments.compare",
            "--config",
            "table1.py",
            "--trained",
            "rpmnet={out}/vane",
            "--workdir",
            "{folder}",
        ),
        "comparison.json",
        "comparison",
        1.0,
        ("vane",),
    ),
    Study(
        "public_vs_virtual",
        "trained on generic shapes against virtual scans",
        (
            "experiments.public_vs_virtual",
            "--config",
            "public.py",
            "--config.data.shapes={shapes}",
            "--workdir",
            "{folder}",
        ),
        "public_vs_virtual.json",
        "public_vs_virtual",
        0.9,
    ),
    Study(
        "density",
        "RMSE and FFMDE over the density of the points",
        ("experiments.density", "--out", "{folder}"),
        "density.json",
        "density",
        0.2,
    ),
    _ablation("ablation_neighbors", "the number of neighbours", "model.num_neighbors=8,16,32,64"),
    _ablation("ablation_noise", "the noise of training", "data.noise=0,0.005,0.01,0.02"),
    Study(
        "robustness",
        "distance, angle, light, clutter, castings",
        (
            "experiments.robustness",
            "--weights",
            f"ideal={_VANE}",
            "--weights",
            f"robust={_ROBUST}",
            "--views",
            "6",
            "--random",
            "1000",
            "--out",
            "{folder}",
        ),
        "robustness.json",
        "robustness",
        0.6,
        ("vane_weights", "vane_robust_weights"),
    ),
    Study(
        "position",
        "turns and moves of a part on a virtual stand",
        ("experiments.position", "--out", "{folder}"),
        "position.json",
        "position",
        0.1,
    ),
    Study(
        "fine",
        "fine registration against the Cramer-Rao bound",
        ("experiments.fine", "--out", "{folder}"),
        "fine.json",
        "fine",
        0.1,
    ),
    Study(
        "any_pose",
        "registration from random rotations",
        ("experiments.any_pose", "--weights", _VANE, "--out", "{folder}"),
        "any_pose.json",
        "any_pose",
        0.2,
        ("vane_weights",),
    ),
    Study(
        "verdicts",
        "whether the verdict tells right poses from wrong ones",
        ("experiments.verdicts", "--out", "{folder}"),
        "verdicts.json",
        "verdicts",
        1.0,
    ),
    Study(
        "sensor_effects",
        "what each effect of the sensor does and costs",
        ("experiments.sensor_effects", "--views", "216", "--out", "{folder}"),
        "sensor_effects.json",
        "sensor_effects",
        0.1,
    ),
    Study(
        "real_scans",
        "real depth-camera scans, no training",
        ("experiments.real_scans", "{real_scans}", "--out", "{folder}"),
        "real_scans.json",
        "real_scans",
        0.02,
    ),
    Study(
        "sensor_fit",
        "how alike virtual and real scans are",
        ("experiments.sensor_fit", "{real_scans}", "--out", "{folder}"),
        "sensor_fit.json",
        "sensor_fit",
        0.02,
    ),
    Study(
        "sensor_transfer",
        "networks by the sensor of their training, on real scans",
        ("experiments.sensor_transfer", "{real_scans}", "--out", "{folder}"),
        "sensor_transfer.json",
        "sensor_transfer",
        2.0,
    ),
    Study(
        "benchmark",
        "times beside other programs and the machine's limits",
        ("experiments.benchmark", "--only", _TIMED, "--weights", _VANE, "--out", "{folder}"),
        "benchmark.json",
        "benchmark",
        0.2,
        ("vane_weights",),
    ),
    Study(
        "growth",
        "how costs grow",
        ("experiments.benchmark", "--only", "scaling", "--weights", _VANE, "--out", "{folder}"),
        "benchmark.json",
        "growth",
        0.2,
        ("vane_weights",),
    ),
)
BY_RECORD = {study.record: study for study in STUDIES if study.record}


def recorded(folder: Path = RESULTS) -> dict[str, Any]:
    """Results by record's name, as far as they are there."""
    paths = {name: folder / f"{name}.json" for name in BY_RECORD}
    return {name: read_json(path) for name, path in paths.items() if path.is_file()}


def measured(studies: Sequence[Study], out: Path) -> dict[str, Any]:
    """The same of what studies left under ``out``."""
    found = {}
    for study in studies:
        path = study.folder(out) / study.written
        if study.record and finished(study, out) and path.is_file():
            found[study.record] = read_json(path)
    return found


def estimate(studies: Sequence[Study], out: Path, inputs: Mapping[str, str]) -> str:
    """What would be done and how long it takes, as aligned text."""
    lines, total = [], 0.0
    for study in studies:
        missing = [name for name in study.inputs if name not in inputs]
        if missing:
            told = f"needs --{missing[0].replace('_', '-')}"
        elif finished(study, out):
            told = "done before"
        else:
            told, total = f"{study.hours:5.2f} h", total + study.hours
        lines.append(f"{study.name:<20}{told:<20}{study.title}".rstrip())
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
    """Does the studies in order; every one has its outcome.

    Args:
      studies: those needed by others first.
      out: folder; each study's own is inside, as are logs/NAME.txt and ended/NAME.json.
      inputs: of `INPUTS`, those that there are.
      say: told what goes on.

    Raises:
      InputError: the folder cannot be written.
    """
    try:
        for name in ("logs", "ended"):
            (out / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be used as a folder ({error.strerror})") from error
    outcomes: dict[str, Outcome] = {}
    for number, study in enumerate(studies, 1):
        say(f"[{number}/{len(studies)}] {study.name}: {study.title}")
        outcomes[study.name] = outcome = _outcome(study, out, inputs, outcomes)
        say(f"    {outcome.state}" + (f": {outcome.why}" if outcome.why else ""))
    return list(outcomes.values())


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
        return Outcome(study, "failed", f"it ended well but wrote no {study.written}", seconds)
    stamp = {"arguments": study.arguments, "seconds": round(seconds, 1), "commit": git_commit()}
    write_json(_stamp(study, out), stamp)
    return Outcome(study, "done", seconds=seconds)


def _stamp(study: Study, out: Path) -> Path:
    return out / "ended" / f"{study.name}.json"


def _last(log: Path) -> str:
    """The last words of a log."""
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1][-_EXCERPT:] if lines else "it said nothing"


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


def outcomes_json(outcomes: Sequence[Outcome]) -> str:
    """What became of all, for a file."""
    rows = [
        {"study": o.study.name, "state": o.state, "why": o.why, "seconds": round(o.seconds, 1)}
        for o in outcomes
    ]
    return json.dumps(rows, indent=2) + "\n"
