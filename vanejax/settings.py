"""Settings that check themselves: dataclasses whose fields hold their default and their bound.

A configuration is a tree of them. What can be set, its default and what it may be stand in one
place, beside the code that uses it:

    @settings_class
    class RpmNetLoss(Settings):
        iterations: int = positive(2)
        pose: float = factor(1.0)

    RpmNetLoss(iterations=0).check("loss")  # InputError: loss.iterations=0 must be positive
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, TypeVar

from vanejax.errors import InputError

_BOUND, _FACTOR = "bound", "factor"


class Bound(NamedTuple):
    """What a field may be: whether a value holds, and what goes behind "must"."""

    holds: Callable[[Any], bool]
    words: str


def bounded(default: Any, holds: Callable[[Any], bool], words: str, **metadata: Any) -> Any:
    """A field with a default and a `Bound`."""
    return dataclasses.field(default=default, metadata={_BOUND: Bound(holds, words)} | metadata)


def positive(default: float) -> Any:
    """A finite number above 0."""
    return bounded(default, lambda value: math.isfinite(value) and value > 0, "be positive")


def not_negative(default: float) -> Any:
    """A finite number of at least 0."""
    return bounded(default, _at_least_zero, "be >= 0")


def factor(default: float) -> Any:
    """The factor, at least 0, of a part of a loss; one of them must be above 0."""
    return bounded(default, _at_least_zero, "be >= 0", **{_FACTOR: True})


def magnitude(default: float) -> Any:
    """A finite number of at least 0, such as the size of an effect."""
    return bounded(default, _at_least_zero, "be 0 or more")


def share(default: float) -> Any:
    """A number above 0, at most 1."""
    return bounded(default, lambda value: 0 < value <= 1, "lie in (0, 1]")


def multiple_of(number: int, default: int) -> Any:
    """A positive multiple of ``number``."""
    return bounded(
        default,
        lambda value: value > 0 and value % number == 0,
        f"be a multiple of {number}",
    )


def one_of(*values: str) -> Any:
    """One of some words; the first is the default."""
    return bounded(values[0], lambda value: value in values, f"be one of {', '.join(values)}")


def _at_least_zero(value: float) -> bool:
    return math.isfinite(value) and value >= 0


_Class = TypeVar("_Class", bound=type)


@typing.dataclass_transform(
    field_specifiers=(dataclasses.field, positive, not_negative, factor, share, multiple_of, one_of)
)
def settings_class(cls: _Class) -> _Class:
    """Makes a class a dataclass of settings: mutable, comparable, and hashable for `jax.jit`.

    A jitted function takes it as a static argument: one that was changed is another argument.
    """
    cls = dataclasses.dataclass(unsafe_hash=True)(cls)  # type: ignore[assignment]
    types = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):  # pyright: ignore[reportArgumentType]
        field.type = types[field.name]  # a command line reads it, and cannot read a string
    return cls


def hint(name: str, names: Iterable[str]) -> str:
    """What to add to a message about an unknown name: the nearest one that there is, if any."""
    near = difflib.get_close_matches(name, names, 1)
    return f"; did you mean {near[0]}?" if near else ""


class Settings:
    """Base of settings; subclasses are decorated with `settings_class`."""

    def __setattr__(self, name: str, value: Any) -> None:
        """Sets a field.

        Raises:
          InputError: there is no such field; names those that there are.
        """
        names = [field.name for field in dataclasses.fields(self)]  # pyright: ignore[reportArgumentType]
        if name not in names:
            raise InputError(
                f"{type(self).__name__} has no field {name!r}{hint(name, names)} (its fields are: "
                f"{', '.join(names)})"
            )
        super().__setattr__(name, value)

    def check(self, path: str = "") -> None:
        """Refuses what cannot be used, here and in the settings below.

        Subclasses add what concerns several fields.

        Args:
          path: where these settings stand, such as "config.loss".

        Raises:
          InputError: names the field, its value and what it must be.
        """
        factors = []
        for field in dataclasses.fields(self):  # pyright: ignore[reportArgumentType]
            value, place = getattr(self, field.name), f"{path}.{field.name}".lstrip(".")
            _check_field(field, value, place)
            if isinstance(value, Settings):
                value.check(place)
            if field.metadata.get(_FACTOR):
                factors.append(field.name)
        if factors and not any(getattr(self, name) for name in factors):
            raise InputError(f"{path}: {', '.join(factors)} are all 0: nothing to learn")


def check_fields(settings: Any, owner: str) -> None:
    """Refuses, by InputError, a value of any dataclass that the field's `Bound` does not allow."""
    for field in dataclasses.fields(settings):
        _check_field(field, getattr(settings, field.name), f"{owner}: {field.name}")


def _check_field(field: dataclasses.Field, value: Any, place: str) -> None:
    bound: Bound | None = field.metadata.get(_BOUND)
    if bound is not None and not _allowed(bound, value):
        raise InputError(f"{place}={value!r} must {bound.words}")


def _allowed(bound: Bound, value: Any) -> bool:
    try:
        return bool(bound.holds(value))
    except TypeError:  # such as a text where a number belongs
        return False


def values_of(cls: type, holder: Any) -> dict[str, Any]:
    """The values of the fields of ``cls`` in settings that have these fields and maybe more."""
    return {field.name: getattr(holder, field.name) for field in dataclasses.fields(cls)}


def field_paths(tree: Any, path: str = "") -> list[str]:
    """Paths of all fields of a tree of settings, such as "model.num_neighbors"."""
    paths = []
    for field in dataclasses.fields(tree):
        value, place = getattr(tree, field.name), f"{path}.{field.name}".lstrip(".")
        paths += field_paths(value, place) if dataclasses.is_dataclass(value) else [place]
    return paths


def with_defaults(record: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """A recorded tree of settings, completed by the fields that did not exist when it was made."""
    completed = dict(defaults) | dict(record)
    for name, default in defaults.items():
        if isinstance(default, Mapping) and isinstance(record.get(name), Mapping):
            completed[name] = with_defaults(record[name], default)
    return completed
