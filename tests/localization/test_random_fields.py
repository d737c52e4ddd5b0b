"""The average over models of a scan's deviations, against linear algebra and by draws from them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from vanejax.localization import random_fields
from vanejax.localization.random_fields import Field, Patches, Prior, average_models

RADIUS = 70.0
KINDS = ("form", "displacement", "range", "facing")


def sphere(count: int, seed: int = 0) -> np.ndarray:
    """[count, 3] unit vectors."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def patches(count: int = 120, sigma_mm: float = 0.01) -> Patches:
    """Of an ellipsoid that a sensor above sees from one side, without any deviation."""
    normals = sphere(count)
    normals[:, 2] = np.abs(normals[:, 2])
    positions = normals * np.array([70.0, 50.0, 40.0])
    normals = positions / np.array([70.0, 50.0, 40.0]) ** 2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    scale = np.sum(normals * positions, axis=1)
    focal = np.sum(normals[:, :2] * positions[:, :2], axis=1)
    motion = np.concatenate([np.cross(positions, normals), normals], axis=1)
    columns = np.column_stack([motion, np.ones(count), scale, focal])
    weight = np.full(count, sigma_mm**-2)
    return Patches(np.zeros(count), weight, columns, positions, normals, normals[:, 2])


def prior(**changes) -> Prior:
    return Prior(**({"radius_mm": RADIUS, "surface": 60 * sphere(100, 1)} | changes))


def deviating(parameters: np.ndarray, field: np.ndarray | float = 0.0, seed: int = 0) -> Patches:
    """The patches with a motion and terms [9], a field and white noise."""
    clean = patches()
    noise = np.random.default_rng(seed).normal(size=len(clean)) / np.sqrt(clean.weight)
    deviation = clean.columns @ parameters + field + noise
    return dataclasses.replace(clean, deviation_mm=deviation)


@pytest.mark.parametrize("kind", KINDS)
def test_fields_have_covariances(kind):
    covariance = Field(kind, 0.4).covariance(patches(), prior())
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-9)
    assert np.linalg.eigvalsh(covariance).min() > -1e-6
    assert 0 < np.diag(covariance).max() < 1.2


def test_a_displacement_moves_the_part_nowhere_as_a_whole(monkeypatch):
    """Whatever the field, the motion that fits the displacements of the surface best is none."""
    monkeypatch.setattr(random_fields, "LEFT_MOTION", 0.0)
    surface = prior().surface
    positions, normals = np.repeat(surface, 3, axis=0), np.tile(np.eye(3), (len(surface), 1))
    motion = np.concatenate([np.cross(positions, normals), normals], axis=1)
    nothing = np.zeros(len(positions))
    whole = Patches(nothing, nothing + 1, motion, positions, normals, nothing + 1)
    covariance = Field("displacement", 0.8).covariance(whole, prior())
    unit = np.array([1 / RADIUS] * 3 + [1] * 3)
    assert np.abs((motion * unit).T @ covariance).max() < 1e-8 * len(positions)


def test_without_fields_and_terms_it_is_least_squares():
    truth = np.array([1e-4, -2e-4, 1e-4, 0.02, 0.01, -0.03, 0, 0, 0])
    scan = deviating(truth)
    found = average_models(scan, np.zeros(3), prior(kinds=()))
    assert found.term_probability.max() < 0.2
    information = (scan.columns[:, :6] * scan.weight[:, None]).T @ scan.columns[:, :6]
    plain = np.linalg.solve(information, scan.columns[:, :6].T @ (scan.weight * scan.deviation_mm))
    off = found.mean[:6] - plain
    assert off @ information @ off < 0.5  # the terms have some of the probability
    ratio = np.linalg.eigvals(found.covariance[:6, :6] @ information).real
    assert 0.9 < ratio.min() < 1.5


@pytest.mark.parametrize(
    ("term", "value"), [(0, 0.5), (0, -0.2), (1, 0.01), (1, -0.002), (2, 0.003)]
)
def test_terms_are_found_with_the_pose(term, value):
    truth = np.array([2e-4, 1e-4, -1e-4, 0.05, -0.04, 0.02, 0, 0, 0])
    truth[6 + term] = value
    found = average_models(deviating(truth), np.zeros(3), prior())
    assert found.term_probability[term] > 0.99
    off = found.mean - truth
    used = [*range(6), 6 + term]
    assert off[used] @ np.linalg.solve(found.covariance[np.ix_(used, used)], off[used]) < 30


def test_terms_that_are_taken_out_already_are_counted_from_there():
    """The same answer from another start: what the model lacks goes back to nothing."""
    truth = np.array([0, 0, 0, 0.05, 0, 0, 0.5, 0, 0])
    current = np.array([0.3, 0.001, 0.0])
    scan = deviating(truth - np.concatenate([np.zeros(6), current]))
    found = average_models(scan, current, prior())
    assert current[0] + found.mean[6] == pytest.approx(0.5, abs=0.01)
    assert current[1] + found.mean[7] == pytest.approx(0.0, abs=1e-5)


def test_stock_that_is_known_is_not_estimated():
    scan = deviating(np.array([0, 0, 0, 0, 0, 0, 0.5, 0, 0]))
    found = average_models(scan, np.array([0.1, 0, 0]), prior(stock_mm=0.2))
    assert found.term_probability[0] == 0
    assert found.mean[6] == pytest.approx(0.1, rel=1e-4)


@pytest.mark.parametrize("kind", ["form", "range"])
def test_the_covariance_holds_where_a_field_deforms_the_part(kind):
    """Squared errors over covariance, of draws from the field: chi-square."""
    field = Field(kind, 0.4)
    clean = patches()
    root = np.linalg.cholesky(field.covariance(clean, prior()) + 1e-9 * np.eye(len(clean)))
    squared, plain = [], []
    weighted = clean.columns[:, :6].T * clean.weight
    for seed in range(12):
        draw = 0.1 * root @ np.random.default_rng([seed, 7]).normal(size=len(clean))
        scan = deviating(np.zeros(9), draw, seed)
        found = average_models(scan, np.zeros(3), prior())
        assert found.field_probability > 0.99
        error, covariance = found.mean[:6], found.covariance[:6, :6]
        squared.append(error @ np.linalg.solve(covariance, error) / 6)
        error = np.linalg.solve(weighted @ clean.columns[:, :6], weighted @ scan.deviation_mm)
        plain.append(error @ weighted @ clean.columns[:, :6] @ error / 6)
    assert 0.3 < np.mean(squared) < 1.7
    assert np.mean(plain) > 10  # what least squares would have claimed


def test_a_patch_that_nothing_explains_does_not_count():
    scan = deviating(np.array([0, 0, 0, 0.05, 0, 0, 0, 0, 0]))
    scan.deviation_mm[17] += 2.0
    found = average_models(scan, np.zeros(3), prior())
    np.testing.assert_array_equal(np.flatnonzero(found.outliers), [17])
    assert found.mean[3] == pytest.approx(0.05, abs=0.01)


def test_patches_on_another_face_are_no_field():
    """A field that is large and short would explain them, and the stock with them."""
    truth = np.array([0, 0, 0, 0.05, 0, 0, 0.5, 0, 0])
    scan = deviating(truth)
    wrong = np.random.default_rng(1).choice(len(scan), len(scan) // 10, replace=False)
    scan.deviation_mm[wrong] += np.linspace(0.3, 1.5, len(wrong))
    found = average_models(scan, np.zeros(3), prior())
    np.testing.assert_array_equal(np.flatnonzero(found.outliers), np.sort(wrong))
    off = found.mean[[3, 6]] - truth[[3, 6]]
    assert np.abs(off).max() < 0.02


def test_errors_of_calibration_that_are_taken_out_already_are_counted_from_there():
    error = np.sin(patches().positions[:, :1] / 20)  # mm, one standard deviation
    clean = dataclasses.replace(patches(), columns=np.hstack([patches().columns, error]))
    whole, half = (
        average_models(
            dataclasses.replace(clean, deviation_mm=left * error[:, 0]),
            np.array([0, 0, 0, 0.8 - left]),
            prior(),
        )
        for left in (0.8, 0.4)
    )
    assert 0.8 - 0.4 + half.mean[9] == pytest.approx(whole.mean[9], abs=1e-4)
    assert whole.mean[9] == pytest.approx(0.8, abs=0.01)


def test_a_known_tolerance_counts_where_the_scan_shows_nothing():
    scan = deviating(np.zeros(9))
    free = average_models(scan, np.zeros(3), prior())
    known = average_models(scan, np.zeros(3), prior(form_tolerance_mm=0.4))
    assert known.field_probability == pytest.approx(1)
    assert np.trace(known.covariance[3:6, 3:6]) > 2 * np.trace(free.covariance[3:6, 3:6])
