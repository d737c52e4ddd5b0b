"""What each step of a training draws its pairs from: fixed scans, generic shapes, or new scans."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext

import jax.numpy as jnp

from experiments.runner.experiment import Experiment
from experiments.runner.run_folder import RunFolder
from vanejax.cad import Part
from vanejax.training import ScanSet, make_bank
from vanejax.training.shape_pairs import ShapeBank
from vanejax.training.shape_sets import load_shapes
from vanejax.training.train_step import Bank


@dataclasses.dataclass(frozen=True)
class TrainingBanks:
    """Banks for training and for validation.

    Attributes:
      validation: the training's own entries where they are fixed, else some that no step sees.
      steps: ``steps(first, end)`` is a context with an iterator over the banks of those steps.
    """

    validation: Bank
    steps: Callable[[int, int], AbstractContextManager[Iterator[Bank]]]


def training_banks(
    config: Experiment, part: Part, scans: ScanSet, folder: RunFolder
) -> TrainingBanks:
    """What ``config`` says to train on; generic shapes are recorded in the run's ``folder``."""
    if config.data.shapes:
        shapes = load_shapes(config.data.shapes, seed=config.seed)
        folder.claim_shapes(shapes.title, shapes.sha256)
        print(f"training on {shapes.title}")
        return _fixed(
            ShapeBank(points=jnp.asarray(shapes.points), normals=jnp.asarray(shapes.normals))
        )
    if not config.online.sensor:
        return _fixed(make_bank(scans.train, num_reference=config.data.num_reference))
    settings, training = config.online, config.training
    sampling = config.pair_sampling(scans)
    stream = settings.stream(
        part, scans, sampling, batch_size=training.batch_size, seed=config.seed
    )
    print(f"training on new scans by {settings.sensor} for every step")
    return TrainingBanks(
        validation=stream.for_validation(training.validation_pairs),
        steps=lambda first, end: stream.steps(first, end, workers=settings.workers),
    )


def _fixed(bank: Bank) -> TrainingBanks:
    return TrainingBanks(bank, lambda first, end: nullcontext(itertools.repeat(bank)))
