"""The paper's measures against slow obvious oracles, analytic cases and their laws."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vanejax.matching import metrics
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform


def cloud(xyz: np.ndarray, normals: np.ndarray | None = None, mask: np.ndarray | None = None):
    """A float32 cloud [N, 3]; normals along z and no padding unless given."""
    xyz = np.asarray(xyz, np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (len(xyz), 1)) if normals is None else normals
    mask = np.ones(len(xyz), bool) if mask is None else mask
    return PointCloud(
        xyz=jnp.asarray(xyz), normals=jnp.asarray(normals, jnp.float32), mask=jnp.asarray(mask)
    )


def random_cloud(seed: int, count: int) -> PointCloud:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    return cloud(
        rng.uniform(-1, 1, (count, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)
    )


fit_of_70_mm = jax.jit(lambda source, reference: metrics.surface_fit(source, reference, unit_mm=70))


# ---------------------------------------------------------------- pose errors


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 179), st.floats(0, 2))
def test_a_known_error_is_measured(seed: int, angle_deg: float, length: float) -> None:
    rng = np.random.default_rng(seed)
    axis, shift = rng.normal(size=(2, 3))
    axis, shift = axis / np.linalg.norm(axis), length * shift / np.linalg.norm(shift)
    truth = Rotation.random(rng=rng).as_matrix(), rng.uniform(-1, 1, 3)
    error = Rotation.from_rotvec(np.radians(angle_deg) * axis).as_matrix()
    found = error @ truth[0], error @ truth[1] + shift
    to_jax = lambda pose: RigidTransform(*(jnp.asarray(x, jnp.float32) for x in pose))  # noqa: E731
    errors = metrics.pose_errors(to_jax(found), to_jax(truth), unit_mm=80.0)
    # a few float32 roundings of matrices with entries up to 1: 1e-6 rad is 6e-5 deg
    np.testing.assert_allclose(errors.rotation_deg, angle_deg, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(errors.translation_mm, 80 * length, rtol=1e-5, atol=1e-4)


def test_a_thousandth_of_a_degree_is_not_lost_in_float32() -> None:
    error = Rotation.from_rotvec([0, 0, np.radians(1e-3)]).as_matrix()
    found = RigidTransform(jnp.asarray(error, jnp.float32), jnp.zeros(3))
    value = metrics.rotation_error_deg(found, RigidTransform.identity())
    # an arc cosine of the trace would read 0; one rounding of the sine is 6e-8 relative
    np.testing.assert_allclose(value, 1e-3, rtol=1e-5)


def test_axis_errors_are_differences_of_angles_and_translations() -> None:
    angles = np.array([[10.0, 20.0, 30.0], [12.5, 17.0, 30.5]])
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix().astype(np.float32)
    translation = np.float32([[0.1, -0.2, 0.3], [0.2, 0.2, 0.3]])
    truth, found = (RigidTransform(jnp.asarray(rotation[i]), translation[i]) for i in (0, 1))
    errors = metrics.pose_errors(found, truth, unit_mm=50.0)
    np.testing.assert_allclose(errors.rotation_axes_deg, [2.5, 3.0, 0.5], atol=5e-5)  # f32 of 30
    np.testing.assert_allclose(errors.translation_axes_mm, [5.0, 20.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2)])
def test_axis_errors_wrap_at_half_a_turn_and_keep_leading_axes(shape: tuple[int, ...]) -> None:
    def about_z(angle_deg: float) -> RigidTransform:
        matrix = Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()
        return RigidTransform(
            jnp.broadcast_to(jnp.asarray(matrix, jnp.float32), (*shape, 3, 3)),
            jnp.zeros((*shape, 3)),
        )

    value = metrics.pose_errors(about_z(179.0), about_z(-179.0), unit_mm=1.0).rotation_axes_deg
    expected = np.broadcast_to([0, 0, 2], (*shape, 3))
    np.testing.assert_allclose(value, expected, atol=1e-4)  # f32 eps of 180


def test_means_over_views_and_over_axes() -> None:
    errors = jnp.asarray([[1.0, 2.0, 3.0], [3.0, 2.0, 7.0]])
    np.testing.assert_array_equal(metrics.mean_per_axis(errors), [2, 2, 5])
    np.testing.assert_array_equal(metrics.mean_per_view(errors), [2, 4])


def test_a_pose_that_is_not_finite_stays_so() -> None:
    lost = RigidTransform(np.float32([np.eye(3), np.full((3, 3), np.nan)]), np.zeros((2, 3)))
    errors = metrics.pose_errors(lost, RigidTransform.identity((2,)), unit_mm=1.0)
    for leaf in (errors.rotation_deg, errors.translation_mm, errors.rotation_axes_deg):
        np.testing.assert_array_equal(np.isnan(leaf).reshape(2, -1).all(axis=1), [False, True])


# ---------------------------------------------------------------- RMSE and FFMDE


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 60))
def test_surface_fit_against_a_kd_tree(seed: int, num_source: int, num_reference: int) -> None:
    source, reference = random_cloud(seed, 40), random_cloud(seed + 1, 60)
    source = source.replace(mask=jnp.arange(40) < num_source)
    reference = reference.replace(mask=jnp.arange(60) < num_reference)
    fit = fit_of_70_mm(source, reference)
    x = np.asarray(source.xyz, np.float64)[:num_source]
    y, n = (np.asarray(a, np.float64)[:num_reference] for a in (reference.xyz, reference.normals))
    distance, nearest = cKDTree(y).query(x)
    along = np.array([n[j] @ (y[j] - x[i]) for i, j in enumerate(nearest)])
    # sums of at most 40 float32 terms; a tie between two neighbours has measure zero
    np.testing.assert_allclose(fit.rmse_mm, 70 * np.sqrt(np.mean(distance**2)), rtol=1e-5)
    np.testing.assert_allclose(fit.ffmde_signed_mm, 70 * along.mean(), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(fit.ffmde_abs_mm, 70 * np.abs(along).mean(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("junk", [1e6, np.nan])
def test_padding_changes_nothing(junk: float) -> None:
    source, reference = random_cloud(5, 20), random_cloud(6, 30)
    alone = fit_of_70_mm(source, reference)

    def padded(points: PointCloud) -> PointCloud:
        pad = np.full((7, 3), junk, np.float32)
        return PointCloud(
            xyz=jnp.concatenate([points.xyz, pad]),
            normals=jnp.concatenate([points.normals, pad]),
            mask=jnp.concatenate([points.mask, np.zeros(7, bool)]),
        )

    fit = fit_of_70_mm(padded(source), padded(reference))
    for with_padding, without in zip(jax.tree.leaves(fit), jax.tree.leaves(alone), strict=True):
        # only the order of a float32 sum of 20 may differ
        np.testing.assert_allclose(with_padding, without, rtol=1e-6)


def test_the_gradient_at_padding_is_exactly_zero() -> None:
    mask = np.arange(20) < 12
    source = random_cloud(7, 20).replace(mask=jnp.asarray(mask))
    reference = random_cloud(8, 30)

    def error(xyz: jax.Array) -> jax.Array:
        return metrics.surface_fit(source.replace(xyz=xyz), reference, unit_mm=1.0).rmse_mm

    gradient = np.asarray(jax.grad(error)(source.xyz))
    assert (gradient[~mask] == 0).all()
    assert (np.abs(gradient[mask]).max(axis=1) > 0).all()


@pytest.mark.parametrize("empty", ["source", "reference"])
def test_without_points_there_is_no_fit(empty: str) -> None:
    source, reference = random_cloud(9, 4), random_cloud(10, 5)
    nothing = lambda points: points.replace(mask=jnp.zeros_like(points.mask))  # noqa: E731
    pair = (nothing(source), reference) if empty == "source" else (source, nothing(reference))
    fit = metrics.surface_fit(*pair, unit_mm=1.0)
    assert all(np.isnan(leaf) for leaf in jax.tree.leaves(fit))


# ---------------------------------------------------------------- summaries


def test_summary_of_known_values() -> None:
    expected = {"mean": 50.0, "median": 50.0, "p95": 95.0, "max": 100.0, "non_finite": 0}
    assert metrics.summary(np.arange(101)) == expected
    assert metrics.summary(np.r_[np.nan, np.arange(101), np.inf]) == expected | {"non_finite": 2}


@pytest.mark.parametrize("values", [[], [np.nan, -np.inf]])
def test_summary_of_nothing_is_nan_not_zero(values: list[float]) -> None:
    found = metrics.summary(np.array(values))
    assert found["non_finite"] == len(values)
    assert all(np.isnan(found[name]) for name in ("mean", "median", "p95", "max"))
