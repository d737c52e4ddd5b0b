"""What an experiment is: a typed tree of settings, and how it becomes objects of vanejax.

Every field can be overridden on the command line: ``--config.model.num_neighbors=16``.
"""

# No ``from __future__ import annotations`` here: the command line reads the fields' types.
import dataclasses
import difflib
from collections.abc import Callable
from dataclasses import field

import numpy as np
import optax

from experiments.runner.networks import (
    DcpSettings,
    LossSettings,
    ModelSettings,
    Network,
    PcrNetSettings,
    PointNetLKSettings,
    dcp_network,
    pcrnet_network,
    pointnetlk_network,
    rpmnet_network,
)
from experiments.runner.online import EndlessSettings
from vanejax.cad.parametric_vane import guide_vane
from vanejax.cad.part import Part, load_part
from vanejax.errors import InputError
from vanejax.scanner.camera import Camera, Viewpoints, hemisphere_viewpoints
from vanejax.training.dataset import ScanSet
from vanejax.training.pairs import PairSampling, source_sizes
from vanejax.training.train_step import make_optimizer


@dataclasses.dataclass
class PartSettings:
    """The workpiece.

    Attributes:
      path: a CAD file; empty for the parametric guide vane.
      units: of the file: mm, cm, m, in.
    """

    path: str = ""
    units: str = "mm"


@dataclasses.dataclass
class ViewSettings:
    """The camera and where it stands (paper, Table 2 and Algorithm 1).

    Attributes:
      distance_mm: from the part's centre.
      formula: "sphere", or "printed" for the paper's literal formula.
      elevations_deg, azimuths_deg: angles of the viewpoints, every pair of them.
      resolution: share of the camera's 1280 x 1024 pixels per side; below 1 only for quick runs.
    """

    distance_mm: float = 400.0
    formula: str = "sphere"
    elevations_deg: tuple[float, ...] = (60.0, 65.0, 70.0, 75.0, 80.0, 85.0)
    azimuths_deg: tuple[float, ...] = tuple(float(angle) for angle in range(0, 360, 10))
    resolution: float = 1.0


@dataclasses.dataclass
class DataSettings:
    """How pairs are drawn from the scans (paper, section III.D).

    Attributes:
      voxel_mm: thinning of scans and CAD surface before points are drawn.
      num_reference: M; sources have M X / Y points.
      noise: standard deviation on both clouds, unit-sphere units.
      noise_clip: largest noise per coordinate, unit-sphere units.
      max_rotation_deg: largest angle of the random pose.
      max_translation: largest coordinate of its translation, unit-sphere units.
      shapes: what the network is trained on: empty for the scans of the part; else generic shapes,
        see `vanejax.training.shape_sets.load_shapes`. Tests are the part's scans either way.
    """

    voxel_mm: float = 1.5
    num_reference: int = 1024
    noise: float = 0.01
    noise_clip: float = 0.05
    max_rotation_deg: float = 45.0
    max_translation: float = 0.5
    shapes: str = ""


@dataclasses.dataclass
class TrainingSettings:
    """The optimizer and the length of the run.

    Attributes:
      steps: of the optimizer.
      batch_size: views per step; they share one reference.
      learning_rate: peak of Adam's.
      warmup_steps: linear growth from 0 to the peak.
      final_fraction: of the peak, at the end of the cosine decay.
      clip_norm: largest global norm of a gradient.
      average_decay: of the moving average of the weights, which is what is evaluated; 0 for none.
      log_every, evaluate_every, save_every: in steps.
      keep: checkpoints kept besides the best.
      quick_compilation: a quarter less time to compile the step on a CPU, and each step 5 %
        slower; off is better from some hundred steps on.
      budget_minutes: training ends here at the latest, with what it has; 0 for no limit. It counts
        the time over all resumptions, and makes the result depend on the machine.
      validation_pairs: drawn from the training views with a key of their own; they choose the
        best checkpoint, so that the test views stay unseen.
    """

    steps: int = 5000
    batch_size: int = 4
    learning_rate: float = 1e-3
    warmup_steps: int = 100
    final_fraction: float = 0.0
    clip_norm: float = 1.0
    average_decay: float = 0.995
    log_every: int = 10
    evaluate_every: int = 250
    save_every: int = 250
    keep: int = 2
    quick_compilation: bool = True
    budget_minutes: float = 0.0
    validation_pairs: int = 18


@dataclasses.dataclass
class Experiment:
    """One experiment; a config file's ``get_config()`` returns it.

    Attributes:
      name: of the run: the default work folder is ``runs/NAME``.
      seed: of everything random.
      model, loss: which network is trained, and RPM-Net's settings.
      endless: new scans for every step, in place of the fixed ones.
      dcp, pointnetlk, pcrnet: settings of the networks of these names, loss and all.
    """

    name: str = "vane"
    seed: int = 0
    part: PartSettings = field(default_factory=PartSettings)
    views: ViewSettings = field(default_factory=ViewSettings)
    data: DataSettings = field(default_factory=DataSettings)
    endless: EndlessSettings = field(default_factory=EndlessSettings)
    model: ModelSettings = field(default_factory=ModelSettings)
    loss: LossSettings = field(default_factory=LossSettings)
    dcp: DcpSettings = field(default_factory=DcpSettings)
    pointnetlk: PointNetLKSettings = field(default_factory=PointNetLKSettings)
    pcrnet: PcrNetSettings = field(default_factory=PcrNetSettings)
    training: TrainingSettings = field(default_factory=TrainingSettings)

    def make_camera(self) -> Camera:
        """The paper's camera at the wanted resolution."""
        return Camera().scaled(self.views.resolution)

    def make_part(self) -> Part:
        """The CAD file, or the guide vane if none is named."""
        if not self.part.path:
            return guide_vane()
        sizes_mm = self.make_camera().part_sizes_mm
        return load_part(self.part.path, units=self.part.units, sizes_mm=sizes_mm)

    def make_viewpoints(self, part: Part) -> Viewpoints:
        """Algorithm 1 around the part's centre."""
        return hemisphere_viewpoints(
            part.center,
            distance_mm=self.views.distance_mm,
            elevations_deg=self.views.elevations_deg,
            azimuths_deg=self.views.azimuths_deg,
            formula=self.views.formula,
        )

    def pair_sampling(self, scans: ScanSet) -> PairSampling:
        """How pairs are drawn; the rows of a source fit the view that sees most."""
        return PairSampling(
            num_reference=self.data.num_reference,
            num_source=int(source_sizes(scans, self.data.num_reference).max()),
            noise=self.data.noise,
            noise_clip=self.data.noise_clip,
            max_rotation_deg=self.data.max_rotation_deg,
            max_translation=self.data.max_translation,
        )

    def make_network(self) -> Network:
        """The network to train, by ``model.name``.

        Raises:
          InputError: there is no network of this name, or its settings cannot be.
        """
        makers = self._makers()
        if self.model.name not in makers:
            near = difflib.get_close_matches(self.model.name, makers, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise InputError(
                f"config.model.name={self.model.name!r}: there is no such network{hint} "
                f"(the names are {', '.join(makers)})"
            )
        return makers[self.model.name]()

    def _makers(self) -> dict[str, Callable[[], Network]]:
        return {
            "rpmnet": lambda: rpmnet_network(self.model, self.loss),
            "dcp": lambda: dcp_network(self.dcp),
            "pointnetlk": lambda: pointnetlk_network(self.pointnetlk),
            "pcrnet": lambda: pcrnet_network(self.pcrnet),
        }

    def make_optimizer(self) -> optax.GradientTransformation:
        """Adam with its schedule."""
        settings = self.training
        return make_optimizer(
            learning_rate=settings.learning_rate,
            steps=settings.steps,
            warmup_steps=settings.warmup_steps,
            clip_norm=settings.clip_norm,
            final_fraction=settings.final_fraction,
        )

    def check(self) -> None:
        """Refuses settings that cannot be run.

        Raises:
          InputError: names the field, its value and what it must be.
        """
        positive = {
            "training": ("steps", "batch_size", "learning_rate", "clip_norm", "log_every"),
            "data": ("voxel_mm", "num_reference", "noise_clip"),
            "model": ("num_neighbors", "radius", "sinkhorn_iterations", "test_iterations"),
            "loss": ("iterations", "matching_sigma", "pairs_at_once"),
            "dcp": (
                "width",
                "num_neighbors",
                "heads",
                "hidden",
                "test_iterations",
                "matching_sigma",
            ),
            "pointnetlk": ("delta", "test_iterations", "iterations", "pairs_at_once"),
            "pcrnet": ("test_iterations", "iterations", "pairs_at_once"),
            "views": ("distance_mm", "resolution"),
        }
        positive["training"] += ("evaluate_every", "save_every", "keep", "validation_pairs")
        not_negative = {
            "data": ("noise", "max_rotation_deg", "max_translation"),
            "loss": ("discount", "pose", "inlier", "matching", "partner"),
            "dcp": ("rotation", "translation", "cycle", "matching"),
            "pointnetlk": ("damping", "discount", "matrix", "residual"),
            "pcrnet": ("discount", "pose", "chamfer"),
            "training": ("warmup_steps", "final_fraction", "budget_minutes"),
        }
        for groups, least, words in ((positive, False, "positive"), (not_negative, True, ">= 0")):
            for group, names in groups.items():
                for name in names:
                    value = getattr(getattr(self, group), name)
                    if not (np.isfinite(value) and (value >= 0 if least else value > 0)):
                        raise InputError(f"config.{group}.{name}={value!r} must be {words}")
        self.endless.check()
        if self.endless.sensor and self.data.shapes:
            raise InputError(
                f"config.data.shapes={self.data.shapes!r} and config.endless.sensor="
                f"{self.endless.sensor!r}: train on one of them"
            )
        self.make_network()
        for make in self._makers().values():
            make()  # a setting that is not used is not wrong silently
        if self.model.feature_width % 8:
            raise InputError(
                f"config.model.feature_width={self.model.feature_width} must be a multiple of 8, "
                "the number of groups of the normalisation"
            )
        if not 0 <= self.training.average_decay < 1:
            raise InputError(
                f"config.training.average_decay={self.training.average_decay} must lie in [0, 1)"
            )
        factors = {
            "loss": ("pose", "matching", "partner"),
            "dcp": ("rotation", "translation", "matching"),
            "pointnetlk": ("matrix", "residual"),
            "pcrnet": ("pose", "chamfer"),
        }
        for group, names in factors.items():
            if not any(getattr(getattr(self, group), name) for name in names):
                raise InputError(f"config.{group}: {', '.join(names)} are all 0: nothing to learn")
