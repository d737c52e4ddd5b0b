"""From a pose to what a machine takes.

In: poses of a part and of the camera, scans of a blank. Out: pose files, the place of the finished
part in the blank, work frames for controllers, compensated tool paths, motions between two
registrations, the calibration of a camera to a machine; each with its errors.
"""

from vanejax.machine.calibration import Calibration, calibrate
from vanejax.machine.controllers import Compensation
from vanejax.machine.motion_covariance import MotionCovariance
from vanejax.machine.placement import Placement, place
from vanejax.machine.pose_file import read_pose, write_result
from vanejax.machine.pose_record import PoseRecord, read_record
from vanejax.machine.positioning import MotionErrors, motion_errors
from vanejax.machine.tool_path import ToolPath, compensate

__all__ = [
    "Calibration",
    "Compensation",
    "MotionCovariance",
    "MotionErrors",
    "Placement",
    "PoseRecord",
    "ToolPath",
    "calibrate",
    "compensate",
    "motion_errors",
    "place",
    "read_pose",
    "read_record",
    "write_result",
]
