"""Sweeps over fields of an experiment: their grammar, and the cells of the grid they span."""

from __future__ import annotations

import ast
import copy
import dataclasses
import functools
import hashlib
import itertools
import json
import math
import re
import typing
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.runner import command_line
from experiments.runner.experiment import Experiment
from vanejax.errors import InputError

_Tree = typing.TypeVar("_Tree")
LONGEST_NAME = 120  # of a cell's folder; file systems take 255 bytes


@dataclasses.dataclass(frozen=True)
class Sweep:
    """The path of a field, such as "model.num_neighbors", and values of its type, all different."""

    field: str
    values: tuple[Any, ...]


@dataclasses.dataclass(frozen=True)
class Cell:
    """One point of the grid with one seed: one training.

    ``overrides`` are in the order of the fields' names: an order of sweeps is no other grid.
    """

    overrides: tuple[tuple[str, Any], ...]
    seed: int

    @property
    def name(self) -> str:
        """What its folder is called: readable, and another for every other cell."""
        words = [f"{field}={value}" for field, value in (*self.overrides, ("seed", self.seed))]
        name = ",".join(words)
        safe = re.sub(r"[^\w.=,+-]", "_", name)[:LONGEST_NAME]
        if safe == name:
            return name
        identity = json.dumps([self.overrides, self.seed])
        return f"{safe}-{hashlib.sha256(identity.encode()).hexdigest()[:8]}"

    def config(self, base: Experiment) -> Experiment:
        """The base with the cell's overrides and seed; the base stays as it is."""
        return with_values(base, {"seed": self.seed} | dict(self.overrides))


def with_values(config: _Tree, values: Mapping[str, Any]) -> _Tree:
    """A copy with the fields of these paths, such as "model.num_neighbors", set."""
    config = copy.deepcopy(config)
    for path, value in values.items():
        *groups, name = path.split(".")
        setattr(functools.reduce(getattr, groups, config), name, value)
    return config


def grid(sweeps: Sequence[Sweep], seeds: Sequence[int]) -> list[Cell]:
    """Every combination of the sweeps' values with every seed; seeds vary fastest."""
    return [
        Cell(tuple(sorted(zip((sweep.field for sweep in sweeps), values, strict=True))), seed)
        for values in itertools.product(*(sweep.values for sweep in sweeps))
        for seed in seeds
    ]


def check_used(cells: Sequence[Cell], base: Experiment) -> None:
    """Refuses cells that change what their network does not use: they would be one training."""
    for cell in cells:
        config = cell.config(base)
        for field, _ in cell.overrides:
            try:
                config.check_used(field)
            except InputError as error:
                raise InputError(f"--sweep {str(error).removeprefix('--sweep ')}") from error


def parse_sweeps(words: Sequence[str], config: Experiment) -> list[Sweep]:
    """Sweeps from ``FIELD=VALUE,VALUE,...``, each value typed as the config's field is.

    A tuple is written in brackets, a text with a comma in quotes:
    ``views.elevations_deg=(60,70),(80,85)``. Raises InputError for another form, field or type.
    """
    if not words:
        raise InputError("--sweep is missing; try --sweep model.num_neighbors=16,32")
    sweeps = [_parse_sweep(word, config) for word in words]
    for field in (fields := [sweep.field for sweep in sweeps]):
        if fields.count(field) > 1:
            raise InputError(f"--sweep {field}: given twice; put all its values into one")
    return sweeps


def parse_seeds(words: Sequence[str], default: int) -> tuple[int, ...]:
    """Whole numbers from 0, each once, from words; the default where there are none."""
    for word in words:
        if not word.isdecimal():
            raise InputError(f"--seeds: {word!r} should be a whole number, such as --seeds 0,1,2")
    seeds = tuple(map(int, words)) or (default,)
    _refuse_twice("--seeds", seeds)
    return seeds


def _parse_sweep(word: str, config: Experiment) -> Sweep:
    field, equals, text = word.partition("=")
    field = field.removeprefix("config.")
    if not equals:
        raise InputError(f"--sweep {word}: should be FIELD=VALUE,VALUE,...")
    if field == "seed":
        raise InputError("--sweep seed: seeds have an option of their own, such as --seeds 0,1,2")
    try:
        command_line.check_field(config, field)
    except InputError as error:
        raise InputError(f"--sweep {str(error).removeprefix('--config.')}") from error
    kind = _type_of(config, field)
    try:
        texts = _split(text)
    except ValueError as error:
        raise InputError(f"--sweep {word}: {error}") from None
    values = []
    for value in texts:
        try:
            values.append(_parse_value(value, kind))
        except (ValueError, SyntaxError):
            wanted = command_line.kind_of(config, field)
            raise InputError(f"--sweep {field}: {value!r} will not do; it takes {wanted}") from None
    _refuse_twice(f"--sweep {field}", values)
    return Sweep(field, tuple(values))


def _refuse_twice(where: str, values: Sequence[Any]) -> None:
    for index, value in enumerate(values):
        if value in values[:index]:
            raise InputError(f"{where}: {value!r} is there twice")


def _type_of(config: Experiment, field: str) -> Any:
    *groups, name = field.split(".")
    node = functools.reduce(getattr, groups, config)
    return next(entry.type for entry in dataclasses.fields(node) if entry.name == name)


def _split(text: str) -> list[str]:
    """The text at its commas, but for those inside brackets or quotes, which must be closed."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        else:
            depth += (letter in "([") - (letter in ")]")
        if letter == "," and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    if depth or quote:
        raise ValueError(f"a {'quote' if quote else 'bracket'} is not closed")
    return [part.strip() for part in parts]


def _parse_value(text: str, kind: Any) -> Any:
    """A value of the type ``kind``; ValueError or SyntaxError where the text is none."""
    if typing.get_origin(kind) is tuple:
        value = ast.literal_eval(text)
        if not isinstance(value, tuple | list):
            raise ValueError(text)
        element = typing.get_args(kind)[0]
        return tuple(_parse_value(str(entry), element) for entry in value)
    if kind is bool:
        if text.lower() not in ("true", "false"):
            raise ValueError(text)
        return text.lower() == "true"
    if kind is str:
        quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "'\""
        return text[1:-1] if quoted else text
    value = kind(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value
