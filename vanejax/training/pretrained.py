"""Weights that come with the package: RPM-Net for the built-in guide vane."""

from __future__ import annotations

import os
from importlib import resources

from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.training.weight_file import TrainedMatcher, load_model

WORD = "shipped"  # in place of a file's name
FILES = ("guide_vane.npz",)


def shipped_weights(part: Part) -> TrainedMatcher | None:
    """The matcher that comes with the package for this part; None if there is none."""
    for name in FILES:
        with resources.as_file(resources.files("vanejax") / "weights" / name) as path:
            matcher = load_model(path)
        if matcher.knows(part):
            return matcher
    return None


def find_weights(named: str | os.PathLike[str], part: Part) -> TrainedMatcher:
    """The matcher of a file, or the shipped one where ``named`` is "shipped".

    Raises:
      InputError: the file cannot be read, or no network of this part is there.
    """
    if os.fspath(named) != WORD:
        matcher = load_model(named)
        matcher.check_part(part)
        return matcher
    found = shipped_weights(part)
    if found is None:
        raise InputError(
            f"no weights are shipped for {part.name}, only for the built-in guide vane (vane); "
            "train for it and export, or leave the weights out: registration works without"
        )
    return found
