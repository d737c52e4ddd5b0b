"""ICP and its nearest neighbours: slow float64 twins, Open3D's answers, laws and edges."""

from __future__ import annotations

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from quick_jit import quick_jit
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.matching.baselines.icp import icp
from vanejax.pointcloud import PointCloud, nearest_neighbors
from vanejax.rigid import RigidTransform

PARITY = Path(__file__).parents[4] / "shared" / "parity" / "open3d.npz"
ROWS, N, M = 160, 90, 140  # of every cloud, real ones of source and target
KEY = jax.random.key(0)
WIDTH = 0.08  # of kernels
METRICS = ("point_to_point", "point_to_plane")

nearest = quick_jit(nearest_neighbors)


@functools.cache
def register(**settings):
    return quick_jit(icp(**{"max_distance": 0.3} | settings))


def cloud(xyz: np.ndarray, normals: np.ndarray, dtype=np.float32, place=None) -> PointCloud:
    """A cloud of ROWS rows, so that all tests share what is compiled; padding lies at the origin.

    The points go to the rows ``place``, or to the first ones.
    """
    place = np.arange(len(xyz)) if place is None else place
    padded = np.zeros((2, ROWS, 3), dtype)
    padded[:, place] = xyz, normals
    return PointCloud(*padded, np.isin(np.arange(ROWS), place))


def motion(rotvec, translation, dtype=np.float32) -> RigidTransform:
    rotation = Rotation.from_rotvec(rotvec).as_matrix().astype(dtype)
    return RigidTransform(rotation, np.asarray(translation, dtype))


@functools.cache
def blob(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points on an ellipsoid of three different axes and its normals; f64."""
    outward = np.random.default_rng(seed).normal(size=(count, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    axes = np.array([1.0, 0.7, 0.4])
    normals = outward / axes
    return outward * axes, normals / np.linalg.norm(normals, axis=1, keepdims=True)


TRUTH = motion([0.03, -0.02, 0.04], [0.01, 0.02, -0.015], np.float64)


def pair(dtype=np.float32) -> tuple[PointCloud, PointCloud]:
    """Every source point is a point of the target, a small motion away."""
    target = cloud(*blob(M), dtype)
    xyz, normals = (values[:N] for values in blob(M))
    back = TRUTH.inverse()
    return cloud(back.apply(xyz), back.rotate(normals), dtype), target


def assert_close(found: RigidTransform, expected: RigidTransform, atol: float) -> None:
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=atol)
    np.testing.assert_allclose(found.translation, expected.translation, atol=atol)


# ---- nearest neighbours ----


@pytest.mark.parametrize(("count", "points"), [(5, 3), (130, 64), (1, 200), (300, 129)])
def test_nearest_neighbors_are_those_of_a_tree(count, points):
    rng = np.random.default_rng(count)
    queries, xyz = (rng.normal(size=(n, 3)).astype(np.float32) for n in (count, points))
    mask = rng.uniform(size=points) < 0.7
    mask[0] = True
    index, squared = nearest(queries, xyz, mask)
    distance, expected = cKDTree(xyz[mask]).query(queries)
    assert index.dtype == jnp.int32
    np.testing.assert_array_equal(index, np.flatnonzero(mask)[expected])
    np.testing.assert_allclose(squared, distance**2, rtol=1e-5)  # f32 eps x 100: differences


def test_nearest_neighbors_of_equals_is_the_first_and_of_nothing_is_infinitely_far():
    xyz = np.zeros((200, 3), np.float32)
    mask = np.arange(200) >= 150
    assert nearest(xyz, xyz, mask)[0].tolist() == [150] * 200
    for points in (xyz, xyz[:0]):
        index, squared = nearest(xyz, points, np.zeros(len(points), bool))
        assert not index.any()
        assert np.isinf(squared).all()


# ---- one iteration and all of them ----


def slow_step(source, target, init, metric, kernel, trim) -> np.ndarray:
    """The pose [4, 4] after one iteration, in numpy."""
    moved = init.apply(source.xyz[:N])
    distance, partner = cKDTree(target.xyz[:M]).query(moved)
    kept = distance <= 0.3
    kept[np.argsort(distance)[round(trim * len(moved)) :]] = False
    q, n = target.xyz[partner], target.normals[partner]
    along = np.sum(n * (q - moved), axis=1)
    residual = np.abs(along) if metric == "point_to_plane" else distance
    weights = {
        "none": np.ones(len(moved)),
        "huber": np.minimum(1, WIDTH / np.maximum(residual, 1e-12)),
        "tukey": np.where(residual < WIDTH, (1 - (residual / WIDTH) ** 2) ** 2, 0),
    }[kernel] * kept
    a, b = (np.average(points, axis=0, weights=weights) for points in (moved, q))
    step = np.eye(4)
    if metric == "point_to_point":
        turn, _ = Rotation.align_vectors(q - b, moved - a, weights=weights)
        step[:3, :3], step[:3, 3] = turn.as_matrix(), b - turn.as_matrix() @ a
    else:
        rows = np.concatenate([np.cross(moved - a, n), n], 1) * np.sqrt(weights)[:, None]
        twist = np.linalg.lstsq(rows, np.sqrt(weights) * along, rcond=None)[0]
        generator = np.zeros((4, 4))
        generator[:3, :3] = np.cross(twist[None, :3], np.eye(3)).T
        generator[:3, 3] = twist[3:]
        there, back = np.eye(4), np.eye(4)
        there[:3, 3], back[:3, 3] = a, -a
        step = there @ scipy.linalg.expm(generator) @ back
    return step @ init.as_matrix()


@pytest.mark.parametrize(
    ("metric", "kernel", "trim"),
    [
        ("point_to_point", "huber", 0.83),
        ("point_to_plane", "tukey", 1.0),
        ("point_to_plane", "none", 0.83),
    ],
)
def test_one_iteration_is_the_slow_twin(metric, kernel, trim):
    source, target = pair(np.float64)
    init = motion([0.02, 0.03, -0.01], [-0.02, 0.0, 0.03], np.float64)
    expected = slow_step(source, target, init, metric, kernel, trim)
    width = None if kernel == "none" else WIDTH
    with jax.enable_x64(True):
        settings = {"metric": metric, "kernel": kernel, "kernel_width": width, "trim": trim}
        found = register(max_iterations=1, **settings)(source, target, init, KEY)
        matrix = np.asarray(found.target_from_source.as_matrix())
    # to points exact: f64 eps x 1e5; to planes the damping of 1e-5 shortens a step of 0.1 rad
    atol = 1e-10 if metric == "point_to_point" else 1e-5
    np.testing.assert_allclose(matrix, expected, atol=atol)
    assert found.iterations == 1
    assert not found.converged
    assert float(found.overlap) == pytest.approx(round(trim * N) / N)


@pytest.mark.parametrize("metric", METRICS)
def test_it_finds_the_motion_and_says_how_well(metric):
    source, target = pair()
    found = register(metric=metric)(source, target, RigidTransform.identity(), KEY)
    assert found.converged
    assert_close(found.target_from_source, TRUTH, 2e-6)  # f32 eps x 20
    assert found.rmse < 1e-6
    assert found.overlap == 1


def test_a_kernel_that_refuses_every_pair_leaves_the_start():
    source, target = pair()
    init = motion([0.2, 0.1, 0.0], [0.0, 0.0, 0.1])
    found = register(kernel="tukey", kernel_width=1e-6)(source, target, init, KEY)
    assert not found.converged
    assert_close(found.target_from_source, init, 0)


@pytest.mark.parametrize("loose", ["tolerance_rotation_deg", "tolerance_translation"])
def test_it_rests_only_below_both_tolerances(loose):
    source, target = pair()
    init = motion([0.0, 0.1, 0.1], [0.0, 0.0, 0.05])
    found = register(**{loose: 180.0})(source, target, init, KEY)
    assert found.iterations > 1
    assert_close(found.target_from_source, TRUTH, 5e-5)  # three times 1e-3 deg, where it rests


# ---- edges ----


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("case", ["no source", "no target", "apart", "two points"])
def test_without_pairs_the_start_is_the_answer(metric, case):
    source, target = pair()
    init = motion([0.1, 0.2, 0.3], [0.3, 0.2, 0.1])
    if case == "no source":
        source = source.replace(mask=np.zeros(ROWS, bool))
    if case == "no target":
        target = target.replace(mask=np.zeros(ROWS, bool))
    if case == "apart":
        target = target.replace(xyz=target.xyz + 10)
    if case == "two points":
        source = source.replace(mask=np.arange(ROWS) < 2)
    found = register(metric=metric)(source, target, init, KEY)
    assert not found.converged
    assert_close(found.target_from_source, init, 0)
    assert np.isfinite(found.rmse)
    assert (found.overlap > 0) == (case == "two points")


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("axes", [(1, 1, 0), (1, 0, 0), (0, 0, 0)], ids=["plane", "line", "point"])
def test_flat_clouds_move_finitely_and_say_what_nothing_holds(metric, axes):
    source, target = (
        points.replace(
            xyz=points.xyz * np.float32(axes),
            normals=np.broadcast_to(np.float32([0, 0, 1]), points.xyz.shape),
        )
        for points in pair()
    )
    init = motion([0.02, 0.01, 0.0], [0.0, 0.0, 0.05])
    found = register(metric=metric)(source, target, init, KEY)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    rotation = found.target_from_source.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=2e-6)  # f32 eps x 20
    # partners on a plane fix a motion to points, but not one to the plane itself
    assert found.converged == (metric == "point_to_point" and axes == (1, 1, 0))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"metric": "plane"}, "'plane'.*point_to_point, point_to_plane"),
        ({"kernel": "cauchy", "kernel_width": 1.0}, "'cauchy'.*none, huber, tukey"),
        ({"kernel": "huber"}, "kernel_width None"),
        ({"kernel_width": 0.1}, "kernel_width 0.1"),
        ({"kernel": "huber", "kernel_width": 0.0}, "kernel_width is 0.0"),
        ({"max_distance": -1.0}, "max_distance is -1.0"),
        ({"max_distance": float("nan")}, "max_distance is nan"),
        ({"max_iterations": 0}, "max_iterations is 0"),
        ({"tolerance_translation": 0.0}, "tolerance_translation is 0.0"),
        ({"tolerance_rotation_deg": -1.0}, "tolerance_rotation_deg is -1.0"),
        ({"trim": 0.0}, r"trim is 0.0.*\(0, 1\]"),
        ({"trim": 1.5}, r"trim is 1.5.*\(0, 1\]"),
    ],
)
def test_settings_that_cannot_be_meant(settings, words):
    with pytest.raises(InputError, match=words):
        icp(**{"max_distance": 1.0} | settings)


@pytest.mark.skipif(not PARITY.exists(), reason="needs ../shared/parity/open3d.npz")
@pytest.mark.parametrize("metric", METRICS)
def test_parity_with_open3d(metric):
    """Both run to rest from the identity, with the same pairs in the end; coordinates in mm."""
    with np.load(PARITY) as file:
        known = {name: file[name] for name in file.files if name.startswith("icp")}
    points = known["icp_source"], known["icp_target"], known["icp_target_normals"]
    xyz, target_xyz, normals = (jnp.float32(values) for values in points)
    source, target = PointCloud.create(xyz, 0 * xyz), PointCloud.create(target_xyz, normals)
    found = register(
        metric=metric,
        max_distance=float(known["icp_max_distance"]),
        tolerance_translation=1e-4,
    )(source, target, RigidTransform.identity(), KEY)
    assert found.converged
    expected = RigidTransform.from_matrix(known[f"icp_{metric}"])
    rotation = found.target_from_source.rotation
    np.testing.assert_allclose(rotation, expected.rotation, atol=1e-6)  # f32 eps x 10
    # f32 eps x 100 mm x 10
    np.testing.assert_allclose(
        found.target_from_source.translation, expected.translation, atol=1e-4
    )
