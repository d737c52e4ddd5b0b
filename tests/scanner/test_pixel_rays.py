"""The rays of a view's pixels against the camera's own, and where they meet planes."""

from __future__ import annotations

import numpy as np
import pytest

from vanejax.scanner import Camera, look_at
from vanejax.scanner.pixel_rays import PixelRays

CAMERA = Camera(width=320, height=256, near_mm=100)
POSE = look_at(400 * np.array([0.43301, 0.25, 0.86603]), np.array([3.0, -2.0, 1.0]))


def view(*, backs: bool = False) -> PixelRays:
    return PixelRays(CAMERA, POSE, start_mm=320.0, farthest_mm=600.0, backs=backs)


def planes_through(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    return np.column_stack([normals, np.sum(points * normals, axis=-1)])


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_depths_are_where_rays_meet_their_planes():
    rng = np.random.default_rng(0)
    column, row = rng.integers(0, 320, 500), rng.integers(0, 256, 500)
    depth = rng.uniform(50, 1500, 500)
    x, y = CAMERA.slopes(column, row)
    at_camera = depth[:, None] * np.stack([x, y, np.full(500, -1.0)], axis=-1)
    points = POSE.inverse().apply(at_camera)
    rays = unit(points - POSE.inverse().translation)
    normals = unit(rng.normal(size=(500, 3)))
    cosine = -np.sum(normals * rays, axis=-1)
    normals *= np.where(np.arange(500) < 400, np.sign(cosine), -np.sign(cosine))[:, None]
    between = (depth >= 100) & (depth <= 1300)
    assert 300 < between.sum() < 480
    for backs in (False, True):
        seen = view(backs=backs)
        planes = seen.facing(planes_through(points, normals))
        found, measured = seen.depth(x, y, planes)
        np.testing.assert_allclose(found, depth, rtol=1e-9)  # f64 eps / the least cosine, 1e-4
        expected = between if backs else between & (np.arange(500) < 400)
        np.testing.assert_array_equal(measured, expected)
        facing = (
            POSE.rotate(normals) * np.where(np.arange(500) < 400, 1, -1 if backs else 1)[:, None]
        )
        np.testing.assert_allclose(planes[:, :3], facing, atol=1e-14)


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
    local = planes_through(POSE.inverse().apply(np.tile(point, (201, 1))), normals @ POSE.rotation)
    seen = view(backs=backs)
    _, measured = seen.depth(x, y, seen.facing(local))
    clear = np.abs(cosine - 1e-3) > 1e-9
    expected = (cosine > 1e-3) & (backs or side == 1)
    np.testing.assert_array_equal(measured[clear], expected[clear])
