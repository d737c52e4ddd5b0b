"""Single scans of castings that differ from their CAD model, by cameras with errors of their own.

The castings are made by `vanejax.cad.investment_casting`; here are the ranges of what is drawn.
Waves and bow are about what grade 6 of ISO 8062-3 allows. Stock is an allowance, and wrong sizes
and missing corners are faults beyond any tolerance (docs/castings.md).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from experiments.runner.vane_views import with_noise
from experiments.studies.verdicts.challenge_parts import VANE, ChallengePart, challenge_parts
from experiments.studies.verdicts.depth_camera import random_pose
from vanejax.cad.investment_casting import (
    InvestmentCasting,
    as_cast,
    with_stock_on_one_side,
    without_a_corner,
)
from vanejax.cad.part import Part
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Camera
from vanejax.scanner.measurement import measure
from vanejax.scanner.sensor import preset
from vanejax.scanner.virtual_scanner import Scanner

VANES = (VANE, "vane_4")
PARTS = (*VANES, "l_bracket", "pump_housing", "elbow", "bearing_block")
CAMERA_SCALE = 0.4
CAMERA = dataclasses.replace(Camera().scaled(CAMERA_SCALE), near_mm=50.0)
DISTANCE, LEAST_DISTANCE_MM = (4.0, 7.0), 300.0  # of the part's radius
PAPER_CAMERA = "paper_camera"
WHITE_MM, QUIET_MM = 0.1, 0.02  # noise along the rays
BEND_MM = 0.05
CAMERA_SCALE_ERROR = (0.001, 0.003)
STOCK_MM, ONE_SIDE_MM = (0.3, 1.0), 1.0
UNCHANGED = InvestmentCasting(allowance_mm=0.0, waviness_mm=0.0)
SIZE = (0.97, 1.03)
VARYING = {"allowance_mm": 0.3, "waviness_mm": 0.1}
WAVELENGTH_MM = (20.0, 60.0)
BOW_MM = (0.1, 0.4)
MISSING_BOX, MISSING_VOLUME = (0.2, 0.5), (0.03, 0.15)  # of the part's sides and of its volume
KEPT = (0.2, 0.8)  # of the points of a cropped scan


@dataclasses.dataclass(frozen=True, eq=False)
class Casting:
    """A casting in the frame of its CAD model.

    Attributes:
      part: its solid.
      stock_mm: uniform offset of the surface, on average.
      scale_error: by how much it is larger than the CAD model, relative.
    """

    part: Part
    stock_mm: float = 0.0
    scale_error: float = 0.0


Cast = Callable[[Part, np.ndarray, np.random.Generator], Casting]


@dataclasses.dataclass(frozen=True)
class Kind:
    """What a case differs by.

    Attributes:
      title: for readers.
      cast: ``cast(part, to_camera, rng)`` makes the casting; to_camera [3] is a unit vector.
      sensor: "white" noise, "quiet", "bend" (a smooth error), "scale" (a wrong one), "crop" (quiet,
        cut along the ring), or the paper's camera.
      other_part: whether the scan is of another part.
      per_view: how many cases there are for each of the other kinds' views.
    """

    title: str
    cast: Cast = lambda part, to_camera, rng: Casting(part)
    sensor: str = "quiet"
    other_part: bool = False
    per_view: int = 1


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """One scan of one casting, and what is true of it.

    Attributes:
      part, kind, number: of the case.
      challenge: the part that is sought.
      points: [N, 3] f64, mm, camera frame.
      truth: part_from_camera; None where the scan is of another part.
      stock_mm, scale_error: of the scan against the CAD model.
      calibration: what `register` is told of the camera.
    """

    part: str
    kind: str
    number: int
    challenge: ChallengePart
    points: np.ndarray
    truth: RigidTransform | None
    stock_mm: float
    scale_error: float
    calibration: str | None


@functools.cache
def sought(name: str) -> ChallengePart:
    """The part of a name, one of `PARTS`."""
    return challenge_parts([name])[name]


def make_case(name: str, kind: str, number: int, seed: int) -> Case:
    """A case; the same arguments give the same points."""
    rng = np.random.default_rng([seed, number, *name.encode(), *kind.encode()])
    how, challenge = KINDS[kind], sought(name)
    scanned = challenge.part
    if how.other_part:  # one vane segment is much like another
        others = [n for n in PARTS if n != name and not {n, name} <= {*VANES}]
        scanned = sought(str(rng.choice(others))).part
    distance = max(rng.uniform(*DISTANCE) * scanned.radius, LEAST_DISTANCE_MM)
    pose = random_pose(rng, scanned, distance)
    truth = pose.inverse()
    to_camera = truth.translation - scanned.center
    casting = how.cast(scanned, to_camera / np.linalg.norm(to_camera), rng)
    points = _points(casting.part, how.sensor, pose, distance, rng)
    scale = casting.scale_error
    if how.sensor == "scale":
        scale = rng.uniform(*CAMERA_SCALE_ERROR)
        points = points * (1 + scale)
    if how.sensor == "crop":
        points = _cropped(points, truth, rng)
    return Case(
        name,
        kind,
        number,
        challenge,
        points,
        None if how.other_part else truth,
        casting.stock_mm,
        scale,
        PAPER_CAMERA if how.sensor == PAPER_CAMERA else None,
    )


def _points(
    part: Part, sensor: str, pose: RigidTransform, distance_mm: float, rng: np.random.Generator
) -> np.ndarray:
    """[N, 3] f64: a scan by a camera, another one in every case."""
    scanner = Scanner(part)
    if sensor == PAPER_CAMERA:
        camera = preset(PAPER_CAMERA).sample(rng).scaled(CAMERA_SCALE).exposed_for(distance_mm)
        return measure(scanner, camera, pose, rng).points.astype(np.float64)
    points = scanner.scan(CAMERA, pose).points.astype(np.float64)
    points = with_noise(points, WHITE_MM if sensor == "white" else QUIET_MM, rng)
    return _bent(points, rng) if sensor == "bend" else points


def _bent(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The range is off by a wave across the image, one to two and a half half waves long."""
    place = points[:, :2] / -points[:, 2:]
    place = place - place.mean(axis=0)
    angle, phase = rng.uniform(0, 2 * np.pi, 2)
    along = place @ [np.cos(angle), np.sin(angle)] / np.abs(place).max()
    error = BEND_MM * np.cos(rng.uniform(1, 2.5) * np.pi * along + phase)
    return points * (1 + error / np.linalg.norm(points, axis=1))[:, None]


def _cropped(points: np.ndarray, truth: RigidTransform, rng: np.random.Generator) -> np.ndarray:
    """One end along the ring, which is the vane's x."""
    along = truth.apply(points)[:, 0] * rng.choice([-1.0, 1.0])
    return points[along < np.quantile(along, rng.uniform(*KEPT))]


def _with_stock(part: Part, to_camera: np.ndarray, rng: np.random.Generator) -> Casting:
    stock = rng.uniform(*STOCK_MM)
    return Casting(as_cast(part, dataclasses.replace(UNCHANGED, allowance_mm=stock), rng), stock)


def _varying(part: Part, to_camera: np.ndarray, rng: np.random.Generator) -> Casting:
    allowance = InvestmentCasting(**VARYING, wavelength_mm=rng.uniform(*WAVELENGTH_MM))
    return Casting(as_cast(part, allowance, rng), allowance.allowance_mm)


def _one_side(part: Part, to_camera: np.ndarray, rng: np.random.Generator) -> Casting:
    """Stock on the faces that look along one axis, one of those that point to the camera."""
    towards = np.diag(np.where(to_camera < 0, -1.0, 1.0))
    axis = towards[rng.choice(np.flatnonzero(np.abs(to_camera) > 0.3))]
    return Casting(with_stock_on_one_side(part, axis, ONE_SIDE_MM))


def _resized(part: Part, to_camera: np.ndarray, rng: np.random.Generator) -> Casting:
    scale = rng.uniform(*SIZE) - 1
    resized = as_cast(part, dataclasses.replace(UNCHANGED, scale_error=scale), rng)
    return Casting(resized, 0.0, scale)


def _warped(part: Part, to_camera: np.ndarray, rng: np.random.Generator) -> Casting:
    bow = dataclasses.replace(UNCHANGED, bow_mm=rng.uniform(*BOW_MM))
    return Casting(as_cast(part, bow, rng))


def _broken(part: Part, to_camera: np.ndarray, rng: np.random.Generator) -> Casting:
    return Casting(without_a_corner(part, rng, sides=MISSING_BOX, volume=MISSING_VOLUME))


KINDS = {
    "equal": Kind("equal to the CAD model", sensor="white"),
    "paper": Kind("paper's camera", sensor=PAPER_CAMERA),
    "bend": Kind("smooth range error", sensor="bend"),
    "camera_scale": Kind("camera's scale off", sensor="scale"),
    "stock": Kind("uniform stock", _with_stock),
    "varying": Kind("varying stock", _varying),
    "one_side": Kind("stock on one side", _one_side),
    "size": Kind("shrunk or grown", _resized),
    "warped": Kind("warped", _warped),
    "broken": Kind("corner missing", _broken),
    "paper_stock": Kind("uniform stock, paper's camera", _with_stock, PAPER_CAMERA),
    "paper_varying": Kind("varying stock, paper's camera", _varying, PAPER_CAMERA),
    "crop": Kind("vanes cropped along the ring", sensor="crop", per_view=10),
    "other_part": Kind("another part", other_part=True),
}
