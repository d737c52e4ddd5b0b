"""What a comparison of methods is: one part and its scans, and settings for every method.

Every field can be overridden on the command line: ``--config.icp.max_distance=0.1``.
"""

from __future__ import annotations

import copy
from dataclasses import field

from experiments.runner.experiment import Experiment, TrainingSettings
from vanejax.errors import InputError
from vanejax.settings import Settings, settings_class

CLASSICAL = ("icp", "sac_ia", "sac_ia_icp", "fgr")
NETWORKS = ("dcp", "pointnetlk", "pcrnet", "rpmnet")
OPEN3D = ("open3d_icp", "open3d_ransac_icp", "open3d_fgr")
METHODS = CLASSICAL + NETWORKS + OPEN3D


@settings_class
class IcpSettings(Settings):
    """ICP's, ours and Open3D's; see `vanejax.matching.baselines.icp.icp`. Unit-sphere units."""

    metric: str = "point_to_plane"
    max_iterations: int = 50
    max_distance: float = 0.3
    kernel: str = "none"
    kernel_width: float = 0.05
    trim: float = 1.0


@settings_class
class Open3dRansacSettings(Settings):
    """Open3D's RANSAC on FPFH; see `open3d_methods.ransac`. Unit-sphere units."""

    feature_radius: float = 0.3
    max_distance: float = 0.1
    num_hypotheses: int = 100_000


@settings_class
class SacIaSettings(Open3dRansacSettings):
    """SAC-IA's; see `vanejax.matching.baselines.sac_ia.sac_ia`. Lengths in unit-sphere units."""

    num_candidates: int = 3


@settings_class
class Open3dFgrSettings(Settings):
    """Open3D's FGR; see `open3d_methods.fgr`. Lengths in unit-sphere units."""

    feature_radius: float = 0.3
    max_distance: float = 0.05
    tuple_similarity: float = 0.95
    num_tuples: int = 1000


@settings_class
class FgrSettings(Open3dFgrSettings):
    """FGR's; see `vanejax.matching.baselines.fgr.fgr`. Lengths in unit-sphere units."""

    tuple_similarity: float = 0.9
    num_candidates: int = 10


@settings_class
class TrainingOfNetworks(Settings):
    """How each network is trained."""

    dcp: TrainingSettings = field(default_factory=TrainingSettings)
    pointnetlk: TrainingSettings = field(default_factory=TrainingSettings)
    pcrnet: TrainingSettings = field(default_factory=TrainingSettings)
    rpmnet: TrainingSettings = field(default_factory=TrainingSettings)


@settings_class
class Comparison(Settings):
    """A comparison; a config file's ``get_config()`` returns it.

    Attributes:
      name: of the comparison: the default work folder is ``runs/NAME``.
      methods: what is compared, of `METHODS`, in this order.
      experiment: part, views, pairs and seed for all methods, and the networks' own settings; its
        ``training`` and ``model.name`` are set for each network.
      training: of each network.
      icp, sac_ia, fgr: of ours; ``fine_icp`` follows SAC-IA.
      open3d_icp, open3d_ransac, open3d_fgr: of Open3D's, tuned for themselves;
        ``open3d_fine_icp`` follows RANSAC.
    """

    name: str = "table1"
    methods: tuple[str, ...] = METHODS
    experiment: Experiment = field(default_factory=Experiment)
    training: TrainingOfNetworks = field(default_factory=TrainingOfNetworks)
    icp: IcpSettings = field(default_factory=IcpSettings)
    fine_icp: IcpSettings = field(default_factory=IcpSettings)
    sac_ia: SacIaSettings = field(default_factory=SacIaSettings)
    fgr: FgrSettings = field(default_factory=FgrSettings)
    open3d_icp: IcpSettings = field(default_factory=IcpSettings)
    open3d_fine_icp: IcpSettings = field(default_factory=IcpSettings)
    open3d_ransac: Open3dRansacSettings = field(default_factory=Open3dRansacSettings)
    open3d_fgr: Open3dFgrSettings = field(default_factory=Open3dFgrSettings)

    def experiment_of(self, network: str) -> Experiment:
        """The experiment that trains this network for the comparison."""
        experiment = copy.deepcopy(self.experiment)
        experiment.name = f"{self.name}-{network}"
        experiment.model.name = network
        experiment.training = copy.deepcopy(getattr(self.training, network))
        return experiment

    def check(self, path: str = "config") -> None:
        """Refuses settings that cannot be run.

        Raises:
          InputError: names the field, its value and what it must be.
        """
        unknown = [name for name in self.methods if name not in METHODS]
        if unknown or not self.methods:
            raise InputError(
                f"methods {', '.join(unknown) or 'are none'}: take {', '.join(METHODS)}"
            )
        if len(set(self.methods)) < len(self.methods):
            raise InputError(f"methods {', '.join(self.methods)}: one is named twice")
        for network in NETWORKS:
            self.experiment_of(network).check()
