"""Virtual scans of guide vanes, learned registration in JAX, and a pose to trust.

The public interface on one page. What stands below is loaded when it is first asked for; the wings
have more, each with a few lines on what goes in and what comes out:

`cad` CAD files and parametric vanes, `scanner` virtual scans, `scans` measured scans, `matching`
RPM-Net and the methods beside it, `training` data, losses, the step and weights, `localization` the
pose of a part in a scan, `plotting` figures, `machine` poses for controllers, `report` pages.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vanejax.cad import Part, guide_vane, load_part
    from vanejax.localization import PoseResult, register
    from vanejax.matching import Registration, RpmNet, pose_metrics
    from vanejax.pointcloud import PointCloud
    from vanejax.rigid import RigidTransform
    from vanejax.scanner import Camera, Scanner, Sensor, hemisphere_viewpoints, measure, preset
    from vanejax.scans import MeasuredScan, load_scan, save_points
    from vanejax.training import (
        PairSampling,
        RpmNetLoss,
        ScanSet,
        init_state,
        make_bank,
        make_scan_set,
        make_train_step,
    )

_PLACES = {
    "cad": "Part guide_vane load_part",
    "localization": "PoseResult register",
    "matching": "Registration RpmNet pose_metrics",
    "pointcloud": "PointCloud",
    "rigid": "RigidTransform",
    "scanner": "Camera Scanner Sensor hemisphere_viewpoints measure preset",
    "scans": "MeasuredScan load_scan save_points",
    "training": "PairSampling RpmNetLoss ScanSet init_state make_bank make_scan_set "
    "make_train_step",
}
_PLACE_OF = {name: place for place, names in _PLACES.items() for name in names.split()}

__all__ = sorted(_PLACE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Loads a public name when it is asked for: importing the package stays cheap."""
    if name not in _PLACE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_PLACE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """What can be asked for."""
    return sorted({*globals(), *__all__})
