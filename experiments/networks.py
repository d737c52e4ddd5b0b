"""The networks that can be trained, by name: model, loss, and the method that they become."""

# No ``from __future__ import annotations`` here: the command line reads the fields' types.
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax

from vanejax.models.rpmnet import RpmNet, rpmnet
from vanejax.registration import Register, Registration
from vanejax.rpmnet_loss import RpmNetLoss
from vanejax.training import Loss, Variables


@dataclasses.dataclass(frozen=True)
class Network:
    """A network to train and to register with.

    Attributes:
      title: as tables call it.
      model: without parameters.
      loss: of its training.
      factory: ``factory(model, variables, iterations=n)`` is a `Register`.
      iterations: of the network at inference.
    """

    title: str
    model: nn.Module
    loss: Loss
    factory: Callable[..., Register]
    iterations: int

    def register(self, variables: Variables) -> Register:
        """The trained network as a method, jitted once whatever the weights are."""
        return functools.partial(_run, self.factory, self.model, self.iterations, variables)


# variables are an argument: as constants of the program they would be folded at compile time
@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _run(
    factory: Callable[..., Register],
    model: nn.Module,
    iterations: int,
    variables: Variables,
    *pair_and_key: Any,
) -> Registration:
    return factory(model, variables, iterations=iterations)(*pair_and_key)


@dataclasses.dataclass
class ModelSettings:
    """Which network, and RPM-Net's own settings; the others have a group of their own.

    Attributes:
      name: rpmnet, dcp, pointnetlk or pcrnet.
      num_neighbors: the paper's k.
      radius: of a neighbourhood, unit-sphere units.
      sinkhorn_iterations: rounds of normalisation.
      feature_width: channels of a feature.
      test_iterations: of the network at inference.
    """

    name: str = "rpmnet"
    num_neighbors: int = 32
    radius: float = 0.3
    sinkhorn_iterations: int = 5
    feature_width: int = 96
    test_iterations: int = 5


@dataclasses.dataclass
class LossSettings:
    """Factors of the parts of RPM-Net's loss; see `vanejax.rpmnet_loss.RpmNetLoss`."""

    iterations: int = 2
    discount: float = 0.5
    pose: float = 1.0
    inlier: float = 0.01
    matching: float = 0.0
    matching_sigma: float = 0.04
    partner: float = 0.0
    pairs_at_once: int = 1


def rpmnet_network(model: ModelSettings, loss: LossSettings) -> Network:
    """RPM-Net as configured."""
    return Network(
        title="RPM-Net",
        model=RpmNet(
            num_neighbors=model.num_neighbors,
            radius=model.radius,
            sinkhorn_iterations=model.sinkhorn_iterations,
            feature_width=model.feature_width,
        ),
        loss=RpmNetLoss(**dataclasses.asdict(loss)),
        factory=rpmnet,
        iterations=model.test_iterations,
    )
