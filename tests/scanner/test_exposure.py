"""How bright surfaces look: Lambert, a mirror's lobe, distance, exposure time, shot noise."""

from __future__ import annotations

import numpy as np

from vanejax.scanner.exposure import Exposure

UP = np.float32([[0, 0, 1]])


def tilted(deg: float) -> np.ndarray:
    """[1, 3] unit, turned from +z towards +x."""
    return np.float32([[np.sin(np.radians(deg)), 0, np.cos(np.radians(deg))]])


def test_a_matte_surface_follows_the_cosine():
    matte = Exposure(specular=0.0)
    for deg in (0, 30, 60, 89):
        found = matte.reflected(UP, UP, tilted(deg))
        np.testing.assert_allclose(found, np.cos(np.radians(deg)), atol=1e-6)
    assert matte.reflected(UP, UP, tilted(120))[0] == 0


def test_the_reference_surface_has_the_stated_brightness():
    """Matte, facing the projector at 400 mm: ``exposure_ms * projector_per_ms``."""
    light = Exposure(specular=0.0, exposure_ms=12.0, projector_per_ms=0.03)
    shine = light.reflected(UP, UP, UP)
    np.testing.assert_allclose(light.modulation(shine, np.float32([400.0])), 0.36, rtol=1e-6)
    # a projector's light spreads as the square of the distance, a far lamp's does not
    np.testing.assert_allclose(light.modulation(shine, np.float32([800.0])), 0.09, rtol=1e-6)
    np.testing.assert_allclose(light.ambient(shine), 12 * 0.002, rtol=1e-6)


def test_shine_is_brightest_where_a_mirror_would_send_it():
    """Light from 30 deg on one side, camera at 30 deg on the other; then the camera moves off."""
    shiny = Exposure(specular=1.0, roughness=0.2)
    found = [shiny.reflected(UP, tilted(-deg), tilted(30))[0] for deg in (30, 40, 50, 70)]
    assert found == sorted(found, reverse=True)
    expected = 1 / (4 * 0.2**2 * np.cos(np.radians(30)))  # the lobe's formula at h = 0
    np.testing.assert_allclose(found[0], expected, rtol=1e-5)
    h = np.radians(5)  # the camera at 40 deg: the normal is 5 deg off the middle
    lobe = np.exp(-((np.tan(h) / 0.2) ** 2)) / (4 * 0.2**2 * np.cos(h) ** 4)
    np.testing.assert_allclose(found[1], lobe / np.cos(np.radians(40)), rtol=1e-4)


def test_noise_grows_with_all_light_and_falls_with_the_modulation():
    light = Exposure(reference_signal=0.4)
    half, same = np.float32([0.2]), np.float32([0.4])
    np.testing.assert_allclose(light.noise_gain(same, same), 1.0, rtol=1e-6)
    np.testing.assert_allclose(light.noise_gain(half, half), np.sqrt(2), rtol=1e-6)
    np.testing.assert_allclose(light.noise_gain(half, same), 2.0, rtol=1e-6)
