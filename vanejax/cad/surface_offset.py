"""Directions in which the vertices of a surface move when all its faces move outward alike."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import LinearOperator, cg

from vanejax.cad.triangles import Triangles

# of the largest eigenvalue of the faces' normals: below, the faces at a vertex are one plane or
# two, and the vertex is not moved along the directions that they leave open
FLAT = 0.02
# both per mm of offset: how far a face may be from where it belongs if that makes the surface
# smoother, and how far along a face its vertices give way to a corner's
SLACK_MM, REACH_MM = 0.03, 10.0


def offset_directions(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """By how much each vertex moves when every face moves outward by 1 mm: [V, 3] f64.

    The field u that minimises, over the surface, ``((n . u - 1) / SLACK_MM)^2 + |grad u|^2 +
    |u - d|^2 / REACH_MM^2`` with the faces' normals n and the directions d of `_mitres`. On a
    smooth surface it is the unit normal and at the edge of a box it is sqrt(2) long, to one per
    mille. In a concave corner the mitres alone would fold the surface over: there vertices of a
    flat face that are near the corner must move along the face out of its way, and do.
    """
    shapes = Triangles(points, faces)
    area = shapes.areas()
    cross = np.cross(*np.diff(points[faces], axis=1).swapaxes(0, 1))
    normals = cross / np.maximum(2 * area, 1e-30)[:, None]
    start = _mitres(points, faces, normals)
    squares, total = _at_vertices(len(points), faces, normals, np.repeat(area[:, None] / 3, 3, 1))
    smooth = _laplacian(points, faces, area)
    own_area = np.bincount(faces.ravel(), np.repeat(area / 3, 3), len(points))[:, None]
    local = squares / SLACK_MM**2 + own_area[..., None] / REACH_MM**2 * np.eye(3)
    wanted = total / SLACK_MM**2 + own_area / REACH_MM**2 * start
    inverse = np.linalg.inv(local + smooth.diagonal()[:, None, None] * np.eye(3))

    def product(blocks: np.ndarray, flat: np.ndarray) -> np.ndarray:
        return np.einsum("vij,vj->vi", blocks, flat.reshape(-1, 3))

    def applied(flat: np.ndarray) -> np.ndarray:
        return (product(local, flat) + smooth @ flat.reshape(-1, 3)).ravel()

    size = (start.size, start.size)
    near = LinearOperator(size, lambda flat: product(inverse, flat).ravel())
    # to 1e-5 of the offset, which is below a millimetre
    options = {"x0": start.ravel(), "rtol": 1e-5, "maxiter": 500, "M": near}
    directions, _ = cg(LinearOperator(size, applied), wanted.ravel(), **options)
    return directions.reshape(-1, 3)


def _mitres(points: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The shortest d [V, 3] with ``n . d = 1`` for the faces at a vertex, weighted by angle."""
    edges = np.roll(points[faces], -1, axis=1) - points[faces]
    along = edges / np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-30)
    cosine = -np.einsum("fki,fki->fk", along, np.roll(along, 1, axis=1))
    angle = np.arccos(np.clip(cosine, -1, 1))
    squares, total = _at_vertices(len(points), faces, normals, angle)
    values, vectors = np.linalg.eigh(squares)
    known = values > FLAT * values[:, -1:]
    solved = np.einsum("vij,vi->vj", vectors, total)
    solved = np.where(known, solved / np.where(known, values, 1.0), 0.0)
    return np.einsum("vij,vj->vi", vectors, solved)


def _at_vertices(
    count: int, faces: np.ndarray, normals: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over a vertex's faces of ``w n n^T`` [V, 3, 3] and ``w n`` [V, 3]; weight [F, 3]."""
    squares, total = np.zeros((count, 3, 3)), np.zeros((count, 3))
    outer = normals[:, :, None] * normals[:, None, :]
    for k in range(3):
        np.add.at(squares, faces[:, k], weight[:, k, None, None] * outer)
        np.add.at(total, faces[:, k], weight[:, k, None] * normals)
    return squares, total


def _laplacian(points: np.ndarray, faces: np.ndarray, area: np.ndarray) -> csr_array:
    """[V, V]: ``u^T L u`` is about the integral of ``|grad u|^2`` over the surface.

    An edge weighs two thirds of its faces' area by its squared length. The cotangent formula is
    exact, but slivers make it indefinite.
    """
    first, second = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    squared = np.maximum(np.sum((points[first] - points[second]) ** 2, axis=1), 1e-12)
    weight = np.repeat(area, 3) * (2 / 3) / squared
    shape = (len(points), len(points))
    ways = csr_array((weight, (first, second)), shape=shape)
    ways = ways + ways.T
    return csr_array(diags_array(np.asarray(ways.sum(axis=1))) - ways)
