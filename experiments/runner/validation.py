"""Pose errors of the averaged weights while they are trained."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from experiments.runner.experiment import Experiment
from vanejax.matching import pose_metrics
from vanejax.rigid import RigidTransform
from vanejax.training.pairs import PairSampling
from vanejax.training.train_step import Bank, Metrics, TrainState, Variables


def make_validation(
    config: Experiment, bank: Bank, sampling: PairSampling, radius_mm: float
) -> Callable[[TrainState], dict[str, float]]:
    """Mean errors on training entries, drawn with a key of their own.

    They choose the best checkpoint, so that the test views stay unseen until the end.
    """
    network, count = config.make_network(), config.training.validation_pairs
    key = jax.random.fold_in(jax.random.key(config.seed), 0x7A11DA7E)
    entries = jnp.linspace(0, bank.size - 1, count).astype(int)

    @jax.jit
    def errors(variables: Variables, bank: Bank) -> Metrics:
        register = network.factory(network.model, variables, iterations=network.iterations)

        def errors_of(number: jax.Array) -> Metrics:
            draw_key, register_key = jax.random.split(jax.random.fold_in(key, number))
            pairs = bank.draw(draw_key, entries[number][None], sampling)
            source, truth = jax.tree.map(
                lambda leaf: leaf[0], (pairs.source, pairs.target_from_source)
            )
            init = jax.tree.map(jnp.asarray, RigidTransform.identity())
            result = register(source, pairs.target, init, register_key)
            return pose_metrics(result.target_from_source, truth)

        return jax.lax.map(errors_of, jnp.arange(count))

    def validate(state: TrainState) -> dict[str, float]:
        means = jax.tree.map(np.mean, jax.device_get(errors(state.average, bank)))
        return {
            "validation_rotation_error_deg": float(means["rotation_error_deg"]),
            "validation_translation_error_mm": float(means["translation_error"]) * radius_mm,
        }

    return validate
