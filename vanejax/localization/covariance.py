"""How sure a refined pose is: covariance, its weakest directions, and errors that go together.

``J^T W J`` knows independent errors only. Errors of neighbouring points that go together
(calibration, quantisation, a casting that is not its CAD model) carry less information than their
number says. The scores of patches of the scan tell by how much: they vary more than independent
points would let them (the cluster-robust sandwich, Liang and Zeger 1986). What is smooth over half
the part and more is taken for a motion, and no residual shows it.
"""

from __future__ import annotations

import numpy as np

from vanejax.localization.pose_result import Refinement, Uncertainty

# of the scan, along the longer side of its view, and how many times the variance of independent
# points their scores must show: white noise stays below
PATCHES = {16: 1.4, 8: 1.8}


def uncertainty(refinement: Refinement, center: np.ndarray) -> Uncertainty:
    """Covariance and its weakest directions from the information of a refinement."""
    values, vectors = np.linalg.eigh(_scaled(refinement.information, 100.0))
    # nothing is known worse than by half a turn, or by that much at 100 mm
    values = np.maximum(values, 1 / (100.0 * np.pi) ** 2)
    covariance = _scaled(vectors / values @ vectors.T, 100.0)
    turn, shift = covariance[:3, :3], covariance[3:, 3:]
    turn_values, turn_axes = np.linalg.eigh(turn)
    shift_values, shift_axes = np.linalg.eigh(shift)
    return Uncertainty(
        covariance=covariance,
        center=np.asarray(center, np.float64),
        rotation_sigma_deg=np.degrees(np.sqrt(np.diag(turn))),
        translation_sigma_mm=np.sqrt(np.diag(shift)),
        weakest_rotation_axis=_pointing_up(turn_axes[:, -1]),
        weakest_rotation_sigma_deg=float(np.degrees(np.sqrt(turn_values[-1]))),
        weakest_translation_axis=_pointing_up(shift_axes[:, -1]),
        weakest_translation_sigma_mm=float(np.sqrt(shift_values[-1])),
    )


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
