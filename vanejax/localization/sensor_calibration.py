"""What a sensor's calibration leaves open, as displacements of measured points."""

from __future__ import annotations

import dataclasses

import numpy as np

from vanejax.errors import InputError
from vanejax.scanner.camera import Camera
from vanejax.scanner.range_errors import Lens, Trueness
from vanejax.scanner.sensor import PRESETS, Sensor, preset
from vanejax.scans.measured_scan import MeasuredScan

NEAR_MM = 1e-6  # of the sensor's origin: the scan's frame is the camera's


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Standard deviations of what calibration leaves of a camera's errors, all independent.

    Attributes:
      camera: intrinsics, for errors in pixels and in shares of the image.
      lens: standard deviation of each of its parameters.
      trueness: likewise.
    """

    camera: Camera = dataclasses.field(default_factory=Camera)
    lens: Lens = dataclasses.field(default_factory=Lens)
    trueness: Trueness = dataclasses.field(default_factory=Trueness)

    @classmethod
    def of(cls, sensor: Sensor | str) -> Calibration:
        """That of a virtual sensor, or of one of `vanejax.scanner.sensor.PRESETS` by name.

        Raises:
          InputError: no such name, or a sensor of whose calibration nothing is known.
        """
        name = f"sensor {sensor!r}" if isinstance(sensor, str) else "the sensor"
        sensor = preset(sensor) if isinstance(sensor, str) else sensor
        if sensor.lens is None and sensor.trueness is None:
            known = [n for n, make in PRESETS.items() if make().lens or make().trueness]
            raise InputError(
                f"{name} has no errors of calibration that could count; give one whose are known: "
                f"{', '.join(known)}"
            )
        return cls(sensor.camera, sensor.lens or Lens(), sensor.trueness or Trueness())

    def check_frame(self, scan: MeasuredScan) -> None:
        """Refuses a scan that is not in its camera's frame.

        Raises:
          InputError: says so.
        """
        origin = scan.sensor_origin
        if origin is None or np.abs(origin).max() > NEAR_MM or scan.looks_along is None:
            raise InputError(
                f"{scan.name}: for a sensor's calibration the scan must be in the camera's frame: "
                "the sensor at the origin, looking along +z or -z"
            )

    def displacements(self, points: np.ndarray) -> np.ndarray:
        """[C, n, 3] mm: how one standard deviation of each error moves points [n, 3] mm.

        Points are in the camera's frame, looking along +z or -z; the sign of an error is of no
        matter.
        """
        depth = np.abs(points[:, 2])
        x, y = points[:, 0] / depth, points[:, 1] / depth
        moved = []
        for lens in _one_by_one(self.lens):
            right, up = lens.shifts(x, y, fx=self.camera.fx, fy=self.camera.fy)
            moved.append(np.stack([depth * right, depth * up, np.zeros_like(depth)], axis=1))
        across = x * 2 * self.camera.fx / self.camera.width
        down = y * 2 * self.camera.fy / self.camera.height
        for trueness in _one_by_one(self.trueness):
            error = trueness.error_mm(depth, across, down)
            moved.append(points * (error / depth)[:, None])
        return np.array(moved).reshape(-1, len(points), 3)


def _one_by_one(errors: Lens | Trueness) -> list[Lens] | list[Trueness]:
    """The same with one number at a time, those that are not 0."""
    alone = []
    for field in dataclasses.fields(errors):
        value = getattr(errors, field.name)
        if isinstance(value, tuple):
            split = [tuple(v if i == k else 0.0 for i, v in enumerate(value)) for k in (0, 1)]
            alone += [type(errors)(**{field.name: s}) for s in split if any(s)]
        elif value:
            alone.append(type(errors)(**{field.name: value}))
    return alone
