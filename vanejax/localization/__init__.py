"""From a `MeasuredScan` and a `Part` to a pose, its covariance and a verdict.

In: one scan, one part, perhaps a rough pose or trained weights. Out: a `PoseResult`: search among
all rotations, fine registration by ray casting, verification by rays, comparison with competing
hypotheses, and a verdict: accepted, ambiguous or rejected.
"""

from vanejax.localization.assessment import Assessment, assess
from vanejax.localization.fine_registration import refine
from vanejax.localization.pose_result import PoseResult, Verdict
from vanejax.localization.registration import register
from vanejax.localization.residuals import (
    MeasurementModel,
    RayCasting,
    SurfaceMatching,
    measurement_model,
)
from vanejax.localization.verdict import Limits, judge
from vanejax.localization.verification import verify

__all__ = [
    "Assessment",
    "Limits",
    "MeasurementModel",
    "PoseResult",
    "RayCasting",
    "SurfaceMatching",
    "Verdict",
    "assess",
    "judge",
    "measurement_model",
    "refine",
    "register",
    "verify",
]
