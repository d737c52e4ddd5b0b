"""Training on scans without end in place of the fixed 216: settings, and the stream of them."""

# No ``from __future__ import annotations`` here: the command line reads the fields' types.
import dataclasses

import numpy as np

from vanejax.cad.investment_casting import InvestmentCasting, as_cast
from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.scanner.sensor import Sensor, preset
from vanejax.scanner.virtual_scanner import Scanner
from vanejax.training.dataset import ScanSet
from vanejax.training.online_scans import RandomViews, ScanStream
from vanejax.training.pairs import PairSampling, make_bank

_CASTINGS = 0xCA57  # folded into the seed: castings are drawn from another stream than scans


@dataclasses.dataclass
class EndlessSettings:
    """New scans for every step, each from a random view by a random sensor.

    Attributes:
      sensor: whose like makes the scans, a name of `vanejax.scanner.sensor.PRESETS`; empty for the
        fixed scans.
      effects: off for an ideal camera of the same pixels, view and range in the sensor's place.
      distance_mm: (least, most) from the camera to the part's centre.
      elevation_deg: (least, most) above the part's xy plane.
      resolution: share of the sensor's pixels per side.
      casting_mm: largest allowance of the castings that are scanned; 0 for the CAD model itself.
      castings: how many different ones there are.
      workers: threads that scan ahead; they change no result.
    """

    sensor: str = ""
    effects: bool = True
    distance_mm: tuple[float, float] = (300.0, 500.0)
    elevation_deg: tuple[float, float] = (40.0, 90.0)
    resolution: float = 0.25
    casting_mm: float = 0.0
    castings: int = 16
    workers: int = 1

    def check(self) -> None:
        """Refuses settings that give no scans.

        Raises:
          InputError: names the field, its value and what it must be.
        """
        if not self.sensor:
            return
        preset(self.sensor)
        RandomViews(distance_mm=self.distance_mm, elevation_deg=self.elevation_deg)
        for name, least in (("castings", 1), ("workers", 1), ("casting_mm", 0)):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= least):
                raise InputError(f"config.endless.{name}={value!r} must be {least} or more")
        if not 0 < self.resolution <= 1:
            raise InputError(f"config.endless.resolution={self.resolution!r} must lie in (0, 1]")

    def stream(
        self, part: Part, scans: ScanSet, sampling: PairSampling, *, batch_size: int, seed: int
    ) -> ScanStream:
        """The stream, with the thinned surface and the voxels of ``scans``."""
        return ScanStream(
            part=part,
            reference=make_bank(scans, num_reference=sampling.num_reference).reference,
            sensor=self.kind().scaled(self.resolution),
            views=RandomViews(distance_mm=self.distance_mm, elevation_deg=self.elevation_deg),
            castings=[Scanner(casting) for casting in self.cast(part, seed)],
            batch_size=batch_size,
            num_reference=sampling.num_reference,
            num_source=sampling.num_source,
            voxel_mm=float(scans.source["voxel_mm"]),
            seed=seed,
        )

    def kind(self) -> Sensor:
        """The sensor, or an ideal camera in its place; at full resolution."""
        sensor = preset(self.sensor)
        return sensor if self.effects else Sensor(camera=sensor.camera)

    def cast(self, part: Part, seed: int) -> list[Part]:
        """The parts that are scanned."""
        if not self.casting_mm:
            return [part]
        return [
            as_cast(part, random_casting(rng, self.casting_mm), rng)
            for rng in (np.random.default_rng([seed, _CASTINGS, k]) for k in range(self.castings))
        ]


def random_casting(rng: np.random.Generator, most_mm: float) -> InvestmentCasting:
    """Stock of up to ``most_mm``; waves (one deviation) and a bow of up to a fifth of it."""
    return InvestmentCasting(
        allowance_mm=rng.uniform(0, most_mm),
        waviness_mm=rng.uniform(0, most_mm / 5),
        wavelength_mm=rng.uniform(20, 60),
        bow_mm=rng.uniform(0, most_mm / 5),
    )
