"""From two point clouds to a pose, in pure JAX.

In: source and target as `PointCloud`s in unit-sphere units, a pose to start from. Out: a
`Registration` with ``target_from_source``. `RpmNet` is the paper's network;
`vanejax.matching.baselines` has the methods that it is compared with.
"""

from vanejax.matching.contract import Register, Registration
from vanejax.matching.metrics import pose_metrics, surface_fit
from vanejax.matching.procrustes import weighted_procrustes
from vanejax.matching.rpmnet import RpmNet

__all__ = [
    "Register",
    "Registration",
    "RpmNet",
    "pose_metrics",
    "surface_fit",
    "weighted_procrustes",
]
