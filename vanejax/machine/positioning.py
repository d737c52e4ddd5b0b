"""How far a part was turned and moved between two registrations, and how well that is known.

Section IV of the paper, whose camera is fixed. An error e [6] is a small motion about a centre c,
after what is reported, as in `vanejax.localization.pose_result.Uncertainty`:
``x -> c + exp(e[:3]) (x - c) + e[3:]``, (rad, mm); all is first order in it. Host code, float64.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.rigid import RigidTransform

_STILL_RAD = 1e-9  # less is no rotation: its axis is a rounding error
_FLIPPED = 1e-9  # of half a turn of swing: then every twist fits


def camera_motion(before: RigidTransform, after: RigidTransform) -> RigidTransform:
    """The part's motion in the camera's frame, from poses part_from_camera before and after it.

    A point of the part, at x in the camera's frame before, is at ``motion.apply(x)`` after:
    ``camera_from_part(after) @ part_from_camera(before)``. The paper's ``T = T2 T1^-1`` is the same
    with T = camera_from_part. With part_from_camera in that order it would be the motion of the
    camera in the *part's* frame: another axis, and the opposite angle.
    """
    return after.inverse() @ before


def in_machine(motion: RigidTransform, machine_from_camera: RigidTransform) -> RigidTransform:
    """The same motion in the machine's frame (eq. 13): ``T_CCM = T_b T_camera T_b^-1``.

    Its rotation has the same angle; its translation is that of the point at the machine's origin.
    """
    return machine_from_camera @ motion @ machine_from_camera.inverse()


def displacement(motion: RigidTransform, point: np.ndarray) -> np.ndarray:
    """[3] mm: where the motion brings a point [3] of its frame, less where it was.

    Compare displacements at the part: an error of the angle grows with the distance.
    """
    point = np.asarray(point, np.float64)
    return motion.rotation @ point + motion.translation - point


class Twist(NamedTuple):
    """A rotation as a turn about a known axis, then a swing about one square to it.

    The turn is above -180 and up to 180 deg, the swing (0 for a rotation about that axis) 0 to 180.
    """

    angle_deg: float
    swing_deg: float


def twist_about(rotation: np.ndarray, axis: np.ndarray) -> Twist:
    """The turn of a rotation [3, 3] about an axis [3] nearest to it: swing-twist decomposition.

    Raises:
      InputError: an axis that is no direction, or a rotation that swings by half a turn.
    """
    real, along, imaginary, axis = _about(rotation, axis)
    length = float(np.hypot(real, along))
    if length < _FLIPPED:
        raise InputError(
            "the rotation turns the axis round (swing 180 deg): it has no angle about it; is the "
            "axis given in the rotation's frame?"
        )
    angle = np.degrees(2 * np.arctan2(along, real))
    across = float(np.linalg.norm(imaginary - along * axis))
    swing = float(np.degrees(2 * np.arctan2(across, length)))
    return Twist(float(wrapped_deg(angle)), swing)


def wrapped_deg(angle: np.ndarray | float) -> np.ndarray | float:
    """The same angle above -180 and up to 180 deg."""
    return -np.mod(180.0 - np.asarray(angle, np.float64), 360.0) + 180.0


def _about(rotation: np.ndarray, axis: np.ndarray) -> tuple[float, float, np.ndarray, np.ndarray]:
    """The quaternion's real part, its imaginary part along the axis and whole; the unit axis."""
    axis = np.asarray(axis, np.float64)
    length = np.linalg.norm(axis)
    if axis.shape != (3,) or not 0 < length < np.inf:
        raise InputError(f"an axis must be a direction, three numbers not all 0; got {axis}")
    axis = axis / length
    quaternion = Rotation.from_matrix(rotation).as_quat(canonical=True)
    imaginary = quaternion[:3]
    return float(quaternion[3]), float(imaginary @ axis), imaginary, axis


def common_axis(rotations: np.ndarray) -> np.ndarray:
    """[3] unit: the axis that rotations [K, 3, 3] share best, of a rotary stage for example.

    The principal direction of the quaternions' imaginary parts, with the sign of most turns.

    Raises:
      InputError: no rotation, or none that turns by more than rounding.
    """
    rotations = np.asarray(rotations, np.float64).reshape(-1, 3, 3)
    if not len(rotations):
        raise InputError("no rotation to find an axis from")
    imaginary = Rotation.from_matrix(rotations).as_quat(canonical=True)[:, :3]
    values, vectors = np.linalg.eigh(imaginary.T @ imaginary)
    if values[-1] < _STILL_RAD**2:
        raise InputError("no rotation to find an axis from: turn the part between the scans")
    axis = vectors[:, -1]
    return axis if np.sum(imaginary @ axis) >= 0 else -axis


def probe_translation(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """[3] mm: the mean motion of probed points [K, 3], the true translation of eq. 12.

    As printed, ``1/4 sum(1P_i - jP_i)``, it is the way back from position j to the first; here it
    is the way there, as T2 T1^-1 is. Raises `InputError` for points that are not alike in number.
    """
    before, after = np.asarray(before, np.float64), np.asarray(after, np.float64)
    if before.shape != after.shape or before.ndim != 2 or before.shape[1] != 3 or not len(before):
        raise InputError(
            f"probed points must be [K, 3] mm, the same before and after; got {before.shape} and "
            f"{after.shape}"
        )
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        raise InputError("probed points must be finite, in mm")
    return np.mean(after - before, axis=0)


def recentred(center: np.ndarray, new_center: np.ndarray) -> np.ndarray:
    """[6, 6]: a small motion about ``center`` as one about ``new_center``: v + w x (new - old)."""
    x, y, z = np.asarray(new_center, np.float64) - center
    out = np.eye(6)
    out[3:, :3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    return out


class MotionErrors(NamedTuple):
    """How errors of two registrations and of the calibration reach the motion they give.

    The error of the motion, a small motion about ``center`` applied after it, is
    ``of_before @ e_before + of_after @ e_after + of_calibration @ e_calibration``.

    Attributes:
      center: [3] mm, machine frame: the part's centre after the motion.
      of_before, of_after: [6, 6], of errors as `Uncertainty` has them, about the part's centre;
        opposite: what both registrations have in common cancels.
      of_calibration: [6, 6], of an error of machine_from_camera, applied after it.
    """

    center: np.ndarray
    of_before: np.ndarray
    of_after: np.ndarray
    of_calibration: np.ndarray

    def covariance(
        self, before: np.ndarray, after: np.ndarray, calibration: np.ndarray | None = None
    ) -> np.ndarray:
        """[6, 6] of the motion, from independent covariances [6, 6]; None for a known frame."""
        pairs = zip(self[1:], (before, after, calibration), strict=True)
        return sum(way @ matrix @ way.T for way, matrix in pairs if matrix is not None)

    def common(
        self, before: np.ndarray, after: np.ndarray, calibration: np.ndarray | None = None
    ) -> np.ndarray:
        """[6, K]: the error of the motion by K causes that act on everything at once.

        Each has a column in every argument. ``common @ common.T`` is a covariance if the columns
        are for one standard deviation of independent causes.
        """
        pairs = zip(self[1:], (before, after, calibration), strict=True)
        return sum(way @ columns for way, columns in pairs if columns is not None)


def motion_errors(
    before: RigidTransform,
    after: RigidTransform,
    part_center: np.ndarray,
    *,
    machine_from_camera: RigidTransform | None = None,
    calibration_center: np.ndarray | None = None,
) -> MotionErrors:
    """Where errors of poses part_from_camera go in ``in_machine(camera_motion(before, after))``.

    With the errors E of the poses and of the calibration B, all applied after them, the true motion
    is ``E_B (B after^-1 (E_after^-1 E_before) after B^-1) (M E_B^-1 M^-1) M``.

    Args:
      part_center: [3] mm, part frame, about which the errors of the poses are.
      machine_from_camera: None: the machine's frame is the camera's.
      calibration_center: [3] mm, machine frame, about which its error is; None for its origin.
    """
    if machine_from_camera is None:
        machine_from_camera = RigidTransform.identity(dtype=np.float64)
    machine_from_part = machine_from_camera @ after.inverse()
    center = machine_from_part.rotation @ part_center + machine_from_part.translation
    carried = block_diag(machine_from_part.rotation, machine_from_part.rotation)
    motion = in_machine(camera_motion(before, after), machine_from_camera)
    place = np.zeros(3) if calibration_center is None else np.asarray(calibration_center)
    arrived = motion.rotation @ place + motion.translation
    turned = block_diag(motion.rotation, motion.rotation)
    calibration = recentred(place, center) - recentred(arrived, center) @ turned
    return MotionErrors(center, carried, -carried, calibration)


def angle_sigma_deg(covariance: np.ndarray, rotation: np.ndarray, axis: np.ndarray) -> float:
    """Standard deviation of `twist_about`'s angle, from a motion's covariance [6, 6].

    With the quaternion (q0, q), a small rotation afterwards changes the angle by its product with
    ``(q0 (q0 a + q x a) + (q . a) q) / (q0^2 + (q . a)^2)``: a, of a rotation about the axis a.
    """
    real, along, imaginary, axis = _about(rotation, axis)
    turned_axis = real * axis + np.cross(imaginary, axis)
    gradient = (real * turned_axis + along * imaginary) / (real**2 + along**2)
    return float(np.degrees(np.sqrt(gradient @ covariance[:3, :3] @ gradient)))


def displacement_covariance(
    covariance: np.ndarray, center: np.ndarray, arrived: np.ndarray
) -> np.ndarray:
    """[3, 3] mm^2, of `displacement`, from a motion's covariance [6, 6] about ``center``.

    ``arrived`` [3] is where the motion brings the point; the point before it is taken as known.
    """
    way = recentred(center, arrived)[3:]
    return way @ covariance @ way.T
