"""Scans of parts by several sensors, and poses of those parts that are wrong in tempting ways."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.runner.vane_views import with_noise
from experiments.studies.verdicts.challenge_parts import ChallengePart
from experiments.studies.verdicts.depth_camera import KINDS, measure, random_pose
from vanejax.cad.symmetry import rotation_about
from vanejax.localization.fine_registration import subset
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Scanner

WHITE = "white"
SENSORS = (WHITE, *KINDS)
WHITE_MM = 0.1
WHITE_CAMERA = Camera(width=320, height=256, near_mm=50.0)
WHITE_DISTANCE = 6.0  # of the part's radius: the part fills half the image
DISTANCE_MM = (230.0, 500.0)  # of the other sensors
MOST_POINTS = 12_000  # of a scan: more of them cost time and tell poses apart no better
TURNS_DEG = (10.0, 30.0, 60.0, 90.0, 120.0, 180.0)
NEAR_SYMMETRIES = 4  # of a part, the nearest
# a pose farther off is not what the sensor could give: 5 deg and 5 mm for the depth camera, whose
# bias alone makes 1 to 2 mm
RIGHT = {"depth_camera": (5.0, 5.0)}
RIGHT_ELSE = (1.0, 1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class PosedScan:
    """A scan whose true pose is known.

    Attributes:
      name: of the part.
      challenge: the part, with its symmetries.
      sensor: one of `SENSORS`.
      points: [N, 3] f64, mm, sensor frame.
      truth: part_from_camera.
    """

    name: str
    challenge: ChallengePart
    sensor: str
    points: np.ndarray
    truth: RigidTransform

    def error(self, part_from_camera: RigidTransform) -> tuple[float, float]:
        """Degrees and mm to the nearest right pose."""
        return self.challenge.pose_error(part_from_camera, self.truth)

    def is_right(self, part_from_camera: RigidTransform) -> bool:
        """Whether a part_from_camera is as near as the sensor allows."""
        most_deg, most_mm = RIGHT.get(self.sensor, RIGHT_ELSE)
        angle, shift = self.error(part_from_camera)
        return angle < most_deg and shift < most_mm


def posed_scan(
    name: str, challenge: ChallengePart, scanner: Scanner, sensor: str, seed: int
) -> PosedScan:
    """A scan from a random rotation; the same arguments give the same points."""
    part = challenge.part
    rng = np.random.default_rng([seed, SENSORS.index(sensor), *name.encode()])
    if sensor == WHITE:
        pose = random_pose(rng, part, WHITE_DISTANCE * part.radius)
        ideal = scanner.scan(WHITE_CAMERA, pose).points.astype(np.float64)
        points = with_noise(ideal, WHITE_MM, rng)
    else:
        pose = random_pose(rng, part, rng.uniform(*DISTANCE_MM))
        points = measure(part, scanner, pose, kind=sensor, seed=seed)
    points = points[subset(points, MOST_POINTS, seed)]
    return PosedScan(name, challenge, sensor, points, pose.inverse())


def wrong_poses(scan: PosedScan, rng: np.random.Generator) -> Iterator[tuple[str, RigidTransform]]:
    """Kinds of wrong poses and one part_from_camera each; refinement may lead some of them back.

    "near symmetry": a motion that nearly maps the part to itself; "upside down": half a turn about
    a principal axis of the surface; "one pitch off": of vanes, by one or more pitches; "turned": by
    10 to 180 deg about a random axis.
    """
    challenge, part = scan.challenge, scan.challenge.part
    for matrix in challenge.also_tried:
        yield "one pitch off", RigidTransform.from_matrix(matrix) @ scan.truth
    for matrix in challenge.near_symmetries[:NEAR_SYMMETRIES]:
        yield "near symmetry", RigidTransform.from_matrix(matrix) @ scan.truth
    points, _, _ = part.sample(1000, seed=0)
    _, axes = np.linalg.eigh(np.cov(points.T))
    for axis in axes.T:
        half_turn = rotation_about(axis, 180.0, points.mean(axis=0))
        yield "upside down", RigidTransform.from_matrix(half_turn) @ scan.truth
    for degrees in TURNS_DEG:
        axis = rng.standard_normal(3)
        turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
        yield "turned", RigidTransform(turn, part.center - turn @ part.center) @ scan.truth
