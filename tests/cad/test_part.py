"""A part: its units, centre, radius, identity, surface samples and export."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.stats
import trimesh

from vanejax.cad.part import SIZES_MM, Part, load_part, part_from_mesh
from vanejax.errors import InputError
from vanejax.scanner import Camera


def box(extents=(100.0, 50.0, 20.0), at=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation(at)
    return mesh


def part_of(mesh: trimesh.Trimesh, name: str = "test") -> Part:
    return part_from_mesh(mesh.vertices, mesh.faces, name=name)


@pytest.fixture(scope="module")
def ball() -> Part:
    return part_of(trimesh.creation.icosphere(3, 50.0))


def test_center_and_radius_are_those_of_the_box():
    part = part_of(box(at=(10, -5, 3)))
    # all numbers are exact in float32
    np.testing.assert_array_equal(part.center, [10, -5, 3])
    np.testing.assert_array_equal(part.extent_mm, [100, 50, 20])
    assert part.radius == pytest.approx(np.sqrt(50**2 + 25**2 + 10**2), rel=1e-15)
    assert part.mesh.is_watertight
    assert part.notes == ()


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".glb", ".obj"])
def test_export_and_load_give_the_same_arrays_and_hash(ball, tmp_path, suffix):
    path = tmp_path / f"ball{suffix}"
    ball.export(path)
    again = load_part(path, units="m" if suffix == ".glb" else "mm")
    np.testing.assert_array_equal(again.mesh.faces, ball.mesh.faces)
    # .obj is text with 8 digits after the point; the others keep every bit
    np.testing.assert_allclose(again.mesh.vertices, ball.mesh.vertices, rtol=0, atol=5e-9)
    if suffix != ".obj":
        assert again.sha256 == ball.sha256
    assert again.name == "ball"
    assert again.notes == ()


def test_hash_is_of_the_geometry_not_of_its_order(ball):
    rng = np.random.default_rng(0)
    order = rng.permutation(len(ball.mesh.vertices))
    rank = np.argsort(order)
    faces = np.roll(rank[ball.mesh.faces], 1, axis=1)[rng.permutation(len(ball.mesh.faces))]
    shuffled = part_from_mesh(ball.mesh.vertices[order], faces, name="x")
    assert shuffled.sha256 == ball.sha256
    moved = np.array(ball.mesh.vertices)
    moved[7, 1] += 1e-4  # float32 resolves 4e-6 at 50 mm
    assert part_from_mesh(moved, ball.mesh.faces, name="x").sha256 != ball.sha256


def test_hash_is_the_same_in_every_run():
    # recorded once: data sets on disk carry it
    assert part_of(box()).sha256.startswith("02d5143c")


def box_file(folder: Path, size_mm: list[float], mm: float) -> Path:
    """A box as an STL file, in a unit of so many mm."""
    path = folder / "part.stl"
    path.write_bytes(box(np.array(size_mm) / mm).export(file_type="stl"))
    return path


@pytest.mark.parametrize(
    ("units", "mm"),
    [("mm", 1), ("cm", 10), ("m", 1000), ("in", 25.4), ("ft", 304.8), ("um", 0.001)],
)
def test_units_scale_the_part_to_mm(tmp_path, units, mm):
    part = load_part(box_file(tmp_path, [100, 50, 20], mm), units=units)
    # one float32 rounding in the file, one in mm
    np.testing.assert_allclose(part.extent_mm, [100, 50, 20], rtol=2.4e-7)


def test_unknown_unit_lists_the_right_ones(tmp_path):
    with pytest.raises(InputError, match="unknown unit 'inch'; use one of mm, cm, m, in, ft, um"):
        load_part(tmp_path / "any.stl", units="inch")


@pytest.mark.parametrize(
    ("written_in_mm", "read_as", "likely"),
    [
        (1000.0, "mm", "it looks like metres (110 mm): use units='m'"),
        (25.4, "mm", "it looks like inches (110 mm): use units='in'"),
        (0.001, "mm", "it looks like micrometres (110 mm): use units='um'"),
        (1.0, "m", "it looks like millimetres (110 mm): use units='mm'"),
        (1000.0, "in", "it looks like metres (110 mm): use units='m'"),
    ],
)
def test_a_wrong_unit_is_refused_and_the_likely_one_named(tmp_path, written_in_mm, read_as, likely):
    with pytest.raises(InputError, match=r"part.stl: read as " + read_as) as caught:
        load_part(box_file(tmp_path, [110, 60, 40], written_in_mm), units=read_as)
    assert likely in str(caught.value)


def test_the_default_sizes_are_those_of_the_papers_camera():
    assert Camera().part_sizes_mm == pytest.approx(SIZES_MM, abs=0.05)  # rounded in the constant


def test_a_small_part_is_read_with_a_word_about_its_unit(tmp_path):
    note = "is only 18 mm large; if that is wrong, the unit may be 'in' (457 mm), 'cm' (180 mm)"
    assert load_part(box_file(tmp_path, [18, 5, 2], 1.0), units="mm").notes == (note,)


def test_samples_are_uniform_over_the_area():
    part = part_of(box())
    count = 40_000
    points, normals, face = part.sample(count, seed=3)
    # faces of very unlike area; then a grid of 4 x 4 x 2 bins inside the largest side
    by_face = np.bincount(face, minlength=len(part.mesh.faces))
    expected = part.mesh.area_faces / part.mesh.area * count
    # the seed is fixed: a sampler that is right fails one seed in a thousand, a wrong one all
    assert scipy.stats.chisquare(by_face, expected).pvalue > 1e-3
    top = points[normals[:, 2] > 0.5][:, :2]
    bins, _, _ = np.histogram2d(*top.T, bins=(8, 4), range=[(-50, 50), (-25, 25)])
    assert scipy.stats.chisquare(bins.ravel()).pvalue > 1e-3


def test_samples_lie_on_their_face_with_its_outward_unit_normal(ball):
    points, normals, face = ball.sample(5000, seed=0)
    corners = np.asarray(ball.mesh.triangles)[face]
    offset = np.sum((points - corners[:, 0]) * normals, axis=1)
    # rounding of coordinates of 50 mm in float64, a few operations
    np.testing.assert_allclose(offset, 0, atol=1e-12)
    inside = trimesh.triangles.points_to_barycentric(corners, points)
    assert inside.min() > -1e-9
    assert inside.max() < 1 + 1e-9
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-14)
    assert np.sum(points * normals, axis=1).min() > 0  # outward from the centre of the ball
    assert points.dtype == normals.dtype == np.float64
    assert face.dtype == np.int32


def test_samples_repeat_with_the_seed_only(ball):
    one, again, other = (ball.sample(100, seed=s)[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert not np.any(np.all(one == other, axis=1))
    with pytest.raises(InputError, match="cannot draw 0 points"):
        ball.sample(0, seed=0)


@pytest.mark.parametrize("name", ["part.step", "part", "part.xyz"])
def test_export_refuses_what_it_cannot_write(ball, tmp_path, name):
    with pytest.raises(InputError, match=r"use .stl, .ply, .obj or .glb"):
        ball.export(tmp_path / name)


def test_an_open_surface_is_refused_unless_it_may_be_open() -> None:
    """A box without its lid, half of its faces inside out."""
    faces = box().faces[box().face_normals[:, 2] < 0.5].copy()
    faces[::2] = faces[::2, ::-1]
    with pytest.raises(InputError, match="not a closed solid"):
        part_from_mesh(box().vertices, faces, name="tray")
    part = part_from_mesh(box().vertices, faces, name="tray", must_be_closed=False)
    assert not part.closed
    assert len(part.mesh.faces) == len(faces)
    assert "open surface" in part.notes[-1]
    assert "open edges" in part.notes[-1]
