"""Pairs of generic shapes: labels, crops, noise, order and keys, on shapes made by hand."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vanejax.errors import InputError
from vanejax.matching.se3 import rotation_angle
from vanejax.pointcloud import PointCloud
from vanejax.training.pairs import Pair, PairSampling
from vanejax.training.shape_pairs import ShapeBank, crop

POINTS, WHOLE, ROWS, BATCH = 200, 100, 70, 3
CLEAN = PairSampling(
    num_reference=WHOLE, num_source=8, noise=0.0, max_rotation_deg=20.0, max_translation=0.1
)

# what training calls: B entries in, B sources of the first entry's shape out
draw = jax.jit(ShapeBank.draw, static_argnums=3)


@functools.cache
def bank() -> ShapeBank:
    """Three ellipsoids."""
    normals = np.random.default_rng(0).normal(size=(3, POINTS, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    sides = np.array([[1.0, 0.6, 0.3], [0.2, 1.0, 0.9], [0.5, 0.5, 1.0]])
    points = normals * sides[:, None]
    return ShapeBank(jnp.asarray(points, jnp.float32), jnp.asarray(normals, jnp.float32))


def pairs(index: int = 1, sampling: PairSampling = CLEAN, seed: int = 0) -> Pair:
    drawn = draw(bank(), jax.random.key(seed), jnp.array([index, 0, 2]), sampling)
    return jax.tree.map(np.asarray, drawn)


def in_target_frame(pair: Pair) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points and normals of every source, put back by the label."""
    found = []
    for b in range(BATCH):
        label = jax.tree.map(lambda leaf, b=b: leaf[b], pair.target_from_source)
        found.append((label.apply(pair.source.xyz[b]), label.rotate(pair.source.normals[b])))
    return found


def clouds_of(pair: Pair) -> list[np.ndarray]:
    """The points of the target and of every source, in the target's frame."""
    return [pair.target.xyz, *(points for points, _ in in_target_frame(pair))]


def rows_of(points: np.ndarray, of: np.ndarray) -> np.ndarray:
    """For each point the row of ``of`` that it equals to within f32 rounding, -1 if none."""
    gaps = np.linalg.norm(points[:, None] - of[None], axis=-1)
    return np.where(gaps.min(axis=1) < 2e-6, gaps.argmin(axis=1), -1)  # f32 eps x 20


@pytest.mark.parametrize("index", [0, 2])
def test_without_noise_the_label_puts_every_source_point_on_the_shape(index: int):
    drawn = pairs(index)
    shape, normals = np.asarray(bank().points[index]), np.asarray(bank().normals[index])
    assert drawn.source.xyz.shape == (BATCH, ROWS, 3)
    assert drawn.source.mask.all()
    angles = np.degrees(rotation_angle(drawn.target_from_source.rotation))
    assert 5 < angles.max() <= 20 + 1e-4  # f32 eps x 1000
    for b, (points, turned) in enumerate(in_target_frame(drawn)):
        rows = rows_of(points, shape)
        assert rows.min() >= 0
        assert len(set(rows.tolist())) == ROWS  # drawn without replacement
        np.testing.assert_allclose(turned, normals[rows], atol=2e-6)  # f32 eps x 20
        assert (rows_of(drawn.source.xyz[b], shape) < 0).all()  # moved away first
    rows = rows_of(drawn.target.xyz, shape)
    assert drawn.target.xyz.shape == (ROWS, 3)
    assert rows.min() >= 0
    assert len(set(rows.tolist())) == ROWS
    np.testing.assert_array_equal(drawn.target.normals, normals[rows])


def test_clouds_are_drawn_and_cropped_apart():
    """Each cloud holds half of the shape's points, of its own choice, and loses a side of its own.

    One plane for two clouds would leave their means 0.1 apart, the noise of 70 points; planes of
    their own leave 0.3.
    """
    drawn = pairs()
    shape = np.asarray(bank().points[1])
    kept = [set(rows_of(cloud, shape).tolist()) for cloud in clouds_of(drawn)]
    for i, one in enumerate(kept):
        for other in kept[:i]:
            assert len(one & other) < 0.75 * ROWS
    means = [[cloud.mean(axis=0) for cloud in clouds_of(pairs(seed=seed))] for seed in range(20)]
    means = np.array(means)
    assert np.ptp(means, axis=0).min() > 0.1  # other keys, other clouds
    for i in range(BATCH + 1):
        for other in range(i):
            gaps = np.linalg.norm(means[:, i] - means[:, other], axis=1)
            assert gaps.mean() > 0.2


def test_a_crop_is_a_cut_by_a_plane_that_keeps_the_share():
    """Oracle: sorted heights along the one direction that the key stands for."""
    cloud = PointCloud.create(bank().points[0], bank().normals[0])
    key = jax.random.key(3)
    kept = crop(key, cloud, 140)
    heights = np.asarray(cloud.xyz) @ np.asarray(jax.random.normal(key, (3,)))
    expected = np.argsort(-heights)[:140]
    assert kept.mask.all()
    rows = rows_of(np.asarray(kept.xyz), np.asarray(cloud.xyz))
    assert rows.tolist() == sorted(expected.tolist())  # in the cloud's order


def test_crop_directions_are_uniform():
    """The kept part's mean points anywhere: the mean over many keys is near zero."""
    normals = np.random.default_rng(5).normal(size=(POINTS, 3))
    sphere = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    sphere = jnp.asarray(np.concatenate([sphere, -sphere]), jnp.float32)  # its mean is the origin
    cloud = PointCloud.create(sphere, sphere)
    keys = jax.random.split(jax.random.key(0), 1000)
    means = jax.vmap(lambda key: crop(key, cloud, 280).xyz.mean(axis=0))(keys)
    # 70 % of a sphere has its mean at 0.3; each coordinate has a deviation of 0.3 / sqrt(3)
    np.testing.assert_allclose(np.linalg.norm(means, axis=1).mean(), 0.3, atol=0.03)
    np.testing.assert_allclose(np.mean(means, axis=0), 0, atol=5 * 0.3 / np.sqrt(3 * 1000))
    np.testing.assert_allclose(np.std(means, axis=0), 0.3 / np.sqrt(3), rtol=0.15)


def test_padding_is_cropped_first():
    cloud = PointCloud.create(bank().points[0], bank().normals[0])
    cloud = cloud.replace(mask=jnp.arange(POINTS) < 100, xyz=cloud.xyz.at[100:].set(99.0))
    kept = crop(jax.random.key(0), cloud, 70)
    assert kept.mask.all()
    assert np.abs(kept.xyz).max() <= 1
    assert crop(jax.random.key(0), cloud, 120).mask.tolist() == [True] * 100 + [False] * 20


def test_order_says_nothing():
    """Rows come in random order, not sorted by height along the crop's direction."""
    cloud = pairs(0).target.xyz
    centred = cloud - cloud.mean(axis=0)
    places = np.linspace(-1, 1, ROWS)
    # a sorted crop correlates by about 0.95 with its direction
    correlation = np.abs(places @ centred) / np.linalg.norm(places)
    assert np.max(correlation / np.linalg.norm(centred, axis=0)) < 0.5


def test_both_clouds_are_noisy_and_the_label_is_not():
    noisy, clean = pairs(sampling=dataclasses.replace(CLEAN, noise=0.01)), pairs()
    jax.tree.map(np.testing.assert_array_equal, noisy.target_from_source, clean.target_from_source)
    np.testing.assert_array_equal(noisy.source.normals, clean.source.normals)
    gaps = [noisy.target.xyz - clean.target.xyz]
    gaps += [
        a - b for (a, _), (b, _) in zip(in_target_frame(noisy), in_target_frame(clean), strict=True)
    ]
    for gap in gaps:
        np.testing.assert_allclose(gap.std(), 0.01, rtol=5 / np.sqrt(2 * gap.size))
    assert min(np.abs(a - b).max() for i, a in enumerate(gaps) for b in gaps[:i]) > 0.01


def test_published_sizes():
    """Nothing is compiled."""

    def drawn(held: int) -> Pair:
        shapes = ShapeBank(jnp.zeros((1, held, 3)), jnp.zeros((1, held, 3)))
        entries = jnp.zeros(BATCH, jnp.int32)
        return jax.eval_shape(lambda: shapes.draw(jax.random.key(0), entries, PairSampling()))

    pair = drawn(1024)
    assert pair.source.xyz.shape == (BATCH, 717, 3)
    assert pair.source.mask.shape == (BATCH, 717)
    assert pair.target.xyz.shape == (717, 3)
    assert pair.target_from_source.rotation.shape == (BATCH, 3, 3)
    with pytest.raises(InputError, match="1023 points each, 1024 are wanted"):
        drawn(1023)
    assert bank().size == 3
