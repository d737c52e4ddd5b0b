"""Motions that put a part onto itself: symmetries of simple solids, and the pitch of a ring."""

from __future__ import annotations

import numpy as np
import pytest
from example_scans import box, motion, vane
from scipy.spatial.transform import Rotation

from vanejax.localization.pose_batch import distances
from vanejax.localization.self_similarity import (
    LEAST_SHIFT,
    LEAST_TURN_DEG,
    STILL,
    moved_by,
    self_similar_motions,
)
from vanejax.rigid import RigidTransform

PITCH_DEG = 360 / 54
RING_MM = 303.0  # from the engine's axis to the middle of the part


def test_half_turns_of_a_box_are_found() -> None:
    motions = self_similar_motions(box())
    for axis in np.eye(3):
        angle, shift = distances(motions, motion(box(), 180 * axis, np.zeros(3)), box())
        assert np.min(angle + shift) < 0.5


def test_quarter_turns_of_a_square_prism_are_found() -> None:
    prism = box(40.0, 40.0, 90.0)
    for turn in (90, -90, 180):
        expected = motion(prism, [0, 0, turn], [0, 0, 0])
        angle, shift = distances(self_similar_motions(prism), expected, prism)
        assert np.min(angle + shift) < 0.5


@pytest.mark.parametrize("sign", [1, -1])
def test_a_pitch_along_the_ring_is_found(sign: int) -> None:
    """Of a vane segment, whose pitch turns as well, and whose principal axes lie oblique to it."""
    motions = self_similar_motions(vane())
    turn_deg = np.degrees(Rotation.from_matrix(motions.rotation).as_rotvec())
    _, shift_mm = distances(motions, STILL, vane())
    off = np.linalg.norm(turn_deg - [0, 0, sign * PITCH_DEG], axis=1)
    nearest = int(np.argmin(off + np.abs(shift_mm - RING_MM * np.radians(PITCH_DEG))))
    # a scan's own convergence does the rest
    assert off[nearest] < 0.5
    assert shift_mm[nearest] == pytest.approx(RING_MM * np.radians(PITCH_DEG), abs=2.0)


def test_none_leaves_the_part_nearly_still() -> None:
    angle, shift = distances(self_similar_motions(vane()), STILL, vane())
    assert np.all((angle > LEAST_TURN_DEG) | (shift > LEAST_SHIFT * vane().radius))
    assert len(angle) > 4


def test_a_pose_is_moved_in_the_parts_frame() -> None:
    pose = motion(box(), [10, 20, 30], [1, 2, 3])
    motions = self_similar_motions(box())
    moved = moved_by(motions, pose)
    points = np.random.default_rng(0).normal(size=(5, 3))
    first = RigidTransform(motions.rotation[0], motions.translation[0])
    np.testing.assert_allclose(
        RigidTransform(moved.rotation[0], moved.translation[0]).apply(points),
        first.apply(pose.apply(points)),
        atol=1e-12,
    )
