"""The envelope of a part: a convex polytope around it, and the part of an image it can cover.

A mesh may have ten million vertices; the envelope has some three hundred corners whatever the
mesh, so that what a view needs to know before it casts rays costs next to nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.spatial

from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Camera

SIDES = 160
# of the part's radius, beyond its extent: float32 turns rays by far less, and a flat part gets the
# thickness that a polytope must have
PADDING = 1e-3
# few enough that BLAS does not start threads, which wait for the scanning ones
VERTICES_AT_ONCE = 512


class Window(NamedTuple):
    """A rectangle of pixels: the rows and the columns of an image that it spans."""

    rows: slice
    columns: slice

    @property
    def size(self) -> int:
        """Number of pixels."""
        return (self.rows.stop - self.rows.start) * (self.columns.stop - self.columns.start)

    def pixels(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns i32 in the image of pixels that are counted from 0, row by row."""
        # 32 bits divide three times as fast as 64
        index = index.astype(np.int32)
        width = np.int32(self.columns.stop - self.columns.start)
        row = index // width
        column = index - row * width
        row += np.int32(self.rows.start)
        column += np.int32(self.columns.start)
        return row, column


class PartEnvelope:
    """A convex polytope that contains a part with a margin.

    It is what `SIDES` planes that look in all directions leave of space when moved up to the part's
    vertices, [V, 3] f64, mm, not all the same. Not the convex hull: that may have a corner for
    every vertex, and fails on a flat part.

    Attributes:
      corners: [P, 3] f64, mm, in the frame of the vertices.
      edges: [E, 2] i64, corners at the ends; facets are triangles, so some edges are not sharp.
    """

    def __init__(self, vertices: np.ndarray) -> None:
        outward = _directions(SIDES)
        inside = vertices.mean(axis=0)
        # about `inside`, which need not be near the origin
        extent = np.full(SIDES, -np.inf)
        radius = 0.0
        for first in range(0, len(vertices), VERTICES_AT_ONCE):
            block = vertices[first : first + VERTICES_AT_ONCE] - inside
            np.maximum(extent, (block @ outward.T).max(axis=0), out=extent)
            radius = max(radius, np.linalg.norm(block, axis=-1).max())
        halfspaces = np.column_stack([outward, -(extent + PADDING * radius)])
        met = scipy.spatial.HalfspaceIntersection(halfspaces, np.zeros(3)).intersections
        hull = scipy.spatial.ConvexHull(met)
        ends = np.sort(hull.simplices[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=-1)
        self.corners, self.edges = met + inside, np.unique(ends, axis=0)

    def windows(
        self, camera: Camera, camera_from_part: RigidTransform, *, pixels: int
    ) -> list[Window]:
        """Windows from top to bottom that hold every pixel whose ray may meet the part.

        Each has about ``pixels``, at least one row, and is as wide as the envelope's image is in
        its rows. An envelope that reaches behind the camera has no bounded image: every pixel then.
        """
        corners = camera_from_part.apply(self.corners)
        if (corners[:, 2] >= 0).any():
            height = max(1, pixels // camera.width)
            tops = np.arange(0, camera.height, height)
            lefts, rights = np.zeros_like(tops), np.full_like(tops, camera.width)
        else:
            column, row = camera.project(corners).T
            left, right = _whole(column.min(), column.max(), camera.width)
            top, bottom = _whole(row.min(), row.max(), camera.height)
            height = max(1, pixels // max(1, right - left))
            tops = np.arange(top, bottom, height)
            lefts, rights = _whole(*self._spans(column, row, tops, height), camera.width)
        rows = (slice(int(top), min(int(top) + height, camera.height)) for top in tops)
        columns = (slice(int(a), int(b)) for a, b in zip(lefts, rights, strict=True))
        windows = map(Window, rows, columns)
        return [window for window in windows if window.columns.stop > window.columns.start]

    def _spans(
        self, column: np.ndarray, row: np.ndarray, tops: np.ndarray, height: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest column [S] f64 of the corners' image in bands that begin at ``tops``.

        It is convex, so they are at a corner [P] within the band, or where an edge leaves it.
        """
        borders = np.append(tops, tops[-1:] + height)
        (u0, u1), (v0, v1) = column[self.edges].T, row[self.edges].T
        with np.errstate(divide="ignore", invalid="ignore"):  # level edges: their corners do
            share = (borders[:, None] - v0) / (v1 - v0)
            crossing = u0 + share * (u1 - u0)
        met = (share >= 0) & (share <= 1)
        least = np.where(met, crossing, np.inf).min(axis=1)
        greatest = np.where(met, crossing, -np.inf).max(axis=1)
        least, greatest = np.minimum(least[:-1], least[1:]), np.maximum(greatest[:-1], greatest[1:])
        band = np.floor((row - borders[0]) / height)
        within = (band >= 0) & (band < len(tops))
        band = band[within].astype(int)
        np.minimum.at(least, band, column[within])
        np.maximum.at(greatest, band, column[within])
        return least, greatest


def _directions(count: int) -> np.ndarray:
    """Unit vectors [count, 3] f64 spread evenly over the sphere: a Fibonacci lattice."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    turn = np.pi * (1 + np.sqrt(5)) * index
    radius = np.sqrt(1 - z * z)
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), z])


def _whole(least: np.ndarray, greatest: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds i64, the second exclusive, of the pixels of 0 to ``size`` that a span touches."""
    first = np.clip(np.floor(least), 0, size).astype(int)
    return first, np.clip(np.ceil(greatest), 0, size).astype(int)
