"""The study of RMSE and FFMDE over density: its numbers against slow and made-up ones."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from experiments.runner.vane_views import VaneViews
from experiments.studies.density import study as density
from experiments.studies.density.report import verdict
from vanejax.errors import InputError
from vanejax.matching import surface_fit
from vanejax.pointcloud import PointCloud
from vanejax.scanner import Camera
from vanejax.training import PairSampling

VIEW = 52
COUNTS = (256, 1024, 4096)


@pytest.fixture(scope="module")
def views() -> VaneViews:
    return VaneViews(camera=Camera().scaled(0.12))


@pytest.fixture(scope="module")
def sweep(views: VaneViews) -> density.Sweep:
    return sweep_of(views)


def sweep_of(views: VaneViews, **changes: object) -> density.Sweep:
    given = {
        "varied": "CAD", "sizes": COUNTS, "cad_noise": 0.0, "scan_noise": 0.0, "draws": 4, "seed": 0
    } | changes  # fmt: skip
    return density.measure(views, [VIEW], **given)


def made_up(
    scores: np.ndarray, *, signed: np.ndarray | None = None, **changes: object
) -> density.Sweep:
    """A sweep whose metrics are all ``scores`` [S, E, D]."""
    values = dict.fromkeys(density.METRICS, scores)
    values["ffmde_signed_mm"] = scores if signed is None else signed
    counts = [4**k for k in range(4, 4 + len(scores))]
    given = {"varied": "CAD", "cad_noise": 0.0, "scan_noise": 0.0} | changes
    return density.Sweep(cad_points=counts, scan_points=counts, values=values, **given)


def test_the_tree_finds_what_the_metrics_own_search_finds(views: VaneViews) -> None:
    points, normals, _ = views.part.sample(300, 0)
    scan = views.truth(VIEW).apply(views.points(VIEW))[::7] + np.array([[0.4, -0.3, 0.2]])
    found = density.fit(scan, cKDTree(points), normals.astype(np.float32))
    clouds = (
        PointCloud(
            xyz=jnp.asarray(xyz, jnp.float32), normals=jnp.asarray(normal, jnp.float32),
            mask=jnp.ones(len(xyz), bool),
        )
        for xyz, normal in ((scan, np.zeros_like(scan)), (points, normals))
    )  # fmt: skip
    expected = surface_fit(*clouds, unit_mm=1.0)
    for name in density.METRICS:
        # f32 of squared distances up to 300 mm^2
        np.testing.assert_allclose(found[name], getattr(expected, name), rtol=1e-4)


def test_rmse_on_a_plane_is_the_poisson_neighbours() -> None:
    """Points strewn with intensity i: the mean square distance to the nearest is 1 / (pi i)."""
    rng = np.random.default_rng(0)
    for count in (400, 6400):
        cad = np.pad(rng.uniform(0, 1, (count, 2)), ((0, 0), (0, 1)))
        scan = np.pad(rng.uniform(0.1, 0.9, (20_000, 2)), ((0, 0), (0, 1)))
        found = density.fit(scan, cKDTree(cad), np.tile(np.float32([0, 0, 1]), (count, 1)))
        # some 250 cells inside, each as unsure as its mean: 1 / (2 sqrt 250)
        assert found["rmse_mm"] == pytest.approx(1 / np.sqrt(np.pi * count), rel=0.1)
        assert found["ffmde_abs_mm"] == 0


def test_noise_is_the_papers() -> None:
    zeros, clip = np.zeros((100_000, 3)), PairSampling().noise_clip
    noisy = density.jittered(zeros, 0.01, 70.0, np.random.default_rng(0))
    assert np.std(noisy) == pytest.approx(0.7, rel=0.01)  # 5 of its own standard deviations
    assert np.abs(density.jittered(zeros, 0.1, 70.0, np.random.default_rng(0))).max() == 70 * clip
    np.testing.assert_array_equal(
        density.jittered(zeros, 0.0, 70.0, np.random.default_rng(0)), zeros
    )


def test_at_the_true_pose_rmse_falls_with_the_root_of_the_density(sweep: density.Sweep) -> None:
    report = density.summarize(sweep, 1.0)
    # 4 draws of one view; edges of the part make it a little flatter than on a plane
    assert report["rmse_mm"]["slope"][0] == pytest.approx(-0.5, abs=0.08)
    assert report["ffmde_abs_mm"]["slope"][0] < -0.8
    # a wrong pose stops both, FFMDE sooner
    last = len(density.ERRORS) - 1
    assert report["rmse_mm"]["slope"][0] < report["rmse_mm"]["slope"][last] < -0.1
    assert report["ffmde_abs_mm"]["slope"][last] > report["rmse_mm"]["slope"][last]


def test_a_sweep_repeats_and_its_poses_do_not_depend_on_size(views, sweep) -> None:
    again = sweep_of(views)
    one = sweep_of(views, sizes=COUNTS[1:2])
    other = sweep_of(views, seed=1)
    for name in density.METRICS:
        np.testing.assert_array_equal(again.values[name], sweep.values[name])
        np.testing.assert_array_equal(one.values[name][0], sweep.values[name][1])
        assert not np.any(other.values[name] == sweep.values[name])
    assert np.ptp(sweep.values["rmse_mm"], axis=2).min() > 0  # draws differ


def test_each_cloud_has_its_own_noise(views: VaneViews) -> None:
    """On a dense, exact model the scan's noise is all that is left of FFMDE: mean of a normal."""

    def face(cad_noise: float, scan_noise: float) -> float:
        noise = {"cad_noise": cad_noise, "scan_noise": scan_noise}
        found = sweep_of(views, sizes=(32768,), draws=1, **noise)
        return float(found.values["ffmde_abs_mm"][0, 0, 0])

    expected = 0.01 * views.part.radius * np.sqrt(2 / np.pi)
    # over edges a nearest point is nearer than the plane below: a few per cent
    assert face(0.0, 0.01) == pytest.approx(expected, rel=0.1)
    assert face(0.0, 0.0) < 0.1 * expected
    # the nearest of a thick cloud's points lies on the scan's side
    assert face(0.01, 0.01) < 0.8 * expected
    assert 0.1 * expected < face(0.01, 0.0) < 0.8 * expected


def test_the_scans_own_number_changes_no_mean(views: VaneViews) -> None:
    found = sweep_of(views, varied="scan", sizes=(200, 1600, 10**9))
    assert found.cad_points == [density.FIXED_CAD] * 3
    assert found.scan_points == [200, 1600, len(views.points(VIEW))]
    assert found.sizes == found.scan_points
    for name in density.METRICS[:2]:
        mean = found.values[name].mean(axis=2)
        # 4 x 200 points whose distances differ by about as much as they are large
        np.testing.assert_allclose(mean[0, 1:], mean[-1, 1:], rtol=0.1)


def test_slope_is_the_exponent() -> None:
    falling = (
        np.ones((3, len(density.ERRORS), 2)) * np.array([1, 0.5, 0.25])[:, None, None]
    )  # sizes 4^k
    for scores, exponent in ((falling, -0.5), (np.zeros_like(falling), 0.0)):
        found = density.summarize(made_up(scores), 1.0)["rmse_mm"]["slope"]
        np.testing.assert_allclose(found, exponent, atol=1e-9)


def test_the_share_counts_draws_beyond_three_standard_deviations() -> None:
    score = np.array([[[1.0, 3.0], [6.2, 6.3], [6.2, 6.3], [0.0, 99.0]]])  # 2 + 3 sqrt 2 = 6.24
    np.testing.assert_array_equal(density.share_distinguished(score), [[0, 0.5, 0.5, 0.5]])


def test_the_first_of_the_rest_stays_good() -> None:
    sizes = (10, 20, 30, 40)
    for good, expected in (("1111", 10), ("1011", 30), ("0001", 40), ("1110", None)):
        assert density.first_of_rest(sizes, np.array([c == "1" for c in good])) == expected


def test_signs_that_cancel_are_seen() -> None:
    size = np.ones((2, len(density.ERRORS), 2))
    signed = 0.5 * size
    signed[1, 2] = [-0.04, 0.3]
    rows = density.cancellation(made_up(size, signed=signed))
    assert [row["share"] for row in rows] == [0, 0, 0.25, 0, 0]
    assert (rows[2]["worst_signed_mm"], rows[2]["worst_abs_mm"]) == (0.04, 1)


def test_the_verdict_follows_the_numbers() -> None:
    """FFMDE that keeps its value is praised, and one that behaves as RMSE is not."""
    rng = np.random.default_rng(0)
    sizes = np.array([1, 2, 4])[:, None, None]
    off = np.arange(len(density.ERRORS))[None, :, None]
    jitter = rng.uniform(0.99, 1.01, (3, len(density.ERRORS), 6))
    dense, free = jitter * (1 + 0.1 * off) / sizes, jitter * (0.1 + off)
    good = made_up(dense)
    good.values["ffmde_abs_mm"] = free
    praised, refuted = (verdict([density.summarize(one, 1.0)]) for one in (good, made_up(dense)))
    assert "FFMDE ranks poses better than RMSE over unequal densities in every case" in praised
    assert "free of density in every case" in praised
    assert "FFMDE ranks poses better than RMSE over unequal densities in no case" in refuted
    assert "free of density in no case" in refuted
    assert "settles at some density in no case" in refuted
    for found, says in ((good, "it does not matter"), (made_up(dense), "it matters too")):
        found.values["rmse_mm"] = found.values["ffmde_abs_mm"]
        scan = density.Sweep("scan", 0.0, 0.0, [1] * 3, [1, 2, 4], found.values)
        assert says in verdict([density.summarize(good, 1.0), density.summarize(scan, 1.0)])


def test_the_command_writes_what_it_prints(record, tmp_path, monkeypatch, capsys, views) -> None:
    monkeypatch.setattr(density, "VaneViews", lambda: views)
    monkeypatch.setattr(density, "CAD_POINTS", COUNTS)
    monkeypatch.setattr(density, "SCAN_POINTS", (200, 800))
    report = record(density, "density", "--views", "0,52", "--draws", "1")
    assert (tmp_path / "density.png").stat().st_size > 10_000
    assert report["part"]["sha256"] == views.part.sha256
    assert [(s["varied"], s["cad_noise"], s["scan_noise"]) for s in report["sweeps"]] == [
        ("CAD", 0, 0), ("CAD", 0.01, 0.01), ("CAD", 0, 0.01), ("scan", 0, 0), ("scan", 0.01, 0.01)
    ]  # fmt: skip
    assert {s["draws"] for s in report["sweeps"]} == {2}
    printed = " ".join(capsys.readouterr().out.split())
    assert report["verdict"] in printed
    with pytest.raises(InputError, match="two draws"):
        record(density, "density", "--views", "0", "--draws", "1")
