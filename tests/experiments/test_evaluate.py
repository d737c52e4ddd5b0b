"""Evaluation of any method on the test views, and what it reports."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from example_experiment import tiny_experiment

from experiments.evaluate import evaluate
from experiments.runner.evaluation_report import hardest_views, plain, summarize, table
from experiments.runner.experiment import Experiment
from experiments.runner.registrations import Results, register_views
from experiments.runner.run_folder import TrainingRecord
from vanejax.errors import InputError
from vanejax.matching import Register, Registration
from vanejax.matching.se3 import rotation_angle
from vanejax.rigid import RigidTransform
from vanejax.training import ScanSet, make_scan_set
from vanejax.training.pairs import ScanBank, draw_source, make_bank

pytestmark = pytest.mark.usefixtures("hasty_compiler")


@pytest.fixture(scope="module")
def config() -> Experiment:
    config = tiny_experiment()
    config.views.elevations_deg, config.views.azimuths_deg = (60.0, 85.0), (0.0, 20.0, 40.0, 80.0)
    return config


@pytest.fixture(scope="module")
def scans(config: Experiment) -> ScanSet:
    """Two elevations; azimuths 0, 40 and 80 deg are test views."""
    part = config.make_part()
    return make_scan_set(
        part,
        config.make_camera(),
        config.make_viewpoints(part),
        voxel_mm=config.data.voxel_mm,
        progress=False,
    )


@pytest.fixture(scope="module")
def bank(config: Experiment, scans: ScanSet) -> ScanBank:
    return make_bank(scans.test, num_reference=config.data.num_reference)


@pytest.fixture(scope="module")
def register(config: Experiment, scans: ScanSet, bank: ScanBank) -> Callable[[Register], Results]:
    """Registers the test views with a method."""
    sampling, radius_mm = config.pair_sampling(scans), scans.radius_mm
    return lambda method: register_views(
        method, bank, sampling, seed=config.seed, unit_mm=radius_mm, progress=False
    )


def stay(source, target, init, key) -> Registration:
    """The method that does nothing."""
    return Registration(
        target_from_source=jax.tree.map(jnp.asarray, init),
        converged=jnp.asarray(True),
        iterations=jnp.asarray(0),
        rmse=jnp.zeros(()),
        overlap=jnp.ones(()),
    )


def lose_some(source, target, init, key) -> Registration:
    """Fails where the source's first point has a positive x."""
    found = stay(source, target, init, key)
    lost = jnp.where(source.xyz[0, 0] > 0, jnp.nan, 0.0)
    pose = found.target_from_source
    return found.replace(target_from_source=pose.replace(translation=pose.translation + lost))


def report_of(results: Results, scans: ScanSet) -> dict:
    return plain(summarize(results, scans.test) | {"method": "a test", "part": {"name": "vane"}})


def test_doing_nothing_is_as_wrong_as_the_pose_drawn(register, scans: ScanSet) -> None:
    results = register(stay)
    truth = results.pairs.target_from_source
    assert truth.rotation.shape == (6, 3, 3)
    angle = np.degrees(rotation_angle(jnp.asarray(truth.rotation)))
    np.testing.assert_allclose(results.errors.rotation_deg, angle, rtol=1e-5)  # f32
    origin = np.linalg.norm(np.einsum("vji,vj->vi", truth.rotation, truth.translation), axis=1)
    np.testing.assert_allclose(results.errors.translation_mm, scans.radius_mm * origin, rtol=1e-5)
    assert (results.time_s > 0).all()
    # the true pose fits better than a wrong one
    assert (results.fit_at_truth.rmse_mm < results.fit.rmse_mm).all()


def test_every_method_gets_the_same_pairs_each_view_its_own(register) -> None:
    one, other = (register(method).pairs for method in (stay, lose_some))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)
    poses = one.target_from_source.translation
    assert len(np.unique(poses, axis=0)) == len(poses)
    targets = one.target.xyz
    assert all((targets[0] != targets[view]).any() for view in range(1, len(targets)))


def test_the_hardest_views_see_least_at_their_elevation(scans: ScanSet) -> None:
    counts = np.array([50, 40, 60, 30, 31, 29])
    test = dataclasses.replace(scans.test, counts=counts)
    np.testing.assert_array_equal(hardest_views(test), [1, 5])


def test_what_is_not_finite_is_counted_and_left_out(register, scans: ScanSet) -> None:
    results = register(lose_some)
    report = report_of(results, scans)
    lost = results.pairs.source.xyz[:, 0, 0] > 0
    assert 0 < lost.sum() < 6  # or this test says nothing
    assert report["non_finite_views"] == lost.sum()
    assert report["summary"]["translation_error_mm"]["non_finite"] == lost.sum()
    kept = results.errors.translation_mm[~lost]
    assert report["summary"]["translation_error_mm"]["mean"] == pytest.approx(kept.mean())
    assert report["mte_per_axis_mm"] == pytest.approx(
        results.errors.translation_axes_mm[~lost].mean(axis=0)
    )
    assert [row["translation_error_mm"] is None for row in report["rows"]] == list(lost)
    assert f"WARNING: {lost.sum()} of 6 views" in table(report)
    json.dumps(report, allow_nan=False)


def test_a_method_that_always_fails_has_no_figures(register, scans: ScanSet) -> None:
    def fail(*arguments) -> Registration:
        return jax.tree.map(lambda leaf: leaf * jnp.nan, stay(*arguments))

    report = report_of(register(fail), scans)
    assert report["summary"]["rotation_error_deg"]["mean"] is None
    assert report["mre_per_axis_deg"] == [None] * 3
    assert "WARNING: 6 of 6 views" in table(report)


def test_evaluate_writes_json_and_pictures(config, scans, bank, register, tmp_path, capsys) -> None:
    model, sampling = config.make_network().model, config.pair_sampling(scans)
    key = jax.random.key(0)
    source, _ = draw_source(key, bank, jnp.asarray(0), sampling)
    variables = jax.jit(model.init, static_argnums=4)(
        key, source, source, RigidTransform.identity(), 1
    )
    rows = [{"step": step, "loss": 1 / step, "rotation_error_deg": 2.0} for step in (1, 2, 3)]
    part = config.make_part()
    training = TrainingRecord(rows, 36.0)
    report = evaluate(config, scans, variables, tmp_path, part=part, training=training)

    def refuse(constant: str) -> float:
        raise ValueError(constant)

    text = (tmp_path / "evaluation.json").read_text()
    assert json.loads(text, parse_constant=refuse) == report
    assert report["views"] == len(report["rows"]) == 6
    assert report["hardest"]["rows"] == hardest_views(scans.test).tolist()
    assert report["config"]["name"] == "tiny"
    assert report["part"]["sha256"] == config.make_part().sha256
    pictures = ("overlays", "error_map", "axis_errors", "training_curves", "view_and_shadow")
    names = (*pictures, "overview")
    assert {path.name for path in tmp_path.iterdir()} == {
        "evaluation.json",
        *(f"{name}.{kind}" for name in names for kind in ("png", "pdf")),
    }
    printed = capsys.readouterr().out
    assert "rotation error (deg)" in printed
    # the same weights and seed give the same figures
    found = register(config.make_network().register(variables))
    again = [row["rotation_error_deg"] for row in report["rows"]]
    np.testing.assert_array_equal(found.errors.rotation_deg, np.float32(again))


def test_without_test_views_there_is_nothing_to_evaluate(config, scans, tmp_path) -> None:
    with pytest.raises(InputError, match="azimuths_deg"):
        evaluate(config, scans.train, {}, tmp_path, part=config.make_part())
