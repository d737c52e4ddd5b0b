"""The networks that can be trained, by name: model, loss, and the method that they become."""

# No ``from __future__ import annotations`` here: the command line reads the fields' types.
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax

from vanejax.errors import InputError
from vanejax.matching.baselines.dcp import Dcp, dcp
from vanejax.matching.baselines.pcrnet import PcrNet, pcrnet
from vanejax.matching.baselines.pointnetlk import PointNetLK, pointnetlk
from vanejax.matching.contract import Register, Registration
from vanejax.matching.fast_rpmnet import rpmnet
from vanejax.matching.rpmnet import RpmNet
from vanejax.training.dcp_loss import DcpLoss
from vanejax.training.pointnet_losses import PcrNetLoss, PointNetLKLoss
from vanejax.training.rpmnet_loss import RpmNetLoss
from vanejax.training.train_step import Loss, Variables

ORIGINS = ("means", "target")


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
    """Factors of the parts of RPM-Net's loss; see `vanejax.training.rpmnet_loss.RpmNetLoss`."""

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


@dataclasses.dataclass
class DcpSettings:
    """DCP and its loss; see `vanejax.matching.baselines.dcp.Dcp` and
    `vanejax.training.dcp_loss.DcpLoss`.

    Attributes:
      width: channels of a feature; 512 as published.
      num_neighbors: of the graph, the point itself counted.
      heads: of every attention; divides ``width``.
      hidden: channels inside a feed-forward layer; 1024 as published.
      test_iterations: of the network at inference; 1 as published.
      rotation, translation, cycle, matching, matching_sigma: of the loss.
    """

    width: int = 512
    num_neighbors: int = 20
    heads: int = 4
    hidden: int = 1024
    test_iterations: int = 1
    rotation: float = 1.0
    translation: float = 1.0
    cycle: float = 0.0
    matching: float = 0.0
    matching_sigma: float = 0.04


@dataclasses.dataclass
class PointNetLKSettings:
    """PointNetLK and its loss; see `vanejax.matching.baselines.pointnetlk` and
    `vanejax.training.pointnet_losses`.

    Attributes:
      delta: step of the Jacobian's differences.
      damping: of the normal equations.
      origin: what clouds are centred on: means (of each, as published) or target.
      test_iterations: of the network at inference; 10 as published.
      iterations: in training.
      discount, matrix, residual, pairs_at_once: of the loss.
    """

    delta: float = 0.01
    damping: float = 1e-6
    origin: str = "means"
    test_iterations: int = 10
    iterations: int = 10
    discount: float = 0.5
    matrix: float = 1.0
    residual: float = 0.0
    pairs_at_once: int = 1


@dataclasses.dataclass
class PcrNetSettings:
    """PCRNet's loss; see `vanejax.matching.baselines.pcrnet` and
    `vanejax.training.pointnet_losses.PcrNetLoss`.

    Attributes:
      test_iterations: of the network at inference; 8 as published.
      iterations: in training.
      discount, pose, chamfer, pairs_at_once: of the loss.
    """

    test_iterations: int = 8
    iterations: int = 8
    discount: float = 0.5
    pose: float = 1.0
    chamfer: float = 0.0
    pairs_at_once: int = 1


def dcp_network(settings: DcpSettings) -> Network:
    """DCP as configured.

    Raises:
      InputError: the heads do not divide the width.
    """
    if settings.width % settings.heads:
        raise InputError(
            f"config.dcp.width={settings.width} must be a multiple of "
            f"config.dcp.heads={settings.heads}"
        )
    model = ("width", "num_neighbors", "heads", "hidden")
    loss = ("rotation", "translation", "cycle", "matching", "matching_sigma")
    return Network(
        title="DCP",
        model=Dcp(**_some(settings, model)),
        loss=DcpLoss(**_some(settings, loss)),
        factory=dcp,
        iterations=settings.test_iterations,
    )


def pointnetlk_network(settings: PointNetLKSettings) -> Network:
    """PointNetLK as configured.

    Raises:
      InputError: an unknown origin.
    """
    if settings.origin not in ORIGINS:
        raise InputError(
            f"config.pointnetlk.origin={settings.origin!r} must be one of {', '.join(ORIGINS)}"
        )
    loss = ("iterations", "discount", "matrix", "residual", "pairs_at_once")
    return Network(
        title="PointNetLK",
        model=PointNetLK(**_some(settings, ("delta", "damping", "origin"))),
        loss=PointNetLKLoss(**_some(settings, loss)),
        factory=pointnetlk,
        iterations=settings.test_iterations,
    )


def pcrnet_network(settings: PcrNetSettings) -> Network:
    """PCRNet as configured."""
    loss = ("iterations", "discount", "pose", "chamfer", "pairs_at_once")
    return Network(
        title="PCRNet",
        model=PcrNet(),
        loss=PcrNetLoss(**_some(settings, loss)),
        factory=pcrnet,
        iterations=settings.test_iterations,
    )


def _some(settings: Any, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(settings, name) for name in names}
