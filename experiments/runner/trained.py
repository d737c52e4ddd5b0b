"""A trained network for a comparison: trained here and now, or taken from the folder of a run."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path

from experiments.evaluate import load_variables
from experiments.runner.experiment import Experiment
from experiments.runner.run_folder import (
    RunFolder,
    TrainingRecord,
    differences,
    read_record,
    training_record,
)
from experiments.train import fit
from vanejax.cad import Part
from vanejax.errors import InputError
from vanejax.matching.torch_weights import load_state_dict, rpmnet_variables
from vanejax.settings import values_of
from vanejax.training import ScanSet
from vanejax.training.train_step import Variables


@dataclasses.dataclass(frozen=True)
class Trained:
    """Averaged weights of a run's last step; no record where only the weights are known."""

    variables: Variables
    config: Experiment
    record: TrainingRecord | None


def trained(
    config: Experiment, part: Part, scans: ScanSet, folder: Path, given: Path | None = None
) -> Trained:
    """Trains in ``folder``, going on where a run there was interrupted; or loads what is ``given``.

    That is the folder of another run, or a published RPM-Net's weights, see `load_state_dict`.
    Raises InputError if it is of another network, part or kind of data.
    """
    if given is None:
        with RunFolder(folder) as run:
            run.claim(config, part)
            variables = fit(config, part, scans, run).average
        return Trained(variables, config, training_record(folder))
    if given.is_file():
        if config.model.name != "rpmnet":
            raise InputError(f"{given}: weights from PyTorch are read for an RPM-Net only")
        return Trained(rpmnet_variables(load_state_dict(given)), config, None)
    record = read_record(given, config)
    theirs, mine = record["config"], json.loads(json.dumps(dataclasses.asdict(config)))
    # what decides how a network is built and tested; how it was trained is reported only
    groups = {"part", "views", "data", "model", config.model.name} & set(mine)
    problems = list(differences(theirs, {name: mine[name] for name in mine if name in groups}))
    if record["part"]["sha256"] != part.sha256:
        problems.append(f"it is about the part {record['part']['name']}")
    if problems:
        raise InputError(f"{given}: is no run for this comparison: {'; '.join(problems)}")
    for name in ("training", "loss"):
        settings = getattr(config, name)
        known = values_of(type(settings), settings)
        values = {key: value for key, value in theirs[name].items() if key in known}
        setattr(config, name, dataclasses.replace(settings, **values))
    return Trained(load_variables(config, scans, given), config, training_record(given))


def given_runs(words: Iterable[str], names: Iterable[str]) -> dict[str, Path]:
    """Folders, or files of weights, by network from ``NAME=PATH`` arguments."""
    runs: dict[str, Path] = {}
    for word in words:
        name, equals, folder = word.partition("=")
        if not equals or name not in names:
            raise InputError(f"--trained {word}: should be NAME=PATH with {', '.join(names)}")
        if not Path(folder).exists():
            raise InputError(f"--trained {word}: there is no {folder}")
        runs[name] = Path(folder)
    return runs
