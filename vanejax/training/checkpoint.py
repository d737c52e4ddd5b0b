"""Checkpoints of a training state: atomic, the last few and the best."""

from __future__ import annotations

import contextlib
import operator
import os
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers

from vanejax.errors import InputError
from vanejax.training.train_step import TrainState, Variables


class Checkpoints(contextlib.AbstractContextManager):
    """The checkpoints in a folder; each is written whole or not at all (orbax renames it).

    Kept are the ``keep`` latest and the one with the lowest ``score``. Use as a context manager.
    """

    def __init__(self, folder: str | os.PathLike[str], *, keep: int = 2) -> None:
        score = operator.itemgetter("score")
        latest = checkpoint_managers.LatestN(keep)
        best = checkpoint_managers.BestN(
            get_metric_fn=score, reverse=True, n=1, keep_checkpoints_without_metrics=False
        )
        options = ocp.CheckpointManagerOptions(
            preservation_policy=checkpoint_managers.AnyPreservationPolicy([latest, best]),
            best_fn=score,
            best_mode="min",
            enable_async_checkpointing=False,
        )
        self._manager = ocp.CheckpointManager(Path(folder).absolute(), options=options)

    def __exit__(self, *_: object) -> None:
        self._manager.close()

    @property
    def latest_step(self) -> int | None:
        """Step of the newest checkpoint, None if there is none."""
        return self._manager.latest_step()

    @property
    def best_step(self) -> int | None:
        """Step of the checkpoint with the lowest score, None if none has a score."""
        return self._manager.best_step()

    def save(self, state: TrainState, *, score: float | None = None) -> None:
        """Writes the state under its step; does nothing where that step is there already.

        The best checkpoint has the lowest ``score``; None is for one that was not measured.
        """
        step = int(state.step)
        if step in self._manager.all_steps():
            return
        metrics = None if score is None else {"score": float(score)}
        self._manager.save(step, args=ocp.args.StandardSave(state), metrics=metrics)
        self._manager.wait_until_finished()

    def restore(self, like: TrainState, *, step: int | None = None) -> TrainState:
        """Reads a state; the latest one by default.

        It has the structure, shapes and dtypes of the state ``like``, such as `init_state` gives.

        Raises:
          InputError: no checkpoint, one that cannot be read, or one of another model.
        """
        step = self.latest_step if step is None else step
        if step is None:
            raise InputError(f"{self._manager.directory}: no checkpoint; train first")
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
        try:
            return self._manager.restore(step, args=ocp.args.StandardRestore(abstract))
        except (ValueError, KeyError, TypeError, OSError) as error:
            reason = str(error).strip().split("\n")[0][:200]
            raise InputError(
                f"{self._manager.directory}/{step}: cannot be read as a state of this model; "
                f"was it trained with another config? ({reason})"
            ) from error


def restore_or(folder: str | os.PathLike[str], fresh: TrainState, *, keep: int) -> TrainState:
    """The latest state in ``folder``, or ``fresh`` where there is none."""
    with Checkpoints(folder, keep=keep) as checkpoints:
        return fresh if checkpoints.latest_step is None else checkpoints.restore(fresh)


def all_finite(variables: Variables) -> bool:
    """Whether every number of a tree of arrays is finite."""
    return all(bool(np.isfinite(np.asarray(leaf)).all()) for leaf in jax.tree.leaves(variables))
