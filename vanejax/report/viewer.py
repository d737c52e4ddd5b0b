"""What the interactive view shows, as JSON: positions as 16-bit integers, poses as matrices.

A report of a part with ten million triangles must still open on a tablet, so the surface is
simplified where it has more vertices than 16 bits can count, and of the points a choice is shown.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from matplotlib.colors import to_rgb
from scipy.spatial import cKDTree

from vanejax.cad import Part
from vanejax.localization import PoseResult, measurement_model
from vanejax.localization.assessment import without_form_deviation
from vanejax.localization.deviation_patches import scaled_pose
from vanejax.plotting.canvas import NO_PARTNER, SCAN
from vanejax.plotting.deviation import (
    color_limit_mm,
    deviation_colormap,
    form_terms,
    overlay_rotation,
)
from vanejax.plotting.scene import Scene
from vanejax.rigid import RigidTransform
from vanejax.scans import MeasuredScan
from vanejax.scans.voxels import Voxels

MAX_VERTICES = 65_535
MAX_POINTS = 60_000
_NO_DEVIATION = -32768


class Viewer(NamedTuple):
    """The view's data, and what was left out to keep it small.

    Attributes:
      json: for `viewer.js`; safe inside an HTML script element.
      poses: the names of the poses that can be shown, in the order of the buttons.
      num_points: of the scan, shown.
      num_faces: of the part, shown.
      detail_mm: details of the part smaller than this are not shown; 0 where all are.
    """

    json: str
    poses: tuple[str, ...]
    num_points: int
    num_faces: int
    detail_mm: float


def viewer(result: PoseResult, scan: MeasuredScan, part: Part) -> Viewer:
    """The part, the checked points and every pose of a result.

    Points are the checked ones; the whole scan where none was checked. They are without the stock
    and the other size that were found: then they lie where their colours say.
    """
    verification = result.verification
    chosen, deviation = verification.checked, verification.deviation_mm
    if not len(chosen):
        chosen, deviation = np.arange(len(scan.points)), np.full(len(scan.points), np.nan)
    form = result.refinement.form
    points, pose = scan.points[chosen], result.part_from_camera
    size = 1.0 if form is None else 1 + form.scale_error
    if form_terms(form):
        model = measurement_model(part, result.sensor_origin)
        _, points, _ = without_form_deviation(model, points, pose, form)
    points, codes_um = thinned(points, _micrometres(deviation))
    poses = {"Before": result.before, "After": pose}
    poses |= {
        f"Alternative {number}": alternative.part_from_camera
        for number, alternative in enumerate(result.alternatives, 1)
    }
    poses = {name: scaled_pose(pose, part.center, 1 / size) for name, pose in poses.items()}
    limit_mm = color_limit_mm(verification)
    return scene(
        part,
        points,
        codes_um,
        poses,
        measured=("After",),
        colors=_colors(),
        limit_mm=limit_mm,
        reader_from_part=overlay_rotation(scan, Scene(part), result.part_from_camera),
        spacing_mm=spacing_mm(points),
        # little enough to hide behind the thinnest wall
        lift_mm=min(limit_mm, 0.005 * part.radius),
    )


def _colors() -> np.ndarray:
    """[256, 4], the colours of deviations; the first and the last are of those beyond."""
    return deviation_colormap()(np.linspace(-1 / 254, 1 + 1 / 254, 256))


def scene(
    part: Part,
    points: np.ndarray,
    codes_um: np.ndarray,
    poses: Mapping[str, RigidTransform],
    *,
    measured: Collection[str],
    colors: np.ndarray,
    limit_mm: float,
    reader_from_part: np.ndarray,
    spacing_mm: float,
    lift_mm: float,
) -> Viewer:
    """What `viewer.js` reads.

    Args:
      part: about whose centre the view turns.
      points: [N, 3] mm, N at most `MAX_POINTS`.
      codes_um: [N], deviations in whole micrometres; -32768 for none.
      poses: part_from_points by name, in the order of the buttons.
      measured: names of the poses that the points' codes are for.
      colors: [256, 4], 0 to 1, from -``limit_mm`` to ``limit_mm``.
      limit_mm: deviation at the ends of the colours.
      reader_from_part: [3, 3], rows right, up, towards the reader.
      spacing_mm: how large dots are drawn.
      lift_mm: how far in front of the surface dots are drawn, at least.
    """
    vertices, faces, detail_mm = simplified(
        np.asarray(part.mesh.vertices, np.float64), np.asarray(part.mesh.faces)
    )
    local_from_part = RigidTransform(np.eye(3), -part.center)
    point_grid, points_from_grid = to_grid(points)
    vertex_grid, part_from_grid = to_grid(vertices)
    values = {
        "radius": part.radius,
        # how far the part reaches from its centre, as the reader sees it
        "half_mm": np.abs((vertices - part.center) @ reader_from_part.T).max(axis=0).tolist(),
        "view": columns(RigidTransform(reader_from_part, np.zeros(3)).as_matrix()),
        "mesh": {
            "vertices": to_base64(vertex_grid, "<u2"),
            "faces": to_base64(faces, "<u2"),
            "model": columns(local_from_part.as_matrix() @ part_from_grid),
        },
        "scan": {
            "points": to_base64(point_grid, "<u2"),
            "deviation_um": to_base64(codes_um, "<i2"),
            "spacing_mm": spacing_mm,
            "lift_mm": lift_mm,
        },
        "poses": [
            {
                "name": name,
                "measured": name in measured,
                "model": columns((local_from_part @ pose).as_matrix() @ points_from_grid),
            }
            for name, pose in poses.items()
        ],
        "limit_mm": limit_mm,
        "colors": to_base64(np.round(255 * colors), "u1"),
        "scan_color": to_rgb(SCAN),
        "lost_color": to_rgb(NO_PARTNER),
    }
    # "<" could end the script element
    text = json.dumps(values, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return Viewer(text, tuple(poses), len(points), len(faces), detail_mm)


def thinned(points: np.ndarray, codes_um: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] and their codes [N]: a random choice of them, if more than `MAX_POINTS`."""
    if len(points) <= MAX_POINTS:
        return points, codes_um
    some = np.sort(np.random.default_rng(0).choice(len(points), MAX_POINTS, replace=False))
    return points[some], codes_um[some]


def simplified(
    vertices: np.ndarray, faces: np.ndarray, *, max_vertices: int = MAX_VERTICES
) -> tuple[np.ndarray, np.ndarray, float]:
    """A surface of at most ``max_vertices``: all vertices in a cell of a grid become their mean.

    Vertex clustering (Rossignac and Borrel, 1993): in time linear in the vertices, for any mesh,
    and good enough to look at.

    Args:
      vertices: [V, 3] f64, mm.
      faces: [F, 3], indices.
      max_vertices: at least 8.

    Returns:
      vertices [v, 3]; faces [f, 3]; the side of the cells in mm, 0 where nothing was done.
    """
    if len(vertices) <= max_vertices:
        return vertices, faces, 0.0
    low = vertices.min(axis=0)
    # a plane at any angle crosses about 1.5 cells per cell's area
    side = float(np.sqrt(1.5 * trimesh.triangles.area(vertices[faces]).sum() / max_vertices))
    while len(cells := Voxels(vertices - low, side)) > max_vertices:
        side *= 1.15
    merged = cells.of_point[faces]
    a, b, c = merged.T
    merged = merged[(a != b) & (b != c) & (c != a)]
    # of several faces with the same corners one is enough, from whichever side it is seen
    _, first = np.unique(np.sort(merged, axis=1), axis=0, return_index=True)
    return cells.middle + low, merged[first], side


def to_grid(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] on a grid of 65,535 steps a side, and the matrix [4, 4] that undoes it.

    WebGL reads 16-bit integers as 0 to 1. Half a step is 1 micrometre on a part of 130 mm.
    """
    if not len(points):
        return points, np.eye(4)
    low = points.min(axis=0)
    size = np.maximum(np.ptp(points, axis=0), 1e-9)
    matrix = np.diag([*size, 1.0])
    matrix[:3, 3] = low
    return np.round((points - low) / size * 65_535), matrix


def _micrometres(deviation_mm: np.ndarray) -> np.ndarray:
    """Deviations [n] mm in whole micrometres, cut at 32.767 mm; -32768 for none."""
    whole = np.clip(np.round(1000.0 * deviation_mm), -32767, 32767)
    return np.where(np.isnan(deviation_mm), _NO_DEVIATION, whole)


def spacing_mm(points: np.ndarray) -> float:
    """Typical distance between neighbours among points [N, 3]."""
    if len(points) < 2:
        return 1.0
    some = points[:: max(1, len(points) // 1000)]
    return max(float(np.median(cKDTree(points).query(some, k=2)[0][:, 1])), 1e-6)


def to_base64(values: Sequence[float] | np.ndarray, dtype: str) -> str:
    """Little-endian bytes as text."""
    return base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode("ascii")


def columns(matrix: np.ndarray) -> list[float]:
    """A 4x4 matrix as WebGL wants it: column after column."""
    return np.asarray(matrix, np.float64).T.ravel().tolist()
