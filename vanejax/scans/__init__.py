"""From files of points to a `MeasuredScan`.

In: PLY, PCD, text, NPZ or arrays, in mm or m, as scanners and their programs write them. Out:
points in millimetres with the sensor's viewpoint, normals, and which of them are the part.
"""

from vanejax.scans.measured_scan import MeasuredScan, clean_scan
from vanejax.scans.scan_file import load_scan, save_points
from vanejax.scans.segmentation import Segment, Segments, segment

__all__ = [
    "MeasuredScan",
    "Segment",
    "Segments",
    "clean_scan",
    "load_scan",
    "save_points",
    "segment",
]
