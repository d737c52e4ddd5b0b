"""Checkpoints: the last few and the best, whole or not at all."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from vanejax.errors import InputError
from vanejax.training.checkpoint import Checkpoints, all_finite, restore_or
from vanejax.training.train_step import TrainState, first_state


def make_state(step: int, width: int = 3) -> TrainState:
    variables = {"params": {"kernel": jnp.full((width, 2), step / 7), "bias": jnp.zeros(2)}}
    average = jax.tree.map(lambda leaf: leaf * 0.5, variables)
    state = first_state(optax.adam(1e-3), variables)
    return state.replace(step=jnp.asarray(step, jnp.int32), average=average)


def test_a_state_comes_back_bit_equal(tmp_path) -> None:
    state = make_state(5)
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(state)
    again = restore_or(tmp_path, make_state(0), keep=2)
    assert jax.tree.structure(again) == jax.tree.structure(state)
    for left, right in zip(jax.tree.leaves(again), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(left, right)


def test_the_last_and_the_best_are_kept(tmp_path) -> None:
    with Checkpoints(tmp_path, keep=2) as checkpoints:
        for step, score in enumerate([5.0, 1.0, 3.0, None, 4.0, 2.0]):
            checkpoints.save(make_state(step), score=score)
        assert checkpoints.best_step == 1
        assert checkpoints.latest_step == 5
        assert int(checkpoints.restore(make_state(0), step=1).step) == 1
        assert int(checkpoints.restore(make_state(0), step=4).step) == 4
    kept = sorted(int(path.name) for path in tmp_path.iterdir() if path.name.isdigit())
    assert kept == [1, 4, 5]


def test_without_a_checkpoint_the_fresh_state_is_used(tmp_path) -> None:
    fresh = make_state(0)
    assert restore_or(tmp_path / "new", fresh, keep=2) is fresh
    with (
        Checkpoints(tmp_path / "new") as checkpoints,
        pytest.raises(InputError, match="train first"),
    ):
        checkpoints.restore(fresh)


def test_another_model_is_refused(tmp_path) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(make_state(1))
    with pytest.raises(InputError, match="trained with another config"):
        restore_or(tmp_path, make_state(0, width=4), keep=2)


def test_a_half_written_checkpoint_is_passed_over(tmp_path) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(make_state(1))
    # what orbax leaves behind when it is killed before its final rename
    (tmp_path / "2.orbax-checkpoint-tmp").mkdir()
    assert int(restore_or(tmp_path, make_state(0), keep=2).step) == 1


def test_all_finite_sees_a_single_nan() -> None:
    good = {"a": jnp.ones(3), "b": {"c": jnp.zeros(2)}}
    assert all_finite(good)
    assert not all_finite({"a": jnp.ones(3), "b": {"c": jnp.asarray([0.0, jnp.nan])}})
