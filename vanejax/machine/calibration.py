"""Where the camera stands in the frame of a measuring machine, from a cube that both measured.

Section IV.B.2 of the paper: three faces of a cube are scanned by the camera and touched by the
machine's probe, at several placements. The cube need not be square. Host code, float64, mm.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.machine.calibration_cube import SIDE_MM, Cube, Face
from vanejax.rigid import RigidTransform

MOST_MISMATCH_MM = 2.0  # of corresponding cubes: more is another cube, or labels mixed up
CLEARER = 3.0  # how much better the right labels must fit than others


@dataclasses.dataclass(frozen=True, eq=False)
class Calibration:
    """Where the camera is, and how well that is known.

    Attributes:
      machine_from_camera: T_b of eq. 13.
      covariance: [6, 6] of its error, a small motion in the machine's frame about ``center``
        applied after it, see `vanejax.machine.positioning`; (rad, mm).
      center: [3] mm, machine frame: the middle of the cubes' corners.
      rotation_deg, corner_mm: [P], residual of each placement's cube frame and of its corner.
      misfit: root of chi square per degree of freedom: 1 where the cubes fit as well as their
        noise lets them. Above it the covariance has been enlarged by its square. NaN from
        `averaged`, which knows no noise.
    """

    machine_from_camera: RigidTransform
    covariance: np.ndarray
    center: np.ndarray
    rotation_deg: np.ndarray
    corner_mm: np.ndarray
    misfit: float

    @property
    def rotation_sigma_deg(self) -> float:
        """Root of the sum over three axes."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[:3, :3]))))

    @property
    def translation_sigma_mm(self) -> float:
        """The same, at ``center``."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))


def calibrate(camera_cubes: Sequence[Cube], machine_cubes: Sequence[Cube]) -> Calibration:
    """machine_from_camera from P placements of a cube: one least squares over all their planes.

    Each face gives three residuals: two tilts of its normal, and the distance of the machine's
    plane from the camera's where the probe touched it. They are weighted by the inverse of their
    covariance, both sides' together. Which face is which need not be said where there are two
    placements or more, see `matched`.

    Raises:
      InputError: no cubes, or cubes that do not match.
    """
    camera_cubes = matched(camera_cubes, machine_cubes)
    touched = [face for cube in machine_cubes for face in cube.faces]
    machine_from_camera, center, _ = _aligned(camera_cubes, machine_cubes)
    for _ in range(20):
        information, gradient, chi = np.zeros((6, 6)), np.zeros(6), 0.0
        seen = [face for cube in camera_cubes for face in cube.moved(machine_from_camera).faces]
        for face, touched_face in zip(seen, touched, strict=True):
            residual, jacobian, covariance = _disagreement(face, touched_face, center)
            weighted = np.linalg.solve(covariance, np.column_stack([jacobian, residual]))
            information += jacobian.T @ weighted[:, :6]
            gradient += jacobian.T @ weighted[:, 6]
            chi += float(residual @ weighted[:, 6])
        step = -np.linalg.solve(information, gradient)
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        shift = center + step[3:] - turn @ center
        machine_from_camera = RigidTransform(turn, shift) @ machine_from_camera
        if step @ information @ step < 1e-12:
            break
    misfit = float(np.sqrt(chi / (9 * len(camera_cubes) - 6)))
    covariance = np.linalg.inv(information) * max(1.0, misfit**2)
    residuals = _residuals(machine_from_camera, camera_cubes, machine_cubes)
    return Calibration(machine_from_camera, covariance, center, *residuals, misfit)


def averaged(camera_cubes: Sequence[Cube], machine_cubes: Sequence[Cube]) -> Calibration:
    """machine_from_camera as the paper has it: the mean of one matrix for each placement.

    The rotation is the chordal mean (Hartley et al. 2013); Euler angles, which the paper averages,
    have no mean near their poles. The translation then brings the corners onto each other. The
    covariance is that of a mean of P alike: it is NaN for one placement.

    Raises:
      InputError: no cubes, or cubes that do not match.
    """
    camera_cubes = matched(camera_cubes, machine_cubes)
    frames = [
        (touched.world_from_cube, seen.world_from_cube)
        for seen, touched in zip(camera_cubes, machine_cubes, strict=True)
    ]
    turns = Rotation.from_matrix([b.rotation @ a.rotation.T for b, a in frames])
    mean = turns.mean()
    shifts = np.stack([b.translation - mean.apply(a.translation) for b, a in frames])
    pose = RigidTransform(mean.as_matrix(), shifts.mean(axis=0))
    center = np.mean([b.translation for b, _ in frames], axis=0)
    errors = np.column_stack([(turns * mean.inv()).as_rotvec(), shifts - pose.translation])
    count = len(frames)
    spread = errors.T @ errors / (count * (count - 1)) if count > 1 else np.full((6, 6), np.nan)
    residuals = _residuals(pose, camera_cubes, machine_cubes)
    return Calibration(pose, spread, center, *residuals, float("nan"))


def matched(camera_cubes: Sequence[Cube], machine_cubes: Sequence[Cube]) -> list[Cube]:
    """The camera's cubes with their faces named as the machine's.

    A cube looks the same in three attitudes. Placed twice at different tilts or places, only one
    way of naming its faces lets one motion fit all. A single placement is taken as it is given.

    Raises:
      InputError: no cubes, not as many of each, or no way to name the faces that fits better than
        all others and to 2 mm.
    """
    if not camera_cubes or len(camera_cubes) != len(machine_cubes):
        raise InputError(
            f"a calibration needs the same placements from both, at least one; got "
            f"{len(camera_cubes)} cubes of the camera and {len(machine_cubes)} of the machine"
        )
    fits = []
    for first in range(3 if len(camera_cubes) > 1 else 1):
        named = [camera_cubes[0].relabelled(first)]
        rough = _aligned(named, machine_cubes[:1])[0]
        for seen, touched in zip(camera_cubes[1:], machine_cubes[1:], strict=True):
            ways = [seen.relabelled(shift) for shift in range(3)]
            turns = [rough.rotation @ way.world_from_cube.rotation for way in ways]
            like = [np.trace(touched.world_from_cube.rotation.T @ turn) for turn in turns]
            named.append(ways[int(np.argmax(like))])
        fits.append((_aligned(named, machine_cubes)[2], first, named))
    (mismatch, _, best), *others = sorted(fits, key=lambda fit: fit[:2])
    if mismatch > MOST_MISMATCH_MM:
        raise InputError(
            f"the camera's cubes and the machine's do not match: their corners stay {mismatch:.2g} "
            "mm apart; is the order of the placements the same, and are the points of each face "
            "on that face?"
        )
    if others and others[0][0] < CLEARER * max(mismatch, 0.05):
        raise InputError(
            f"which face of the cube is which cannot be told: two ways fit to {mismatch:.2g} and "
            f"{others[0][0]:.2g} mm; turn the cube between the placements"
        )
    return best


def _corners(cube: Cube) -> np.ndarray:
    """[4, 3] mm: the corner and the next three of the cube's ideal shape."""
    offsets = -SIDE_MM * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    return cube.world_from_cube.apply(offsets)


def _aligned(
    camera_cubes: Sequence[Cube], machine_cubes: Sequence[Cube]
) -> tuple[RigidTransform, np.ndarray, float]:
    """The motion that brings corners together, the middle [3] of the machine's, and the misfit."""
    seen = np.concatenate([_corners(cube) for cube in camera_cubes])
    touched = np.concatenate([_corners(cube) for cube in machine_cubes])
    start, end = seen.mean(axis=0), touched.mean(axis=0)
    rotation = Rotation.align_vectors(touched - end, seen - start)[0].as_matrix()
    motion = RigidTransform(rotation, end - rotation @ start)
    misfit_mm = float(np.sqrt(3 * np.mean(np.square(motion.apply(seen) - touched))))
    return motion, np.mean([cube.corner for cube in machine_cubes], axis=0), misfit_mm


def _disagreement(
    seen: Face, touched: Face, center: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residual [3], its derivative [3, 6] by a small motion of ``seen``, its covariance [3, 3].

    Tilts ``U^T (n_b - n)`` in the touched plane's own axes U, then ``n . (x_b - x)`` at its middle.
    """
    normal, away = seen.normal, touched.center - seen.center
    axes = np.linalg.svd(touched.normal[None])[2][1:]  # [2, 3], U^T
    residual = np.append(axes @ (touched.normal - normal), normal @ away)
    jacobian = np.zeros((3, 6))
    # the normal turns by w x n: a row u of U^T sees -u . (w x n) = -(n x u) . w
    jacobian[:2, :3] = -np.cross(normal, axes)
    jacobian[2, :3] = np.cross(normal, touched.center - center)
    jacobian[2, 3:] = -normal
    tilt = seen.normal_covariance
    covariance = np.empty((3, 3))
    covariance[:2, :2] = axes @ (tilt + touched.normal_covariance) @ axes.T
    covariance[:2, 2] = covariance[2, :2] = -axes @ tilt @ away
    covariance[2, 2] = seen.offset_variance + touched.offset_variance + away @ tilt @ away
    # planes without noise would weigh without bounds
    return residual, jacobian, covariance + np.diag([1e-14, 1e-14, 1e-10])


def _residuals(
    machine_from_camera: RigidTransform, camera_cubes: Sequence[Cube], machine_cubes: Sequence[Cube]
) -> tuple[np.ndarray, np.ndarray]:
    """Degrees [P] between the frames of each placement, and mm [P] between its corners."""
    seen = [machine_from_camera @ cube.world_from_cube for cube in camera_cubes]
    touched = [cube.world_from_cube for cube in machine_cubes]
    pairs = list(zip(touched, seen, strict=True))
    rest = Rotation.from_matrix([b.rotation @ a.rotation.T for b, a in pairs])
    apart = [np.linalg.norm(b.translation - a.translation) for b, a in pairs]
    return np.degrees(rest.magnitude()), np.array(apart)
