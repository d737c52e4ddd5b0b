"""Nearest surface points against every triangle, and against the bounds of grid and samples."""

from __future__ import annotations

import numpy as np
import pytest
from example_scans import box, model, vane
from trimesh.triangles import closest_point

from vanejax.cad import Part
from vanejax.cad.surface import CELLS, Surface


def distance_to_every_triangle(part: Part, points: np.ndarray) -> np.ndarray:
    """The smallest distance [n] over all faces, one point at a time."""
    triangles = np.asarray(part.mesh.triangles)
    distance = []
    for point in points:
        closest = closest_point(triangles, np.broadcast_to(point, (len(triangles), 3)))
        distance.append(np.linalg.norm(closest - point, axis=1).min())
    return np.array(distance)


def around(part: Part, count: int, reach: float, seed: int = 0) -> np.ndarray:
    """Points [n, 3] in the part's bounding box, grown by ``reach`` of its radius."""
    low, high = part.mesh.bounds
    grow = reach * part.radius
    return np.random.default_rng(seed).uniform(low - grow, high + grow, (count, 3))


def surface(part: Part) -> Surface:
    return model(part).surface


@pytest.mark.parametrize("make", [vane, box])
def test_exact_feet_are_on_the_surface_of_the_face_that_they_name(make):
    part = make()
    points = around(part, 500, 0.2)
    closest = surface(part).exact(points)
    corners = np.asarray(part.mesh.triangles)[closest.face]
    again = closest_point(corners, points)
    np.testing.assert_allclose(closest.points, again, atol=1e-9)  # f64 eps x 100 mm x 100
    np.testing.assert_allclose(closest.normals, part.mesh.face_normals[closest.face], atol=1e-12)


def test_exact_is_the_nearest_of_all_triangles_of_a_box():
    points = around(box(), 300, 0.3)
    closest = surface(box()).exact(points)
    distance = np.linalg.norm(points - closest.points, axis=1)
    np.testing.assert_allclose(distance, distance_to_every_triangle(box(), points), atol=1e-9)


def test_samples_are_the_nearest_samples():
    found = surface(vane())
    points = around(vane(), 50, 0.2)
    closest = found.nearest(points)
    distance = np.linalg.norm(points - closest.points, axis=1)
    every = np.linalg.norm(points[:, None] - found.points, axis=-1)
    np.testing.assert_array_equal(distance, every.min(axis=1))
    index = every.argmin(axis=1)
    np.testing.assert_array_equal(closest.normals, found.normals[index])
    np.testing.assert_array_equal(closest.face, found.face[index])


@pytest.mark.parametrize("make", [vane, box])
def test_the_grid_is_right_to_a_cell(make):
    part = make()
    found = surface(part)
    points = around(part, 3000, 0.29)
    low, high = part.mesh.bounds
    cell = (np.ptp(part.mesh.bounds, axis=0).max() + 0.6 * part.radius) / CELLS
    coarse = np.linalg.norm(points - found.coarse(points).points, axis=1)
    nearest = np.linalg.norm(points - found.nearest(points).points, axis=1)
    assert (coarse >= nearest).all()
    # a cell's diagonal at the point and one at the sample
    assert np.max(coarse - nearest) <= 2 * np.sqrt(3) * cell
    assert np.mean(coarse - nearest) < 0.5 * cell
    assert (high > low).all()


def test_beyond_the_grid_the_border_answers():
    """Far points come from poses on their way: any sensible sample will do, but it must be one."""
    part, found = vane(), surface(vane())
    far = part.center + 1e4 * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, -1]])
    closest = found.coarse(far)
    assert np.isfinite(closest.points).all()
    side = np.sign(far - part.center)
    axis = np.argmax(np.abs(side), axis=1)
    rows = np.arange(len(far))
    assert (closest.points[rows, axis] * side[rows, axis] > 0).all()  # on the side that faces them


def test_no_point_at_all_has_no_feet():
    found = surface(box())
    for ask in (found.coarse, found.nearest, found.exact):
        assert ask(np.zeros((0, 3))).points.shape == (0, 3)
