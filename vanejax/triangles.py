"""Triangle meshes as two arrays: welding, a fixed order, and what their edges say.

Vertices are rounded to float32 (what Embree sees and what STL stores). A mesh counts as closed
when every directed edge is used as often as its reverse: that survives welding and the removal of
collapsed faces, so neither can open a mesh that was closed.
"""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Triangles:
    """An indexed triangle mesh: points [V, 3] f64 (float32 values), faces [F, 3] i64."""

    points: np.ndarray
    faces: np.ndarray

    def corners(self) -> np.ndarray:
        """[F, 3, 3]: face, corner, coordinate."""
        return self.points[self.faces]

    def diagonal(self) -> float:
        """Length of the bounding box's diagonal."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))


def weld(mesh: Triangles) -> Triangles:
    """Rounds to float32, merges equal vertices and sorts them; faces keep their order."""
    points = np.asarray(mesh.points, np.float32) + np.float32(0)  # -0 becomes 0
    order = np.lexsort(points.T[::-1])
    ranked = points[order]
    first = np.concatenate([[True], np.any(ranked[1:] != ranked[:-1], axis=1)])
    index = np.empty(len(points), np.int64)
    index[order] = np.cumsum(first) - 1
    return Triangles(ranked[first].astype(np.float64), index[mesh.faces])


def canonical(mesh: Triangles) -> Triangles:
    """The same solid with unused vertices gone, and vertices and faces in a fixed order."""
    used, index = np.unique(mesh.faces, return_inverse=True)
    mesh = weld(Triangles(mesh.points[used], index.reshape(-1, 3)))
    first = np.argmin(mesh.faces, axis=1)[:, None]
    faces = np.take_along_axis(mesh.faces, (first + np.arange(3)) % 3, axis=1)
    return Triangles(mesh.points, faces[np.lexsort(faces.T[::-1])])


@dataclasses.dataclass(frozen=True)
class Edges:
    """The three directed edges of every face, row 3 f + i from corner i to corner i + 1.

    Attributes:
      ends: [3F, 2] i64.
      group: [3F] i64, equal for edges with the same two ends.
      uses: [E] i64, edges in each group.
      net: [E] i64, uses in ascending direction minus uses in descending direction.
    """

    ends: np.ndarray
    group: np.ndarray
    uses: np.ndarray
    net: np.ndarray

    @classmethod
    def of(cls, faces: np.ndarray) -> Edges:
        """The edges of faces [F, 3]."""
        ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        low, high = ends.min(axis=1), ends.max(axis=1)
        _, group = np.unique(low * (faces.max() + 1) + high, return_inverse=True)
        net = np.bincount(group, np.where(ends[:, 0] == low, 1, -1)).astype(np.int64)
        return cls(ends, group, np.bincount(group), net)


def drop_collapsed(mesh: Triangles, notes: list[str]) -> Triangles:
    """Without the faces that use a vertex twice."""
    a, b, c = mesh.faces.T
    keep = (a != b) & (b != c) & (c != a)
    if keep.all():
        return mesh
    notes.append(f"dropped {counted(int(np.sum(~keep)), 'collapsed face')}")
    return Triangles(mesh.points, mesh.faces[keep])


def drop_doubled(mesh: Triangles, notes: list[str]) -> Triangles:
    """Each triple of vertices at most once.

    Two copies that face apart are an inner wall between touching bodies: both go. Where most of
    the mesh is doubled, the file was written two-sided: one copy stays.
    """
    ranked = np.sort(mesh.faces, axis=1)
    order = np.lexsort(ranked.T[::-1])
    new = np.concatenate([[True], np.any(ranked[order][1:] != ranked[order][:-1], axis=1)])
    if new.all():
        return mesh
    group = np.empty(len(order), np.int64)
    group[order] = np.cumsum(new) - 1
    first = np.full(group.max() + 1, len(group))
    np.minimum.at(first, group, np.arange(len(group)))
    a, b, c = mesh.faces.T
    even = ((a < b).astype(int) + (b < c) + (c < a)) == 2  # a rotation of the sorted triple
    net = np.bincount(group, np.where(even, 1, -1))
    two_sided = np.mean(net == 0) > 0.5
    keep = np.zeros(len(group), bool)
    keep[first[net != 0] if not two_sided else first] = True
    # the copy that stays must have the orientation that prevails
    wrong = keep & (np.where(even, 1, -1) * net[group] < 0)
    faces = np.where(wrong[:, None], mesh.faces[:, ::-1], mesh.faces)[keep]
    notes.append(
        f"dropped {counted(int(np.sum(~keep)), 'face')} "
        + ("of a surface written two-sided" if two_sided else "that repeat or cancel another")
    )
    return Triangles(mesh.points, faces)


def areas(corners: np.ndarray) -> np.ndarray:
    """Areas [F] of triangles [F, 3, 3]."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.linalg.norm(cross, axis=1)


def signed_volume(corners: np.ndarray) -> float:
    """Signed volume inside closed triangles [F, 3, 3], about their own middle for accuracy."""
    a, b, c = np.moveaxis(corners - corners.mean(axis=(0, 1), keepdims=True), 1, 0)
    return float(np.sum(a * np.cross(b, c))) / 6


def counted(number: int, noun: str) -> str:
    """A number with its noun in the singular or plural, for messages: ``3 vertices``."""
    plural = noun[:-1] + "ies" if noun.endswith("y") else noun + ("es" if noun[-1] in "xs" else "s")
    if noun == "vertex":
        plural = "vertices"
    return f"{number} {noun if number == 1 else plural}"
