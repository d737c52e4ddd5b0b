"""Scenes: the part stays what it is, and things touch it as things do."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.spatial
import trimesh
from example_scans import SMALL, VIEW, bracket, solid, vane

from vanejax.cad import Part
from vanejax.errors import InputError
from vanejax.rigid import RigidTransform
from vanejax.scanner import Scanner, hemisphere_viewpoints
from vanejax.scanner.clutter import (
    Clutter,
    ClutterScene,
    chips,
    clamps,
    clutter_scene,
    coolant_drops,
    table,
)

FULL = Clutter(table=True, tilt_deg=3.0, clamps=2, chips=25, drops=20)
ROUNDING_MM = 1e-4  # float32 at 600 mm is good to 3e-5 mm


def above(part: Part) -> RigidTransform:
    return hemisphere_viewpoints(part.center).view(VIEW)


@pytest.fixture(scope="module")
def full() -> ClutterScene:
    return clutter_scene(vane(), FULL, np.random.default_rng([0, 1]))


def test_no_clutter_is_the_bare_part_bit_for_bit():
    scene = clutter_scene(vane(), Clutter(), np.random.default_rng(0))
    assert scene.objects == ()
    seen = scene.scanner().scan(SMALL, above(vane()))
    bare = Scanner(vane()).scan(SMALL, above(vane()))
    for name in ("points", "normals", "face", "pixel"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(bare, name))
    assert (scene.owner(seen.face) == 0).all()


def test_what_is_seen_of_the_part_is_what_was_seen_without_the_rest(full):
    """The part's faces keep their numbers, and its points their places; the rest only hides."""
    seen = full.scanner().scan(SMALL, above(vane()))
    bare = Scanner(vane()).scan(SMALL, above(vane()))
    mine = full.owner(seen.face) == 0
    np.testing.assert_array_equal(mine, seen.face < len(vane().mesh.faces))
    before = np.isin(seen.pixel[mine], bare.pixel)
    # a ray along an edge may go either way
    assert np.count_nonzero(~before) <= 2
    place = np.searchsorted(bare.pixel, seen.pixel[mine][before])
    gap = np.abs(seen.points[mine][before] - bare.points[place]).max(axis=1)
    assert np.mean(gap < ROUNDING_MM) > 0.999
    # and what is hidden of it is hidden by something nearer
    lost = np.setdiff1d(bare.pixel, seen.pixel[mine])
    assert 20 < len(lost) < 0.5 * len(bare.pixel)
    range_now = seen.range_mm[np.searchsorted(seen.pixel, lost)]
    assert (range_now < bare.range_mm[np.searchsorted(bare.pixel, lost)] + ROUNDING_MM).all()


def test_a_seed_is_a_scene(full):
    again = clutter_scene(vane(), FULL, np.random.default_rng([0, 1]))
    other = clutter_scene(vane(), FULL, np.random.default_rng([0, 2]))
    assert full.surface.sha256 == again.surface.sha256
    assert full.surface.sha256 != other.surface.sha256


def test_everything_is_a_closed_solid_with_its_outside_outside(full):
    kinds = [item.kind for item in full.objects]
    assert [kinds.count(k) for k in ("table", "clamp", "chip", "drop")] == [1, 2, 25, 20]
    for item in full.objects:
        assert item.mesh.is_watertight
        assert item.mesh.is_winding_consistent
        assert item.mesh.volume > 0


@pytest.mark.parametrize("tilt", [0.0, 8.0])
def test_the_part_touches_the_table_and_does_not_sink_in(tilt):
    plate = table(bracket(), tilt_deg=tilt, azimuth_deg=40.0).mesh
    a, b = np.radians([tilt, 40.0])
    normal = np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])
    top = float(np.max(plate.vertices @ normal))
    # the upper face is the one whose normal that is
    assert np.sum(np.linalg.norm(plate.face_normals - normal, axis=1) < 1e-9) == 2
    assert np.min(bracket().mesh.vertices @ normal) - top == pytest.approx(0, abs=1e-9)
    aside = np.cross(normal, plate.vertices.mean(axis=0) - bracket().center)
    np.testing.assert_allclose(aside, 0, atol=1e-9)  # in the part's middle


def test_jaws_touch_the_part_from_the_side_and_hide_some_of_it():
    part = vane()
    vertices = np.asarray(part.mesh.vertices)
    for seed in range(4):
        for jaw in clamps(part, np.random.default_rng(seed), 3):
            outward = jaw.mesh.vertices.mean(axis=0) - part.center
            hull = scipy.spatial.ConvexHull(jaw.mesh.vertices)
            gap = np.max(vertices @ hull.equations[:, :3].T + hull.equations[:, 3], axis=1)
            assert gap.min() == pytest.approx(0, abs=1e-6)  # touches, and nothing is inside
            assert outward[:2] @ outward[:2] > 30**2
            assert jaw.mesh.bounds[0, 2] == pytest.approx(part.mesh.bounds[0, 2])
            touching = vertices[gap < 1e-6]
            assert jaw.mesh.bounds[1, 2] - touching[:, 2].max() > 2 - 1e-9


def test_chips_lie_on_something_and_in_nothing():
    box = trimesh.creation.box(bounds=[[-40, -30, 0], [40, 30, 20]])
    part = solid(box)
    plate = table(part)
    below = ClutterScene(part, (plate,)).scanner()
    found = chips(below, part, np.random.default_rng(3), 40)
    assert len(found) == 40
    heights = set()
    for chip in found:
        x, y, z = np.asarray(chip.mesh.vertices).T
        on_part = (np.abs(x) < 40) & (np.abs(y) < 30)
        clear = z - np.where(on_part, 20.0, 0.0)
        middle = np.abs([x.mean(), y.mean()])
        hangs = on_part.any() and not (middle < [40, 30]).all()
        assert clear.min() >= -ROUNDING_MM
        assert clear.min() < ROUNDING_MM or hangs or not on_part.all()
        heights.add(bool((middle < [40, 30]).all()))
        assert 1.5 < chip.mesh.extents.max() < 16
    assert heights == {True, False}  # on the part and on the table


def test_drops_sit_on_a_sphere_along_its_normal():
    """On a sphere of 50 mm the top of a cap lies on the line through the sphere's middle."""
    part = solid(trimesh.creation.icosphere(5, 50.0))
    found = coolant_drops(Scanner(part), part, np.random.default_rng(1), 30)
    assert len(found) == 30
    for drop in found:
        distance = np.linalg.norm(drop.mesh.vertices, axis=1)
        top = drop.mesh.vertices[np.argmax(distance)]
        base = drop.mesh.vertices[np.argmin(distance)]
        assert 0.17 < distance.max() - 50 < 3.6  # a tan(contact / 2), a from 1 to 5
        # facets of 3 mm turn the normal by up to 2 deg
        assert np.dot(top, base) / distance.max() / distance.min() > np.cos(np.radians(2))
        assert distance.min() < 50 - 0.25  # the skirt: no gap below the rim


def test_a_table_on_edge_is_refused():
    with pytest.raises(InputError, match="table"):
        table(bracket(), tilt_deg=90.0)
