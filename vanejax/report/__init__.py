"""What a person looks at.

In: a `PoseResult` with its scan and part. Out: one HTML file with the pose, its checks and a 3-D
view (`write_report`), or the 3-D view alone for a notebook.
"""

from vanejax.report.page import write_report
from vanejax.report.view3d import View3d, pose_view, scan_view

__all__ = ["View3d", "pose_view", "scan_view", "write_report"]
