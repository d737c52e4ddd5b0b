"""The part is taken out of its scene, and nothing is taken from a part without one."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from example_scans import bracket, measured_points, random_view, solid, vane, with_noise

from vanejax.cad import Part
from vanejax.errors import InputError
from vanejax.scanner import Camera, hemisphere_viewpoints
from vanejax.scanner.clutter import Clutter, ClutterObject, ClutterScene, clutter_scene, table
from vanejax.scans.segmentation import Segment, is_larger, segment
from vanejax.scans.table_planes import largest_slab_mm2

CAMERA = Camera(width=400, height=320, near_mm=200.0)
ORIGIN = np.zeros(3)


def seen(scene: ClutterScene, view: int = 103, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] mm with 0.1 mm of noise, and what they are [N]: "part", "table", ..."""
    pose = hemisphere_viewpoints(scene.part.center).view(view)
    scan = scene.scanner().scan(CAMERA, pose)
    kinds = np.array(["part", *(item.kind for item in scene.objects)])
    points = with_noise(scan.points.astype(np.float64), 0.1, seed)
    return points, kinds[scene.owner(scan.face)]


def plate(x: float = 100.0, y: float = 80.0, z: float = 5.0) -> Part:
    return solid(trimesh.creation.box((x, y, z)))


def share(labels: np.ndarray, segment: Segment) -> float:
    return float(np.mean(labels == segment))


@pytest.mark.parametrize("seed", range(4))
def test_a_vane_among_everything_is_found(seed):
    clutter = Clutter(table=True, tilt_deg=3.0, clamps=2, chips=30, drops=20)
    scene = clutter_scene(vane(), clutter, np.random.default_rng([1, seed]))
    points, kind = seen(scene, view=40 * seed + 3, seed=seed)
    found = segment(points, vane(), sensor_origin=ORIGIN)
    assert len(found.tables) == 1
    assert share(found.label[kind == "table"], Segment.TABLE) > 0.99
    assert share(found.label[kind == "clamp"], Segment.OTHER) > 0.9
    assert share(found.label[kind == "part"], Segment.PART) > 0.8
    assert np.mean(kind[found.part] == "part") > 0.85  # what lies on it stays
    assert found.count(Segment.PART) == np.count_nonzero(found.part)


@pytest.mark.parametrize("origin", [ORIGIN, None])
@pytest.mark.parametrize("name", ["vane", "bracket", "plate", "cube"])
def test_nothing_is_taken_from_a_part_alone(name, origin):
    """Large flat faces are the part's own, whatever they look like."""
    cube = plate(60.0, 60.0, 60.0)
    part = {"vane": vane(), "bracket": bracket(), "plate": plate(), "cube": cube}[name]
    for seed in range(4):
        points, _ = measured_points(part, random_view(part, seed), camera=CAMERA)
        found = segment(points, part, sensor_origin=origin)
        assert found.tables == ()
        assert found.part.all()
        assert not is_larger(points, part)


def test_a_plate_on_a_table_is_not_the_table():
    part = plate()
    points, kind = seen(ClutterScene(part, (table(part),)))
    found = segment(points, part, sensor_origin=ORIGIN)
    assert share(found.label[kind == "table"], Segment.TABLE) > 0.99
    assert share(found.label[kind == "part"], Segment.PART) > 0.98
    assert is_larger(points, part)


def test_the_plane_found_is_the_tables():
    scene = ClutterScene(vane(), (table(vane(), tilt_deg=4.0, azimuth_deg=70.0),))
    pose = hemisphere_viewpoints(vane().center).view(103)
    points, kind = seen(scene)
    (plane,) = segment(points, vane(), sensor_origin=ORIGIN).tables
    corners = pose.apply(np.asarray(scene.objects[0].mesh.vertices))
    top = np.sort(plane.height_mm(corners))[4:]
    np.testing.assert_allclose(top, 0, atol=0.05)  # 40,000 points of 0.1 mm; 420 mm from the middle
    assert plane.height_mm(points[kind == "part"]).min() > -0.5
    assert plane.thickness_mm == pytest.approx(0.4, rel=0.2)  # four times the noise


def test_pieces_of_a_part_are_joined():
    """A broad stripe is lost, as to a highlight: both halves stay."""
    points, _ = measured_points(vane(), camera=CAMERA)
    across = points[:, 1] - np.median(points[:, 1])
    points = points[np.abs(across) > 8]
    assert segment(points, vane(), sensor_origin=ORIGIN).part.all()


def test_a_block_larger_than_the_part_is_not_the_part():
    """It has more points than the part, at a place of its own."""
    part = bracket()
    low = part.mesh.bounds[0] - [110, 0, 0]
    block = trimesh.creation.box(bounds=[low, np.add(low, [95, 90, 45])])
    scene = ClutterScene(part, (ClutterObject("clamp", block),))
    points, kind = seen(scene, view=3)
    assert np.sum(kind == "clamp") > 1.3 * np.sum(kind == "part")
    found = segment(points, part, sensor_origin=ORIGIN)
    assert share(found.label[kind == "part"], Segment.PART) > 0.99
    assert share(found.label[kind == "clamp"], Segment.OTHER) > 0.99


def test_strays_are_other_things():
    points, _ = measured_points(vane(), camera=CAMERA)
    strays = points.mean(axis=0) + np.array([[500.0, 0, 0], [0, 4e4, 0], [0, 0, -3e7]])
    found = segment(np.concatenate([points, strays]), vane(), sensor_origin=ORIGIN)
    assert found.part[: len(points)].all()
    np.testing.assert_array_equal(found.label[len(points) :], Segment.OTHER)
    assert not is_larger(np.concatenate([points, strays]), vane())


def test_moving_or_sorting_the_scan_changes_hardly_anything():
    """The cubes lie otherwise, so a few points may; the same scan gives the same labels."""
    clutter = Clutter(table=True, clamps=2, chips=10)
    points, _ = seen(clutter_scene(vane(), clutter, np.random.default_rng(2)))
    first = segment(points, vane(), sensor_origin=ORIGIN)
    again = segment(points, vane(), sensor_origin=ORIGIN)
    np.testing.assert_array_equal(first.label, again.label)
    pose = random_view(vane(), 5)
    moved = segment(pose.apply(points), vane(), sensor_origin=pose.translation)
    assert np.mean(moved.label == first.label) > 0.97
    order = np.random.default_rng(0).permutation(len(points))
    mixed = segment(points[order], vane(), sensor_origin=ORIGIN)
    assert np.mean(mixed.label == first.label[order]) > 0.97


def test_the_largest_slab_of_a_box_is_its_largest_face():
    """With 1 mm to either side, strips of its walls count, and planes that are a little tilted."""
    assert largest_slab_mm2(plate(80.0, 50.0, 30.0), 1.0) == pytest.approx(
        80 * 50 + 2 * (80 + 50), rel=0.08
    )
    # both faces of a sheet
    assert largest_slab_mm2(plate(z=1.0), 1.0) == pytest.approx(2 * 100 * 80, rel=0.05)


@pytest.mark.parametrize("wrong", [np.zeros((5, 2)), np.zeros((0, 3)), np.zeros(3)])
def test_what_is_no_scan(wrong):
    with pytest.raises(InputError, match="points"):
        segment(wrong, vane())
