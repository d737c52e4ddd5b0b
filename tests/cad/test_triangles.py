"""Triangle meshes against slow oracles, and what a large one may cost."""

from __future__ import annotations

import tracemalloc
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import trimesh
from example_scans import vane
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vanejax.cad import Part, Surface, load_part, triangles
from vanejax.cad.triangles import Edges, Triangles, canonical, drop_doubled, weld

COORDINATES = [-2.5, -1.0, -0.0, 0.0, 1e-30, 1.0, 3.0]
SOUPS = hnp.arrays(
    np.float32,
    st.tuples(st.integers(1, 12), st.just(3), st.just(3)),
    elements=st.sampled_from(COORDINATES).map(np.float32),
)
FACES = hnp.arrays(np.int64, st.tuples(st.integers(1, 12), st.just(3)), elements=st.integers(0, 4))


def soup_mesh(soup: np.ndarray) -> Triangles:
    return Triangles(soup.reshape(-1, 3), np.arange(3 * len(soup)).reshape(-1, 3))


@hypothesis.given(SOUPS)
def test_welding_keeps_every_corner_and_sorts_the_distinct_ones(soup):
    mesh = weld(soup_mesh(soup))
    np.testing.assert_array_equal(mesh.points[mesh.faces], soup)
    distinct = {tuple(point) for point in soup.reshape(-1, 3).tolist()}
    assert [tuple(point) for point in mesh.points.tolist()] == sorted(distinct)


@hypothesis.given(SOUPS, st.randoms(use_true_random=False))
def test_the_canonical_mesh_does_not_depend_on_the_order_of_faces_and_corners(soup, random):
    mixed = [np.roll(face, random.randrange(3), axis=0) for face in soup]
    random.shuffle(mixed)
    one, other = canonical(soup_mesh(soup)), canonical(soup_mesh(np.array(mixed)))
    np.testing.assert_array_equal(one.points, other.points)
    np.testing.assert_array_equal(one.faces[:, 0], one.faces.min(axis=1))
    assert one.faces.tolist() == sorted(one.faces.tolist())
    # a face whose first corner comes twice can be turned to start at either
    distinct = [face for face in one.faces.tolist() if len(set(face)) == 3]
    assert distinct == [face for face in other.faces.tolist() if len(set(face)) == 3]


@hypothesis.given(FACES)
def test_edges_against_a_count_of_each(faces):
    directed = [(f[i], f[(i + 1) % 3]) for f in faces.tolist() for i in range(3)]
    uses = Counter(tuple(sorted(edge)) for edge in directed)
    edges = Edges.of(faces)
    assert [tuple(edge) for edge in edges.ends.tolist()] == directed
    assert edges.uses.tolist() == [uses[edge] for edge in sorted(uses)]
    signs = Counter()
    for start, end in directed:
        signs[min(start, end), max(start, end)] += 1 if start <= end else -1
    assert {e: n for e, n in signs.items() if e[0] != e[1]} == {
        e: n for e, n in zip(sorted(uses), edges.net.tolist(), strict=True) if e[0] != e[1]
    }
    twice = edges.rows(edges.uses == 2)
    assert twice.tolist() == [
        row for row, edge in enumerate(directed) if uses[tuple(sorted(edge))] == 2
    ]


@hypothesis.given(SOUPS)
def test_doubled_faces_are_found_as_a_set_finds_them(soup):
    mesh = weld(soup_mesh(soup))
    notes: list[str] = []
    kept = drop_doubled(mesh, notes)
    triples = Counter(tuple(sorted(face)) for face in mesh.faces.tolist())
    assert (kept is mesh) == (notes == []) == (max(triples.values()) == 1)
    assert (
        max(Counter(tuple(sorted(face)) for face in kept.faces.tolist()).values(), default=1) == 1
    )


@pytest.mark.parametrize("block", [1, 7, 10**6])
def test_figures_do_not_depend_on_how_many_faces_are_taken_at_a_time(monkeypatch, block):
    whole = trimesh.creation.annulus(20.0, 50.0, 30.0, sections=16)
    whole.apply_translation([100.0, 5.0, -3.0])
    mesh = Triangles(np.asarray(whole.vertices), np.asarray(whole.faces))
    monkeypatch.setattr(triangles, "BLOCK", block)
    np.testing.assert_allclose(mesh.volume(), whole.volume, rtol=1e-12)  # f64 eps x 1000
    np.testing.assert_allclose(mesh.areas(), whole.area_faces, rtol=1e-12)
    np.testing.assert_array_equal(mesh.bounds(), whole.bounds)
    np.testing.assert_array_equal(np.concatenate(list(mesh.blocks())), mesh.points[mesh.faces])


@pytest.mark.slow
def test_moments_of_the_surface_do_not_depend_on_it_either(monkeypatch):
    monkeypatch.setattr(triangles, "BLOCK", 100)
    middle, axes = Surface(vane()).moments
    dense, _, _ = vane().sample(2_000_000, seed=3)
    np.testing.assert_allclose(middle, dense.mean(axis=0), atol=0.1)  # 40 mm / sqrt(2e6) x 4
    spread = axes @ np.cov(dense.T) @ axes.T
    off = np.abs(spread - np.diag(np.diag(spread))).max()
    assert off < 3e-3 * spread.trace()  # 1 / sqrt(2e6) x 4


def sphere_file(folder: Path, subdivisions: int) -> tuple[Path, int]:
    """A ball as an STL file, every corner by itself, and how many faces it has."""
    ball = trimesh.creation.icosphere(subdivisions, 50.0)
    path = folder / f"{subdivisions}.stl"
    path.write_bytes(ball.export(file_type="stl"))
    return path, len(ball.faces)


def prepared(path: Path) -> Part:
    """All that a registration does once for a part, but for Embree's own."""
    part = load_part(path, units="mm")
    Surface(part).moments  # noqa: B018
    assert part.radius > 49
    assert part.center.shape == (3,)
    assert part.triangles.volume() > 0
    return part


def peak_bytes(work: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.slow
def test_memory_grows_with_the_faces_and_no_faster(tmp_path):
    """Ten million faces must fit in 12 GB with Embree's scene: below 500 bytes a face here."""
    prepared(sphere_file(tmp_path, 3)[0])  # what is imported on the way does not count
    small, few = sphere_file(tmp_path, 5)
    large, many = sphere_file(tmp_path, 7)
    assert many == 16 * few
    peak = peak_bytes(lambda: prepared(large))
    assert peak < 500 * many
    assert peak < 1.2 * 16 * peak_bytes(lambda: prepared(small))
