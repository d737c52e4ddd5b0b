"""Open3D's methods keep the library's contract; skipped where Open3D is not installed."""

from __future__ import annotations

import functools
import sys

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.studies.comparison import open3d_methods
from vanejax.errors import InputError
from vanejax.matching.se3 import rotation_angle
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

FEATURES = {"feature_radius": 0.4, "max_distance": 0.06}
TO_PLANES = {"metric": "point_to_plane", "max_distance": 0.3}
METHODS = {
    "icp to points": ("icp", {"metric": "point_to_point", "max_distance": 0.3}),
    "icp to planes": ("icp", TO_PLANES),
    "robust icp": ("icp", TO_PLANES | {"kernel": "tukey", "kernel_width": 0.2}),
    "ransac": ("ransac", FEATURES),
    "fgr": ("fgr", FEATURES),
}
IDENTITY = RigidTransform(np.eye(3, dtype=np.float32), np.zeros(3, np.float32))
KEY = jax.random.key(3)


def make(name: str):
    pytest.importorskip("open3d", reason="needs the extra peers")
    factory, settings = METHODS[name]
    return getattr(open3d_methods, factory)(**settings)


def small_motion() -> RigidTransform:
    rotation = Rotation.from_rotvec([0.05, -0.08, 0.06]).as_matrix().astype(np.float32)
    return RigidTransform(rotation, np.float32([0.03, -0.02, 0.04]))


@functools.cache
def problem() -> tuple[PointCloud, PointCloud]:
    """An ellipsoid with a lump, and the same points moved by the inverse of `small_motion`."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(400, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    axes = np.float32([1.0, 0.7, 0.45])
    xyz = normals * axes
    xyz[:, 2] += 0.3 * np.exp(-10 * np.sum((xyz[:, :2] - np.float32([0.4, 0.2])) ** 2, -1))
    normals /= axes
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    target = PointCloud(xyz, normals, np.ones(400, bool))
    return target.transform(small_motion().inverse()), target


@pytest.mark.parametrize("name", METHODS)
def test_it_finds_the_motion_and_padding_does_not_matter(name):
    source, target = problem()
    far = np.full((50, 3), 9.0, np.float32)
    padded = [
        PointCloud(
            np.concatenate([far, cloud.xyz]),
            np.concatenate([far / 9, cloud.normals]),
            np.arange(450) >= 50,
        )
        for cloud in (source, target)
    ]
    register = make(name)
    found, again = register(source, target, IDENTITY, KEY), register(*padded, IDENTITY, KEY)
    for result in (found, again):
        assert all(isinstance(leaf, np.ndarray | np.generic) for leaf in jax.tree.leaves(result))
        assert result.target_from_source.rotation.dtype == np.float32
        gap = result.target_from_source @ small_motion().inverse()
        assert np.rad2deg(rotation_angle(gap.rotation)) < 0.5  # the same points, without noise
        np.testing.assert_allclose(gap.translation, 0, atol=0.01)
        assert result.converged
        assert result.overlap > 0.95
        assert result.rmse < 0.02


@pytest.mark.parametrize("name", ["icp to points", "icp to planes", "robust icp"])
def test_icp_starts_at_the_guess_and_answers_with_the_total(name):
    source, target = problem()
    away = RigidTransform(
        Rotation.from_rotvec([0, 2.0, 0]).as_matrix().astype(np.float32), np.float32([2, 0, 0])
    )
    found = make(name)(source.transform(away), target, away.inverse(), KEY)
    gap = found.target_from_source @ away @ small_motion().inverse()
    assert np.rad2deg(rotation_angle(gap.rotation)) < 0.5


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("empty", ["source", "target", "two points"])
def test_without_points_the_guess_is_the_answer(name, empty):
    source, target = problem()
    few = np.arange(400) < (2 if empty == "two points" else 0)
    if empty == "target":
        target = target.replace(mask=few)
    else:
        source = source.replace(mask=few)
    found = make(name)(source, target, small_motion(), KEY)
    assert not found.converged
    np.testing.assert_allclose(
        found.target_from_source.as_matrix(), small_motion().as_matrix(), atol=1e-6
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


@pytest.mark.parametrize("factory", ["icp", "ransac", "fgr"])
def test_without_open3d_it_says_what_to_install(factory, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    settings = FEATURES if factory != "icp" else {"max_distance": 0.1}
    with pytest.raises(InputError, match=r"pip install 'vanejax\[peers\]'"):
        getattr(open3d_methods, factory)(**settings)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"metric": "plane"}, "metric 'plane' is unknown"),
        ({"trim": 0.5}, "does not trim"),
        ({"kernel": "tukey", "kernel_width": 0.1}, "with point_to_plane only"),
        ({"kernel": "tukey", "metric": "point_to_plane"}, "with a width"),
    ],
)
def test_settings_that_open3d_lacks_are_refused(settings, words):
    pytest.importorskip("open3d", reason="needs the extra peers")
    with pytest.raises(InputError, match=words):
        open3d_methods.icp(max_distance=0.1, **settings)
