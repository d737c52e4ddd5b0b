"""What a stereo camera's matching window rounds off, taken out of a scan of a part of known shape.

Stereo finds the mean depth of a window, so that outer edges are measured too far and inner ones too
near (`vanejax.scanner.range_errors.window_mean`), over a millimetre deep with a coarse camera. That
is no noise: it pulls the pose. At a pose that is about right, the virtual sensor says by how much
each pixel is off, and the fine registration goes on from the points without it.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vanejax.errors import InputError
from vanejax.localization.fine_registration import refine
from vanejax.localization.pose_result import Refinement
from vanejax.localization.residuals import RayCasting
from vanejax.rigid import RigidTransform
from vanejax.scanner import Scanner, Sensor, measure
from vanejax.scans.measured_scan import MeasuredScan

ROUNDS = 2  # the first does nearly all of it: of 1.07 deg it leaves 0.13, the second 0.10
NEAR_MM = 1e-6  # of the sensor's origin: the scan's frame is the camera's
_FLIP = np.array([1.0, -1.0, -1.0])  # from a camera that looks along +z to one that looks along -z


def check_window(sensor: Sensor, scan: MeasuredScan) -> None:
    """Refuses a sensor without a window, or a scan that is not in its camera's frame.

    Raises:
      InputError: says which.
    """
    if not sensor.window_px:
        raise InputError(
            "this sensor codes single pixels and rounds nothing off; a sensor is given for a "
            "stereo camera's window, such as consumer_depth's"
        )
    origin = scan.sensor_origin
    if origin is None or np.abs(origin).max() > NEAR_MM or scan.looks_along is None:
        raise InputError(
            f"{scan.name}: to take out what a sensor's window rounds off, the scan must be in the "
            "camera's frame: the sensor at the origin, looking along +z or -z"
        )


def without_rounding(
    scanner: Scanner, sensor: Sensor, points: np.ndarray, part_from_camera: RigidTransform
) -> np.ndarray:
    """Points [N, 3] f64 mm as they would be without the window, if the part stood at a pose.

    Each is moved along its ray by what the virtual sensor's window does to the pixel that sees it.
    Where that sees nothing, or another surface of which the window holds a part, it stays.

    Args:
      scanner: of the part.
      sensor: of its effects, only the window is taken.
      points: camera frame, x right, y up, looking along -z.
      part_from_camera: about right.
    """
    camera = sensor.camera
    window = Sensor(camera, sensor.baseline_mm, window_px=sensor.window_px, jump_mm=sensor.jump_mm)
    rng = np.random.default_rng(0)  # nothing random is left in it
    seen = measure(scanner, window, part_from_camera.inverse(), rng)
    factor = np.ones(camera.height * camera.width)
    clean, rounded = seen.ideal.points[seen.kept, 2], seen.points[:, 2]
    factor[seen.pixel] = clean.astype(np.float64) / rounded
    place = np.floor(np.nan_to_num(camera.project(points), nan=-1.0)).astype(np.int64)
    inside = ((place >= 0) & (place < [camera.width, camera.height])).all(axis=1)
    out = points.copy()
    out[inside] *= factor[place[inside, 1] * camera.width + place[inside, 0], None]
    return out


def refine_sharpened(
    model: RayCasting, scan: MeasuredScan, refinement: Refinement, sensor: Sensor, *, seed: int = 0
) -> tuple[Refinement, np.ndarray]:
    """The fine registration again, of the points [N, 3] without what the window rounds off; those.

    Args:
      model: of the part; ``scan`` is what `check_window` takes.
      refinement: of the scan as it is.
      sensor: whose window.
      seed: as for `vanejax.localization.fine_registration.refine`.
    """
    flip = _FLIP if scan.looks_along == "+z" else np.ones(3)
    points = scan.points * flip
    iterations = refinement.iterations
    for _ in range(ROUNDS):
        pose = refinement.part_from_camera
        turned = RigidTransform(pose.rotation * flip, pose.translation)
        sharp = without_rounding(model.scanner, sensor, points, turned) * flip
        refinement = refine(model, sharp, pose, seed=seed)
        iterations += refinement.iterations
    return dataclasses.replace(refinement, iterations=iterations), sharp
