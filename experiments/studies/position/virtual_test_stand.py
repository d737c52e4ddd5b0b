"""The paper's test stand (Fig. 12), virtually: stage, camera, probe, and the cube that joins them.

The camera stands still. A stage carries the guide vane: it turns about its R axis and moves along
X, Y, Z, which are not quite where the drawing has them. The probe's machine has a frame of its own,
two metres away.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from experiments.runner.vane_views import pose_error
from vanejax.cad.part import Part, part_from_mesh
from vanejax.errors import InputError
from vanejax.localization.residuals import RayCasting, measurement_model
from vanejax.machine.calibration import Calibration, averaged, calibrate
from vanejax.machine.calibration_cube import SIDE_MM, Cube, cube_faces, cube_of
from vanejax.machine.positioning import in_machine
from vanejax.rigid import RigidTransform
from vanejax.scanner import Scanner, Sensor, measure
from vanejax.scans.measured_scan import MeasuredScan

PROBE_MM = 0.015  # of the paper's probe, taken as the standard deviation along each axis
FLATNESS_MM = 0.02  # of the cube's faces, and how far they are from square over its side
ASKEW_DEG, ASIDE_MM = 0.5, 1.0  # of the stage from its drawing, standard deviations
AXIS_BESIDE_MM = 8.0  # from the R axis to the part's centre
PLACEMENTS, TOUCHED = 8, 3  # of the cube, and points along each side of each of its faces
TRIES = 10  # to place the cube so that all three faces are seen
CUBE_TILT_DEG = 8.0
MOVES_MM = (
    (0.0, 0.0, 0.0),
    (20.0, 0.0, 0.0), (40.0, 0.0, 0.0), (-30.0, 0.0, 0.0),
    (0.0, 15.0, 0.0), (0.0, 25.0, 0.0), (0.0, -20.0, 0.0),
    (0.0, 0.0, 15.0), (0.0, 0.0, 30.0), (0.0, 0.0, -25.0),
    (20.0, 15.0, 10.0), (-25.0, -15.0, -20.0),
)  # fmt: skip
# what four cone-shaped dents on the platform are probed at, mm from the part's centre
DENTS_MM = ((-90.0, -70.0, -30.0), (90.0, -70.0, -30.0), (90.0, 70.0, -30.0), (-90.0, 70.0, -30.0))
BIAS_POINTS = 4_000
FAR_MM = 0.5  # from the part: such points do not take part in a registration
LEAST_COSINE = 0.2


@dataclasses.dataclass(frozen=True, eq=False)
class VirtualTestStand:
    """One camera, one part, one stage, one measuring machine."""

    part: Part  # in its own frame
    sensor: Sensor  # this camera, with the errors of its calibration
    camera_from_part: RigidTransform  # at the initial position
    camera_from_stage: RigidTransform  # the stage's axes: R along z through its origin
    nominal_from_stage: RigidTransform  # the same by the drawing
    machine_from_camera: RigidTransform  # what the calibration should find

    @classmethod
    def build(
        cls, part: Part, sensor: Sensor, camera_from_part: RigidTransform, rng: np.random.Generator
    ) -> VirtualTestStand:
        """A stage about the part as ``camera_from_part`` has it, and a machine somewhere.

        The part's z is along the R axis but for the tolerances of the mounting.
        """
        aside = RigidTransform(np.eye(3), part.center + np.array([AXIS_BESIDE_MM, 0.0, 0.0]))
        nominal = camera_from_part @ aside
        slip = RigidTransform(
            Rotation.from_rotvec(np.radians(ASKEW_DEG) * rng.standard_normal(3)).as_matrix(),
            ASIDE_MM * rng.standard_normal(3),
        )
        machine = RigidTransform(
            Rotation.random(rng=rng).as_matrix(), np.array([600.0, -500.0, 1800.0])
        )
        return cls(part, sensor, camera_from_part, nominal @ slip, nominal, machine)

    @functools.cached_property
    def model(self) -> RayCasting:
        """Predicts the camera's scans of the part."""
        return measurement_model(self.part, np.zeros(3))

    @property
    def axis(self) -> np.ndarray:
        """[3] unit, the drawing's R axis, camera frame."""
        return self.nominal_from_stage.rotation[:, 2]

    def moved(self, stage: RigidTransform) -> RigidTransform:
        """The part's true motion in the camera's frame when the stage does ``stage`` in its own."""
        return in_machine(stage, self.camera_from_stage)

    def expected(self, stage: RigidTransform) -> RigidTransform:
        """The same by the drawing."""
        return in_machine(stage, self.nominal_from_stage)

    def truth(self, stage: RigidTransform) -> RigidTransform:
        """part_from_camera after the stage's motion."""
        return (self.moved(stage) @ self.camera_from_part).inverse()

    def scan(self, stage: RigidTransform, rng: np.random.Generator) -> MeasuredScan:
        """What the camera measures after the stage's motion."""
        measured = measure(self.model.scanner, self.sensor, self.truth(stage).inverse(), rng)
        return MeasuredScan(measured.points.astype(np.float64), None, np.zeros(3))

    def probed(self, stage: RigidTransform, rng: np.random.Generator) -> np.ndarray:
        """[4, 3] mm, machine frame: the platform's dents after the stage's motion."""
        there = self.machine_from_camera @ self.moved(stage) @ self.camera_from_part
        dents = there.apply(self.part.center + np.array(DENTS_MM))
        return dents + PROBE_MM * rng.standard_normal(dents.shape)


def stage_turns(positions: int) -> list[RigidTransform]:
    """Motions of the stage about its R axis, from the initial position on round the full turn."""
    angles = 2 * np.pi * np.arange(positions) / positions
    return [
        RigidTransform(Rotation.from_rotvec([0, 0, a]).as_matrix(), np.zeros(3)) for a in angles
    ]


def stage_moves(positions: int) -> list[RigidTransform]:
    """Motions of the stage along X, Y, Z: one axis at a time, then all; the first is none.

    Raises:
      InputError: more positions than there are.
    """
    if not 2 <= positions <= len(MOVES_MM):
        raise InputError(f"positions must be from 2 to {len(MOVES_MM)}, got {positions}")
    return [RigidTransform(np.eye(3), np.array(shift)) for shift in MOVES_MM[:positions]]


# The cube.


@dataclasses.dataclass(frozen=True, eq=False)
class GroundCube:
    """A calibration cube as it was ground: corner at the origin, material at x, y, z < 0."""

    waves: (
        np.ndarray
    )  # [3, 2, 4] of three faces: length (mm), direction, phase (rad), weight of two
    lean: np.ndarray  # [3, 3], makes the faces not quite square

    @classmethod
    def ground(cls, rng: np.random.Generator) -> GroundCube:
        """Faces within their flatness, square within theirs."""
        limits = ((50, 120), (0, np.pi), (0, 2 * np.pi), (0.3, 1))
        waves = np.stack([rng.uniform(*limit, (3, 2)) for limit in limits], axis=-1)
        grid = np.stack(np.meshgrid(*2 * [np.linspace(-SIDE_MM, 0, 31)]), axis=-1).reshape(-1, 2)
        for face in waves:
            face[:, 3] *= FLATNESS_MM / np.ptp(_height(face, grid))
        lean = np.eye(3) + rng.uniform(-0.5, 0.5, (3, 3)) * FLATNESS_MM / SIDE_MM * (1 - np.eye(3))
        return cls(waves, lean)

    def on_face(self, k: int, places: np.ndarray) -> np.ndarray:
        """[N, 3] mm: points of face k, whose normal is along axis k, at [N, 2] of the others."""
        points = np.insert(places, k, _height(self.waves[k], places), axis=1)
        return points @ self.lean.T

    @functools.cached_property
    def part(self) -> Part:
        """As a solid."""
        box = trimesh.creation.box(extents=[SIDE_MM] * 3)
        for _ in range(4):
            box = box.subdivide()
        flat = np.asarray(box.vertices) - SIDE_MM / 2
        vertices = flat.copy()
        for k in range(3):
            height = _height(self.waves[k], np.delete(flat, k, axis=1))
            # fades towards the face on the other side, which nobody sees
            vertices[:, k] += height * (1 + flat[:, k] / SIDE_MM)
        return part_from_mesh(vertices @ self.lean.T, np.asarray(box.faces), name="cube")


def _height(waves: np.ndarray, places: np.ndarray) -> np.ndarray:
    """[N] mm of two waves [2, 4] at places [N, 2]."""
    length, direction, phase, weight = waves.T
    along = places @ np.stack([np.cos(direction), np.sin(direction)])
    return np.sin(2 * np.pi * along / length + phase) @ weight


class PlacedCube(NamedTuple):
    """One placement of the cube, as both instruments have it."""

    scanned: list[np.ndarray]  # three of [n, 3] mm, camera frame: the scan's points on each face
    touched: list[np.ndarray]  # three of [9, 3] mm, machine frame


def place_cubes(stand: VirtualTestStand, rng: np.random.Generator) -> list[PlacedCube]:
    """The cube at eight places before the camera, scanned and touched.

    A placement that hides a face from the camera or the projector is given up for another, as one
    would at the stand.
    """
    block = GroundCube.ground(rng)
    scanner = Scanner(block.part)
    return [_placed(stand, block, scanner, rng) for _ in range(PLACEMENTS)]


def _placed(
    stand: VirtualTestStand, block: GroundCube, scanner: Scanner, rng: np.random.Generator
) -> PlacedCube:
    steps = np.linspace(-0.9, -0.1, TOUCHED) * SIDE_MM
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    for _ in range(TRIES):
        camera_from_cube = _corner_up(rng)
        points = measure(scanner, stand.sensor, camera_from_cube, rng).points.astype(np.float64)
        try:
            label = cube_faces(points)
        except InputError:
            continue
        machine_from_cube = stand.machine_from_camera @ camera_from_cube
        touched = []
        for k in range(3):
            places = grid + rng.uniform(-3, 3, grid.shape)
            exact = machine_from_cube.apply(block.on_face(k, places))
            touched.append(exact + PROBE_MM * rng.standard_normal(exact.shape))
        return PlacedCube([points[label == k] for k in range(3)], touched)
    raise InputError(f"no placement of {TRIES} showed three faces of the cube to the camera")


def _corner_up(rng: np.random.Generator) -> RigidTransform:
    """camera_from_cube: the corner towards the camera, somewhere in its view."""
    up = Rotation.align_vectors([[0, 0, 1]], [[1, 1, 1]])[0]
    spin = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])
    tilt = Rotation.from_rotvec(np.radians(rng.uniform(-CUBE_TILT_DEG, CUBE_TILT_DEG, 3)))
    corner = np.array([*rng.uniform(-1, 1, 2) * [60, 30], -390 + rng.uniform(-30, 30)])
    return RigidTransform((tilt * spin * up).as_matrix(), corner)


def touched_cubes(placed: list[PlacedCube]) -> list[Cube]:
    """As the machine has them."""
    return [cube_of(cube.touched, noise_mm=PROBE_MM) for cube in placed]


def calibrations(placed: list[PlacedCube]) -> tuple[Calibration, Calibration]:
    """By all planes at once, and by the paper's mean."""
    seen = [cube_of(cube.scanned) for cube in placed]
    touched = touched_cubes(placed)
    return calibrate(seen, touched), averaged(seen, touched)


# What the camera's own calibration does.


def calibration_errors(kind: Sensor) -> list[Sensor]:
    """A kind of camera with one error of its calibration each, of one standard deviation.

    Those that `Sensor.sample` draws of a lens and a trueness, a pair's two apart.
    """
    exact = dataclasses.replace(kind, lens=None, trueness=None)
    return [
        dataclasses.replace(exact, **{name: type(errors)(**{field: one})})
        for name, errors in (("lens", kind.lens), ("trueness", kind.trueness))
        for field, value in dataclasses.asdict(errors).items()
        for one in (map(tuple, np.diag(value)) if isinstance(value, tuple) else [value])
    ]


def shifts_mm(sensor: Sensor, points: np.ndarray) -> np.ndarray:
    """[N, 3]: how far the errors of a sensor's calibration move measured points [N, 3]."""
    camera, depth = sensor.camera, -points[:, 2]
    out = np.zeros_like(points)
    if sensor.trueness is not None:
        x, y = (camera.project(points) / [camera.width / 2, camera.height / 2] - 1).T
        out += points * (sensor.trueness.error_mm(depth, x, y) / depth)[:, None]
    if sensor.lens is not None:
        x, y = points[:, 0] / depth, points[:, 1] / depth
        for axis, shift in enumerate(sensor.lens.shifts(x, y, fx=camera.fx, fy=camera.fy)):
            out[:, axis] += depth * shift
    return out


def pose_bias(
    stand: VirtualTestStand, scan: MeasuredScan, pose: RigidTransform, errors: list[Sensor]
) -> np.ndarray:
    """[6, K]: what each of K errors of calibration does to a registered pose part_from_camera.

    To first order, least squares along the rays: the truth is that small motion after the pose.
    """
    rng = np.random.default_rng(0)
    points = scan.points[rng.permutation(len(scan.points))[:BIAS_POINTS]]
    batch = RigidTransform(pose.rotation[None], pose.translation[None])
    residuals = stand.model.residuals(batch, points, precision="samples")
    on = (
        residuals.hit[0]
        & (np.abs(residuals.deviation_mm[0]) < FAR_MM)
        & (residuals.cosine[0] > LEAST_COSINE)
    )
    columns = residuals.jacobian[0][on] / residuals.cosine[0][on, None]
    normals = residuals.jacobian[0][on, 3:] @ pose.rotation
    moved = [np.einsum("ni,ni->n", normals, shifts_mm(error, points[on])) for error in errors]
    along = np.stack(moved, axis=1) / residuals.cosine[0][on, None]
    return np.linalg.solve(columns.T @ columns, columns.T @ along)


def frame_bias(placed: list[PlacedCube], found: Calibration, errors: list[Sensor]) -> np.ndarray:
    """[6, K]: what the same errors do to machine_from_camera, about ``found.center``."""
    touched = touched_cubes(placed)
    scanned = [
        [points[:: max(1, len(points) // 500)] for points in cube.scanned] for cube in placed
    ]

    def machine_from_camera(faces: list[list[np.ndarray]]) -> RigidTransform:
        return calibrate([cube_of(points) for points in faces], touched).machine_from_camera

    start = machine_from_camera(scanned)
    columns = []
    for error in errors:
        wrong = [[points + shifts_mm(error, points) for points in faces] for faces in scanned]
        columns.append(pose_error(machine_from_camera(wrong), start, found.center))
    return np.stack(columns, axis=1)
