"""Training as a pure function of the state: ``state, metrics = step(state, bank)``.

Everything random in a step comes from ``fold_in(key(seed), step)``, so that a restored run is
bit-equal to an unbroken one and there is nothing to resume but the state.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from vanejax import losses
from vanejax.accumulation import accumulate
from vanejax.metrics import rotation_error_deg, translation_error
from vanejax.models.rpmnet import Match, RpmNet
from vanejax.pairs import Drawing, Pair, ScanBank, draw_pairs
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

Metrics = dict[str, jax.Array]
Variables = Any


@flax.struct.dataclass
class TrainState:
    """All that a training run is.

    Attributes:
      step: [] i32, steps done.
      variables: the model's, as the optimizer moves them.
      average: exponential moving average of ``variables``: what is evaluated and shipped.
      opt_state: the optimizer's.
    """

    step: jax.Array
    variables: Variables
    average: Variables
    opt_state: optax.OptState


@dataclasses.dataclass(frozen=True)
class RpmNetLoss:
    """The loss of RPM-Net over its iterations, and what vanejax adds to it.

    Attributes:
      iterations: of the network in training.
      discount: weight of an iteration relative to the next.
      pose: factor of `losses.pose_loss`; 1 as published.
      inlier: factor of `losses.inlier_loss`; 0.01 as published.
      matching: factor of `losses.matching_loss`; 0 as published.
      matching_sigma: its width, unit-sphere units.
      partner: factor of `losses.partner_loss`; 0 as published.
      pairs_at_once: pairs of a batch that are computed side by side: 1 suits the caches of a CPU,
        the whole batch a GPU. It should divide the batch, and changes rounding only.
    """

    iterations: int = 2
    discount: float = 0.5
    pose: float = 1.0
    inlier: float = 0.01
    matching: float = 0.0
    matching_sigma: float = 0.04
    partner: float = 0.0
    pairs_at_once: int = 1

    def of_match(self, match: Match, source: Any, pair: Pair) -> tuple[jax.Array, Metrics]:
        """Loss [] of one iteration for one pair, and its parts."""
        truth = pair.target_from_source
        parts = {"pose": losses.pose_loss(match, source, truth)}
        parts["inlier"] = losses.inlier_loss(match, source, pair.target)
        if self.matching:
            parts["matching"] = losses.matching_loss(
                match, source, pair.target, truth, sigma=self.matching_sigma
            )
        if self.partner:
            parts["partner"] = losses.partner_loss(match, source, truth)
        return sum(getattr(self, name) * value for name, value in parts.items()), parts

    def __call__(
        self, model: RpmNet, variables: Variables, pairs: Pair
    ) -> tuple[jax.Array, Metrics]:
        """Mean loss [] over a batch that shares its target, and mean metrics [].

        Metrics: each part of the loss and the pose error, all after the last iteration.
        """
        # Once for the batch: the reference is the same for every view.
        features = model.apply(variables, pairs.target, method="features")
        weights = self.discount ** jnp.arange(self.iterations - 1.0, -1.0, -1.0)

        def of_pair(
            shared: tuple[Variables, jax.Array], source: PointCloud, truth: RigidTransform
        ) -> tuple[jax.Array, Metrics]:
            pair = Pair(source=source, target=pairs.target, target_from_source=truth)
            near = model.apply(variables, source, method="neighborhoods")

            def iteration(
                shared: tuple[Variables, jax.Array], pose: RigidTransform, weight: jax.Array
            ) -> tuple[jax.Array, RigidTransform, Metrics]:
                variables, features = shared
                match = model.apply(
                    variables, source, near, pair.target, features, pose, method="match"
                )
                value, parts = self.of_match(match, source, pair)
                pose = match.target_from_source
                return weight * value, pose, parts | pose_metrics(pose, truth)

            # the published network does not differentiate through the pose either
            init = jax.tree.map(jnp.asarray, RigidTransform.identity())
            total, _, metrics = accumulate(iteration, shared, init, weights)
            return total, jax.tree.map(lambda leaf: leaf[-1], metrics)

        def some_pairs(
            shared: tuple[Variables, jax.Array], carry: tuple[()], some: tuple
        ) -> tuple[jax.Array, tuple[()], Metrics]:
            if at_once == 1:
                total, metrics = of_pair(shared, *jax.tree.map(lambda leaf: leaf[0], some))
                return total, carry, metrics
            totals, metrics = jax.vmap(of_pair, in_axes=(None, 0, 0))(shared, *some)
            return jnp.sum(totals), carry, metrics

        batch = pairs.source.mask.shape[0]
        at_once = math.gcd(batch, self.pairs_at_once)
        some = jax.tree.map(
            lambda leaf: leaf.reshape(batch // at_once, at_once, *leaf.shape[1:]),
            (pairs.source, pairs.target_from_source),
        )
        total, _, metrics = accumulate(some_pairs, (variables, features), (), some)
        return total / batch, jax.tree.map(jnp.mean, metrics)


def pose_metrics(found: RigidTransform, truth: RigidTransform) -> Metrics:
    """Rotation error in degrees and translation error in unit-sphere units, [...] each."""
    return {
        "rotation_error_deg": rotation_error_deg(found, truth),
        "translation_error": translation_error(found, truth),
    }


def make_optimizer(
    *,
    learning_rate: float,
    steps: int,
    warmup_steps: int,
    clip_norm: float,
    final_fraction: float = 0.0,
) -> optax.GradientTransformation:
    """Adam with warm-up, cosine decay to ``final_fraction`` of the peak, and norm clipping."""
    schedule = optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=learning_rate,
        warmup_steps=warmup_steps,
        decay_steps=max(steps, warmup_steps + 1),
        end_value=final_fraction * learning_rate,
    )
    # flat: some dozens of leaves would be updated, and compiled, one by one
    return optax.flatten(optax.chain(optax.clip_by_global_norm(clip_norm), optax.adam(schedule)))


def init_state(
    model: RpmNet,
    optimizer: optax.GradientTransformation,
    bank: ScanBank,
    drawing: Drawing,
    *,
    seed: int,
) -> TrainState:
    """The state before the first step; the same seed gives the same state."""

    @jax.jit
    def init(key: jax.Array) -> Variables:
        # Only the shapes of a pair matter here: inside the jit nothing of it is computed.
        draw_key = jax.random.fold_in(key, 1)
        pairs = draw_pairs(draw_key, bank, jnp.zeros((1,), jnp.int32), drawing)
        source = jax.tree.map(lambda leaf: leaf[0], pairs.source)
        return model.init(key, source, pairs.target, RigidTransform.identity(), 1)

    variables = init(jax.random.key(seed))
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        variables=variables,
        average=jax.tree.map(jnp.copy, variables),
        opt_state=optimizer.init(variables),
    )


def views_of_step(key: jax.Array, step: jax.Array, *, batch_size: int, num_views: int) -> jax.Array:
    """View indices [batch_size] i32: each epoch visits every view once, in its own random order."""
    position = step * batch_size + jnp.arange(batch_size)
    epochs = position // num_views

    def of(epoch: jax.Array, place: jax.Array) -> jax.Array:
        return jax.random.permutation(jax.random.fold_in(key, epoch), num_views)[place]

    return jax.vmap(of)(epochs, position % num_views)


def make_train_step(
    model: RpmNet,
    optimizer: optax.GradientTransformation,
    loss: RpmNetLoss,
    drawing: Drawing,
    *,
    batch_size: int,
    seed: int,
    average_decay: float,
    quick_compilation: bool = False,
) -> Callable[[TrainState, ScanBank], tuple[TrainState, Metrics]]:
    """The jitted step; it donates the state and draws its own batch from the bank.

    The moving average forgets its start: its decay grows as (1 + step) / (10 + step).
    ``quick_compilation`` is for CPUs: a quarter less time to compile, 5 % more for each step.
    """

    def step(state: TrainState, bank: ScanBank) -> tuple[TrainState, Metrics]:
        order_key, draw_key = jax.random.split(jax.random.key(seed))
        views = views_of_step(
            order_key, state.step, batch_size=batch_size, num_views=bank.scans.mask.shape[0]
        )
        pairs = draw_pairs(jax.random.fold_in(draw_key, state.step), bank, views, drawing)
        (value, metrics), gradients = jax.value_and_grad(
            lambda variables: loss(model, variables, pairs), has_aux=True
        )(state.variables)
        updates, opt_state = optimizer.update(gradients, state.opt_state, state.variables)
        variables = optax.apply_updates(state.variables, updates)
        decay = jnp.minimum(average_decay, (1.0 + state.step) / (10.0 + state.step))
        average = jax.tree.map(
            lambda old, new: decay * old + (1 - decay) * new, state.average, variables
        )
        norm = jnp.linalg.norm(ravel_pytree(gradients)[0])
        metrics = metrics | {"loss": value, "gradient_norm": norm}
        new = TrainState(
            step=state.step + 1, variables=variables, average=average, opt_state=opt_state
        )
        return new, metrics

    # XLA's older generator of CPU kernels, of which the step has hundreds
    options = {"xla_cpu_use_fusion_emitters": False}
    if not (quick_compilation and jax.default_backend() == "cpu" and _knows(options)):
        options = None
    return jax.jit(step, donate_argnums=0, compiler_options=options)


def _knows(options: dict[str, bool]) -> bool:
    """Whether this version of XLA has these options."""
    try:
        jax.jit(lambda: jnp.zeros(()), compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
