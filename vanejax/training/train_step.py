"""Training as a pure function of the state: ``state, metrics = step(state, bank)``.

Everything random in a step comes from ``fold_in(key(seed), step)``, so that a restored run is
bit-equal to an unbroken one and there is nothing to resume but the state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from vanejax.rigid import RigidTransform
from vanejax.settings import Settings, not_negative, positive, settings_class
from vanejax.training.pairs import Pair, PairSampling, ScanBank
from vanejax.training.shape_pairs import ShapeBank

Metrics = dict[str, jax.Array]
Variables = Any
Bank = ScanBank | ShapeBank  # what pairs are drawn from
# ``loss(model, variables, pairs)`` of sources [B] that share one target: mean loss [], and mean
# metrics [], among them ``rotation_error_deg`` and ``translation_error``
Loss = Callable[[nn.Module, Variables, Pair], tuple[jax.Array, Metrics]]


@flax.struct.dataclass
class TrainState:
    """All that a training run is.

    Attributes:
      step: [] i32, steps done.
      variables: the model's, as the optimizer moves them.
      average: exponential moving average of ``variables``: what is evaluated and exported.
      opt_state: the optimizer's.
    """

    step: jax.Array
    variables: Variables
    average: Variables
    opt_state: optax.OptState


@settings_class
class OptimizerSettings(Settings):
    """Adam with warm-up, cosine decay and clipped gradients.

    Attributes:
      steps: of the optimizer.
      learning_rate: peak of Adam's.
      warmup_steps: linear growth from 0 to the peak.
      final_fraction: of the peak, at the end of the cosine decay.
      clip_norm: largest global norm of a gradient.
    """

    steps: int = positive(5000)
    learning_rate: float = positive(1e-3)
    warmup_steps: int = not_negative(100)
    final_fraction: float = not_negative(0.0)
    clip_norm: float = positive(1.0)


def make_optimizer(settings: OptimizerSettings) -> optax.GradientTransformation:
    """Adam as its settings say."""
    schedule = optax.warmup_cosine_decay_schedule(
        init_value=0.0,
        peak_value=settings.learning_rate,
        warmup_steps=settings.warmup_steps,
        decay_steps=max(settings.steps, settings.warmup_steps + 1),
        end_value=settings.final_fraction * settings.learning_rate,
    )
    # flat: some dozens of leaves would be updated, and compiled, one by one
    return optax.flatten(
        optax.chain(optax.clip_by_global_norm(settings.clip_norm), optax.adam(schedule))
    )


def init_state(
    model: nn.Module,
    optimizer: optax.GradientTransformation,
    bank: Bank,
    sampling: PairSampling,
    *,
    seed: int,
) -> TrainState:
    """The state before the first step; the same seed gives the same state."""

    @jax.jit
    def init(key: jax.Array) -> Variables:
        # only the shapes of a pair matter here: inside the jit nothing of it is computed
        draw_key = jax.random.fold_in(key, 1)
        pairs = bank.draw(draw_key, jnp.zeros((1,), jnp.int32), sampling)
        source = jax.tree.map(lambda leaf: leaf[0], pairs.source)
        return model.init(key, source, pairs.target, RigidTransform.identity(), 1)

    return first_state(optimizer, init(jax.random.key(seed)))


def first_state(optimizer: optax.GradientTransformation, variables: Variables) -> TrainState:
    """The state of a training that begins with these weights."""
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        variables=variables,
        average=jax.tree.map(jnp.copy, variables),
        opt_state=optimizer.init(variables),
    )


def views_of_step(key: jax.Array, step: jax.Array, *, batch_size: int, num_views: int) -> jax.Array:
    """View indices [batch_size] i32: each epoch visits every view once, in its own random order."""

    def view(position: jax.Array) -> jax.Array:
        epoch, place = jnp.divmod(position, num_views)
        return jax.random.permutation(jax.random.fold_in(key, epoch), num_views)[place]

    return jax.vmap(view)(step * batch_size + jnp.arange(batch_size))


def make_train_step(
    model: nn.Module,
    optimizer: optax.GradientTransformation,
    loss: Loss,
    sampling: PairSampling,
    *,
    batch_size: int,
    seed: int,
    average_decay: float,
    quick_compilation: bool = False,
) -> Callable[[TrainState, Bank], tuple[TrainState, Metrics]]:
    """The jitted step; it donates the state and draws its own batch from the bank.

    The moving average forgets its start: its decay grows as (1 + step) / (10 + step).
    ``quick_compilation`` is for CPUs: a quarter less time to compile, 5 % more for each step.
    """

    def step(state: TrainState, bank: Bank) -> tuple[TrainState, Metrics]:
        order_key, draw_key = jax.random.split(jax.random.key(seed))
        views = views_of_step(order_key, state.step, batch_size=batch_size, num_views=bank.size)
        pairs = bank.draw(jax.random.fold_in(draw_key, state.step), views, sampling)
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
        metrics |= {"loss": value, "gradient_norm": norm}
        return TrainState(state.step + 1, variables, average, opt_state), metrics

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
