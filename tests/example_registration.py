"""A registration of a virtual scan whose true pose, noise and deviations are known."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.cad.parametric_vane import guide_vane
from vanejax.cad.part import Part
from vanejax.localization import pose_result
from vanejax.localization.pose_result import PointStatus
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Camera, hemisphere_viewpoints
from vanejax.scanner.virtual_scanner import Scanner
from vanejax.scans.measured_scan import MeasuredScan

NOISE_MM = 0.1
TOLERANCE_MM = 0.4


@dataclasses.dataclass(frozen=True, eq=False)
class Registration:
    """What a report is made of; ``truth`` is the pose that the scan was made with."""

    part: Part
    scan: MeasuredScan
    result: pose_result.PoseResult
    truth: RigidTransform

    def replace(self, **changes: object) -> Registration:
        """With other fields of the result."""
        return dataclasses.replace(self, result=dataclasses.replace(self.result, **changes))


@functools.cache
def example_registration(status: str = "accepted") -> Registration:
    """The guide vane, 0.1 mm of noise along the rays, 2 % of the points without a partner.

    The guess is 3 deg and 3 mm off; the result is 0.002 deg and 0.005 mm off.
    """
    part = guide_vane()
    rng = np.random.default_rng(0)
    view = hemisphere_viewpoints(part.center).view(103)
    ideal = Scanner(part).scan(Camera().scaled(0.3), view)
    error = rng.normal(0, NOISE_MM, len(ideal.points))
    lost = rng.random(len(error)) < 0.02
    error[lost] = rng.normal(0, 4, np.count_nonzero(lost))
    points = ideal.points.astype(np.float64)
    points *= 1 + error[:, None] / np.linalg.norm(points, axis=1, keepdims=True)
    # away from the sensor is into the material
    deviation = np.where(lost, np.nan, -error * np.cos(np.radians(ideal.incidence_deg)))
    point_status = np.where(lost, PointStatus.BESIDE, PointStatus.INLIER).astype(np.uint8)
    point_status[deviation > TOLERANCE_MM] = PointStatus.BEFORE
    point_status[deviation < -TOLERANCE_MM] = PointStatus.BEHIND
    truth = view.inverse()
    off = _motion(part, 3.0 * np.array([0.6, -0.64, 0.48]), [2.0, -1.0, 2.0])
    found = _motion(part, [0.0, 0.002, 0.0], [0.003, 0.0, -0.004]) @ truth
    flipped = _motion(part, [0.0, 0.0, 180.0], [0.0, 0.0, 0.0]) @ truth
    alternative = pose_result.Alternative(flipped, 180.0, 0.2, 0.95)
    sigma = np.array([2e-5, 1e-5, 3e-5, 0.002, 0.003, 0.0015])
    share = {s: float((point_status == s).mean()) for s in PointStatus}
    result = pose_result.PoseResult(
        part_from_camera=found,
        verdict=pose_result.Verdict(status, f"made up to be {status}"),
        refinement=pose_result.Refinement(
            part_from_camera=found,
            converged=True,
            iterations=7,
            method="ray casting",
            noise_mm=NOISE_MM,
            num_points=len(points),
            num_inliers=int(np.count_nonzero(point_status == PointStatus.INLIER)),
            information=np.diag(sigma**-2),
        ),
        uncertainty=pose_result.Uncertainty(
            covariance=np.diag(sigma**2),
            center=part.center,
            rotation_sigma_deg=np.degrees(sigma[:3]),
            translation_sigma_mm=sigma[3:],
            weakest_rotation_axis=np.array([0.0, 0.0, 1.0]),
            weakest_rotation_sigma_deg=float(np.degrees(sigma[2])),
            weakest_translation_axis=np.array([0.0, 1.0, 0.0]),
            weakest_translation_sigma_mm=0.003,
        ),
        verification=pose_result.Verification(
            inlier_share=share[PointStatus.INLIER],
            violation_share=share[PointStatus.BEHIND],
            unmeasured_share=0.031,
            missing_share=0.031,
            tolerance_mm=TOLERANCE_MM,
            checked=np.arange(len(points)),
            status=point_status,
            deviation_mm=deviation,
            score=0.9,
        ),
        alternatives=(alternative,) if status == "ambiguous" else (),
        before=off @ truth,
        sensor_origin=np.zeros(3),
        notes=("The sensor looks along -z.",),
        seconds={"search": 1.25, "refinement": 0.5},
    )
    scan = MeasuredScan(points, ideal.normals, np.zeros(3), "casting_0417", ("2 points dropped.",))
    return Registration(part, scan, result, truth)


def _motion(part: Part, turn_deg: list[float] | np.ndarray, move_mm: list[float]) -> RigidTransform:
    """A motion in the part's frame: a turn about the part's centre, then a translation."""
    rotation = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    return RigidTransform(rotation, part.center - rotation @ part.center + np.array(move_mm))
