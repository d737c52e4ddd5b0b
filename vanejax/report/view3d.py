"""The report's interactive view alone, for a notebook: orbit, zoom, and nothing from the network.

A `View3d` at the end of a cell shows itself in Jupyter, VS Code and exported HTML. It is the same
`viewer.js` as in the report, in a frame of its own that may run scripts and do nothing else.
"""

from __future__ import annotations

import dataclasses
import html
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation

from vanejax.cad import Part
from vanejax.errors import InputError
from vanejax.files import write_text
from vanejax.localization import PoseResult
from vanejax.plotting.canvas import HIDDEN, SCAN
from vanejax.plotting.clouds import seen_and_hidden
from vanejax.plotting.deviation import color_limit_mm
from vanejax.report import templates
from vanejax.report.viewer import Viewer, scene, spacing_mm, thinned, viewer
from vanejax.rigid import RigidTransform
from vanejax.scanner import Scan
from vanejax.scans import MeasuredScan

_HEIGHT_PX = 560
# a reader who stands a little beside the camera sees some of its shadow
_YAW_DEG, _PITCH_DEG = 28.0, 14.0
# the viewer colours dots by deviation: here its two ends are the two colours
_CODE_UM = 32_000
_SCAN_AND_HIDDEN = np.repeat([(*to_rgb(c), 1.0) for c in (SCAN, HIDDEN)], 128, axis=0)
_DOT, _LARGEST_DOT = 0.45, 0.012  # spacings, radii: between the dots the part's shading shows


@dataclasses.dataclass(frozen=True)
class View3d:
    """An interactive view.

    Attributes:
      page: a whole HTML page, self-contained.
      height_px: of its frame in a notebook.
    """

    page: str = dataclasses.field(repr=False)
    height_px: int = _HEIGHT_PX

    def _repr_html_(self) -> str:
        """What a notebook shows: the page in a frame that can reach nothing outside itself."""
        # ASCII: a document read in another encoding would change the scripts, and their hashes
        page = html.escape(self.page).encode("ascii", "xmlcharrefreplace").decode()
        return (
            f'<iframe srcdoc="{page}" sandbox="allow-scripts" title="3-D view" '
            f'style="width: 100%; height: {self.height_px}px; border: 0"></iframe>'
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the page; any browser with WebGL 2 opens it, without a network.

        Raises:
          InputError: a name that does not end in .html or .htm, or a file that cannot be written.
        """
        if Path(path).suffix.lower() not in (".html", ".htm"):
            raise InputError(f"{path}: the view is an HTML page; let its name end in .html")
        write_text(path, self.page)


def scan_view(scan: Scan, part: Part, *, voxel_mm: float = 1.5) -> View3d:
    """What a view sees and what self-occlusion hides from it, on the part.

    Args:
      scan: with `Scan.hidden`.
      part: what was scanned.
      voxel_mm: one point per voxel is shown, of either cloud.

    Raises:
      InputError: the scan was made without hidden points, or a voxel is not positive.
    """
    if not voxel_mm > 0:
        raise InputError(f"voxel_mm={voxel_mm!r} should be positive, in mm")
    seen, hidden = seen_and_hidden(scan, voxel_mm=voxel_mm)
    points = np.concatenate([seen, hidden])
    points, codes_um = thinned(points, np.repeat([-_CODE_UM, _CODE_UM], [len(seen), len(hidden)]))
    turn = Rotation.from_euler("yx", [_YAW_DEG, _PITCH_DEG], degrees=True).as_matrix()
    here = RigidTransform.identity(dtype=np.float64)
    shown = scene(
        part,
        points,
        codes_um,
        {"0": here, "1": here},
        measured=("0", "1"),
        colors=_SCAN_AND_HIDDEN,
        limit_mm=_CODE_UM / 1000,
        reader_from_part=turn @ np.asarray(scan.camera_from_part.rotation, np.float64),
        spacing_mm=min(_DOT * spacing_mm(points), _LARGEST_DOT * part.radius),
        lift_mm=0.002 * part.radius,
    )
    legend = [("scan", "seen"), ("hidden", "hidden by self-occlusion"), ("metal", "CAD")]
    return _view(shown, (), legend)


def pose_view(result: PoseResult, scan: MeasuredScan, part: Part) -> View3d:
    """The scan on the part at every pose of a result, and where it deviates: as in the report."""
    shown = viewer(result, scan, part)
    lost = np.isnan(result.verification.deviation_mm).any()
    legend = [("lost", "no partner on the part")] if lost else []
    limit_mm = color_limit_mm(result.verification)
    deviation = result.verification.deviation_mm
    if (deviation < -limit_mm).any():
        legend.append(("below", f"more than {limit_mm:g} mm below"))
    if (deviation > limit_mm).any():
        legend.append(("above", f"more than {limit_mm:g} mm outside"))
    return _view(shown, shown.poses, legend, limit_mm=limit_mm)


def _view(
    shown: Viewer,
    poses: Sequence[str],
    legend: Sequence[tuple[str, str]],
    *,
    limit_mm: float = 0.0,
) -> View3d:
    """The page; ``legend``: colours of the dots, what `page.css` calls each and what it means.

    ``poses`` can be chosen; ``limit_mm`` ends the colour bar, 0 where dots show no deviation.
    """
    values = {"scene": shown.json, "poses": poses, "legend": legend, "limit_mm": limit_mm}
    return View3d(templates.page("view3d.html", **values))
