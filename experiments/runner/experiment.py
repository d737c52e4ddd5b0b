"""What an experiment is: a tree of the library's own settings, and how it becomes its objects.

Every field can be overridden on the command line: ``--config.model.num_neighbors=16``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field

from vanejax.cad import Part, guide_vane, load_part
from vanejax.errors import InputError
from vanejax.scanner import Camera, Viewpoints, hemisphere_viewpoints
from vanejax.settings import (
    Settings,
    bounded,
    field_paths,
    hint,
    not_negative,
    positive,
    settings_class,
)
from vanejax.training import (
    OptimizerSettings,
    PairSampling,
    RpmNetLoss,
    ScanSet,
    TrainState,
    init_state,
    make_optimizer,
    make_train_step,
)
from vanejax.training.networks import (
    DcpNetwork,
    Network,
    PcrNetNetwork,
    PointNetLKNetwork,
    RpmNetNetwork,
)
from vanejax.training.online_scans import OnlineScans
from vanejax.training.train_step import Bank, Metrics

# by the name of a network: the groups of settings that it uses
NETWORKS = {
    "rpmnet": ("model", "loss"),
    "dcp": ("dcp",),
    "pointnetlk": ("pointnetlk",),
    "pcrnet": ("pcrnet",),
}


@settings_class
class PartSettings(Settings):
    """The workpiece.

    Attributes:
      path: a CAD file; empty for the parametric guide vane.
      units: of the file: mm, cm, m, in.
    """

    path: str = ""
    units: str = "mm"


@settings_class
class ViewSettings(Settings):
    """The camera and where it stands (paper, Table 2 and Algorithm 1).

    Attributes:
      distance_mm: from the part's centre.
      formula: "sphere", or "printed" for the paper's literal formula.
      elevations_deg, azimuths_deg: angles of the viewpoints, every pair of them.
      resolution: share of the camera's 1280 x 1024 pixels per side; below 1 only for quick runs.
    """

    distance_mm: float = positive(400.0)
    formula: str = "sphere"
    elevations_deg: tuple[float, ...] = (60.0, 65.0, 70.0, 75.0, 80.0, 85.0)
    azimuths_deg: tuple[float, ...] = tuple(float(angle) for angle in range(0, 360, 10))
    resolution: float = positive(1.0)


@settings_class
class DataSettings(PairSampling):
    """What pairs are drawn from; how, is the rest: see `PairSampling`.

    Attributes:
      voxel_mm: thinning of scans and CAD surface before points are drawn.
      shapes: what the network is trained on: empty for the scans of the part; else generic shapes,
        see `vanejax.training.shape_sets.load_shapes`. Tests are the part's scans either way.
    """

    voxel_mm: float = positive(1.5)
    shapes: str = ""


@settings_class
class ModelSettings(RpmNetNetwork):
    """Which network, and RPM-Net's own settings; the others have a group of their own.

    Attributes:
      name: rpmnet, dcp, pointnetlk or pcrnet.
    """

    name: str = "rpmnet"


@settings_class
class TrainingSettings(OptimizerSettings):
    """The optimizer, the batches and the length of the run.

    Attributes:
      batch_size: views per step; they share one reference.
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

    batch_size: int = positive(4)
    average_decay: float = bounded(0.995, lambda decay: 0 <= decay < 1, "lie in [0, 1)")
    log_every: int = positive(10)
    evaluate_every: int = positive(250)
    save_every: int = positive(250)
    keep: int = positive(2)
    quick_compilation: bool = True
    budget_minutes: float = not_negative(0.0)
    validation_pairs: int = positive(18)


@settings_class
class Experiment(Settings):
    """One experiment; a config file's ``get_config()`` returns it.

    Attributes:
      name: of the run: the default work folder is ``runs/NAME``.
      seed: of everything random.
      online: new scans for every step, in place of the fixed ones.
      model, loss: which network is trained, and RPM-Net's settings.
      dcp, pointnetlk, pcrnet: settings of the networks of these names, loss and all.
    """

    name: str = "vane"
    seed: int = 0
    part: PartSettings = field(default_factory=PartSettings)
    views: ViewSettings = field(default_factory=ViewSettings)
    data: DataSettings = field(default_factory=DataSettings)
    online: OnlineScans = field(default_factory=OnlineScans)
    model: ModelSettings = field(default_factory=ModelSettings)
    loss: RpmNetLoss = field(default_factory=RpmNetLoss)
    dcp: DcpNetwork = field(default_factory=DcpNetwork)
    pointnetlk: PointNetLKNetwork = field(default_factory=PointNetLKNetwork)
    pcrnet: PcrNetNetwork = field(default_factory=PcrNetNetwork)
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
        """How pairs are drawn from these scans."""
        return self.data.fitted(scans)

    def make_network(self) -> Network:
        """The network to train, by ``model.name``.

        Raises:
          InputError: there is no network of this name.
        """
        self.groups_of_network()
        if self.model.name == "rpmnet":
            return self.model.make(self.loss)
        return getattr(self, self.model.name).make()

    def initial_state(self, bank: Bank, sampling: PairSampling) -> TrainState:
        """The network and its optimizer before the first step."""
        model, optimizer = self.make_network().model, make_optimizer(self.training)
        return init_state(model, optimizer, bank, sampling, seed=self.seed)

    def train_step(
        self, sampling: PairSampling
    ) -> Callable[[TrainState, Bank], tuple[TrainState, Metrics]]:
        """The jitted step of training: ``state, metrics = step(state, bank)``."""
        network, training = self.make_network(), self.training
        return make_train_step(
            network.model,
            make_optimizer(training),
            network.loss,
            sampling,
            batch_size=training.batch_size,
            seed=self.seed,
            average_decay=training.average_decay,
            quick_compilation=training.quick_compilation,
        )

    def groups_of_network(self) -> tuple[str, ...]:
        """The groups of settings that the network of ``model.name`` uses.

        Raises:
          InputError: there is no network of this name.
        """
        name = self.model.name
        if name not in NETWORKS:
            raise InputError(
                f"config.model.name={name!r}: there is no such network{hint(name, NETWORKS)} "
                f"(the names are {', '.join(NETWORKS)})"
            )
        return NETWORKS[name]

    def check_used(self, path: str) -> None:
        """Refuses a field, such as ``model.num_neighbors``, of a network that is not trained.

        Raises:
          InputError: names the fields that the network does use.
        """
        used = self.groups_of_network()
        others = {group for groups in NETWORKS.values() for group in groups} - set(used)
        if path != "model.name" and path.partition(".")[0] in others:
            fields = [f for group in used for f in field_paths(getattr(self, group), group)]
            raise InputError(
                f"{path}: {self.model.name} does not use it; its fields are {', '.join(fields)}"
            )

    def check(self, path: str = "config") -> None:
        """As `Settings.check`, for all networks: a setting that is not used is not wrong silently.

        Raises:
          InputError: names the field, its value and what it must be.
        """
        super().check(path)
        self.groups_of_network()
        if self.online.sensor and self.data.shapes:
            raise InputError(
                f"{path}.data.shapes={self.data.shapes!r} and {path}.online.sensor="
                f"{self.online.sensor!r}: train on one of them"
            )
