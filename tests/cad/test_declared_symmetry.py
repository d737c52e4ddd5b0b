"""Declared symmetry: words, the check against the CAD model, and poses that are one."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from example_scans import box, bracket, motion, random_view
from scipy.spatial.transform import Rotation

from vanejax.cad.declared_symmetry import EXACT, Symmetry
from vanejax.cad.part import Part, part_from_mesh
from vanejax.errors import InputError
from vanejax.rigid import RigidTransform


def tube(*, keyway: bool = False) -> Part:
    """A tube about z with its axis at (7, -4) mm, as wide as it is long; with a slot of 3 mm."""
    ring = trimesh.creation.annulus(20, 30, 50, sections=96)
    if keyway:
        slot = trimesh.creation.box(bounds=[[27, -4, -5], [40, 4, 20]])
        ring = trimesh.boolean.difference([ring, slot])
    return part_from_mesh(ring.vertices + np.array([7.0, -4.0, 11.0]), ring.faces, name="tube")


def prism(sides: int) -> Part:
    """A regular prism about z, its axis at (30, 0) mm."""
    mesh = trimesh.creation.cylinder(25, 40, sections=sides)
    return part_from_mesh(mesh.vertices + np.array([30.0, 0.0, 0.0]), mesh.faces, name="prism")


def turned(part: Part, axis: str, angle_deg: float, pose: RigidTransform) -> RigidTransform:
    """A pose, then a turn of the part about an axis through its centre."""
    return motion(part, angle_deg * np.eye(3)["xyz".index(axis)], np.zeros(3)) @ pose


@pytest.mark.parametrize("text", ["none", "auto", "z:180", "z:any", "x:180,y:90", "y:51.4286"])
def test_what_is_said_is_read_and_written(text):
    assert str(Symmetry.parse(text)) == text
    assert Symmetry.parse(" z:180 , x:180").turns == (("z", 2), ("x", 2))
    assert Symmetry.parse("y:51.43").turns == (("y", 7),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("w:180", "w:180 is no axis and angle"),
        ("", "an empty term"),
        ("z", "z is no axis and angle"),
        ("z:180,", "an empty term"),
        ("z:half", "the angle half is neither degrees above 0 nor any"),
        ("z:-180", "neither degrees above 0"),
        ("z:nan", "neither degrees above 0"),
        ("z:100", "100 deg is no half, third"),
        ("z:360", "360 deg is no half, third"),
        ("z:2", "use z:any"),
    ],
)
def test_what_makes_no_sense_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        Symmetry.parse(text)


def test_nothing_declared_is_no_symmetry():
    assert Symmetry.parse("none").on(box()) is None


@pytest.mark.parametrize(
    ("text", "motions"), [("z:180", 2), ("x:180,y:180", 4), ("x:180,y:180,z:180", 4)]
)
def test_a_box_has_the_turns_that_are_declared(text, motions):
    """Its frame is not in its middle: the axes are found there."""
    symmetry = Symmetry.parse(text).on(box())
    assert symmetry.is_exact
    assert symmetry.difference_mm < 1e-4
    assert len(symmetry.motions) == motions
    # a group: products are members
    for a in symmetry.motions:
        products = a @ symmetry.motions
        assert (
            np.abs(products[:, None] - symmetry.motions).max(axis=(2, 3)).min(axis=1).max() < 1e-9
        )


def test_an_axis_away_from_the_middle_of_the_bounding_box_is_found():
    part = prism(5)
    assert abs(part.center[0] - 30) > 1
    symmetry = Symmetry.parse("z:72").on(part)
    assert symmetry.difference_mm < 1e-3
    assert len(symmetry.motions) == 5
    assert symmetry.in_words(guess=False).startswith("symmetry z:72: 5 poses are one")


@pytest.mark.parametrize(
    ("part", "text"),
    [(box, "z:90"), (box, "x:any"), (bracket, "z:180"), (lambda: prism(5), "z:180")],
)
def test_a_symmetry_that_the_part_does_not_have_is_refused(part, text):
    with pytest.raises(InputError, match=r"the CAD model does not have it: .* up to [\d.]+ mm off"):
        Symmetry.parse(text).on(part())


def test_turns_that_only_a_ball_has_are_refused():
    ball = trimesh.creation.icosphere(4, 20.0)
    ball = part_from_mesh(ball.vertices, ball.faces, name="ball")
    with pytest.raises(InputError, match="more than one free axis"):
        Symmetry.parse("x:any,y:any").on(ball)
    for text in ("x:any,y:90", "x:60,y:72"):
        with pytest.raises(InputError, match="no part but a ball"):
            Symmetry.parse(text).on(ball)
    with pytest.raises(InputError, match="the part is a ball"):
        Symmetry.parse("auto").on(ball)


def test_a_small_difference_is_the_users_word_with_its_figure():
    """The slot is 3 mm deep: so far is its floor from the round surface."""
    symmetry = Symmetry.parse("z:any").on(tube(keyway=True))
    assert symmetry.difference_mm == pytest.approx(3, abs=0.4)
    assert symmetry.difference_mm > EXACT * symmetry.radius_mm
    words = symmetry.in_words(guess=False)
    assert "by your word" in words
    assert f"at most {symmetry.difference_mm:.2g} mm" in words


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "motions", "free"),
    [(tube, 2, True), (box, 4, False), (lambda: prism(5), 10, False), (bracket, 1, False)],
)
def test_it_is_found_in_the_cad_model(part, motions, free):
    part = part()
    symmetry = Symmetry.parse("auto").on(part)
    assert len(symmetry.motions) == motions
    assert (symmetry.free_axis is not None) == free
    assert symmetry.difference_mm < 0.05
    if motions == 1:
        assert "none was found" in symmetry.in_words(guess=False)


def test_equivalent_poses_have_one_canonical_pose():
    part = box()
    symmetry = Symmetry.parse("x:180,y:180").on(part)
    pose = random_view(part, 3).inverse()
    equivalent = [pose, *(turned(part, axis, 180, pose) for axis in "xyz")]
    least = [symmetry.canonical(p).as_matrix() for p in equivalent]
    np.testing.assert_allclose(least, np.broadcast_to(least[0], (4, 4, 4)), atol=1e-9)
    angles = [Rotation.from_matrix(p.rotation).magnitude() for p in equivalent]
    assert Rotation.from_matrix(least[0][:3, :3]).magnitude() == pytest.approx(min(angles))
    for wanted in equivalent:
        guess = turned(part, "y", 20, wanted)
        near = symmetry.canonical(pose, guess)
        np.testing.assert_allclose(near.as_matrix(), wanted.as_matrix(), atol=1e-9)


def test_a_free_rotation_does_not_count():
    part = tube()
    symmetry = Symmetry.parse("z:any,x:180").on(part)
    assert len(symmetry.motions) == 2
    pose = random_view(part, 1).inverse()
    for angle, axis in ((33.0, "z"), (180.0, "x"), (-151.0, "z")):
        other = turned(part, axis, angle, pose)
        near = symmetry.canonical(other, pose)
        np.testing.assert_allclose(near.as_matrix(), pose.as_matrix(), atol=1e-6)
    tilted = turned(part, "y", 4, turned(part, "z", 70, pose))
    left = symmetry.canonical(tilted, pose) @ pose.inverse()
    assert np.degrees(Rotation.from_matrix(left.rotation).magnitude()) == pytest.approx(4, abs=1e-6)
