"""Where rays of pixels stop to measure planes; their depths are tested with the scanner."""

from __future__ import annotations

import numpy as np
import pytest

from vanejax.scanner import Camera, look_at
from vanejax.scanner.pixel_rays import PixelRays

CAMERA = Camera(width=320, height=256, near_mm=100)
POSE = look_at(400 * np.array([0.43301, 0.25, 0.86603]), np.array([3.0, -2.0, 1.0]))


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@pytest.mark.parametrize("backs", [False, True])
@pytest.mark.parametrize("side", [1, -1])
def test_edge_on_means_a_cosine_below_one_thousandth(side, backs):
    """Planes through the point that a ray meets at 300 mm, with a cosine of 0.8e-3 to 1.2e-3."""
    x, y = np.full(201, 0.2), np.full(201, -0.1)
    point = 300 * np.array([0.2, -0.1, -1.0])
    across = unit(np.cross(point, [0.0, 1.0, 0.0]))
    cosine = np.linspace(0.8e-3, 1.2e-3, 201)
    sine = np.sqrt(1 - cosine**2)
    normals = side * (sine[:, None] * across - cosine[:, None] * unit(point))
    local_point, local_normals = POSE.inverse().apply(point[None]), normals @ POSE.rotation
    planes = np.column_stack([local_normals, np.sum(local_point * local_normals, axis=-1)])
    rays = PixelRays(CAMERA, POSE, start_mm=320.0, farthest_mm=600.0, backs=backs)
    _, measured = rays.depth(x, y, rays.facing(planes))
    clear = np.abs(cosine - 1e-3) > 1e-9
    expected = (cosine > 1e-3) & (backs or side == 1)
    np.testing.assert_array_equal(measured[clear], expected[clear])
