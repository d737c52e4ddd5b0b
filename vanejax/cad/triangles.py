"""Triangle meshes as two arrays: welding, a fixed order, and what their edges say.

Vertices are rounded to float32 (what Embree sees and what STL stores). A mesh counts as closed
when every directed edge is used as often as its reverse: that survives welding and the removal of
collapsed faces, so neither can open a mesh that was closed.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator

import numpy as np

BLOCK = 1 << 15  # faces at a time: their arrays stay in the cache


@dataclasses.dataclass(frozen=True)
class Triangles:
    """An indexed triangle mesh: points [V, 3] f64 (float32 values), faces [F, 3] i32 or i64."""

    points: np.ndarray
    faces: np.ndarray

    def blocks(self) -> Iterator[np.ndarray]:
        """Corners [F, 3, 3] of some faces at a time: all would be larger than the mesh itself."""
        for start in range(0, len(self.faces), BLOCK):
            yield self.points[self.faces[start : start + BLOCK]]

    @functools.cached_property
    def edges(self) -> Edges:
        """The edges of the faces; they are sorted once, by whoever asks first."""
        return Edges.of(self.faces)

    def bounds(self) -> np.ndarray:
        """[2, 3]: lower and upper corner of the box around the faces."""
        points = self.points[in_use(self.faces, len(self.points))]
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def areas(self) -> np.ndarray:
        """[F]."""
        return np.concatenate([areas(corners) for corners in self.blocks()])

    def volume(self) -> float:
        """What the faces enclose, negative where they face inward."""
        about = self.bounds().mean(axis=0)
        volume = 0.0
        for corners in self.blocks():
            a, b, c = np.moveaxis(corners - about, 1, 0)
            volume += float(np.sum(a * np.cross(b, c))) / 6
        return volume

    def diagonal(self) -> float:
        """Length of the bounding box's diagonal."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))


def weld(mesh: Triangles) -> Triangles:
    """Rounds to float32, merges equal vertices and sorts them; faces keep their order."""
    points = np.asarray(mesh.points, np.float32) + np.float32(0)  # -0 becomes 0
    order, first = _sorted_rows(points)
    index = np.empty(len(points), np.int32)
    index[order] = np.cumsum(first, dtype=np.int32) - np.int32(1)
    return Triangles(points[order[first]].astype(np.float64), index[mesh.faces])


def in_use(index: np.ndarray, count: int) -> np.ndarray:
    """[count] bool: which rows an index, of any shape, names."""
    used = np.zeros(count, bool)
    used[index] = True
    return used


def renumbered(index: np.ndarray, used: np.ndarray) -> np.ndarray:
    """An index into all rows becomes one, i32, into those `in_use`."""
    if used.all():
        return index.astype(np.int32, copy=False)
    return (np.cumsum(used, dtype=np.int32) - np.int32(1))[index]


def canonical(mesh: Triangles) -> Triangles:
    """The same solid with unused vertices gone, and vertices and faces in a fixed order."""
    used = in_use(mesh.faces, len(mesh.points))
    mesh = weld(Triangles(mesh.points[used], renumbered(mesh.faces, used)))
    faces, first = mesh.faces.copy(), np.argmin(mesh.faces, axis=1)
    for corner in (1, 2):
        turned = first == corner
        faces[turned] = np.roll(faces[turned], -corner, axis=1)
    return Triangles(mesh.points, faces[_sorted_rows(faces)[0]])


def _sorted_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The order [N] that sorts rows [N, 3], f32 or i32, and which sorted ones [N] bool are new.

    Two columns are one 64-bit key. Sorting that, and then what is equal in it, is four times
    faster than `np.lexsort`.
    """
    order = np.argsort(_pair(_ordinal(rows[:, 0]), _ordinal(rows[:, 1])), kind="stable")
    # not kept from above: ten million faces have 240 MB of keys
    key = _pair(_ordinal(rows[order, 0]), _ordinal(rows[order, 1]))
    group = np.cumsum(_new(key), dtype=np.uint32)
    key = _pair(group, _ordinal(rows[order, 2]))
    if np.any(key[1:] < key[:-1]):
        again = np.argsort(key, kind="stable")
        order, key = order[again], key[again]
    return order, _new(key)


def _ordinal(column: np.ndarray) -> np.ndarray:
    """[N] u32 in the same order as a column of f32 (neither NaN nor -0) or i32."""
    bits = np.ascontiguousarray(column).view(np.uint32)
    if column.dtype.kind == "i":
        return bits ^ np.uint32(1 << 31)
    return bits ^ np.where(bits >> 31, np.uint32(0xFFFFFFFF), np.uint32(1 << 31))


def _pair(high: np.ndarray, low: np.ndarray) -> np.ndarray:
    """[N] u64: in the order of ``high``, then ``low``."""
    return high.astype(np.uint64) << np.uint64(32) | low


def _new(ranked: np.ndarray) -> np.ndarray:
    """[N] bool: which entries of a sorted array differ from the one before."""
    return np.concatenate([[True], ranked[1:] != ranked[:-1]])


@dataclasses.dataclass(frozen=True)
class Edges:
    """The three directed edges of every face, row 3 f + i from corner i to corner i + 1.

    Attributes:
      ends: [3F, 2] i32 or i64.
      order: [3F] i64: the rows, those with the same two ends together.
      uses: [E] i64: how many rows there are of each edge, in that order.
      net: [E] i64: uses in ascending direction minus uses in descending direction.
    """

    ends: np.ndarray
    order: np.ndarray
    uses: np.ndarray
    net: np.ndarray

    @classmethod
    def of(cls, faces: np.ndarray) -> Edges:
        """The edges of faces [F, 3]."""
        ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        start, end = ends[:, 0].astype(np.uint32), ends[:, 1].astype(np.uint32)
        key = _pair(np.minimum(start, end), np.maximum(start, end))
        order = np.argsort(key, kind="stable")
        first = np.flatnonzero(_new(key[order]))
        upward = np.where(start < end, 1, -1)[order]
        uses, net = np.diff(first, append=len(order)), np.add.reduceat(upward, first)
        return cls(ends, order, uses, net)

    def rows(self, which: np.ndarray) -> np.ndarray:
        """The rows, ascending, of the edges for which ``which`` [E] bool holds."""
        return np.sort(self.order[np.repeat(which, self.uses)])


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
    order, new = _sorted_rows(np.sort(mesh.faces, axis=1).astype(np.int32))
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
    keep = in_use(first if two_sided else first[net != 0], len(group))
    # the copy that stays must have the orientation that prevails
    wrong = keep & (np.where(even, 1, -1) * net[group] < 0)
    faces = np.where(wrong[:, None], mesh.faces[:, ::-1], mesh.faces)[keep]
    why = "of a surface written two-sided" if two_sided else "that repeat or cancel another"
    notes.append(f"dropped {counted(int(np.sum(~keep)), 'face')} {why}")
    return Triangles(mesh.points, faces)


def areas(corners: np.ndarray) -> np.ndarray:
    """Areas [F] of triangles [F, 3, 3]."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.linalg.norm(cross, axis=1)


def counted(number: int, noun: str) -> str:
    """A number with its noun in the singular or plural, for messages: ``3 vertices``."""
    plural = noun[:-1] + "ies" if noun.endswith("y") else noun + "s"
    if noun == "vertex":
        plural = "vertices"
    return f"{number} {noun if number == 1 else plural}"
