"""The nearest face of all, against a loop over every face; the side of a sharp edge."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from example_scans import vane
from trimesh.triangles import closest_point

from vanejax.cad import NearestFace, Part, part_from_mesh


@pytest.fixture(scope="module")
def box() -> Part:
    mesh = trimesh.creation.box((40.0, 60.0, 10.0))
    return part_from_mesh(mesh.vertices, mesh.faces, name="box")


@pytest.mark.parametrize("spread_mm", [1e-3, 30.0, 2000.0])
def test_no_face_is_nearer(spread_mm: float) -> None:
    rng = np.random.default_rng(0)
    start, _, _ = vane().sample(25, seed=1)
    points = start + rng.normal(0, spread_mm, start.shape)
    closest = NearestFace(vane()).closest_points(points)
    corners = np.asarray(vane().mesh.triangles)
    for point, foot, face in zip(points, closest.points, closest.face, strict=True):
        every = closest_point(corners, np.broadcast_to(point, (len(corners), 3)))
        least = np.linalg.norm(every - point, axis=1).min()
        assert np.linalg.norm(foot - point) == pytest.approx(least, rel=1e-12, abs=1e-12)
        np.testing.assert_allclose(every[face], foot, rtol=0, atol=1e-12)


def test_the_sides_of_a_box_edges_and_corners_too(box: Part) -> None:
    """Signed distances of a box are known: inside min(half - |x|), outside |max(|x| - half, 0)|."""
    half = np.array([20.0, 30.0, 5.0])
    steps = [np.linspace(-h - 8, h + 8, 15) for h in half]
    points = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    beyond = np.abs(points) - half
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    truth = np.where((beyond < 0).all(axis=1), beyond.max(axis=1), outside)
    closest = NearestFace(box).closest_points(points)
    off = points - closest.points
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), np.abs(truth), rtol=0, atol=1e-12)
    side = np.einsum("ni,ni->n", off, closest.normals)
    assert np.count_nonzero(truth > 0) > 400
    assert np.count_nonzero(truth < 0) > 400
    assert (np.sign(side) == np.sign(truth))[np.abs(truth) > 1e-9].all()


def test_more_points_than_go_at_once(box: Part, monkeypatch) -> None:
    points, _, _ = box.sample(100, seed=0)
    points = points + 1.5
    whole = NearestFace(box).closest_points(points)
    monkeypatch.setattr("vanejax.cad.nearest_face.PAIRS_AT_ONCE", 64)
    parts = NearestFace(box).closest_points(points)
    for name in ("points", "normals", "face"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))


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
