"""What disturbs a scan, one thing at a time: distance, angle, light, clutter, casting, noise."""

from __future__ import annotations

import bisect
import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from vanejax.cad.investment_casting import InvestmentCasting, as_cast
from vanejax.cad.part import Part
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import hemisphere_viewpoints
from vanejax.scanner.clutter import Clutter, clutter_scene
from vanejax.scanner.measurement import Measurement, Reason, measure
from vanejax.scanner.sensor import Sensor, preset
from vanejax.scanner.virtual_scanner import Scanner
from vanejax.scans.segmentation import segment
from vanejax.training.online_scans import RandomViews

SENSOR = "paper_camera"
DISTANCE_MM = 400.0
ELEVATION_DEG = 75.0
BISECTIONS = 14
# the paper's mean RMSE and FFMDE over a series (Fig. 11)
PAPER = {
    "distance": {"rmse_mm": 0.7951, "ffmde_abs_mm": 0.3620},
    "angle": {"rmse_mm": 0.7904, "ffmde_abs_mm": 0.3620},
}
MOST_STOPS = 8.0  # how far exposure is turned up or down to make holes, powers of two


@dataclasses.dataclass(frozen=True, eq=False)
class Disturbed:
    """A scan to register.

    Attributes:
      points: [N, 3] f64, mm, camera frame: what is taken for the part.
      part_from_camera: the truth.
      measured: what the sensor measured, all of it.
      clutter_share: of ``points``, those that are not of the part.
    """

    points: np.ndarray
    part_from_camera: RigidTransform
    measured: Measurement
    clutter_share: float


@dataclasses.dataclass(frozen=True, eq=False)
class Series:
    """One kind of disturbance at growing strength.

    Attributes:
      name: for files, and ``title`` for readers.
      values: strengths, in ``unit``, with ``views`` scans at each.
      take: ``take(value, number)`` makes one of them; same arguments, same bits.
      max_allowance_mm: of the fine registration: how much stock it may find; 0 for none.
      paper: the paper's mean RMSE and FFMDE over this series, mm, where it has one (Fig. 11).
    """

    name: str
    title: str
    unit: str
    values: Sequence[float]
    take: Callable[[float, int], Disturbed]
    views: int
    max_allowance_mm: float = 0.0
    paper: dict[str, float] | None = None


class Stand:
    """A part that stands still before cameras of the kind `SENSOR`, another one for each scan."""

    def __init__(self, part: Part, seed: int) -> None:
        self.part, self.sensor, self.seed = part, preset(SENSOR), seed
        self.scanner = Scanner(part)

    def series(self, views: int) -> list[Series]:
        """All kinds of disturbance, with so many scans at each strength."""
        stock_mm = (0.0, 0.25, 0.5, 0.75, 1.0)
        distances_mm = (300.0, 350.0, 400.0, 450.0, 500.0, 600.0, 800.0, 1000.0)
        angles_deg = tuple(float(angle) for angle in range(0, 360, 10))
        saturated = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
        chips, clamps = (0.0, 10.0, 20.0, 40.0, 80.0), (0.0, 1.0, 2.0, 3.0, 4.0)
        noise_px = (0.0, 0.02, 0.05, 0.1, 0.2)
        light, noise = "% of the pixels saturated", "px of disparity"
        table = (
            ("distance", "Distance", "mm", distances_mm, self._at_distance),
            ("angle", "Angle", "deg", angles_deg, self._at_angle),
            ("light", "Strong light", light, saturated, self._in_light),
            ("chips", "Chips and drops", "of each on the part", chips, self._among_chips),
            ("fixture", "Table and clamps", "clamps", clamps, self._in_fixture),
            ("casting", "Casting allowance", "mm", stock_mm, self._as_cast),
            ("stock", "The same, stock estimated", "mm", stock_mm, self._as_cast),
            ("noise", "Correlated noise", noise, noise_px, self._with_noise),
        )
        return [
            Series(
                *row,
                views=1 if row[0] == "angle" else views,
                max_allowance_mm=1.0 if row[0] == "stock" else 0.0,
                paper=PAPER.get(row[0]),
            )
            for row in table
        ]

    def _at_distance(self, distance_mm: float, number: int) -> Disturbed:
        rng = self._rng(0, number)
        return self.scan(rng, self._pose(rng, distance_mm=distance_mm), distance_mm=distance_mm)

    def _at_angle(self, azimuth_deg: float, number: int) -> Disturbed:
        views = hemisphere_viewpoints(
            self.part.center,
            distance_mm=DISTANCE_MM,
            elevations_deg=(ELEVATION_DEG,),
            azimuths_deg=(azimuth_deg,),
        )
        return self.scan(self._rng(1, number, round(azimuth_deg)), views.view(0))

    def _in_light(self, percent: float, number: int) -> Disturbed:
        rng = self._rng(2, number)
        pose, sensor = self._pose(rng), self.sensor.sample(rng)
        bright = saturating(self.scanner, sensor, pose, percent / 100, seed=self.seed)
        return self.scan(rng, pose, sensor=bright)

    def _among_chips(self, count: float, number: int) -> Disturbed:
        return self._cluttered(self._rng(3, number), Clutter(chips=int(count), drops=int(count)))

    def _in_fixture(self, count: float, number: int) -> Disturbed:
        rng = self._rng(4, number)
        return self._cluttered(rng, Clutter(table=True, tilt_deg=3.0, clamps=int(count)))

    def _as_cast(self, allowance_mm: float, number: int) -> Disturbed:
        rng = self._rng(5, number)
        pose = self._pose(rng)
        casting = InvestmentCasting(
            allowance_mm=allowance_mm / 2, waviness_mm=allowance_mm / 6, wavelength_mm=30.0
        )
        return self.scan(rng, pose, scanner=Scanner(as_cast(self.part, casting, rng)))

    def _with_noise(self, pixels: float, number: int) -> Disturbed:
        rng = self._rng(6, number)
        pose, sensor = self._pose(rng), self.sensor.sample(rng)
        noisy = dataclasses.replace(sensor, correlated_px=pixels, correlation_px=40.0)
        return self.scan(rng, pose, sensor=noisy)

    def _rng(self, *numbers: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *numbers])

    def _pose(
        self, rng: np.random.Generator, *, distance_mm: float = DISTANCE_MM
    ) -> RigidTransform:
        """A random one of the paper's heights, turned as it happens."""
        views = RandomViews(
            distance_mm=(distance_mm, distance_mm), elevation_deg=(60.0, 85.0), aside=0.02
        )
        return views.draw(rng, self.part.center)

    def _cluttered(self, rng: np.random.Generator, clutter: Clutter) -> Disturbed:
        pose = self._pose(rng)
        scene = clutter_scene(self.part, clutter, rng)
        measured = measure(scene.scanner(), self.sensor.sample(rng), pose, rng)
        points = measured.points.astype(np.float64)
        part = segment(points, self.part, sensor_origin=np.zeros(3)).part
        clutter = scene.owner(measured.face)[part] > 0
        return Disturbed(points[part], pose.inverse(), measured, float(clutter.mean()))

    def scan(
        self,
        rng: np.random.Generator,
        pose: RigidTransform,
        *,
        sensor: Sensor | None = None,
        scanner: Scanner | None = None,
        distance_mm: float = DISTANCE_MM,
    ) -> Disturbed:
        """Without a ``sensor`` by another camera of the kind, exposed for the distance."""
        sensor = sensor or self.sensor.sample(rng).exposed_for(distance_mm)
        measured = measure(scanner or self.scanner, sensor, pose, rng)
        return Disturbed(measured.points.astype(np.float64), pose.inverse(), measured, 0.0)


def saturating(
    scanner: Scanner, sensor: Sensor, pose: RigidTransform, share: float, *, seed: int
) -> Sensor:
    """The sensor with the exposure time at which that share of its pixels saturates.

    This is how the paper makes holes (section III.E): exposure alone. 0 leaves it as it is. Found
    at a quarter of the pixels per side.
    """
    if share <= 0:
        return sensor

    def exposed(stops: float) -> Sensor:
        exposure = dataclasses.replace(
            sensor.exposure, exposure_ms=sensor.exposure.exposure_ms * 2.0**stops
        )
        return dataclasses.replace(sensor, exposure=exposure)

    def saturated(stops: float) -> float:
        small = exposed(stops).scaled(0.25)
        reason = measure(scanner, small, pose, np.random.default_rng(seed)).reason
        return float(np.mean(reason == Reason.SATURATED))

    stops = np.linspace(-MOST_STOPS, MOST_STOPS, 2**BISECTIONS + 1).tolist()
    return exposed(stops[bisect.bisect_left(stops, share, 1, len(stops) - 1, key=saturated)])
