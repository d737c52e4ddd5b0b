"""How sure a refined pose is: covariance, its weakest directions, and errors that go together.

``J^T W J`` knows independent errors only. Errors of neighbouring points that go together
(calibration, quantisation, a casting that is not its CAD model) carry less information than their
number says. The scores of patches of the scan tell by how much: they vary more than independent
points would let them (the cluster-robust sandwich, Liang and Zeger 1986). What is smooth over half
the part and more is taken for a motion, and no residual shows it.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vanejax.cad.symmetry import Axis
from vanejax.localization.pose_result import Refinement, Uncertainty
from vanejax.rigid import RigidTransform

# of the scan, along the longer side of its view, and how many times the variance of independent
# points their scores must show: white noise stays below
PATCHES = {16: 1.4, 8: 1.8}
ACROSS = 1e-6  # of a unit vector: an axis with no more of the free one is square to it


def uncertainty(
    refinement: Refinement, center: np.ndarray, free_axis: Axis | None = None
) -> Uncertainty:
    """Covariance and its weakest directions from the information of a refinement.

    Args:
      refinement: with its information.
      center: [3] mm, of the part.
      free_axis: about which the part's rotation is free by symmetry, point [3] mm and direction
        [3]. Of equivalent errors that without such a rotation counts: the information of these.
    """
    # the errors that count: all, or those that do not turn about the free axis
    errors = np.eye(6)
    if free_axis is not None:
        across = np.linalg.svd(free_axis[1][None])[2][1:]
        errors = np.delete(errors, 0, axis=1)
        errors[:3, :2] = across.T
    information = errors.T @ _scaled(refinement.information, 100.0) @ errors
    values, vectors = np.linalg.eigh(information)
    # nothing is known worse than by half a turn, or by that much at 100 mm
    values = np.maximum(values, 1 / (100.0 * np.pi) ** 2)
    vectors = errors @ vectors
    covariance = _scaled(vectors / values @ vectors.T, 100.0)
    turn, shift = covariance[:3, :3], covariance[3:, 3:]
    turn_values, turn_axes = np.linalg.eigh(turn)
    shift_values, shift_axes = np.linalg.eigh(shift)
    rotation_sigma_deg = np.degrees(np.sqrt(np.diag(turn)))
    if free_axis is not None:
        rotation_sigma_deg[np.abs(free_axis[1]) > ACROSS] = np.inf
    return Uncertainty(
        covariance=covariance,
        center=np.asarray(center, np.float64),
        rotation_sigma_deg=rotation_sigma_deg,
        translation_sigma_mm=np.sqrt(np.diag(shift)),
        weakest_rotation_axis=_pointing_up(turn_axes[:, -1]),
        weakest_rotation_sigma_deg=float(np.degrees(np.sqrt(turn_values[-1]))),
        weakest_translation_axis=_pointing_up(shift_axes[:, -1]),
        weakest_translation_sigma_mm=float(np.sqrt(shift_values[-1])),
        free_axis=None if free_axis is None else free_axis[1],
    )


def moved_to(refinement: Refinement, pose: RigidTransform, center: np.ndarray) -> Refinement:
    """The refinement at an equivalent pose, its information [6, 6] in the part's frame there.

    An error e of the old pose is the error ``moves @ e`` of the new one, about the same centre [3].
    """
    motion = pose @ refinement.part_from_camera.inverse()
    turn = motion.rotation
    offset = motion.apply(center[None])[0] - center  # of the point that the old errors are about
    moves = np.zeros((6, 6))
    moves[:3, :3] = moves[3:, 3:] = turn
    moves[3:, :3] = np.cross(offset, turn, axisb=0, axisc=0)
    back = np.linalg.inv(moves)
    information = back.T @ refinement.information @ back
    return dataclasses.replace(refinement, part_from_camera=pose, information=information)


def _scaled(matrix: np.ndarray, length: float) -> np.ndarray:
    """With rotations counted as the way they move a point at ``length`` mm, or the reverse."""
    unit = np.array([1 / length] * 3 + [1.0] * 3)
    return matrix * np.outer(unit, unit)


def _pointing_up(axis: np.ndarray) -> np.ndarray:
    """Of the two signs of an axis, that with its largest component positive."""
    return axis * np.sign(axis[np.argmax(np.abs(axis))])


def inflation(information: np.ndarray, scores: np.ndarray, patches: list[np.ndarray]) -> float:
    """How much more the patches' scores vary than independent points would; at least 1.

    The median over the six directions of the sandwich's ratio, at each size of patches; the
    largest that is more than chance.

    Args:
      information: [6, 6].
      scores: [n, 6] of the points, with zero mean.
      patches: for each size of `PATCHES`, [n] the patch of each point.
    """
    largest = 1.0
    for patch, chance in zip(patches, PATCHES.values(), strict=True):
        totals = np.stack([np.bincount(patch, weights=column) for column in scores.T], axis=1)
        count = len(totals)
        if count < 20:
            continue
        between = totals.T @ totals * count / (count - 6)
        try:
            ratio = np.linalg.eigvals(np.linalg.solve(information, between)).real
        except np.linalg.LinAlgError:
            continue
        if np.median(ratio) > chance:
            largest = max(largest, float(np.median(ratio)))
    return largest
