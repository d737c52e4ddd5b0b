"""Registering the views of a scan set with any method: the same pairs for all of them."""

from __future__ import annotations

import functools
import time

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from vanejax.matching import Register, Registration
from vanejax.matching.metrics import PoseErrors, SurfaceFit, pose_errors, surface_fit
from vanejax.rigid import RigidTransform
from vanejax.training.pairs import Pair, PairSampling, ScanBank, draw_source, draw_target

TEST_STREAM = 0x7E57  # folded into key(seed): training and validation draw from other keys


@flax.struct.dataclass
class Results:
    """Registrations of V views, on the host.

    Attributes:
      pairs: what was registered, unit-sphere units; a target for each view: [V, N], [V, M], [V].
      registration: [V] what was found.
      errors: [V] against the labels.
      fit: [V] of the moved source to its own target: noisy points both, as the network got them.
      fit_at_truth: [V] the same under the true pose: what density and noise alone amount to.
      time_s: [V] f64, wall clock of a registration without compilation.
    """

    pairs: Pair
    registration: Registration
    errors: PoseErrors
    fit: SurfaceFit
    fit_at_truth: SurfaceFit
    time_s: np.ndarray


def register_views(
    register: Register,
    bank: ScanBank,
    sampling: PairSampling,
    *,
    seed: int,
    unit_mm: float,
    progress: bool = True,
) -> Results:
    """Draws a pair from each view of the bank, registers it from the identity and measures.

    View v draws its points, noise and pose from ``fold_in(fold_in(key(seed), TEST_STREAM), v)``:
    the same pairs for every method, whatever it does. ``register`` should be jitted if it can be;
    ``unit_mm`` is the length of the unit-sphere unit, the part's radius.
    """
    stream = jax.random.fold_in(jax.random.key(seed), TEST_STREAM)
    init = RigidTransform.identity()
    rows = []
    views = range(bank.scans.mask.shape[0])
    for view in tqdm(views, "evaluating", unit="view", disable=not progress):
        draw_key, register_key = jax.random.split(jax.random.fold_in(stream, view))
        pair = jax.block_until_ready(_draw(draw_key, bank, jnp.asarray(view), sampling))
        if view == 0:  # compiles
            jax.block_until_ready(register(pair.source, pair.target, init, register_key))
        start = time.perf_counter()
        estimate = jax.block_until_ready(register(pair.source, pair.target, init, register_key))
        seconds = time.perf_counter() - start
        measured = measure(pair, estimate.target_from_source, unit_mm)
        rows.append(jax.device_get(Results(pair, estimate, *measured, time_s=np.float64(seconds))))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


# jitted here, not in the function: another evaluation in this process compiles nothing


@functools.partial(jax.jit, static_argnames="sampling")
def _draw(key: jax.Array, bank: ScanBank, view: jax.Array, sampling: PairSampling) -> Pair:
    target_key, source_key = jax.random.split(key)
    source, truth = draw_source(source_key, bank, view, sampling)
    target = draw_target(target_key, bank, sampling)
    return Pair(source=source, target=target, target_from_source=truth)


@functools.partial(jax.jit, static_argnames="unit_mm")
def _fit(pair: Pair, pose: RigidTransform, unit_mm: float) -> SurfaceFit:
    return surface_fit(pair.source.transform(pose), pair.target, unit_mm=unit_mm)


def measure(
    pair: Pair, estimate: RigidTransform, unit_mm: float
) -> tuple[PoseErrors, SurfaceFit, SurfaceFit]:
    """Errors of a pose of one pair, and how the clouds fit under it and under the true pose."""
    truth = pair.target_from_source
    fits = (_fit(pair, pose, unit_mm) for pose in (estimate, truth))
    return pose_errors(estimate, truth, unit_mm=unit_mm), *fits
