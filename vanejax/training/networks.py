"""The networks that can be trained: model, loss, and the method that the trained model becomes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax

from vanejax.matching.baselines.dcp import Dcp, DcpSettings, dcp
from vanejax.matching.baselines.pcrnet import PcrNet, PcrNetSettings, pcrnet
from vanejax.matching.baselines.pointnetlk import PointNetLK, PointNetLKSettings, pointnetlk
from vanejax.matching.contract import Register, Registration
from vanejax.matching.fast_rpmnet import rpmnet
from vanejax.matching.rpmnet import RpmNet, RpmNetSettings
from vanejax.settings import positive, settings_class, values_of
from vanejax.training.baseline_losses import DcpLoss, PcrNetLoss, PointNetLKLoss
from vanejax.training.rpmnet_loss import RpmNetLoss
from vanejax.training.train_step import Loss, Variables


@dataclasses.dataclass(frozen=True)
class Network:
    """A network to train and to register with, by the title that tables call it.

    ``factory(model, variables, iterations=n)`` is a `Register`; ``iterations`` are those at
    inference.
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


@settings_class
class RpmNetNetwork(RpmNetSettings):
    """RPM-Net; ``test_iterations``: of the network at inference."""

    test_iterations: int = positive(5)

    def make(self, loss: RpmNetLoss) -> Network:
        """With its loss, whose settings stand apart."""
        model = RpmNet(**values_of(RpmNetSettings, self))
        return Network("RPM-Net", model, loss, rpmnet, self.test_iterations)


@settings_class
class DcpNetwork(DcpSettings):
    """DCP and its loss; ``test_iterations``: of the network at inference, 1 as published."""

    test_iterations: int = positive(1)
    loss: DcpLoss = dataclasses.field(default_factory=DcpLoss)

    def make(self) -> Network:
        """Model, loss and method."""
        model = Dcp(**values_of(DcpSettings, self))
        return Network("DCP", model, self.loss, dcp, self.test_iterations)


@settings_class
class PointNetLKNetwork(PointNetLKSettings):
    """PointNetLK and its loss; ``test_iterations``: at inference, 10 as published."""

    test_iterations: int = positive(10)
    loss: PointNetLKLoss = dataclasses.field(default_factory=PointNetLKLoss)

    def make(self) -> Network:
        """Model, loss and method."""
        model = PointNetLK(**values_of(PointNetLKSettings, self))
        return Network("PointNetLK", model, self.loss, pointnetlk, self.test_iterations)


@settings_class
class PcrNetNetwork(PcrNetSettings):
    """PCRNet and its loss; ``test_iterations``: of the network at inference, 8 as published."""

    test_iterations: int = positive(8)
    loss: PcrNetLoss = dataclasses.field(default_factory=PcrNetLoss)

    def make(self) -> Network:
        """Model, loss and method."""
        model = PcrNet(**values_of(PcrNetSettings, self))
        return Network("PCRNet", model, self.loss, pcrnet, self.test_iterations)
