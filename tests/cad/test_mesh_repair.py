"""Repairs: what is mended comes out as the solid it should have been, the rest is refused."""

from __future__ import annotations

import hypothesis
import numpy as np
import pytest
import trimesh
from hypothesis import strategies as st

from vanejax.cad import mesh_repair
from vanejax.cad.mesh_repair import repair_solid
from vanejax.cad.triangles import Edges
from vanejax.errors import InputError


def box(extents=(100.0, 50.0, 20.0), at=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation(at)
    return mesh


def ball(radius: float = 50.0, at=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(3, radius)
    mesh.apply_translation(at)
    return mesh


def both(*meshes: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.util.concatenate(list(meshes))
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def repaired(vertices, faces) -> tuple[trimesh.Trimesh, str]:
    """The solid and its notes as one text; whatever went in, it is closed and outward."""
    solid, notes = repair_solid(np.asarray(vertices), np.asarray(faces), name="part")
    assert not np.any(Edges.of(solid.faces).net)
    assert solid.volume() > 0
    return trimesh.Trimesh(solid.points, solid.faces, process=False), "; ".join(notes)


@pytest.mark.parametrize(("apart_mm", "says"), [(0.0, ""), (2e-4, "welded")])
def test_a_soup_of_triangles_is_welded(apart_mm, says):
    soup = ball().triangles.reshape(-1, 3)
    soup = soup + np.random.default_rng(0).uniform(-apart_mm, apart_mm, soup.shape)
    mesh, notes = repaired(soup, np.arange(len(soup)).reshape(-1, 3))
    assert (says in notes) if says else notes == ""
    assert mesh.is_watertight
    assert len(mesh.vertices) == len(ball().vertices)


BALL, BOX, SMALL_BOX = ball(), box(), box((10, 10, 10))
FAR_BOX, CAVITY = box(at=(200, 0, 0)), box((10, 10, 10))
FAR_BOX.invert()
CAVITY.invert()
STRAY = [[0, 0, 60], [1, 0, 60], [2, 0, 60]]
HOLLOW = both(BALL, CAVITY)
EXTRA = [[0, 0, 1], [2, 3, 2], *BOX.faces[:2], BOX.faces[5][[1, 2, 0]]]  # collapsed or repeated


@pytest.mark.parametrize(
    ("mesh", "solid", "says"),
    [
        (
            both(BOX, FAR_BOX),
            [BOX, BOX],
            "turned 1 inside-out body outward; has 2 separate bodies",
        ),
        (
            (BOX.vertices, [*BOX.faces, *EXTRA]),
            [BOX],
            "dropped 2 collapsed faces; dropped 3 faces that repeat or cancel another",
        ),
        (
            ([*BOX.vertices, *STRAY], [*BOX.faces, [8, 9, 10]]),
            [BOX],
            "dropped 1 face without area",
        ),
        (
            (BALL.vertices, [*BALL.faces, *BALL.faces[:, ::-1]]),
            [BALL],
            "dropped 1280 faces of a surface written two-sided",
        ),
        ((BOX.vertices, BOX.faces[1:]), [BOX], "filled 1 hole, the largest 53.9 mm across"),
        (
            both(BALL, SMALL_BOX),
            [BALL],
            "united 2 bodies that overlap or touch (their inner walls are gone)",
        ),
        (HOLLOW, [BALL], "dropped 1 closed cavity that no camera can see"),
        (
            (HOLLOW[0], HOLLOW[1][:, ::-1]),
            [BALL],
            "turned 1 inside-out body outward; dropped 1 closed cavity that no camera can see",
        ),
    ],
)
def test_what_can_be_mended_comes_out_as_the_solid_meant(mesh, solid, says):
    again, notes = repaired(*mesh)
    assert notes == says
    assert len(again.faces) == sum(len(body.faces) for body in solid)
    assert again.volume == pytest.approx(sum(body.volume for body in solid), rel=1e-7)  # float32


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_any_winding_is_mended(share):
    mesh = ball()
    flip = np.random.default_rng(1).random(len(mesh.faces)) < share
    faces = np.where(flip[:, None], mesh.faces[:, ::-1], mesh.faces)
    again, notes = repaired(mesh.vertices, faces)
    good, _ = repaired(mesh.vertices, mesh.faces)
    np.testing.assert_array_equal(again.faces, good.faces)
    assert "to agree with the neighbours" in notes


def test_small_holes_are_filled():
    mesh = trimesh.creation.icosphere(5, 50.0)  # edges of 2 mm
    ring = np.flatnonzero(np.any(mesh.faces == 700, axis=1))
    lone = next(
        f for f in range(len(mesh.faces)) if not np.isin(mesh.faces[f], mesh.faces[ring]).any()
    )
    rest = np.delete(mesh.faces, [*ring, lone], axis=0)
    again, notes = repaired(mesh.vertices, rest)
    assert notes.startswith("filled 2 holes, the largest ")
    assert again.is_watertight
    # a flat lid on a cap 2 mm wide takes 0.2 mm^3 of 523,000
    assert again.volume == pytest.approx(mesh.volume, rel=1e-6)


def moebius_strip() -> tuple[np.ndarray, np.ndarray]:
    turn = np.linspace(0, 2 * np.pi, 30, endpoint=False)[:, None]
    across = np.array([[-5, 5]])
    r = 40 + across * np.cos(turn / 2)
    xyz = np.stack([r * np.cos(turn), r * np.sin(turn), across * np.sin(turn / 2)], -1)
    a, b = np.arange(60).reshape(30, 2).T
    c, d = np.roll(a, -1), np.roll(b, -1)
    c[-1], d[-1] = 1, 0  # joined with a twist
    return xyz.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def with_a_fin() -> tuple[np.ndarray, np.ndarray]:
    a, b = box().faces[0][:2]
    return np.concatenate([box().vertices, [[0.0, 0, 90]]]), [*box().faces, [a, b, 8]]


def with_a_coordinate(value: float) -> tuple[np.ndarray, np.ndarray]:
    vertices = np.array(BOX.vertices)
    vertices[5, 1] = value
    return vertices, BOX.faces


SQUARE = [[0.0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0]]
SLIVER = [[0.0, 0, 0], [100, 0, 0], [0, 1e-4, 0]]  # narrower than the welding's reach


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ((SQUARE, [[0, 1, 2], [0, 2, 3], [0, 1, 3], [1, 2, 3]]), "part: encloses no volume"),
        ((np.zeros((3, 3)), [[0, 1, 2]]), "collapsed to a line or a point"),
        ((SLIVER, [[0, 1, 2]]), "every face is collapsed"),
        (moebius_strip(), "one side only"),
        (with_a_fin(), "at 1 edge three or more surfaces meet"),
        (
            (box().vertices, box().faces[box().face_normals[:, 2] < 0.5]),
            "part: not a closed solid: 4 open edges around 1 hole, ",
        ),
        (both(box(at=(2e4, 0, 0))), "single precision rounds"),
        (both(*(box((1, 1, 1), at=(2 * i, 0, 0)) for i in range(257))), "257 separate bodies"),
        (with_a_coordinate(np.nan), r"1 of 8 vertices are not finite .*vertex 5\)"),
        (with_a_coordinate(np.inf), r"1 of 8 vertices are not finite .*vertex 5\)"),
        # arrays that are no mesh
        ((np.zeros((0, 3)), np.zeros((0, 3), int)), "has no faces"),
        ((np.zeros((4, 3)), np.zeros((0, 3), int)), "has no faces"),
        ((np.zeros((4, 2)), [[0, 1, 2]]), r"vertices have shape \(4, 2\)"),
        ((np.zeros((4, 3)), [[0, 1, 2, 3]]), r"faces have shape \(1, 4\)"),
        ((np.zeros((4, 3)), [[0.0, 1, 2]]), "not integer"),
        ((np.zeros((4, 3)), [[0, 1, 4]]), r"outside 0\.\.3"),
        ((np.zeros((4, 3)), [[0, 1, -1]]), r"outside 0\.\.3"),
    ],
)
def test_what_is_no_solid_is_refused(mesh, message):
    with pytest.raises(InputError, match=message):
        repaired(*mesh)


def test_vertices_that_meet_by_the_thousand_are_not_paired_one_by_one(monkeypatch):
    """A cone whose faces share no vertex: all of its tips are less than a micrometre apart."""
    count = 60
    turn = 2 * np.pi * np.arange(count + 1) / count
    rim = np.stack([50 * np.cos(turn), 50 * np.sin(turn), 0 * turn], axis=1)
    tips = np.array([0, 0, 40]) + np.random.default_rng(0).uniform(-2e-5, 2e-5, (count, 3))
    side = np.stack([rim[:-1], rim[1:], tips], axis=1)
    base = np.stack([rim[1:], rim[:-1], np.zeros((count, 3))], axis=1)
    soup = np.concatenate([side, base]).reshape(-1, 3)
    faces = np.arange(len(soup)).reshape(-1, 3)
    cone, notes = repaired(soup, faces)
    assert "welded" in notes
    assert cone.is_watertight
    monkeypatch.setattr(mesh_repair, "MAX_PAIRS", count)  # there are count^2 / 2
    with pytest.raises(InputError, match="open edges"):
        repaired(soup, faces)


def test_too_many_faces_are_refused(monkeypatch):
    monkeypatch.setattr(mesh_repair, "MAX_FACES", 11)
    with pytest.raises(InputError, match="12 faces are more than the 11"):
        repaired(box().vertices, box().faces)


CORNER = st.tuples(*[st.integers(0, 2)] * 3)
# a body whose edge is used four times, and a union that lays two faces on one another
TOUCHING_ITSELF = [
    [(0, 2, 0), (1, 2, 0), (2, 0, 2), (0, 1, 2)],
    [(0, 1, 2), (0, 2, 0), (2, 2, 1), (1, 0, 2)],
    [(1, 1, 2), (1, 1, 1), (1, 2, 2), (2, 0, 1)],
]
THIN_UNION = [
    [(0, 2, 0), (2, 0, 2), (1, 1, 2), (0, 0, 2)],
    [(2, 2, 0), (0, 0, 1), (1, 1, 2), (0, 2, 2)],
    [(0, 0, 1), (2, 2, 0), (0, 1, 2), (1, 1, 1)],
]


@hypothesis.given(
    st.lists(st.tuples(*[CORNER] * 4), min_size=1, max_size=5),
    st.lists(st.integers(0, 19), max_size=2, unique=True),
    st.lists(st.tuples(*[CORNER] * 3), max_size=2),
)
@hypothesis.example(TOUCHING_ITSELF, [], [])
@hypothesis.example(THIN_UNION, [], [])
@hypothesis.settings(max_examples=100, deadline=None)
def test_any_triangles_give_a_closed_solid_or_an_input_error(tetrahedra, lost, added):
    """Tetrahedra on a coarse grid, with faces lost and added: every coincidence turns up."""
    soup = [(t[i], t[j], t[k]) for t in tetrahedra for i, j, k in SIDES]
    for face in lost:
        soup[face % len(soup)] = soup[-1]
    vertices = np.array(soup + added, float).reshape(-1, 3)
    try:
        repaired(vertices, np.arange(len(vertices)).reshape(-1, 3))
        hypothesis.event("solid")
    except InputError as error:
        hypothesis.event(str(error)[:20])


SIDES = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]


@hypothesis.given(
    st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=2, max_size=5, unique=True),
    st.integers(0, 2**32 - 1),
)
@hypothesis.settings(max_examples=60, deadline=None)
def test_the_union_of_boxes_has_the_volume_of_their_cells(places, seed):
    """Boxes of 2 x 2 x 2 cells on a grid overlap, touch by a face, an edge or a corner."""
    rng = np.random.default_rng(seed)
    boxes = [box((20, 20, 20), at=10 * np.array(place)) for place in places]
    soup = np.concatenate([b.triangles for b in boxes])
    soup = soup[rng.permutation(len(soup))].reshape(-1, 3)
    cells = {
        (x + i, y + j, z + k) for x, y, z in places for i in (0, 1) for j in (0, 1) for k in (0, 1)
    }
    solid, _ = repaired(soup, np.arange(len(soup)).reshape(-1, 3))
    assert solid.volume == pytest.approx(1000 * len(cells), rel=1e-6)  # float32 of 20 mm
    walls = sum((x + dx, y + dy, z + dz) not in cells for x, y, z in cells for dx, dy, dz in STEPS)
    assert solid.area == pytest.approx(100 * walls, rel=1e-6)


STEPS = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
