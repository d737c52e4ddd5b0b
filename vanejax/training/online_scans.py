"""Online scans: every training step gets new ones, from anywhere, by another camera.

Scan number n is made from ``default_rng([seed, n])`` alone: viewpoint, distance, roll, sensor and
casting. Step s takes the scans ``B s`` to ``B s + B - 1``, so that a run can begin at any step and
see what an unbroken one sees. Worker threads scan ahead of the training.
"""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

import jax.numpy as jnp
import numpy as np

from vanejax.cad import InvestmentCasting, Part, as_cast, dimensional_tolerance_mm
from vanejax.errors import InputError
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.scanner import Scanner, Sensor, look_at, measure, preset
from vanejax.scans.normals import estimate_normals
from vanejax.scans.voxels import voxel_thin
from vanejax.settings import Settings, bounded, not_negative, positive, settings_class, share
from vanejax.training.dataset import ScanSet, padded
from vanejax.training.pairs import PairSampling, ScanBank, make_bank

# more than a log interval: the loop runs ahead of the device between two looks at its metrics
STEPS_AHEAD = 16
LEAST_POINTS = 32
ATTEMPTS = 20
# of the castings: waves as a share of the largest stock, their correlation length, the size, and
# the grade of ISO 8062-3 that the bow keeps
WAVINESS, CORRELATION_MM, SCALE_ERROR, GRADE = 0.2, (20.0, 60.0), 0.01, 6
LARGEST_MM = 630.0  # in the table of the grades; larger parts are bent as this one
_CASTINGS = 0xCA57  # folded into the seed: castings are drawn from another stream than scans
_AHEAD_OF_VALIDATION = 1 << 40  # scan numbers that no training reaches


@settings_class
class RandomViews(Settings):
    """From where a part is seen: uniform in each of these.

    Attributes:
      distance_mm: (least, most) from the camera to the part's centre.
      elevation_deg: (least, most) above the part's xy plane; directions are uniform on that zone
        of the sphere.
      roll_deg: the camera turns about its axis by up to this, either way; the projector with it.
      aside: the part's centre is off the optical axis by up to this share of the distance, in x and
        in y.
    """

    distance_mm: tuple[float, float] = bounded(
        (300.0, 500.0), lambda ends: 0 < ends[0] <= ends[1] < np.inf, "be (least, most), in mm"
    )
    elevation_deg: tuple[float, float] = bounded(
        (40.0, 90.0),
        lambda ends: -90 <= ends[0] <= ends[1] <= 90,
        "be (least, most) within -90 and 90",
    )
    roll_deg: float = not_negative(180.0)
    aside: float = not_negative(0.04)

    def draw(self, rng: np.random.Generator, center: np.ndarray) -> RigidTransform:
        """camera_from_part, [3, 3] and [3] mm, of a part with this ``center`` [3] mm."""
        low, high = np.sin(np.radians(self.elevation_deg))
        height, azimuth = rng.uniform(low, high), rng.uniform(0, 2 * np.pi)
        flat = np.sqrt(1 - height**2)
        outward = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), height])
        distance = rng.uniform(*self.distance_mm)
        roll = np.radians(rng.uniform(-self.roll_deg, self.roll_deg))
        sideways = np.append(rng.uniform(-self.aside, self.aside, 2) * distance, 0.0)
        turn = np.eye(3)
        turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
        return RigidTransform(turn, sideways) @ look_at(center + distance * outward, center)


@settings_class
class OnlineScans(RandomViews):
    """New scans for every step, each from a random view by a random sensor.

    Attributes:
      sensor: each scan is by a sensor of this kind, a name of `vanejax.scanner.sensor.PRESETS`;
        empty for the fixed scans.
      effects: off for an ideal camera of the same pixels, view and range in the sensor's place.
      resolution: share of the sensor's pixels per side.
      casting_mm: largest stock of the castings that are scanned, which are warped and shrunk as
        `make_parts` says; 0 for the CAD model itself. The reference and the true pose are those of
        the CAD model.
      castings: how many different ones there are.
      workers: threads that scan ahead; they change no result.
    """

    sensor: str = ""
    effects: bool = True
    resolution: float = share(0.25)
    casting_mm: float = not_negative(0.0)
    castings: int = positive(16)
    workers: int = positive(1)

    def check(self, path: str = "") -> None:
        """As `Settings.check`; the sensor is one of the presets."""
        super().check(path)
        if self.sensor:
            preset(self.sensor)

    def make_parts(self, part: Part, seed: int) -> list[Part]:
        """The parts that are scanned: the CAD model, or castings of it.

        Each of their deviations is drawn uniformly: stock of up to ``casting_mm``; waves (one
        standard deviation) of up to a fifth of it, correlated over 20 to 60 mm; a size within 1 %
        of the CAD model's; a bow of up to half the tolerance of the longest side (DCTG 6).
        """
        parts, most_mm = [], self.casting_mm
        longest_mm = min(float(part.extent_mm.max()), LARGEST_MM)
        most_bow_mm = dimensional_tolerance_mm(longest_mm, GRADE) / 2
        for number in range(self.castings if most_mm else 0):
            rng = np.random.default_rng([seed, _CASTINGS, number])
            casting = InvestmentCasting(
                allowance_mm=rng.uniform(0, most_mm),
                waviness_mm=rng.uniform(0, WAVINESS * most_mm),
                wavelength_mm=rng.uniform(*CORRELATION_MM),
                bow_mm=rng.uniform(0, most_bow_mm),
                scale_error=rng.uniform(-SCALE_ERROR, SCALE_ERROR),
            )
            parts.append(as_cast(part, casting, rng))
        return parts or [part]

    def stream(
        self, part: Part, scans: ScanSet, sampling: PairSampling, *, batch_size: int, seed: int
    ) -> ScanStream:
        """The stream of scans, with the thinned surface and the voxels of ``scans``."""
        sensor = preset(self.sensor)
        if not self.effects:
            sensor = Sensor(camera=sensor.camera)
        return ScanStream(
            part=part,
            reference=make_bank(scans, num_reference=sampling.num_reference).reference,
            sensor=sensor.scaled(self.resolution),
            views=self,
            castings=[Scanner(casting) for casting in self.make_parts(part, seed)],
            batch_size=batch_size,
            sampling=sampling,
            voxel_mm=float(scans.source["voxel_mm"]),
            seed=seed,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class ScanStream:
    """Random scans of a part as training takes them, B = ``batch_size`` in a step.

    Attributes:
      part: the CAD model: frame, centre and radius.
      reference: [Y] its thinned surface on the device, unit-sphere units.
      sensor: each scan is by `Sensor.sample` one of this kind.
      views: from where.
      castings: scanners of the parts that are scanned: the CAD model's own, or of castings of it.
      sampling: a scan has M X / Y points, at most N, its ``num_reference`` and ``num_source``.
      voxel_mm: thinning, as that of the reference.
    """

    part: Part
    reference: PointCloud
    sensor: Sensor
    views: RandomViews
    castings: Sequence[Scanner]
    batch_size: int
    sampling: PairSampling
    voxel_mm: float
    seed: int

    def scan(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Points and normals [n, 3] f32 of one scan, part frame, unit-sphere units; n <= N.

        Normals are estimated from the measured points, as those of a real scan are.

        Raises:
          InputError: `ATTEMPTS` random views in a row see next to nothing of the part.
        """
        rng = np.random.default_rng([self.seed, number])
        scanner = self.castings[int(rng.integers(len(self.castings)))]
        for _ in range(ATTEMPTS):
            camera_from_part = self.views.draw(rng, self.part.center)
            distance = float(np.linalg.norm(camera_from_part.apply(self.part.center[None])))
            sensor = self.sensor.sample(rng).exposed_for(distance)
            try:
                points = measure(scanner, sensor, camera_from_part, rng).points
            except InputError:  # the part is outside the image
                continue
            thinned = voxel_thin(points, voxel_mm=self.voxel_mm)
            whole = self.reference.mask.shape[0]
            wanted = round(self.sampling.num_reference * len(thinned) / whole)
            wanted = min(wanted, self.sampling.num_source, len(thinned))
            if wanted >= LEAST_POINTS:
                break
        else:
            raise InputError(
                f"{ATTEMPTS} random views in a row measured next to nothing of {self.part.name}; "
                "see the distances and the sensor's light"
            )
        chosen = np.sort(rng.choice(thinned, wanted, replace=False))
        normals = estimate_normals(points, sensor_origin=np.zeros(3), at=chosen)
        part_from_camera = camera_from_part.inverse()
        xyz = part_from_camera.apply(points[chosen].astype(np.float64)) - self.part.center
        xyz /= self.part.radius
        return xyz.astype(np.float32), part_from_camera.rotate(normals).astype(np.float32)

    def bank(self, numbers: Sequence[int]) -> ScanBank:
        """The scans of these numbers, [B, N], on the device."""
        rows = self.sampling.num_source
        xyz, normals, sizes = padded([self.scan(number) for number in numbers], rows)
        mask = np.arange(rows)[None, :] < sizes[:, None]
        scans = PointCloud(jnp.asarray(xyz), jnp.asarray(normals), jnp.asarray(mask))
        return ScanBank(scans=scans, source_sizes=jnp.asarray(sizes), reference=self.reference)

    def of_step(self, step: int) -> ScanBank:
        """What step ``step`` trains on."""
        return self.bank(range(step * self.batch_size, (step + 1) * self.batch_size))

    def for_validation(self, count: int) -> ScanBank:
        """``count`` scans that no step trains on."""
        return self.bank(range(_AHEAD_OF_VALIDATION, _AHEAD_OF_VALIDATION + count))

    @contextmanager
    def steps(self, first: int, end: int, *, workers: int = 1) -> Iterator[Iterator[ScanBank]]:
        """The banks of the steps ``first`` to ``end - 1``, made ahead in threads; a context."""
        with ThreadPoolExecutor(workers, "scans") as pool:
            waiting: collections.deque[Future[ScanBank]] = collections.deque()

            def banks() -> Iterator[ScanBank]:
                for step in range(first, end):
                    while len(waiting) < STEPS_AHEAD and step + len(waiting) < end:
                        waiting.append(pool.submit(self.of_step, step + len(waiting)))
                    yield waiting.popleft().result()

            try:
                yield banks()
            finally:
                for future in waiting:
                    future.cancel()
