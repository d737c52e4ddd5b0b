"""Scans of a part by the kinds of sensor that verdicts are tried on, and what lies in the way.

Noise, bias and holes are those of `vanejax.scanner.sensor`. What is added here is what a sensor
cannot know: patches and a side of the part that something hides from the depth camera, and a table
or a clamp beside the part.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from vanejax.cad import Part
from vanejax.errors import InputError
from vanejax.rigid import RigidTransform
from vanejax.scanner import Scanner, measurement
from vanejax.scanner.sensor import Sensor, consumer_depth, paper_camera

KINDS = ("structured_light", "depth_camera", "clutter")
HOLES = (1, 5)  # round ones, in scans of the depth camera
HOLE_PX = (2.0, 7.0)
CROPPED_SHARE = (0.0, 0.15)  # of its points, lost at one side of the part
CLUTTER_SHARE = (0.1, 0.2)  # of the points of a scan with a table or a clamp


def sensor(kind: str) -> Sensor:
    """The sensor of a kind, one of `KINDS`.

    Structured light is the paper's camera with half the pixels per side, which may stand nearer.
    """
    if kind == "depth_camera":
        return consumer_depth()
    coarse = paper_camera().scaled(0.5)
    return dataclasses.replace(coarse, camera=dataclasses.replace(coarse.camera, near_mm=50.0))


def random_pose(rng: np.random.Generator, part: Part, distance_mm: float) -> RigidTransform:
    """camera_from_part: uniformly random in SO(3), the part's centre ``distance_mm`` away.

    The centre lies up to 3 % of the distance off the optical axis, in x and in y.
    """
    rotation = Rotation.random(rng=rng).as_matrix()
    aside = rng.uniform(-0.03, 0.03, 2) * distance_mm
    center = np.array([aside[0], aside[1], -distance_mm])
    return RigidTransform(rotation, center - rotation @ part.center)


def measure(
    part: Part, scanner: Scanner, camera_from_part: RigidTransform, *, kind: str, seed: int
) -> np.ndarray:
    """Points [N, 3] f64, mm, of one scan by a sensor of that kind, exposed for its distance.

    They are in the camera's frame, which looks along -z, in pixel order; the same arguments give
    the same points. "clutter" is structured light with a table or a clamp in the view.

    Raises:
      InputError: nothing of the part is measured.
    """
    used = sensor(kind).exposed_for(-float(camera_from_part.apply(part.center[None])[0, 2]))
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    taken = measurement.measure(scanner, used, camera_from_part, rng)
    images = taken.organised()
    points = images["points"].astype(np.float64)
    depth = -points[..., 2]
    if kind == "depth_camera":
        _drop_holes(depth, rng)
        _crop(depth, rng.uniform(*CROPPED_SHARE), rng)
    if kind == "clutter" and len(taken.points):
        share = rng.uniform(*CLUTTER_SHARE)
        if rng.random() < 0.5:
            covered = images["reason"] != measurement.Reason.NOTHING
            vertices = camera_from_part.apply(part.mesh.vertices)
            whole = _table(used, depth, covered, vertices, share, rng)
        else:
            whole = _clamp(used, depth, share, rng)
        clutter = np.isfinite(whole) & (whole != depth)
        rows, columns = np.nonzero(clutter)
        x, y = used.camera.slopes(columns, rows)
        points[clutter] = whole[clutter][:, None] * np.stack([x, y, np.full_like(x, -1.0)], -1)
        depth = whole
    points = points[np.isfinite(depth)]
    if not len(points):
        raise InputError(f"no point of {part.name} is measured from this pose")
    return points


def _drop_holes(depth: np.ndarray, rng: np.random.Generator) -> None:
    """Round patches around random measured pixels become NaN, in place."""
    for _ in range(rng.integers(HOLES[0], HOLES[1] + 1)):
        places = np.argwhere(np.isfinite(depth))
        if not len(places):
            return
        middle = places[rng.integers(len(places))]
        rows, columns = np.ogrid[: depth.shape[0], : depth.shape[1]]
        radius = rng.uniform(*HOLE_PX)
        depth[(rows - middle[0]) ** 2 + (columns - middle[1]) ** 2 < radius**2] = np.nan


def _crop(depth: np.ndarray, share: float, rng: np.random.Generator) -> None:
    """That share of the measured pixels, farthest to a random side, becomes NaN, in place."""
    angle = rng.uniform(0, 2 * math.pi)
    rows, columns = np.nonzero(np.isfinite(depth))
    order = np.argsort(rows * math.sin(angle) + columns * math.cos(angle), kind="stable")
    lost = order[: int(share * len(order))]
    depth[rows[lost], columns[lost]] = np.nan


def _measured_plane(
    sensor: Sensor, point: np.ndarray, normal: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """[height, width]: noisy depth of a plane along each pixel's ray; NaN behind the camera."""
    camera = sensor.camera
    x, y = camera.slopes(np.arange(camera.width), np.arange(camera.height)[:, None])
    closing = normal[0] * x + normal[1] * y - normal[2]
    depth = np.dot(normal, point) / np.where(closing == 0, np.nan, closing)
    depth = np.where((depth > camera.near_mm) & (depth < camera.far_mm), depth, np.nan)
    return depth + sensor.range_sigma_mm(depth) * rng.standard_normal(depth.shape)


def _table(
    sensor: Sensor,
    depth: np.ndarray,
    covered: np.ndarray,
    vertices: np.ndarray,
    share: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """The part lies on a plane that is seen, in a patch, where the part does not hide it."""
    normal = rng.standard_normal(3)
    normal[2] = 1 + abs(normal[2])  # at most some 55 deg from the viewing direction
    normal /= np.linalg.norm(normal)
    plane = _measured_plane(sensor, vertices[np.argmin(vertices @ normal)], normal, rng)
    # nor beside it, where its points would hardly be clutter
    plane[ndimage.binary_dilation(covered, iterations=2)] = np.nan
    rows, columns = np.nonzero(np.isfinite(plane))
    there = np.argwhere(np.isfinite(depth))
    middle = there[rng.integers(len(there))]
    order = np.argsort(np.hypot(rows - middle[0], columns - middle[1]), kind="stable")
    seen = order[: round(share / (1 - share) * len(there))]
    result = depth.copy()
    result[rows[seen], columns[seen]] = plane[rows[seen], columns[seen]]
    return result


def _clamp(sensor: Sensor, depth: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """A jaw of a few mm before the part, square in the image, across a place of its outline."""
    measured = np.isfinite(depth)
    outline = np.argwhere(measured & ~ndimage.binary_erosion(measured))
    row, column = outline[rng.integers(len(outline))]
    x, y = sensor.camera.slopes(column, row)
    front = depth[row, column] - rng.uniform(4, 12)
    tilt = np.append(rng.uniform(-0.3, 0.3, 2), 1.0)
    plane = _measured_plane(sensor, front * np.array([x, y, -1.0]), tilt, rng)
    rows, columns = np.ogrid[: depth.shape[0], : depth.shape[1]]
    square = np.maximum(np.abs(rows - row), np.abs(columns - column))
    seen = np.isfinite(plane) & ~(depth < plane)
    # what the jaw hides is lost, so its half width is found by trying
    for half in range(1, max(depth.shape)):
        jaw = (square <= half) & seen
        if np.count_nonzero(jaw) >= share * np.count_nonzero(jaw | measured):
            break
    return np.where(jaw, plane, depth)
