"""Batches of poses, [H, 3, 3] and [H, 3] mm: put together, compared, thinned to distinct ones."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.cad.declared_symmetry import PartSymmetry
from vanejax.cad.part import Part
from vanejax.rigid import RigidTransform

SAME_DEG, SAME_SHIFT = 3.0, 0.03  # poses nearer than both (of the part's radius) are one


def stack(*poses: RigidTransform) -> RigidTransform:
    """A batch of single poses."""
    return RigidTransform(
        np.stack([pose.rotation for pose in poses]), np.stack([pose.translation for pose in poses])
    )


def select(poses: RigidTransform, which: int | np.ndarray | slice) -> RigidTransform:
    """Some of a batch, or one of them."""
    return RigidTransform(poses.rotation[which], poses.translation[which])


def concatenate(*batches: RigidTransform) -> RigidTransform:
    """Batches, one after the other."""
    return RigidTransform(
        np.concatenate([batch.rotation for batch in batches]),
        np.concatenate([batch.translation for batch in batches]),
    )


def distances(
    poses: RigidTransform, other: RigidTransform, part: Part, symmetry: PartSymmetry | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """[H] deg and [H] mm between H poses and one other; the shift is of the part's centre.

    Of poses that are one by the part's symmetry the nearest counts.
    """
    if symmetry is not None:
        poses = symmetry.nearest(poses, other)
    between = other.rotation @ poses.rotation.swapaxes(-1, -2)
    angle_deg = np.degrees(Rotation.from_matrix(between.reshape(-1, 3, 3)).magnitude())
    # where the other pose puts what each pose has at the centre
    camera = np.einsum("hji,hj->hi", poses.rotation, part.center - poses.translation)
    shift = camera @ other.rotation.T + other.translation - part.center
    return angle_deg, np.linalg.norm(shift, axis=-1)


def is_same(angle_deg: np.ndarray, shift_mm: np.ndarray, part: Part) -> np.ndarray:
    """Whether poses at these `distances` count as one."""
    return (angle_deg < SAME_DEG) & (shift_mm < SAME_SHIFT * part.radius)


def distinct(
    poses: RigidTransform, part: Part, most: int, symmetry: PartSymmetry | None = None
) -> np.ndarray:
    """Indices of at most ``most`` poses that are not near one before them, see `distances`."""
    kept: list[int] = []
    for index in range(len(poses.rotation)):
        known = select(poses, np.array(kept, int))
        near = distances(known, select(poses, index), part, symmetry)
        if not is_same(*near, part).any():
            kept.append(index)
        if len(kept) == most:
            break
    return np.array(kept, int)
