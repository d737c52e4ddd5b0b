"""From a pose to what a machine takes.

In: poses of a part and of the camera. Out: pose files, work frames for controllers, compensated
tool paths, motions between two registrations, the calibration of a camera to a machine; each with
its errors.
"""

from vanejax.machine.calibration import Calibration, calibrate
from vanejax.machine.controllers import Compensation
from vanejax.machine.pose_file import read_pose, write_result
from vanejax.machine.positioning import MotionErrors, motion_errors
from vanejax.machine.tool_path import ToolPath, compensate

__all__ = [
    "Calibration",
    "Compensation",
    "MotionErrors",
    "ToolPath",
    "calibrate",
    "compensate",
    "motion_errors",
    "read_pose",
    "write_result",
]
