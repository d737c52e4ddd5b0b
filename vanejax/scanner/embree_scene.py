"""Embree's answers to two questions: which triangle a ray meets first, and whether a way is free.

Only this file knows embreex. Everything in it is float32: callers centre the scene on the part and
start rays just in front of it, and distances are not read. It overwrites a ``dists`` array, so it
is given a fresh one, and it builds the scene on the first query, which is not safe from two
threads: the constructor asks one. Later queries release the GIL, so threads share one scene.
"""

from __future__ import annotations

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh


class EmbreeScene:
    """Triangles for rays.

    Args:
      vertices: [V, 3] mm, near the origin; rounded to float32.
      faces: [F, 3] integer.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        # robust: without it rays slip between two triangles that share an edge
        self._scene = rtcore_scene.EmbreeScene(robust=True)
        TriangleMesh(
            self._scene, vertices.astype(np.float32), np.ascontiguousarray(faces, np.int32)
        )
        self.first_face(np.zeros((1, 3)), np.ones((1, 3)))

    def first_face(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """[N] i32, the first face that rays [N, 3] meet; -1 for none."""
        return self._scene.run(
            origins.astype(np.float32, copy=False), directions.astype(np.float32, copy=False)
        )

    def is_blocked(
        self, origins: np.ndarray, directions: np.ndarray, lengths: np.ndarray
    ) -> np.ndarray:
        """[N] bool: whether a face is met within ``lengths`` [N] times the direction [N, 3]."""
        blocker = self._scene.run(
            origins.astype(np.float32, copy=False),
            directions.astype(np.float32, copy=False),
            dists=lengths.astype(np.float32),
            query="OCCLUDED",
        )
        return blocker >= 0
