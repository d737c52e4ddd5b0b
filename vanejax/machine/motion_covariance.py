"""How well a place in a machine is known: covariances of small motions.

An error is a small motion about a centre, applied after what is reported, as in
`vanejax.machine.positioning`; all is first order in it. Host code, float64, mm, rad.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.linalg import block_diag

from vanejax.errors import InputError
from vanejax.localization.pose_result import magnitude_bound
from vanejax.machine.positioning import recentred
from vanejax.rigid import RigidTransform

FARTHEST_MM = 1e7  # ten kilometres: no machine is larger
BLOCK = 100_000  # points at once


@dataclasses.dataclass(frozen=True, eq=False)
class MotionCovariance:
    """The covariance of a small motion, and the point that it is about.

    That of an error applied after ``part_from_camera`` is, moved to the machine by
    ``machine_from_part``, that of the error applied after ``machine_from_part``: the opposite
    motion, with the same covariance.

    Attributes:
      covariance: [6, 6], of (rotation vector in rad, translation in mm).
      center: [3] mm.

    Raises:
      InputError: a centre that is more than `FARTHEST_MM` away.
    """

    covariance: np.ndarray
    center: np.ndarray

    def __post_init__(self) -> None:
        _check_near(self.center)

    @classmethod
    def alike(cls, center: np.ndarray, *, sigma_mm: float, sigma_deg: float) -> MotionCovariance:
        """One standard deviation along each axis, and one about each, independent at a centre."""
        sigma = np.repeat([np.radians(sigma_deg), sigma_mm], 3)
        return cls(np.diag(sigma**2), np.asarray(center, np.float64))

    def moved(self, target_from_this: RigidTransform) -> MotionCovariance:
        """The same motion seen in another frame."""
        turn = block_diag(target_from_this.rotation, target_from_this.rotation)
        center = target_from_this.apply(self.center[None])[0]
        return MotionCovariance(turn @ self.covariance @ turn.T, center)

    def with_independent(self, other: MotionCovariance) -> MotionCovariance:
        """Of both motions, one after the other, in the same frame; about this one's centre."""
        way = recentred(other.center, self.center)
        return MotionCovariance(self.covariance + way @ other.covariance @ way.T, self.center)

    def bounds_mm(self, points: np.ndarray) -> np.ndarray:
        """[N]: what the error of each of the points [N, 3] mm exceeds in 5 of 100 cases.

        Raises:
          InputError: a point that is more than `FARTHEST_MM` away.
        """
        _check_near(points)
        arms = np.asarray(points, np.float64) - self.center
        blocks = np.array_split(arms, len(arms) // BLOCK + 1)
        return np.concatenate([magnitude_bound(self._at(block)) for block in blocks])

    def _at(self, arms: np.ndarray) -> np.ndarray:
        """[n, 3, 3] mm^2, of points by their arms [n, 3] mm."""
        ways = np.zeros((len(arms), 3, 6))  # of a rotation vector w and a shift v: w x arm + v
        ways[:, :, :3] = np.cross(np.eye(3), arms[:, None, :]).swapaxes(1, 2)
        ways[:, :, 3:] = np.eye(3)
        return ways @ self.covariance @ ways.swapaxes(1, 2)


def _check_near(points: np.ndarray) -> None:
    if not np.all(np.abs(points) <= FARTHEST_MM):
        raise InputError(
            f"a point lies more than {FARTHEST_MM:g} mm away: check the unit of the pose, of the "
            "camera's place and of the path; it should be mm"
        )
