"""From a `Part` and a camera's pose to what a structured-light camera measures.

In: a part, a `Camera`, poses ``camera_from_part``. Out: an ideal `Scan` (Embree rays,
self-occlusion, normals, face ids), or with a `Sensor` a `Measurement`: points with errors, and the
reason of each lost pixel.
"""

from vanejax.scanner.camera import Camera, Viewpoints, hemisphere_viewpoints, look_at
from vanejax.scanner.clutter import Clutter, clutter_scene
from vanejax.scanner.ideal_scan import Hits, Scan
from vanejax.scanner.measurement import Measurement, Reason, measure
from vanejax.scanner.sensor import Sensor, preset
from vanejax.scanner.virtual_scanner import Scanner, scan_views

__all__ = [
    "Camera",
    "Clutter",
    "Hits",
    "Measurement",
    "Reason",
    "Scan",
    "Scanner",
    "Sensor",
    "Viewpoints",
    "clutter_scene",
    "hemisphere_viewpoints",
    "look_at",
    "measure",
    "preset",
    "scan_views",
]
