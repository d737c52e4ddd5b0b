"""The methods of a comparison: the paper's figures for each, and ours under one contract."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from experiments.runner.trained import Trained
from experiments.studies.comparison import open3d_methods
from experiments.studies.comparison.settings import NETWORKS, OPEN3D, Comparison
from vanejax.matching.baselines.fgr import fgr
from vanejax.matching.baselines.icp import icp
from vanejax.matching.baselines.sac_ia import sac_ia
from vanejax.matching.contract import Register, chain
from vanejax.settings import Settings, values_of

TITLES = {
    "icp": "ICP",
    "sac_ia": "SAC-IA",
    "sac_ia_icp": "SAC-IA + ICP",
    "fgr": "FGR",
    "dcp": "DCP",
    "pointnetlk": "PointNetLK",
    "pcrnet": "PCRNet",
    "rpmnet": "RPM-Net",
    "open3d_icp": "Open3D ICP",
    "open3d_ransac_icp": "Open3D RANSAC-FPFH + ICP",
    "open3d_fgr": "Open3D FGR",
}

# the groups of the configuration and what they configure, by method that is not a network
GROUPS: dict[str, dict[str, Callable[..., Register]]] = {
    "icp": {"icp": icp},
    "sac_ia": {"sac_ia": sac_ia},
    "sac_ia_icp": {"sac_ia": sac_ia, "fine_icp": icp},
    "fgr": {"fgr": fgr},
    "open3d_icp": {"open3d_icp": open3d_methods.icp},
    "open3d_ransac_icp": {
        "open3d_ransac": open3d_methods.ransac,
        "open3d_fine_icp": open3d_methods.icp,
    },
    "open3d_fgr": {"open3d_fgr": open3d_methods.fgr},
}


@dataclasses.dataclass(frozen=True)
class Published:
    """A row of the paper's Table 1, measured on its own part and machine."""

    rmse_mm: float
    ffmde_mm: float
    time_s: float


TABLE_1 = {
    "icp": Published(8.8914, 3.7936, 0.0344),
    "sac_ia_icp": Published(2.2983, 1.1315, 9.7802),
    "fgr": Published(12.3026, 7.5014, 2.9570),
    "dcp": Published(11.3498, 4.9108, 8.1425),
    "pointnetlk": Published(6.2657, 2.7085, 0.8754),
    "pcrnet": Published(8.4870, 3.8836, 0.4218),
    "rpmnet": Published(0.8982, 0.4568, 3.9138),
}


def make_method(name: str, config: Comparison, network: Trained | None = None) -> Register:
    """A method of `experiments.studies.comparison.settings.METHODS`, jitted where it is ours.

    Raises:
      InputError: settings that the method refuses, or an optional package that is missing.
    """
    if name in NETWORKS:
        assert network is not None
        return network.config.make_network().register(network.variables)
    stages = [make(**_arguments(getattr(config, group))) for group, make in GROUPS[name].items()]
    method = stages[0] if len(stages) == 1 else chain(*stages)
    return method if name in OPEN3D else jax.jit(method)


def settings_of(name: str, config: Comparison) -> dict[str, Any]:
    """The settings that a method of this name runs with, for reports."""
    if name in NETWORKS:
        experiment = dataclasses.asdict(config.experiment_of(name))
        own = ("model", "loss") if name == "rpmnet" else (name,)
        return {group: experiment[group] for group in (*own, "training")}
    return {group: dataclasses.asdict(getattr(config, group)) for group in GROUPS[name]}


def _arguments(settings: Settings) -> dict[str, Any]:
    """Of a method's factory: without a kernel there is no width of it."""
    fields = values_of(type(settings), settings)
    return fields | {"kernel_width": None} if fields.get("kernel") == "none" else fields
