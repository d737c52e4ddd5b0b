"""The study of fine registration: its noise, starts, errors and bound against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.runner.vane_views import VaneViews, magnitudes, perturb, pose_error, with_noise
from experiments.studies.fine import study as fine
from vanejax.errors import InputError
from vanejax.localization.pose_batch import stack
from vanejax.localization.residuals import moved
from vanejax.scanner import Camera

VIEW = 40


@pytest.fixture(scope="module")
def views() -> VaneViews:
    return VaneViews(camera=Camera().scaled(0.12))


@pytest.fixture(scope="module")
def points(views: VaneViews) -> np.ndarray:
    return views.points(VIEW)


def test_the_test_views_are_the_papers(views: VaneViews) -> None:
    azimuth = views.viewpoints.azimuth_deg
    assert views.select("test") == [v for v in range(216) if azimuth[v] % 40 == 0]
    assert views.select("all") == list(range(216))
    assert views.select("3,1") == [3, 1]
    for wrong in ("", "216", "-1", "some"):
        with pytest.raises(InputError, match="test, all, or numbers below 216"):
            views.select(wrong)


def test_noise_is_along_the_rays(points: np.ndarray) -> None:
    noisy = with_noise(points, 0.2, np.random.default_rng(0))
    error = noisy - points
    along = np.sum(error * points, axis=1) / np.linalg.norm(points, axis=1)
    assert np.abs(np.cross(error, points)).max() < 1e-9  # f64 eps x 400 mm x 1 mm
    # 2,000 points and more: the spread's own standard deviation is 1.6 %
    assert np.std(along) == pytest.approx(0.2, rel=0.06)


def test_a_start_is_as_far_off_as_it_says_and_its_error_undoes_it(views: VaneViews) -> None:
    """Applied to the start as `residuals.moved` does, the error gives the truth."""
    truth, part = views.truth(VIEW), views.part
    for seed, (deg, mm) in enumerate(((5.0, 3.0), (20.0, 9.0))):
        start = perturb(truth, part, deg=deg, mm=mm, rng=np.random.default_rng(seed))
        error = pose_error(start, truth, part.center)
        assert magnitudes(error) == pytest.approx((deg, mm), abs=1e-9)
        again = moved(part, stack(start), error[None])
        np.testing.assert_allclose(again.rotation[0], truth.rotation, atol=1e-12)
        np.testing.assert_allclose(again.translation[0], truth.translation, atol=1e-9)


def test_the_bound_is_that_of_numerical_derivatives(views: VaneViews, points: np.ndarray) -> None:
    truth, noise_mm, step = views.truth(VIEW), 0.3, 1e-6
    model = views.model

    def ranges(delta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pose = moved(views.part, stack(truth), delta[None])
        directions = points @ pose.rotation[0].T
        origins = np.broadcast_to(pose.translation[0], directions.shape)
        hits = model.scanner.cast(origins, directions)
        return hits.distance_mm, hits.face

    pairs = [(ranges(step * axis), ranges(-step * axis)) for axis in np.eye(6)]
    # a ray that changes its face on the way has no derivative
    same = np.all([(a[1] == b[1]) & (a[1] >= 0) for a, b in pairs], axis=0)
    assert same.mean() > 0.999
    jacobian = np.stack([(a[0] - b[0])[same] / (2 * step) for a, b in pairs], axis=1)
    expected = np.linalg.inv(jacobian.T @ jacobian) * noise_mm**2
    found = fine.cramer_rao(model, points, truth, noise_mm)
    # a missing ray in 1000 may carry some of the information
    np.testing.assert_allclose(np.diag(found), np.diag(expected), rtol=0.02)
    np.testing.assert_allclose(fine.cramer_rao(model, points, truth, 0.6), 4 * found, rtol=1e-9)


def made_up(*, claimed: float = 1.0, worst: float = 1.0) -> list[dict]:
    """Rows of 400 views whose errors are drawn from the bound.

    ``claimed`` scales the reported covariance, ``worst`` one of the errors.
    """
    rng = np.random.default_rng(0)
    root = np.diag([1e-5] * 3 + [1e-3] * 3) @ (np.eye(6) + 0.2 * rng.standard_normal((6, 6)))
    errors = rng.standard_normal((400, 6)) @ root.T
    errors[3, 3:] *= worst
    bound = root @ root.T
    report = {"noise_mm": 0.1, "converged": True, "iterations": 9, "points": 1000, "seconds": 0.5}
    return [
        {"view": view, **fine.against_bound(error, bound, claimed * bound), **report}
        for view, error in enumerate(errors)
    ]


def test_an_honest_and_efficient_estimate_is_seen_to_be_one() -> None:
    report = fine.summarize(made_up(), 0.1)
    # 400 views of three components each: 2 to 3 % of chance
    assert report["rotation_deg"]["ratio"] == pytest.approx(1, abs=0.1)
    assert report["translation_mm"]["ratio"] == pytest.approx(1, abs=0.1)
    assert report["anees"] == pytest.approx(1, abs=0.1)
    assert report["coverage_95"] == pytest.approx(0.95, abs=0.035)
    low, high = report["anees_interval_95"]
    assert 0.94 < low < 1 < high < 1.06
    assert report["noise_estimate_ratio"] == pytest.approx(1)
    assert fine.table([report]).splitlines()[-1].startswith("met")


def test_a_covariance_that_is_too_small_and_one_bad_view_are_seen() -> None:
    small = fine.summarize(made_up(claimed=0.25), 0.1)
    assert small["anees"] == pytest.approx(4, abs=0.4)
    assert small["coverage_95"] < 0.5
    bad = fine.summarize(made_up(worst=50), 0.1)
    assert bad["translation_mm"]["worst_view_ratio"] > 4
    assert fine.table([bad]).splitlines()[-1].startswith("MISSED")


def test_the_study_reaches_the_bound(record, tmp_path, monkeypatch, capsys, views) -> None:
    monkeypatch.setattr(fine, "VaneViews", lambda: views)
    report = record(fine, "fine", "--noise-mm", "0.1,0.5", "--views", "0,120")
    assert (tmp_path / "fine.png").stat().st_size > 10_000
    assert [level["noise_mm"] for level in report["levels"]] == [0.1, 0.5]
    for level in report["levels"]:
        assert [row["view"] for row in level["rows"]] == [0, 120]
        for name in ("rotation_deg", "translation_mm"):
            assert level[name]["worst_view_ratio"] < 4
        assert level["noise_estimate_ratio"] == pytest.approx(1, abs=0.1)
    assert report["part"]["sha256"] == views.part.sha256
    assert "worst view" in capsys.readouterr().out


def test_draws_repeat_and_differ(views: VaneViews, points: np.ndarray) -> None:
    """The same arguments give the same fit; another level, view or seed other noise and start."""

    def relative_error(view: int = VIEW, noise_mm: float = 0.1, seed: int = 0) -> np.ndarray:
        ideal = points if view == VIEW else views.points(view)
        row = fine.refine_view(views, view, ideal, noise_mm=noise_mm, start=(5.0, 5.0), seed=seed)
        return np.array([row["rotation_deg"], row["translation_mm"]]) / noise_mm

    first = relative_error()
    np.testing.assert_array_equal(relative_error(), first)
    for other in (relative_error(noise_mm=0.2), relative_error(seed=1), relative_error(120)):
        # the same draws, scaled, would agree to the nonlinearity of a few per cent
        assert (np.abs(other - first) > 0.1 * first).any()


def test_from_five_degrees_all_arrive() -> None:
    finer = VaneViews(camera=Camera().scaled(0.4))
    rows = fine.basin(finer, [VIEW], 0, degrees=(5.0,))
    assert [(row["start_deg"], row["start_mm"]) for row in rows] == [(5, 5), (5, 10), (5, 20)]
    assert rows[0]["arrived"] == 1.0
    assert "100%" in fine.basin_table(rows)
