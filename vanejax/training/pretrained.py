"""Weights that come with the package: RPM-Net for the built-in guide vane."""

from __future__ import annotations

import os
from importlib import resources

from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.training.weight_file import TrainedMatcher, load_model

PRETRAINED = "pretrained"  # in place of a file's name
_WORDS = (PRETRAINED, "shipped")  # the second is the word of older versions
_FILE = "pretrained_weights/guide_vane.safetensors"


def pretrained_matcher(part: Part) -> TrainedMatcher | None:
    """The matcher that comes with the package for this part; None if there is none."""
    with resources.as_file(resources.files("vanejax.training") / _FILE) as path:
        matcher = load_model(path)
    return matcher if matcher.knows(part) else None


def find_weights(name: str | os.PathLike[str], part: Part) -> TrainedMatcher:
    """The matcher of a file, or the pretrained one where ``name`` is "pretrained" ("shipped").

    Raises:
      InputError: the file cannot be read, or there is no network for this part.
    """
    if os.fspath(name) not in _WORDS:
        matcher = load_model(name)
        matcher.check_part(part)
        return matcher
    pretrained = pretrained_matcher(part)
    if pretrained is None:
        raise InputError(
            f"there are no pretrained weights for {part.name}, only for the built-in guide vane "
            "(vane); train for it and export, or leave the weights out: registration works without"
        )
    return pretrained
