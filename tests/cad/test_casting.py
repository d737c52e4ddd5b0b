"""Castings: offsets on solids whose answer is known, and the random field's law."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from example_scans import box as box_off_its_origin
from example_scans import vane

from vanejax.cad import Part, part_from_mesh
from vanejax.cad.casting_tolerances import SIZES_MM, TOLERANCES_MM, dimensional_tolerance_mm
from vanejax.cad.investment_casting import (
    CUT,
    InvestmentCasting,
    as_cast,
    waviness,
    with_stock_on_one_side,
    without_a_corner,
)
from vanejax.cad.surface import Surface
from vanejax.errors import InputError
from vanejax.plotting.deviation import casting_map
from vanejax.scanner import Scanner

NOTHING = InvestmentCasting(allowance_mm=0, waviness_mm=0)
STOCK = dataclasses.replace(NOTHING, allowance_mm=0.5)
WAVES = InvestmentCasting(allowance_mm=0, waviness_mm=0.2, wavelength_mm=40)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng([7, seed])


def box() -> Part:
    mesh = trimesh.creation.box((60, 40, 20))
    return part_from_mesh(mesh.vertices, mesh.faces, name="box")


def bracket() -> Part:
    """An L: one concave edge between two faces of 25 mm."""
    block, corner = ([[0, 0, 0], [30, 30, 20]], [[5, 5, -1], [31, 31, 21]])
    boxes = [trimesh.creation.box(bounds=bounds) for bounds in (block, corner)]
    mesh = trimesh.boolean.difference(boxes)
    return part_from_mesh(mesh.vertices, mesh.faces, name="bracket")


def test_a_casting_without_errors_is_the_part():
    assert as_cast(vane(), NOTHING, rng()).sha256 == vane().sha256


@pytest.mark.parametrize("stock_mm", [0.5, -0.5])
def test_stock_moves_the_faces_of_a_box(stock_mm):
    cast = as_cast(box(), dataclasses.replace(STOCK, allowance_mm=stock_mm), rng())
    np.testing.assert_allclose(cast.extent_mm, np.add([60, 40, 20], 2 * stock_mm), atol=1e-3)
    assert cast.mesh.volume == pytest.approx(np.prod(cast.extent_mm), rel=1e-4)


def test_stock_is_the_distance_between_the_surfaces_of_a_vane():
    """At every point of the smooth surface: at an edge it is farther."""
    cad, points = Surface(vane()), as_cast(vane(), STOCK, rng()).sample(3_000, 0)[0]
    points = points[cad.is_smooth(points, 2.0, 0.97)]
    assert len(points) > 1_000
    closest = cad.nearest(points)  # the nearest sample: the plane of its face is right to 0.01 mm
    distance = np.sum((points - closest.points) * closest.normals, axis=1)
    assert np.percentile(np.abs(distance - 0.5), 98) < 0.02
    volume = [as_cast(vane(), dataclasses.replace(STOCK, allowance_mm=s), rng()).mesh.volume
              for s in (0.1, 0.5, 1.0)]  # fmt: skip
    assert vane().mesh.volume < volume[0] < volume[1] < volume[2]


@pytest.mark.parametrize("scale_error", [-0.03, 0.01])
@pytest.mark.parametrize("make", [vane, box_off_its_origin])
def test_a_casting_of_another_size_keeps_its_middle(make, scale_error):
    part, larger = make(), dataclasses.replace(NOTHING, scale_error=scale_error)
    cast = as_cast(part, larger, rng())
    np.testing.assert_allclose(cast.extent_mm, part.extent_mm * (1 + scale_error), rtol=1e-6)
    np.testing.assert_allclose(cast.center, part.center, atol=1e-4)
    assert cast.mesh.volume == pytest.approx(part.mesh.volume * (1 + scale_error) ** 3, rel=1e-5)


def test_stock_is_added_after_shrinkage():
    cast = as_cast(box(), dataclasses.replace(STOCK, scale_error=-0.03), rng())
    np.testing.assert_allclose(cast.extent_mm, np.array([60, 40, 20]) * 0.97 + 1, atol=1e-3)


def test_stock_on_one_side_moves_that_side_alone():
    cast = with_stock_on_one_side(box(), [0, -2.0, 0], 1.5)  # the axis' length does not count
    np.testing.assert_allclose(cast.mesh.bounds, [[-30, -21.5, -10], [30, 20, 10]])
    assert cast.mesh.volume == pytest.approx(60 * 41.5 * 20)
    of_vane = with_stock_on_one_side(vane(), [0, 0, 1], 1.0)
    assert of_vane.mesh.is_watertight
    assert of_vane.mesh.volume > vane().mesh.volume
    assert of_vane.mesh.bounds[1, 2] - vane().mesh.bounds[1, 2] == pytest.approx(1, abs=1e-5)
    again = with_stock_on_one_side(vane(), [0, 0, 1], 1.0)
    assert again.sha256 == of_vane.sha256 != vane().sha256


def test_a_corner_is_missing_and_the_rest_stays():
    shares = {"sides": (0.2, 0.5), "volume": (0.03, 0.15)}
    for seed in range(5):
        rest = without_a_corner(vane(), rng(seed), **shares)
        assert 0.03 < 1 - rest.mesh.volume / vane().mesh.volume < 0.15
        assert rest.mesh.is_watertight
        solid = trimesh.boolean.difference([rest.mesh, vane().mesh])
        assert solid.volume < 1e-3 * vane().mesh.volume  # nothing is added
    one, same, other = (without_a_corner(box(), rng(seed), **shares) for seed in (1, 1, 2))
    assert one.sha256 == same.sha256 != other.sha256
    with pytest.raises(InputError, match="none of 200 boxes"):
        without_a_corner(box(), rng(), sides=(0.1, 0.2), volume=(0.5, 0.9))


@pytest.mark.parametrize("stock_mm", [-0.6, -30.0])
def test_a_wall_that_is_gone_is_an_error(stock_mm):
    mesh = trimesh.creation.box((60, 40, 1))
    sheet = part_from_mesh(mesh.vertices, mesh.faces, name="sheet")
    assert as_cast(sheet, dataclasses.replace(STOCK, allowance_mm=-0.3), rng()).closed
    with pytest.raises(InputError, match="sheet: with this stock the part loses its walls"):
        as_cast(sheet, dataclasses.replace(STOCK, allowance_mm=stock_mm), rng())
    with pytest.raises(InputError, match="loses its walls"):
        with_stock_on_one_side(sheet, [0, 0, 1], -1.2)


@pytest.mark.parametrize("axis", [[0, 0, 0], [0, 0], [np.nan, 0, 1]])
def test_an_axis_without_a_direction_is_an_error(axis):
    with pytest.raises(InputError, match="axis x, y, z"):
        with_stock_on_one_side(box(), axis, 1.0)


def test_tolerances_are_those_of_the_standard():
    """A few of the table, and what holds for all: they grow with the size and with the grade."""
    assert dimensional_tolerance_mm(100.0, 4) == 0.40
    assert dimensional_tolerance_mm(100.1, 4) == 0.44  # rows end with their size
    assert dimensional_tolerance_mm(5.0, 5) == 0.36
    assert dimensional_tolerance_mm(400.0, 6) == 1.10
    table = np.array(list(TOLERANCES_MM.values()))
    assert table.shape == (3, len(SIZES_MM))
    assert (np.diff(table, axis=0) > 0).all()
    assert (np.diff(table, axis=1) > 0).all()
    assert np.all(np.abs(table[1:] / table[:-1] - np.sqrt(2)) < 0.11)  # a grade is a factor of 1.4
    for size, grade, message in ((100, 3, "DCTG 3"), (0, 4, "of 0 mm"), (np.nan, 5, "of nan mm")):
        with pytest.raises(InputError, match=message):
            dimensional_tolerance_mm(size, grade)


def test_stock_does_not_fold_a_concave_corner():
    """With waviness of nearly nothing, so that vertices stand within the stock of the corner."""
    casting = InvestmentCasting(allowance_mm=1.0, waviness_mm=1e-6, wavelength_mm=2.5)
    cast = as_cast(bracket(), casting, rng())
    # as the L with each wall moved by 1 mm: 32 x 32 less 25 x 25, 22 high
    assert cast.mesh.volume == pytest.approx((32 * 32 - 25 * 25) * 22, rel=1e-3)
    # what is folded over counts three times here, and not at all in the volume
    assert cast.mesh.area == pytest.approx(2 * (32 * 32 - 25 * 25) + 4 * 32 * 22, rel=1e-3)
    assert cast.mesh.is_watertight


def test_the_vanes_casting_is_closed_and_within_its_limits():
    casting = InvestmentCasting()
    cast = as_cast(vane(), casting, rng())
    assert cast.closed
    assert cast.mesh.is_watertight
    assert not cast.notes  # nothing had to be repaired
    assert len(cast.mesh.faces) < 50_000
    # along the normals, from outside, to the casting and to the CAD model under it
    points, normals, face = cast.sample(4_000, 0)
    origins = points + 5 * normals
    back = Scanner(vane()).cast(origins, -normals).distance_mm
    direct = Scanner(cast).cast(origins, -normals)
    free = (direct.face == face) & (back < 6.5)  # nothing in between, and the CAD model's face
    offset = back[free] - 5
    assert np.mean((offset > 0.03) & (offset < 0.97)) > 0.98  # the rest is beside an edge
    # stock and two thirds of the surface within a standard deviation
    assert np.median(offset) == pytest.approx(0.5, abs=0.15)


def test_equal_generators_give_equal_bits():
    one, two, other = (as_cast(box(), InvestmentCasting(), rng(seed)) for seed in (0, 0, 1))
    assert one.sha256 == two.sha256 != other.sha256
    draws = rng()
    first, second = (as_cast(box(), InvestmentCasting(), draws) for _ in range(2))
    assert first.sha256 == one.sha256 != second.sha256


def test_the_waviness_has_the_deviation_and_the_correlation_asked_for():
    """Over 300 draws, against ``sigma^2 exp(-r^2 / (2 l^2))``."""
    steps = np.array([0.0, 20.0, 40.0, 80.0])
    points = np.column_stack([steps, 0.6 * steps, np.zeros(4)])
    draws = np.stack([waviness(points, WAVES, rng(seed)) for seed in range(300)])
    covariance = draws.T @ draws / len(draws)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    expected = WAVES.waviness_mm**2 * np.exp(-((apart / WAVES.wavelength_mm) ** 2) / 2)
    # an entry's own error is 0.06 to 0.08 of the variance: three and a half of these
    np.testing.assert_allclose(covariance, expected, atol=0.27 * WAVES.waviness_mm**2)
    np.testing.assert_allclose(np.diag(covariance).mean(), 0.04, rtol=0.15)
    assert np.abs(draws.mean(axis=0)).max() < 4 * 0.2 / np.sqrt(300)


def test_the_waviness_is_cut_off():
    points = np.random.default_rng(0).uniform(-1000, 1000, (20_000, 3))
    field = waviness(points, WAVES, rng())
    assert np.abs(field).max() == pytest.approx(CUT * WAVES.waviness_mm)
    assert 0.001 < np.mean(np.abs(field) >= CUT * WAVES.waviness_mm) < 0.01  # 0.27 % of a normal
    assert field.std() == pytest.approx(0.2, rel=0.1)


def test_the_mesh_follows_the_waviness():
    """The cast box's top face against the field itself, between its vertices."""
    cast = as_cast(box(), dataclasses.replace(WAVES, wavelength_mm=15), rng())
    grid = np.stack(np.meshgrid(np.arange(-24.0, 25), np.arange(-14.0, 15)), -1).reshape(-1, 2)
    above = np.column_stack([grid, np.full(len(grid), 30.0)])
    hits = Scanner(cast).cast(above, np.tile([0.0, 0.0, -1.0], (len(above), 1)))
    field_rng = rng().spawn(2)[0]
    foot = np.column_stack([grid, np.full(len(grid), 10.0)])
    field = waviness(foot, dataclasses.replace(WAVES, wavelength_mm=15), field_rng)
    # a fifth of a correlation length between vertices misses 0.9 % of the deviation, and within
    # 10 mm of an edge they give way to it by up to the offset, which is here sloped by 1 in 30
    np.testing.assert_allclose(20 - hits.distance_mm, field, atol=0.06 * 0.2)


def test_the_bow_bends_the_middle_away_from_the_ends():
    casting = dataclasses.replace(NOTHING, bow_mm=0.8)
    cast = as_cast(box(), casting, rng())
    corners = np.asarray(cast.mesh.vertices)
    x = corners[:, 0]
    ends = [corners[np.abs(x - side) < 1e-3].mean(axis=0) for side in (-30, 30)]
    middle = np.abs(x).min()
    bend = corners[np.abs(x) < middle + 1e-3].mean(axis=0) - np.mean(ends, axis=0)
    assert np.linalg.norm(bend[1:]) == pytest.approx(0.8 * (1 - (middle / 30) ** 2), rel=0.02)
    assert abs(bend[0]) < 1e-3
    assert cast.mesh.is_watertight
    waves = as_cast(box(), dataclasses.replace(WAVES, bow_mm=0), rng())
    both = as_cast(box(), dataclasses.replace(WAVES, bow_mm=1e-6), rng())
    np.testing.assert_allclose(both.mesh.bounds, waves.mesh.bounds, atol=0.01)


@pytest.mark.slow
def test_the_map_shows_the_offset():
    """Its colour bar spans what was asked for; a uniform one has a scale of its own."""
    bar = casting_map(vane(), as_cast(vane(), STOCK, rng())).axes[-1]
    low, high = bar.get_ylim()
    assert low == pytest.approx(0.495, abs=0.01)
    assert high == pytest.approx(0.505, abs=0.01)
    waves = casting_map(box(), as_cast(box(), WAVES, rng())).axes[-1].get_ylim()
    assert waves[0] == -waves[1]
    assert 0.05 < waves[1] < 0.61


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"allowance_mm": np.nan}, "allowance_mm must be finite"),
        ({"waviness_mm": -0.1}, "waviness_mm must be 0 mm or more"),
        ({"bow_mm": -0.1}, "bow_mm must be 0 mm or more"),
        ({"wavelength_mm": 0.0}, "wavelength_mm must be above 0 mm"),
        ({"scale_error": 1.0}, "0.01 is 1 %"),
    ],
)
def test_settings_that_no_casting_can_have(wrong, message):
    with pytest.raises(InputError, match=message):
        InvestmentCasting(**wrong)


def test_a_wavelength_too_short_for_the_part_and_an_open_surface():
    with pytest.raises(InputError, match="60 mm needs too many faces"):
        as_cast(box(), InvestmentCasting(wavelength_mm=0.5), rng())
    solid = box()
    sheet = part_from_mesh(
        solid.mesh.vertices, solid.mesh.faces[:-2], name="sheet", must_be_closed=False
    )
    for make in (
        lambda: as_cast(sheet, InvestmentCasting(), rng()),
        lambda: with_stock_on_one_side(sheet, [0, 0, 1], 1.0),
        lambda: without_a_corner(sheet, rng(), sides=(0.2, 0.5), volume=(0.03, 0.15)),
    ):
        with pytest.raises(InputError, match="open surface"):
            make()
