"""What registering one scan to one part gives: a pose, how sure it is, and whether to trust it.

Frames. ``camera`` is the frame of the scan's file, whatever sensor wrote it; ``part`` is that of
the CAD model. Everything is float64, millimetres and, where a name ends in ``_deg``, degrees.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping
from typing import Literal

import numpy as np
from scipy.special import gammaincinv

from vanejax.cad.declared_symmetry import PartSymmetry
from vanejax.rigid import RigidTransform

SURE = 0.95  # of the errors are within a bound
BOUND = 1.96  # standard deviations: the same along one axis
BEYOND_EDGES_MM = 3.0  # off the part by more is clutter
Status = Literal["accepted", "ambiguous", "rejected"]
FieldKind = Literal["none", "form", "displacement", "range", "facing"]


class PointStatus(enum.IntEnum):
    """What a measured point says about a pose.

    INLIER: it lies on the part, within what the noise explains.
    BEFORE: the ray should have gone on to the part: dust, a fixture, or a wrong pose.
    BEHIND: the ray went through material: no sensor sees that, a free-space violation.
    BESIDE: the ray, or where the sensor is unknown the point, does not meet the part at all.
    """

    INLIER = 0
    BEFORE = 1
    BEHIND = 2
    BESIDE = 3


@dataclasses.dataclass(frozen=True, eq=False)
class Uncertainty:
    """How far the pose may be off.

    The error is a small motion in the part's frame about the part's centre c: the true
    ``part_from_camera`` maps to ``c + exp(e[:3]) (x - c) + e[3:]`` what the reported one maps to x.
    Errors of the sensor's calibration count where they are given (`Calibration`), or show.

    Attributes:
      covariance: [6, 6], of e = (rotation vector in rad, translation in mm).
      center: [3] mm, c.
      rotation_sigma_deg: [3], about the part's x, y, z; infinite where a free rotation turns.
      translation_sigma_mm: [3], along the part's x, y, z, at its centre.
      weakest_rotation_axis: [3] unit, the axis about which the rotation is least certain.
      weakest_rotation_sigma_deg: about that axis.
      weakest_translation_axis: [3] unit, the direction in which the translation is least certain.
      weakest_translation_sigma_mm: along it.
      free_axis: [3] unit, part frame: about it the rotation is free by the part's symmetry, and
        the covariance is of the equivalent error that does not turn about it; None where there is
        none.
    """

    covariance: np.ndarray
    center: np.ndarray
    rotation_sigma_deg: np.ndarray
    translation_sigma_mm: np.ndarray
    weakest_rotation_axis: np.ndarray
    weakest_rotation_sigma_deg: float
    weakest_translation_axis: np.ndarray
    weakest_translation_sigma_mm: float
    free_axis: np.ndarray | None = None

    @property
    def rotation_bound_deg(self) -> float:
        """What the angle of the error exceeds in 5 of 100 cases."""
        return float(np.degrees(magnitude_bound(self.covariance[:3, :3])))

    @property
    def translation_bound_mm(self) -> float:
        """What the length of the error, at the part's centre, exceeds in 5 of 100 cases."""
        return float(magnitude_bound(self.covariance[3:, 3:]))


def magnitude_bound(covariance: np.ndarray) -> np.ndarray:
    """What the length of a Gaussian error [..., 3] exceeds in 5 of 100 cases.

    By the chi-square distribution with the same first three moments of the squared length, which
    is exact where the axes are equal or one is alone. Source: Imhof, Biometrika 48, 1961.

    Args:
      covariance: [..., 3, 3]; the result is in the unit of its square root.
    """
    second = covariance @ covariance
    first, second, third = (
        np.trace(power, axis1=-2, axis2=-1) for power in (covariance, second, second @ covariance)
    )
    some = third > 0
    degrees = np.where(some, second, 1) ** 3 / np.where(some, third, 1) ** 2
    quantile = 2 * gammaincinv(degrees / 2, SURE)
    squared = first + (quantile - degrees) * np.sqrt(np.where(some, second, 0) / degrees)
    return np.sqrt(np.maximum(squared, 0))


@dataclasses.dataclass(frozen=True)
class FormDeviation:
    """How a part as scanned differs from its CAD model, see `vanejax.localization.form_deviation`.

    What is 0 is not there: the scan does not prefer a model that has it. Sigmas are standard
    deviations, the pose and all else not being known either.

    Attributes:
      stock_mm, stock_sigma_mm: uniform offset of the surface along its outward normals.
      scale_error, scale_sigma: how much larger the scan is than the CAD model, relative: the part
        is, or the camera's scale is off.
      focal_error, focal_sigma: likewise, across the line of sight only: the camera's focal length.
      field: what else there is, smooth over the surface: "none", "form" (along the normal),
        "displacement" (in all directions alike), "range" (the sensor's), or "facing" (faces that
        look the same way are offset alike).
      field_mm: its standard deviation.
      field_length_mm: over which it is smooth.
      unexplained_share: of the patches of the scan, those that nothing explains.
      beyond_edges_share: of the points, those that lie clearly beyond the part's edges, by no more
        than `BEYOND_EDGES_MM`.
      converged: whether the estimate stayed the same in the end.
      is_told: whether there was enough smooth surface to tell.
    """

    stock_mm: float = 0.0
    stock_sigma_mm: float = 0.0
    scale_error: float = 0.0
    scale_sigma: float = 0.0
    focal_error: float = 0.0
    focal_sigma: float = 0.0
    field: FieldKind = "none"
    field_mm: float = 0.0
    field_length_mm: float = 0.0
    unexplained_share: float = 0.0
    beyond_edges_share: float = 0.0
    converged: bool = True
    is_told: bool = True

    @property
    def is_as_designed(self) -> bool:
        """Whether the scan shows no difference."""
        return not (self.stock_mm or self.scale_error or self.focal_error or self.field_mm)


@dataclasses.dataclass(frozen=True, eq=False)
class Refinement:
    """How a fine registration ended.

    Attributes:
      part_from_camera: the refined pose.
      converged: whether the last step was below what the noise lets one know.
      iterations: Gauss-Newton steps, all stages together.
      method: ``"ray casting"``, or ``"point to plane"`` where the sensor's place is unknown.
      noise_mm: robust standard deviation of the residuals of the inliers, along the ray (ray
        casting) or along the surface normal (point to plane).
      num_points: points used in the last step.
      num_inliers: of them, those with a weight.
      information: [6, 6], J^T W J of the last step: the inverse of `Uncertainty.covariance`, in
        the same coordinates.
      form: how the part differs from its CAD model; None where nobody asked.
    """

    part_from_camera: RigidTransform
    converged: bool
    iterations: int
    method: str
    noise_mm: float
    num_points: int
    num_inliers: int
    information: np.ndarray
    form: FormDeviation | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class MaterialRegion:
    """A region in which a scan is not as the CAD model, see `vanejax.localization.material`.

    Attributes:
      is_missing: whether the CAD model has material there that the scan was seen through; else the
        scan has points there outside of the CAD model.
      share: of the scan's points, 0 to 1, those of the region.
      area_mm2: of the surface that was measured there, about.
      center: [3] mm, part frame, its middle.
      depth_mm: how deep it is, or how far outside: all but the outermost 5 % of its points.
    """

    is_missing: bool
    share: float
    area_mm2: float
    center: np.ndarray
    depth_mm: float


@dataclasses.dataclass(frozen=True, eq=False)
class Verification:
    """What the scan says about a pose.

    Attributes:
      inlier_share: of the points that were checked, 0 to 1.
      violation_share: points of status BEHIND, 0 to 1; NaN where the sensor's place is unknown.
      unmeasured_share: of the part's surface that the sensor should have seen, what has no
        measurement, 0 to 1; NaN where the sensor's place is unknown.
      missing_share: likewise, without what is outside the measured region: that may have been cut
        off.
      tolerance_mm: the largest deviation of an inlier.
      checked: [n] i64, which points of the scan were checked.
      status: [n] u8, their `PointStatus`.
      deviation_mm: [n], signed distance to the CAD surface along its normal, positive outside the
        material; NaN where a point has no partner on the part.
      score: one figure to compare poses of the same scan, larger is better.
      regions: in which material is missing or extra, the largest ones.
    """

    inlier_share: float
    violation_share: float
    unmeasured_share: float
    missing_share: float
    tolerance_mm: float
    checked: np.ndarray
    status: np.ndarray
    deviation_mm: np.ndarray
    score: float
    regions: tuple[MaterialRegion, ...] = ()

    @property
    def support(self) -> float:
        """What agrees on both sides: share of the points times share of the surface, 0 to 1."""
        unmeasured = 0.0 if np.isnan(self.unmeasured_share) else self.unmeasured_share
        return self.inlier_share * (1 - unmeasured)


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Whether to trust the pose, and the sentence that says why."""

    status: Status
    reason: str


@dataclasses.dataclass(frozen=True, eq=False)
class Alternative:
    """Another pose that the scan does not rule out.

    Attributes:
      part_from_camera: that pose.
      rotation_deg: how far it is turned from the reported pose.
      translation_mm: how far the part's centre is moved from the reported pose.
      inlier_share: as in `Verification`.
    """

    part_from_camera: RigidTransform
    rotation_deg: float
    translation_mm: float
    inlier_share: float


@dataclasses.dataclass(frozen=True, eq=False)
class PoseResult:
    """The answer of `vanejax.register`.

    Attributes:
      part_from_camera: the pose: maps points of the scan's frame to the part's frame.
      verdict: accepted, ambiguous or rejected, and why.
      refinement: how the fine registration ended.
      uncertainty: covariance and its weakest directions.
      verification: what every checked point says.
      alternatives: other poses that the scan allows, best first; empty unless ambiguous.
      before: the pose before the fine registration (the guess given, or the best hypothesis).
      sensor_origin: [3] mm, scan frame; None where unknown.
      notes: what was assumed, dropped or repaired, a sentence each.
      seconds: wall time of each stage by name, in order.
      symmetry: by which poses count as one; None where nothing was declared.
    """

    part_from_camera: RigidTransform
    verdict: Verdict
    refinement: Refinement
    uncertainty: Uncertainty
    verification: Verification
    alternatives: tuple[Alternative, ...]
    before: RigidTransform
    sensor_origin: np.ndarray | None
    notes: tuple[str, ...]
    seconds: Mapping[str, float]
    symmetry: PartSymmetry | None = None

    @property
    def camera_from_part(self) -> RigidTransform:
        """The inverse: where the part is in the scan's frame."""
        return self.part_from_camera.inverse()
