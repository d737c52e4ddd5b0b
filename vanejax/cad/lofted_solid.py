"""Solids lofted through stacks of polygons, drawn in the coordinates of an engine's ring.

Ring coordinates are (axial mm, downstream; angle about the engine's axis, radians; radius mm).
They become x = radius sin(angle), y = radius cos(angle), z = -axial.
"""

from __future__ import annotations

import manifold3d
import numpy as np

SECTION = (0, 1)
"""The ring coordinates in which an airfoil section is drawn: axial and angle."""

PROFILE = (0, 2)
"""The ring coordinates in which a platform's profile is drawn: axial and radius."""


def loft_sections(rings: np.ndarray, flat: tuple[int, int]) -> manifold3d.Manifold:
    """The solid whose skin joins rings of ring coordinates, in x, y, z about the engine's axis.

    Args:
      rings: [S, P, 3]; ring i and i + 1 are joined point by point.
      flat: the two ring coordinates in which the first and the last ring are simple polygons,
        counter-clockwise; their triangles close the ends.
    """
    stations, count, _ = rings.shape
    axial, angle, radius = np.moveaxis(rings, -1, 0)
    vertices = np.stack([radius * np.sin(angle), radius * np.cos(angle), -axial], -1)
    corner = np.arange(count)
    after = np.roll(corner, -1)
    rows = count * np.arange(stations - 1)[:, None]
    quads = np.stack([rows + corner, rows + after, rows + count + after, rows + count + corner], -1)
    # angles are in radians: at the size of the ring they are as long as the axial coordinates
    scaled = rings * [1.0, radius.mean(), 1.0]
    ends = [manifold3d.triangulate([scaled[i][:, flat]]) for i in (0, -1)]
    faces = np.concatenate(
        [
            quads[..., [0, 1, 2]].reshape(-1, 3),
            quads[..., [0, 2, 3]].reshape(-1, 3),
            ends[0][:, ::-1],
            ends[1] + count * (stations - 1),
        ]
    )
    # (axial, angle, radius) -> (x, y, z) mirrors; so does reading a profile as (axial, radius)
    if flat == SECTION:
        faces = faces[:, ::-1]
    mesh = manifold3d.Mesh64(vertices.reshape(-1, 3), faces.astype(np.uint64))
    return manifold3d.Manifold(mesh)
