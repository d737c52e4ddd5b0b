"""The envelope of a part: it holds all of it, is small whatever the mesh, and bounds its image."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.spatial
import trimesh

from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, look_at
from vanejax.scanner.image_window import SIDES, PartEnvelope, Window

POSE = look_at(400 * np.array([0.43301, 0.25, 0.86603]), np.zeros(3))


def knot(seed: int = 0, shift: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(0, [30, 20, 5], (500, 3)) + shift


def plate() -> np.ndarray:
    """As flat as a part of an open surface can be."""
    return np.array([[-40.0, -30, 7], [40, -30, 7], [40, 30, 7], [-40, 30, 7]])


@pytest.mark.parametrize(
    "vertices",
    [knot(), knot(shift=5e4), 1e-3 * knot(), plate(), plate()[:3], np.eye(2, 3) * 1e3],
    ids=["knot", "far away", "tiny", "plate", "triangle", "needle"],
)
def test_it_holds_every_vertex_with_a_margin(vertices):
    envelope = PartEnvelope(vertices)
    outward = scipy.spatial.ConvexHull(envelope.corners).equations
    beyond = vertices @ outward[:, :3].T + outward[:, 3]
    radius = np.linalg.norm(vertices - vertices.mean(axis=0), axis=-1).max()
    assert beyond.max() < -0.9e-3 * radius
    # and is not much larger: its sides are 16 deg apart, and 1 / cos 8 deg = 1.01, at a corner more
    reach = np.linalg.norm(envelope.corners - vertices.mean(axis=0), axis=-1).max()
    assert reach < 1.1 * radius


def test_its_size_is_bounded_whatever_the_mesh():
    fine = trimesh.creation.icosphere(6, 50.0).vertices
    assert len(fine) > 40_000
    envelope = PartEnvelope(fine)
    assert len(envelope.corners) <= 2 * SIDES - 4  # Euler: of a polytope of simple corners
    assert len(envelope.edges) <= 3 * len(envelope.corners) - 6
    assert np.linalg.norm(envelope.corners, axis=-1).max() < 1.05 * 50  # 1 / cos 12 deg + 1e-3


def covered(windows: list[Window], camera: Camera) -> np.ndarray:
    """[H, W] i64, in how many windows each pixel is."""
    image = np.zeros((camera.height, camera.width), int)
    for rows, columns in windows:
        image[rows, columns] += 1
    return image


def hull_pixels(vertices: np.ndarray, camera: Camera, pose: RigidTransform) -> np.ndarray:
    """[H, W] bool, the pixels whose centres lie in the image of the vertices' convex hull."""
    hull = scipy.spatial.ConvexHull(camera.project(pose.apply(vertices)))
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    centres = np.stack([column.ravel(), row.ravel(), np.ones(column.size)])
    return (hull.equations @ centres <= 0).all(axis=0).reshape(camera.height, camera.width)


CAMERAS = {
    "default": Camera(),
    "coarse": Camera(width=64, height=51),
    "narrow": Camera(width=640, height=512, fov_x_deg=6.0, fov_y_deg=3.0),  # sees a part of it
    "wide": Camera(width=640, height=512, fov_x_deg=120.0, fov_y_deg=120.0),
    "column": Camera(width=1, height=300),
    "one pixel": Camera(width=1, height=1),
}


@pytest.mark.parametrize("pixels", [1, 5000, 1 << 14, 1 << 22])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_windows_hold_every_pixel_of_the_hull_once(camera, pixels):
    for vertices in (knot(), plate()):
        windows = PartEnvelope(vertices).windows(camera, POSE, pixels=pixels)
        count = covered(windows, camera)
        wanted = hull_pixels(vertices, camera, POSE)
        assert (count[wanted] == 1).all()
        assert count.max() == 1
        tops = [window.rows.start for window in windows]
        assert tops == sorted(tops)
        assert all(w.size <= max(pixels, camera.width) for w in windows)


def test_windows_are_not_much_larger_than_the_hull():
    camera = Camera()
    vertices = knot()
    wanted = hull_pixels(vertices, camera, POSE).sum()
    envelope = PartEnvelope(vertices)
    # 6 % are the envelope's, the rest are corners of the windows
    by_row, by_strip, whole = (
        sum(w.size for w in envelope.windows(camera, POSE, pixels=pixels))
        for pixels in (1, 1 << 14, 1 << 22)
    )
    assert wanted < by_row < 1.1 * wanted
    assert by_row < by_strip < 1.2 * wanted
    assert by_strip < whole


def test_behind_and_beside_the_camera():
    camera = Camera(width=128, height=102)
    envelope = PartEnvelope(knot())
    beside = look_at(np.array([0.0, 0.0, 400.0]), np.array([500.0, 0.0, 0.0]))
    assert envelope.windows(camera, beside, pixels=1000) == []
    among = look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3))
    windows = envelope.windows(camera, among, pixels=1000)
    assert (covered(windows, camera) == 1).all()
    assert windows[0] == Window(slice(0, 7), slice(0, 128))
