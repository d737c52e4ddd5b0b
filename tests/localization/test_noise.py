"""The noise model on drawn residuals: spread over incidence, tails, and the weights that follow."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from vanejax.localization.noise import Noise, fit_noise, weights
from vanejax.localization.residuals import Residuals


def residuals(along: np.ndarray, cosine: np.ndarray) -> Residuals:
    """Of one pose, every ray a hit."""
    return Residuals(
        deviation_mm=(along * cosine)[None],
        jacobian=np.zeros((1, len(along), 6)),
        cosine=cosine[None],
        hit=np.ones((1, len(along)), bool),
    )


@pytest.mark.parametrize(
    ("range_mm", "lateral_mm"), [(0.1, 0.0), (0.1, 0.1), (0.05, 0.2), (0.5, 0.3)]
)
def test_range_and_lateral_noise_are_told_apart(range_mm, lateral_mm):
    rng = np.random.default_rng(0)
    cosine = np.cos(np.radians(rng.uniform(5, 80, 20_000)))
    sigma = np.hypot(range_mm, lateral_mm * np.sqrt(1 / cosine**2 - 1))
    noise = fit_noise(residuals(sigma * rng.normal(size=len(cosine)), cosine))
    # a median of 1,700 is good to 3 %, and the two follow from twelve of them
    assert noise.range_mm == pytest.approx(range_mm, rel=0.15)
    assert noise.lateral_mm == pytest.approx(lateral_mm, rel=0.15, abs=0.15 * range_mm)
    assert np.isinf(noise.degrees_of_freedom)
    np.testing.assert_allclose(noise.sigma_mm(cosine), sigma, rtol=0.15)


@pytest.mark.parametrize("freedom", [2.0, 4.0, np.inf])
def test_the_tails_are_found(freedom):
    rng = np.random.default_rng(1)
    cosine = np.cos(np.radians(rng.uniform(5, 60, 20_000)))
    size = len(cosine)
    draws = rng.normal(size=size) if np.isinf(freedom) else rng.standard_t(freedom, size)
    noise = fit_noise(residuals(0.2 * draws, cosine))
    near = {2.0: (1.5, 2, 3), 4.0: (3, 4, 6), np.inf: (np.inf,)}[freedom]
    assert noise.degrees_of_freedom in near
    assert noise.range_mm == pytest.approx(0.2, rel=0.15)  # of the t's core, not of all


def test_gross_errors_do_not_pass_for_noise():
    rng = np.random.default_rng(2)
    cosine = np.cos(np.radians(rng.uniform(5, 60, 5_000)))
    along = 0.1 * rng.normal(size=len(cosine))
    along[::10] = rng.uniform(-30, 30, len(along[::10]))
    noise = fit_noise(residuals(along, cosine))
    assert noise.range_mm == pytest.approx(0.1, rel=0.25)


@pytest.mark.parametrize("count", [5, 29, 200])
@pytest.mark.filterwarnings("error")
def test_no_noise_and_few_points_are_no_trouble(count):
    noise = fit_noise(residuals(np.zeros(count), np.full(count, 0.7)))
    assert 0 < noise.range_mm < 1e-3
    assert noise.lateral_mm == 0


def test_a_normal_distribution_weighs_all_alike_up_to_five_sigma():
    noise = Noise(0.1, 0.0, np.inf)
    along = np.array([0.0, 0.1, -0.49, 0.51, -3.0])
    np.testing.assert_allclose(weights(along, np.ones(5), noise), [100, 100, 100, 0, 0])


def test_heavy_tails_weigh_far_points_less_and_flat_ones_too():
    noise = Noise(0.1, 0.2, 3.0)
    cosine = np.full(50, 0.6)  # of 53.1 deg: tangent 4/3
    along = np.linspace(0, 5, 50)
    found = weights(along, cosine, noise)
    assert (np.diff(found) <= 0).all()
    sigma = np.hypot(0.1, 0.2 * 4 / 3)
    assert found[0] == pytest.approx((4 / 3) ** 2 / sigma**2)
    assert (found[along > 10 * sigma] == 0).all()
    np.testing.assert_allclose(weights(-along, cosine, noise), found)


def test_misses_are_no_measure_of_the_noise():
    rng = np.random.default_rng(5)
    good = residuals(0.1 * rng.normal(size=2000), np.full(2000, 0.8))
    hit = np.ones((1, 2000), bool)
    hit[:, ::3] = False
    wild = np.where(hit, good.deviation_mm, 0.3)
    noise = fit_noise(dataclasses.replace(good, deviation_mm=wild, hit=hit))
    assert noise.range_mm == pytest.approx(0.1, rel=0.1)
