"""A result of a registration, made up: for tests of what is done with one."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.localization import pose_result
from vanejax.localization.pose_result import PointStatus
from vanejax.rigid import RigidTransform


def pose(angles_deg: tuple[float, ...], translation_mm: tuple[float, ...]) -> RigidTransform:
    """A pose from angles about the fixed axes x, y, z."""
    rotation = Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix()
    return RigidTransform(rotation, np.array(translation_mm, np.float64))


def example_result(status: str = "accepted", *, sensor: bool = True) -> pose_result.PoseResult:
    """Eight checked points, two of them no inliers; without a sensor two shares are NaN."""
    found = pose((10.0, -20.0, 30.0), (1.5, -2.25, 400.125))
    points = np.array([0, 0, 0, 0, 0, 0, 2, 3], np.uint8)
    assert points[6] == PointStatus.BEHIND
    alternative = pose_result.Alternative(
        pose((190.0, -20.0, 30.0), (1.5, 2.0, 400.0)), 180.0, 0.04, 0.97
    )
    return pose_result.PoseResult(
        part_from_camera=found,
        verdict=pose_result.Verdict(status, f"made up to be {status}"),
        refinement=pose_result.Refinement(
            part_from_camera=found,
            converged=True,
            iterations=9,
            method="ray casting" if sensor else "point to plane",
            noise_mm=0.1012,
            num_points=8,
            num_inliers=6,
            information=np.diag(np.arange(1.0, 7.0)),
        ),
        uncertainty=pose_result.Uncertainty(
            covariance=np.diag([*np.radians([1e-3, 2e-3, 3e-3]), 4e-3, 5e-3, 6e-3]) ** 2,
            center=np.array([1.0, 2.0, 3.0]),
            rotation_sigma_deg=np.array([0.001, 0.002, 0.003]),
            translation_sigma_mm=np.array([0.004, 0.005, 0.006]),
            weakest_rotation_axis=np.array([0.0, 0.0, 1.0]),
            weakest_rotation_sigma_deg=0.003,
            weakest_translation_axis=np.array([0.0, 0.6, 0.8]),
            weakest_translation_sigma_mm=0.0061,
        ),
        verification=pose_result.Verification(
            inlier_share=0.75,
            violation_share=0.125 if sensor else np.nan,
            unmeasured_share=0.031 if sensor else np.nan,
            missing_share=0.031 if sensor else np.nan,
            tolerance_mm=0.31,
            checked=np.arange(8),
            status=points,
            deviation_mm=np.array([0.1, -0.1, 0.0, 0.05, 0.0, 0.1, np.nan, np.nan]),
            score=1.0,
        ),
        alternatives=(alternative,) if status == "ambiguous" else (),
        before=pose((12.0, -20.0, 30.0), (1.0, -2.0, 399.0)),
        sensor_origin=np.zeros(3) if sensor else None,
        notes=("2 points were dropped",),
        seconds={"search": 1.25, "refinement": 0.5},
    )
