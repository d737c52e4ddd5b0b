"""The closed bodies of a mesh: which faces belong together, which way is out, and their union."""

from __future__ import annotations

import manifold3d
import numpy as np
import scipy.sparse.csgraph

from vanejax.cad.triangles import (
    Triangles,
    canonical,
    counted,
    drop_collapsed,
    drop_doubled,
    in_use,
    renumbered,
    weld,
)
from vanejax.errors import InputError

MAX_BODIES = 256


def connected(pairs: np.ndarray, count: int) -> np.ndarray:
    """Connected components of an undirected graph: a label per node."""
    ones = np.ones(len(pairs), np.int8)
    graph = scipy.sparse.coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), (count, count))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1]


def wind_consistently(mesh: Triangles, name: str, notes: list[str]) -> tuple[Triangles, np.ndarray]:
    """Neighbouring faces agree on which side is out; also a body label [F] per face.

    Works on the orientation double cover: every face is there twice, once per orientation, and
    neighbours are linked where they agree. A body falls into two components, one per orientation;
    if into one only, it is a Moebius strip.
    """
    edges, count = mesh.edges, len(mesh.faces)
    paired = edges.order[np.repeat(edges.uses == 2, edges.uses)].reshape(-1, 2)
    paired = np.concatenate([paired, *_wedges(mesh)])
    first, second = (paired // 3).T
    turned = edges.ends[paired[:, 0], 0] == edges.ends[paired[:, 1], 0]
    if not turned.any():  # then the two halves of the cover are alike and apart
        return mesh, connected(np.stack([first, second], axis=1), count)
    other = second + np.where(turned, count, 0)
    cover = np.stack([np.r_[first, first + count], np.r_[other, (other + count) % (2 * count)]], 1)
    label = connected(cover, 2 * count)
    as_is, flipped = label[:count], label[count:]
    if np.any(as_is == flipped):
        raise InputError(
            f"{name}: the surface has one side only (a Moebius strip); "
            "export the part again as one solid body"
        )
    body = np.minimum(as_is, flipped)
    body = renumbered(body, in_use(body, 2 * count))
    flip = as_is > flipped
    flip ^= (np.bincount(body, flip) > 0.5 * np.bincount(body))[body]
    if not flip.any():
        return mesh, body
    notes.append(f"turned {counted(int(np.sum(flip)), 'face')} to agree with the neighbours")
    return Triangles(mesh.points, np.where(flip[:, None], mesh.faces[:, ::-1], mesh.faces)), body


def _contains(body: Triangles, point: np.ndarray) -> bool:
    """Whether a closed body winds around a point [3] (van Oosterom, Strackee 1983)."""
    turns = 0.0
    for corners in body.blocks():
        a, b, c = np.moveaxis(corners - point, 1, 0)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        dot = lambda u, v: np.sum(u * v, axis=1)  # noqa: E731
        below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
        turns += np.sum(np.arctan2(dot(a, np.cross(b, c)), below)) / (2 * np.pi)
    return abs(turns) > 0.75  # 0.5 is on the surface


def _wedges(mesh: Triangles) -> list[np.ndarray]:
    """Pairs [P, 2] of edge rows that bound the same solid, where bodies touch along an edge.

    Seen along such an edge the solids are wedges. With the file's winding, going around in the
    positive sense, a wedge opens at a face that uses the edge downward and closes at one that uses
    it upward: brackets, which match their partners. Of faces at the same angle (an inner wall),
    one wedge closes before the next opens.
    """
    edges = mesh.edges
    first = np.concatenate([[0], np.cumsum(edges.uses)])
    pairs = []
    for group in np.flatnonzero((edges.uses > 2) & (edges.net == 0)):
        rows = edges.order[first[group] : first[group + 1]]
        low, high = mesh.points[np.sort(edges.ends[rows[0]])]
        axis = (high - low) / np.linalg.norm(high - low)
        spoke = mesh.points[mesh.faces[rows // 3, (rows + 2) % 3]] - low
        x = spoke[0] - (spoke[0] @ axis) * axis
        angle = np.arctan2(spoke @ np.cross(axis, x), spoke @ x) % (2 * np.pi)
        upward = edges.ends[rows, 0] < edges.ends[rows, 1]
        # 1e-5 rad is float32 rounding of a short spoke; the modulus folds 2 pi - eps onto 0
        angle = np.round(angle * 1e5) % np.round(2e5 * np.pi)
        rank = np.lexsort((~upward, angle))
        depth = np.cumsum(np.where(upward[rank], -1, 1))
        waiting: list[int] = []
        for row in rows[np.roll(rank, -1 - int(np.argmin(depth)))]:
            if edges.ends[row, 0] < edges.ends[row, 1]:
                pairs.append(np.array([[waiting.pop(), row]]))
            else:
                waiting.append(row)
    return pairs


def outward_bodies(
    mesh: Triangles, body: np.ndarray, name: str, notes: list[str]
) -> list[Triangles]:
    """The closed bodies, each with outward faces; flat ones and closed cavities are left out."""
    count = int(body.max()) + 1
    if count > MAX_BODIES:
        raise InputError(
            f"{name}: {count:,} separate bodies, more than {MAX_BODIES}: this is an assembly or "
            "not welded; export the one part that the camera sees"
        )
    pieces = [mesh]
    if count > 1:
        by_body = np.argsort(body.astype(np.uint16), kind="stable")  # small ones are not compared
        parted = np.split(mesh.faces[by_body], np.cumsum(np.bincount(body))[:-1])
        pieces = [Triangles(mesh.points, faces) for faces in parted]
        # patches that close only together are one body
        rest = [piece.faces for piece in pieces if np.any(piece.edges.net)]
        pieces = [piece for piece in pieces if not np.any(piece.edges.net)]
        pieces += [Triangles(mesh.points, np.concatenate(rest))] if rest else []
    volume = np.array([piece.volume() for piece in pieces])
    low, high = np.moveaxis(np.stack([piece.bounds() for piece in pieces]), 1, 0)
    size = np.linalg.norm(high - low, axis=1)
    solid = np.abs(volume) > 1e-12 * size**3  # rounding leaves 1e-16, a long wire 1e-10
    if not solid.any():
        raise InputError(
            f"{name}: encloses no volume (it is flat); export the part again as one solid body"
        )
    if not solid.all():
        notes.append(f"dropped {counted(int(np.sum(~solid)), 'flat body')}")
    index = np.flatnonzero(solid)
    outermost = {}
    for i in index:
        boxes = np.all((low <= low[i]) & (high[i] <= high), axis=1)
        point = mesh.points[pieces[i].faces[0, 0]]
        around = [j for j in index if j != i and boxes[j] and _contains(pieces[j], point)]
        outermost[i] = max(around, key=lambda j: abs(volume[j]), default=i)
    # an inside-out body turns with all that is inside it: its cavities stay cavities
    turned = [i for i in index if volume[outermost[i]] < 0]
    inverted = sum(outermost[i] == i for i in turned)
    if inverted:
        notes.append(f"turned {counted(inverted, 'inside-out body')} outward")
    outward = {i: -volume[i] if i in turned else volume[i] for i in index}
    cavities = sum(value < 0 for value in outward.values())
    if cavities:
        notes.append(f"dropped {counted(cavities, 'closed cavity')} that no camera can see")
    return [
        Triangles(mesh.points, pieces[i].faces[:, ::-1]) if i in turned else pieces[i]
        for i in index
        if outward[i] > 0
    ]


def united(bodies: list[Triangles], name: str, notes: list[str]) -> Triangles:
    """One mesh of all bodies; overlapping bodies are united so that no inner wall is left."""
    faces = np.concatenate([body.faces for body in bodies]) if len(bodies) > 1 else bodies[0].faces
    apart = canonical(Triangles(bodies[0].points, faces))
    if len(bodies) == 1:
        return apart
    solids = []
    for body in bodies:
        alone = canonical(body)
        solid = manifold3d.Manifold(manifold3d.Mesh64(alone.points, alone.faces.astype(np.uint64)))
        trouble, rounding = solid.status().name, 1e-12 * alone.diagonal() ** 3
        # where a body touches itself along an edge, manifold3d may lose a piece without a word
        if trouble == "NoError" and not np.isclose(solid.volume(), alone.volume(), 1e-6, rounding):
            trouble = "one touches itself"
        if trouble != "NoError":
            raise InputError(
                f"{name}: its {len(bodies)} bodies cannot be united "
                f"({trouble}); unite them in the CAD program"
            )
        solids.append(solid)
    union = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    # touching bodies keep their volume but lose the wall between them
    same_volume = union.volume() > (1 - 1e-6) * sum(solid.volume() for solid in solids)
    same_area = union.surface_area() > (1 - 1e-6) * sum(solid.surface_area() for solid in solids)
    if same_volume and same_area:
        notes.append(f"has {len(bodies)} separate bodies")
        return apart
    notes.append(f"united {len(bodies)} bodies that overlap or touch (their inner walls are gone)")
    result = union.to_mesh64()
    mesh = weld(Triangles(np.asarray(result.vert_properties)[:, :3], np.asarray(result.tri_verts)))
    mesh = drop_collapsed(mesh, [])
    single = drop_doubled(mesh, [])
    # rounded, two layers of the skin may share a face: one copy of it would leave a hole
    return canonical(mesh if np.any(single.edges.net) else single)
