"""Errors of ranges: fields of the statistics asked for, mixtures between both sides, lenses."""

from __future__ import annotations

import numpy as np
import pytest

from vanejax.errors import InputError
from vanejax.scanner.range_errors import (
    Lens,
    Trueness,
    depth_jumps,
    flying_pixel_errors,
    smooth_field,
)


@pytest.fixture(scope="module")
def fields() -> np.ndarray:
    """400 fields [400, 40, 60] with a correlation length of 8 pixels."""
    row, column = (m.ravel() for m in np.mgrid[5:45, 7:67])
    drawn = [
        smooth_field(np.random.default_rng([1, k]), row, column, length_px=8.0) for k in range(400)
    ]
    return np.reshape(drawn, (400, 40, 60))


def test_field_has_unit_variance_at_every_pixel(fields):
    # 400 draws: the standard error of a variance is 0.07, the largest of 2,400 is some 4 of them
    variance = fields.var(axis=0)
    np.testing.assert_allclose(variance.mean(), 1.0, atol=0.02)
    np.testing.assert_allclose(variance, 1.0, atol=0.35)
    np.testing.assert_allclose(fields.mean(), 0.0, atol=0.03)


# of a cubic B-spline: 0.493 at one step of its grid, 0.050 at two, 0 at four
@pytest.mark.parametrize(("shift", "expected"), [(8, 0.493), (16, 0.05), (32, 0.0)])
def test_field_correlates_over_its_length_and_no_farther(fields, shift, expected):
    assert np.mean(fields[:, :, shift:] * fields[:, :, :-shift]) == pytest.approx(
        expected, abs=0.05
    )


def test_field_of_less_than_a_pixel_is_refused():
    with pytest.raises(InputError, match="1 pixel or more"):
        smooth_field(np.random.default_rng(0), np.zeros(1, int), np.zeros(1, int), length_px=0.5)


def neighbors_by_loop(depth: np.ndarray, jump: float) -> set[frozenset[tuple[int, int]]]:
    """Pairs of pixels beside or below each other whose depths differ by ``jump`` or more."""
    found = set()
    height, width = depth.shape
    for row in range(height):
        for column in range(width):
            for r, c in ((row, column + 1), (row + 1, column)):
                inside = r < height and c < width
                if inside and abs(depth[row, column] - depth[r, c]) >= jump:  # False for NaN
                    found.add(frozenset({(row, column), (r, c)}))
    return found


@pytest.mark.parametrize("seed", range(4))
def test_jumps_are_those_between_neighbors(seed):
    rng = np.random.default_rng(seed)
    image = rng.choice([400.0, 401.0, 410.0, np.nan], (9, 7), p=[0.4, 0.2, 0.2, 0.2])
    pixel = np.flatnonzero(np.isfinite(image)).astype(np.int32)
    depth = image.ravel()[pixel].astype(np.float32)
    a, b = depth_jumps(pixel, depth, width=7, jump_mm=2.0)
    places = [tuple(divmod(int(p), 7)) for p in pixel]
    found = [frozenset({places[i], places[j]}) for i, j in zip(a, b, strict=True)]
    assert len(found) == len(set(found))
    assert set(found) == neighbors_by_loop(image, 2.0)


def test_a_mixture_lies_between_both_sides_and_nearer_to_its_own():
    disparity = np.repeat(np.float32([500.0, 480.0]), 2000)
    sides = np.arange(2000), np.arange(2000, 4000)
    own, added = flying_pixel_errors(np.random.default_rng(3), sides, disparity, rate=0.5)
    assert len(np.unique(own)) == len(own)
    # half of 2,000 edges: standard deviation 22
    assert abs(len(own) - 1000) < 100
    near = own < 2000
    assert 0.4 < near.mean() < 0.6
    assert (added[near] <= 0).all()
    assert (added[near] >= -10).all()
    assert (added[~near] >= 0).all()
    assert (added[~near] <= 10).all()
    np.testing.assert_allclose(np.abs(added).mean(), 5.0, atol=0.4)  # uniform up to a half of 20


def test_lens_is_brown_s_model():
    x, y = np.array([0.3]), np.array([-0.2])
    lens = Lens(k1=0.02, k2=0.1, p1=1e-3, p2=2e-3, focal_error=1e-3, center_error_px=(0.5, 0.25))
    r2 = 0.3**2 + 0.2**2
    radial = 0.02 * r2 + 0.1 * r2**2 + 1e-3
    dx, dy = lens.shifts(x, y, fx=1000.0, fy=2000.0)
    # the image's rows run downwards, the camera's y upwards
    np.testing.assert_allclose(
        dx, 0.3 * radial + 2 * 1e-3 * -0.06 + 2e-3 * (r2 + 2 * 0.09) + 0.5 / 1000
    )
    np.testing.assert_allclose(
        dy, -0.2 * radial + 1e-3 * (r2 + 2 * 0.04) + 2 * 2e-3 * -0.06 - 0.25 / 2000
    )


def test_trueness_scales_with_depth_and_bends_with_its_square():
    depth, x, y = np.array([400.0, 800.0]), np.array([1.0, 1.0]), np.array([0.0, -1.0])
    np.testing.assert_allclose(Trueness(scale=1e-3).error_mm(depth, x, y), [0.4, 0.8])
    bent = Trueness(bend_mm=(0.1, 0.2)).error_mm(depth, x, y)
    np.testing.assert_allclose(bent, [0.1, 0.3 * 4])
