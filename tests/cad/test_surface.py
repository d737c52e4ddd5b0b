"""Nearest surface points against every triangle, and against the bounds of grid and samples."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from example_scans import box, model, vane
from trimesh.triangles import closest_point

from vanejax.cad import NearestFace, Part
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
    cell = (np.ptp(part.mesh.bounds, axis=0).max() + 0.6 * part.radius) / CELLS
    coarse = np.linalg.norm(points - found.coarse(points).points, axis=1)
    nearest = np.linalg.norm(points - found.nearest(points).points, axis=1)
    assert (coarse >= nearest).all()
    # a cell's diagonal at the point and one at the sample
    assert np.max(coarse - nearest) <= 2 * np.sqrt(3) * cell
    assert np.mean(coarse - nearest) < 0.5 * cell


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


@pytest.mark.parametrize("spread_mm", [1e-3, 30.0, 2000.0])
def test_no_face_is_nearer(spread_mm: float) -> None:
    rng = np.random.default_rng(0)
    start, _, _ = vane().sample(25, seed=1)
    points = start + rng.normal(0, spread_mm, start.shape)
    closest = NearestFace(vane()).closest_points(points)
    distance = np.linalg.norm(points - closest.points, axis=1)
    least = distance_to_every_triangle(vane(), points)
    np.testing.assert_allclose(distance, least, rtol=1e-12, atol=1e-12)
    corners = np.asarray(vane().mesh.triangles)[closest.face]
    np.testing.assert_allclose(closest_point(corners, points), closest.points, rtol=0, atol=1e-12)


def test_the_sides_of_a_box_edges_and_corners_too() -> None:
    """Signed distances of a box are known: inside min(half - |x|), outside |max(|x| - half, 0)|."""
    half = np.array([40.0, 25.0, 15.0])
    steps = [np.linspace(-h - 8, h + 8, 15) for h in half]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    beyond = np.abs(points) - half
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    truth = np.where((beyond < 0).all(axis=1), beyond.max(axis=1), outside)
    closest = NearestFace(box()).closest_points(points + box().center)
    off = points + box().center - closest.points
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), np.abs(truth), rtol=0, atol=1e-12)
    side = np.einsum("ni,ni->n", off, closest.normals)
    assert np.count_nonzero(truth > 0) > 400
    assert np.count_nonzero(truth < 0) > 400
    assert (np.sign(side) == np.sign(truth))[np.abs(truth) > 1e-9].all()


def test_more_points_than_go_at_once(monkeypatch) -> None:
    points = box().sample(100, seed=0)[0] + 1.5
    whole = NearestFace(box()).closest_points(points)
    monkeypatch.setattr("vanejax.cad.surface.PAIRS_AT_ONCE", 64)
    for one, other in zip(whole, NearestFace(box()).closest_points(points), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_face_without_area_does_no_harm() -> None:
    """Such faces stay in an open surface: the two that are left are looked at."""
    vertices = np.array([[0.0, 0, 0], [30, 0, 0], [30, 30, 0], [0, 30, 0], [15, 0, 0]])
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3], [0, 4, 1]], process=False)
    closest = NearestFace(Part(mesh=mesh, name="sheet", notes=(), closed=False)).closest_points(
        np.array([[10.0, 5, 2], [40.0, 5, 0], [14.0, -5, 0]])
    )
    expected = [[10, 5, 0], [30, 5, 0], [14, 0, 0]]
    np.testing.assert_allclose(closest.points, expected, rtol=0, atol=1e-12)
    assert set(closest.face) <= {0, 1}
