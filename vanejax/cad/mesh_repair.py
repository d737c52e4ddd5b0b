"""From the triangles of a CAD file to one closed, outward solid, or a reason why not."""

from __future__ import annotations

import heapq

import numpy as np
import scipy.spatial

from vanejax.cad.solid_bodies import connected, outward_bodies, united, wind_consistently
from vanejax.cad.triangles import (
    Triangles,
    areas,
    counted,
    drop_collapsed,
    drop_doubled,
    in_use,
    renumbered,
    weld,
)
from vanejax.errors import InputError

MAX_FACES = 20_000_000  # the part and its Embree scene: 7 GB
MAX_OPEN_EDGES = 20_000  # more is no crack but a surface that was never closed
SMALL_HOLE = 0.05  # of the part's diagonal: what is filled without asking
SLIT_AREA = 1e-9  # of the diagonal squared: a crack along which nothing is missing
WELD = 1e-5  # of the part's diagonal: 1.5 micrometres on a 150 mm part, below any scanner
# within reach of each other at open edges, or 8 for each vertex there: more is dust, not a crack
MAX_PAIRS = 25_000_000
MAX_ROUNDING_MM = 1e-3  # the scanner's promised range error


def repair_solid(
    vertices: np.ndarray, faces: np.ndarray, *, name: str
) -> tuple[Triangles, tuple[str, ...]]:
    """One closed solid with outward faces, and a sentence per repair.

    Vertices [V, 3] in mm are sorted by x, y, z and faces [F, 3] by their vertices, so that the same
    geometry gives the same arrays whatever file it came from. Messages call the part ``name``.

    Raises:
      InputError: the mesh is empty, not finite, too large, open by more than small holes, not
        orientable, flat, or its bodies cannot be united.
    """
    notes: list[str] = []
    mesh = drop_doubled(drop_collapsed(_checked(vertices, faces, name), notes), notes)
    if len(mesh.faces):
        mesh = _weld_open_edges(mesh, notes)
    if not len(mesh.faces):
        raise InputError(
            f"{name}: every face is collapsed to a line or a point; "
            "export the part again as one solid body"
        )
    mesh, body = wind_consistently(mesh, name, notes)
    if np.any(mesh.edges.net):
        filled = drop_collapsed(weld(_fill_holes(mesh, name, notes)), [])
        mesh, body = wind_consistently(filled, name, notes)  # slits may have parted a body
    bodies = outward_bodies(mesh, body, name, notes)
    return united(bodies, name, notes), tuple(notes)


def open_surface(
    vertices: np.ndarray, faces: np.ndarray, *, name: str
) -> tuple[Triangles, tuple[str, ...]]:
    """The triangles of a surface that is no solid, in the order of `repair_solid`.

    Which side of a face is outside is then unknown.

    Raises:
      InputError: the mesh is empty, not finite, or too large.
    """
    notes: list[str] = []
    mesh = drop_doubled(drop_collapsed(_checked(vertices, faces, name), notes), notes)
    if not len(mesh.faces):
        raise InputError(
            f"{name}: every face is collapsed to a line or a point; export the part again"
        )
    return mesh, tuple(notes)


def _checked(vertices: np.ndarray, faces: np.ndarray, name: str) -> Triangles:
    """Shape, range and finiteness; then the vertices in use, rounded, unique and sorted."""
    vertices = np.asarray(vertices, np.float64)
    faces = np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError(f"{name}: vertices have shape {vertices.shape}, not [V, 3]")
    if not faces.size or not vertices.size:
        raise InputError(f"{name}: has no faces; a CAD model is a surface of triangles")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise InputError(
            f"{name}: faces have shape {faces.shape} and type {faces.dtype}, not integer [F, 3]"
        )
    if len(faces) > MAX_FACES:
        raise InputError(
            f"{name}: {len(faces):,} faces are more than the {MAX_FACES:,} that fit in memory; "
            "export it with a coarser tolerance (0.01 mm is enough)"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{name}: a face points at a vertex outside 0..{len(vertices) - 1}")
    used = in_use(faces, len(vertices))
    faces = renumbered(faces, used)
    if not used.all():
        vertices = vertices[used]
    low, high = float(vertices.min()), float(vertices.max())  # NaN if there is one
    if not np.isfinite([low, high]).all():
        bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
        raise InputError(
            f"{name}: {len(bad)} of {len(vertices)} vertices are not finite (the first: "
            f"{vertices[bad[0]]}, vertex {np.flatnonzero(used)[bad[0]]}); "
            "export the part again as one solid body"
        )
    far = max(-low, high)
    # half a unit in the last of float32's 24 digits
    if far * 2.0**-24 > MAX_ROUNDING_MM:
        raise InputError(
            f"{name}: the part lies {far:.4g} mm from its origin, where single precision rounds "
            f"to {far * 2.0**-24:.2g} mm; move it near the origin in the CAD program"
        )
    return weld(Triangles(vertices, faces))


def _weld_open_edges(mesh: Triangles, notes: list[str]) -> Triangles:
    """Closes cracks: vertices of open edges that are next to each other become one."""
    odd = mesh.edges.uses % 2 == 1
    if not odd.any():
        return mesh
    # a stray face without area can hang on a closed surface: gone, if that leaves fewer open edges
    solid = mesh.areas() > 0
    if solid.any() and not solid.all():
        rest = Triangles(mesh.points, mesh.faces[solid])
        if np.sum(rest.edges.uses % 2) < np.sum(odd):
            notes.append(f"dropped {counted(int(np.sum(~solid)), 'face')} without area")
            mesh, odd = rest, rest.edges.uses % 2 == 1
    rim = np.unique(mesh.edges.ends[mesh.edges.rows(odd)])
    if not len(rim):
        return mesh
    reach = WELD * mesh.diagonal()
    tree = scipy.spatial.cKDTree(mesh.points[rim])
    # counted before they are listed, since n vertices at one place are n^2 / 2 pairs
    count = (tree.count_neighbors(tree, reach) - len(rim)) // 2
    if not 0 < count <= max(MAX_PAIRS, 8 * len(rim)):
        return mesh
    pairs = tree.query_pairs(reach, output_type="ndarray")
    cluster = connected(pairs, len(rim))
    lowest = np.full(cluster.max() + 1, len(mesh.points))
    np.minimum.at(lowest, cluster, rim)
    target = np.arange(len(mesh.points))
    target[rim] = lowest[cluster]
    moved = int(np.sum(target != np.arange(len(target))))
    notes.append(f"welded {counted(moved, 'vertex')} at open edges, less than {reach:.2g} mm apart")
    welded = drop_collapsed(Triangles(mesh.points, target[mesh.faces]), [])
    return drop_doubled(welded, [])


def _fill_holes(mesh: Triangles, name: str, notes: list[str]) -> Triangles:
    """Fills holes of three edges, slits without area, and what is small beside the part."""
    edges = mesh.edges
    tangled = int(np.sum(edges.uses[edges.net != 0] > 2))
    if tangled:
        raise InputError(
            f"{name}: not a solid: at {counted(tangled, 'edge')} three or more surfaces meet; "
            "export the part again as one solid body, without inner walls"
        )
    # the direction in which the missing faces run
    rim = edges.ends[edges.rows(edges.net != 0)][:, ::-1]
    if len(rim) > MAX_OPEN_EDGES:
        raise InputError(
            f"{name}: not a closed solid: {len(rim):,} open edges; "
            "export the part again as one solid body"
        )
    diagonal = mesh.diagonal()
    points, patches, slits, filled = [mesh.points], [], 0, []
    loops = _loops(rim, mesh.points)
    spans = [float(np.linalg.norm(np.ptp(mesh.points[loop], axis=0))) for loop in loops]
    size = len(mesh.points)
    for loop, span in zip(loops, spans, strict=True):
        patch = np.stack([np.full(len(loop) - 2, loop[0]), loop[1:-1], loop[2:]], axis=1)
        slit = np.sum(areas(mesh.points[patch])) <= SLIT_AREA * diagonal**2
        if len(loop) > 3 and not slit:
            if span > SMALL_HOLE * diagonal:
                worst = int(np.argmax(spans))
                where = ", ".join(f"{x:.4g}" for x in mesh.points[loops[worst]].mean(axis=0))
                raise InputError(
                    f"{name}: not a closed solid: {len(rim)} open edges around "
                    f"{counted(len(loops), 'hole')}, the largest {spans[worst]:.3g} mm across near "
                    f"({where}) mm; close it in the CAD program, or export the solid body instead "
                    "of its surface"
                )
            # a fan around the middle suits any small hole that is about round
            points.append(mesh.points[loop].mean(axis=0, keepdims=True))
            patch = np.stack([loop, np.roll(loop, -1), np.full(len(loop), size)], axis=1)
            size += 1
        patches.append(patch)
        slits += slit
        filled += [] if slit else [span]
    if slits:
        notes.append(f"closed {counted(slits, 'slit')} where edges met without sharing vertices")
    if filled:
        widest = f"{max(filled):.3g} mm across"
        notes.append(f"filled {counted(len(filled), 'hole')}, the largest {widest}")
    return Triangles(np.concatenate(points), np.concatenate([mesh.faces, *patches]))


def _loops(directed: np.ndarray, points: np.ndarray) -> list[np.ndarray]:
    """Splits directed edges [E, 2], as many in as out at every vertex, into simple loops.

    Each loop is the shortest one through the longest edge that is left. Where holes touch, that
    separates them: an edge AB and the slit along it make a loop of length 2 |AB|, and by the
    triangle inequality no other loop through AB is as short.
    """
    length = np.linalg.norm(np.diff(points[directed], axis=1)[:, 0], axis=1)
    ways: dict[int, dict[int, float]] = {}
    for (start, end), far in zip(directed.tolist(), length.tolist(), strict=True):
        ways.setdefault(start, {})[end] = far
    loops = []
    for start, end in directed[np.argsort(-length, kind="stable")].tolist():
        if end not in ways[start]:
            continue
        del ways[start][end]
        came: dict[int, int] = {}
        queue = [(0.0, end, start)]
        while start not in came:
            far, vertex, before = heapq.heappop(queue)
            if vertex not in came:
                came[vertex] = before
                for onward, step in ways[vertex].items():
                    heapq.heappush(queue, (far + step, onward, vertex))
        loop = [start]
        while loop[-1] != end:
            loop.append(came[loop[-1]])
            del ways[loop[-1]][loop[-2]]
        loops.append(np.array(loop[::-1]))
    return loops
