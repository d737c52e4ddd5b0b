"""Drawing pairs: labels, poses, noise, subsets, crops and padding, on scans and shapes by hand."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.matching.se3 import rotation_angle
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Viewpoints
from vanejax.training.dataset import ScanSet
from vanejax.training.pairs import (
    Pair,
    PairSampling,
    draw_pairs,
    draw_pose,
    draw_subset,
    jitter,
    make_bank,
    source_sizes,
)
from vanejax.training.shape_pairs import ShapeBank, crop

COUNTS = np.array([60, 45, 30, 10])
NUM_REFERENCE, SURFACE = 64, 100
CENTER, RADIUS_MM = np.array([3.0, -7.0, 40.0]), 50.0
CLEAN = PairSampling(num_reference=NUM_REFERENCE, num_source=40, noise=0.0)
VIEWS = jnp.array([2, 0, 3, 1, 0])
POINTS, WHOLE, ROWS, BATCH = 200, 100, 70, 3  # of shapes
CLEAN_SHAPES = PairSampling(
    num_reference=WHOLE, num_source=8, noise=0.0, max_rotation_deg=20.0, max_translation=0.1
)

draw = jax.jit(draw_pairs, static_argnames="sampling")
# what training calls: B entries in, B sources of the first entry's shape out
draw_shapes = jax.jit(ShapeBank.draw, static_argnums=3)


def surface(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a part, mm, with unit normals; f64."""
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return CENTER + RADIUS_MM * normals * [1.0, 0.6, 0.3], normals


@functools.cache
def scan_set() -> ScanSet:
    rng = np.random.default_rng(0)
    poses = RigidTransform(
        rotation=Rotation.random(len(COUNTS), rng=rng).as_matrix(),
        translation=rng.normal(size=(len(COUNTS), 3), scale=300),
    )
    points, normals = np.zeros((2, len(COUNTS), COUNTS.max(), 3), np.float32)
    for view, count in enumerate(COUNTS):
        xyz, normal = surface(count, seed=view)
        camera_from_part = RigidTransform(poses.rotation[view], poses.translation[view])
        points[view, :count] = camera_from_part.apply(xyz)
        normals[view, :count] = camera_from_part.rotate(normal)
    reference_points, reference_normals = surface(SURFACE, seed=99)
    return ScanSet(
        points=points,
        normals=normals,
        counts=COUNTS.astype(np.int32),
        viewpoints=Viewpoints(np.full(4, 60.0), np.arange(4) * 10.0, poses),
        reference_points=reference_points.astype(np.float32),
        reference_normals=reference_normals.astype(np.float32),
        center=CENTER,
        radius_mm=RADIUS_MM,
        source={},
    )


@functools.cache
def bank():
    return make_bank(scan_set(), num_reference=NUM_REFERENCE)


@functools.cache
def pairs(sampling: PairSampling = CLEAN, seed: int = 0):
    return jax.tree.map(np.asarray, draw(jax.random.key(seed), bank(), VIEWS, sampling))


@functools.cache
def shapes() -> ShapeBank:
    """Three ellipsoids."""
    normals = np.random.default_rng(0).normal(size=(3, POINTS, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    sides = np.array([[1.0, 0.6, 0.3], [0.2, 1.0, 0.9], [0.5, 0.5, 1.0]])
    points = normals * sides[:, None]
    return ShapeBank(jnp.asarray(points, jnp.float32), jnp.asarray(normals, jnp.float32))


def shape_pairs(index: int = 1, sampling: PairSampling = CLEAN_SHAPES, seed: int = 0) -> Pair:
    entries = jnp.array([index, 0, 2])
    return jax.tree.map(np.asarray, draw_shapes(shapes(), jax.random.key(seed), entries, sampling))


def in_target_frame(pair: Pair) -> list[PointCloud]:
    """The real points of every source, put back by its label."""
    found = []
    for index, mask in enumerate(pair.source.mask):
        label, source = jax.tree.map(
            lambda leaf, index=index: leaf[index], (pair.target_from_source, pair.source)
        )
        found.append(jax.tree.map(lambda leaf, mask=mask: leaf[mask], source.transform(label)))
    return found


def clouds_of(pair: Pair) -> list[np.ndarray]:
    """The points of the target and of every source, in the target's frame."""
    return [pair.target.xyz, *(source.xyz for source in in_target_frame(pair))]


def rows_of(points: np.ndarray, of: np.ndarray) -> np.ndarray:
    """For each point the row of ``of`` that it equals to within f32 rounding, -1 if none."""
    gaps = np.linalg.norm(points[:, None] - of[None], axis=-1)
    return np.where(gaps.min(axis=1) < 2e-6, gaps.argmin(axis=1), -1)  # f32 eps x 20


def test_the_bank_is_the_part_in_unit_sphere_units():
    for view, count in enumerate(COUNTS):
        scan = jax.tree.map(lambda leaf, view=view: np.asarray(leaf[view]), bank().scans)
        assert scan.mask.tolist() == [True] * count + [False] * (60 - count)
        xyz, normals = surface(count, seed=view)
        # the scans are f32 at up to 1,000 mm: eps of that over the radius
        np.testing.assert_allclose(scan.xyz[:count], (xyz - CENTER) / RADIUS_MM, atol=3e-6)
        np.testing.assert_allclose(scan.normals[:count], normals, atol=1e-6)
        np.testing.assert_array_equal(scan.xyz[count:], 0)
    assert bank().scans.xyz.dtype == jnp.float32
    assert np.linalg.norm(bank().reference.xyz, axis=1).max() <= 1 + 1e-6
    assert bank().reference.mask.all()


def test_sources_have_the_paper_s_share_of_the_reference():
    expected = [38, 29, 19, 10]  # 64 X / 100, rounded; at least 16; at most what there is
    assert source_sizes(scan_set(), NUM_REFERENCE).tolist() == expected
    assert bank().source_sizes.tolist() == expected


def test_a_bank_needs_enough_reference_points():
    with pytest.raises(InputError, match=r"100 points, 101 are wanted.*voxel"):
        make_bank(scan_set(), num_reference=101)


def test_without_noise_the_label_puts_every_source_point_on_its_scan_point():
    drawn = pairs()
    assert drawn.source.xyz.shape == (5, 40, 3)
    for index, view in enumerate(VIEWS):
        source = jax.tree.map(lambda leaf, index=index: leaf[index], drawn.source)
        label = jax.tree.map(lambda leaf, index=index: leaf[index], drawn.target_from_source)
        real = np.arange(40) < bank().source_sizes[view]
        np.testing.assert_array_equal(source.mask, real)
        scan = surface(COUNTS[view], seed=int(view))
        xyz = (scan[0] - CENTER) / RADIUS_MM
        rows = rows_of(label.apply(source.xyz)[real], xyz)
        assert (rows >= 0).all()
        assert len(set(rows.tolist())) == real.sum()  # drawn without replacement
        assert rows.tolist() != sorted(rows.tolist())  # in random order
        turned = label.rotate(source.normals)[real]
        np.testing.assert_allclose(turned, scan[1][rows], atol=2e-6)  # f32 eps x 20
        np.testing.assert_array_equal(source.xyz[~real], 0)
        assert (rows_of(source.xyz[real], xyz) < 0).all()  # moved away first


def test_the_target_is_a_subset_of_the_part_s_surface():
    target = pairs().target
    assert target.xyz.shape == (NUM_REFERENCE, 3)
    assert target.mask.all()
    rows = rows_of(target.xyz, (surface(SURFACE, seed=99)[0] - CENTER) / RADIUS_MM)
    assert rows.min() >= 0
    assert len(set(rows.tolist())) == NUM_REFERENCE
    np.testing.assert_allclose(target.normals, surface(SURFACE, seed=99)[1][rows], atol=1e-6)


def test_another_key_gives_another_pair():
    other = pairs(seed=1)
    assert np.abs(other.target.xyz - pairs().target.xyz).max() > 0.1
    found, compared = other.target_from_source, pairs().target_from_source
    assert np.abs(found.rotation - compared.rotation).max(axis=(1, 2)).min() > 1e-3
    # within a batch too: the same view twice is two draws
    twice = pairs().target_from_source.translation[np.flatnonzero(np.asarray(VIEWS) == 0)]
    assert np.abs(twice[0] - twice[1]).max() > 1e-3


def test_poses_fill_their_limits():
    sampling = dataclasses.replace(CLEAN, max_rotation_deg=30.0, max_translation=0.2)
    keys = jax.random.split(jax.random.key(0), 4000)
    poses = jax.jit(jax.vmap(lambda key: draw_pose(key, sampling)))(keys)
    angles = np.degrees(rotation_angle(poses.rotation))
    assert angles.max() <= 30 + 1e-4  # f32 eps x 1000
    # uniform: each tenth of the range holds a tenth, to 5 standard deviations of 19
    np.testing.assert_allclose(np.histogram(angles, 10, (0, 30))[0], 400, atol=95)
    assert np.abs(poses.translation).max() <= 0.2
    for axis in range(3):
        counts = np.histogram(poses.translation[:, axis], 10, (-0.2, 0.2))[0]
        np.testing.assert_allclose(counts, 400, atol=95)
    vectors = Rotation.from_matrix(poses.rotation).as_rotvec()
    axes = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    # uniform on the sphere: mean 0, second moment a third; 5 deviations of 0.58 / sqrt(4000)
    np.testing.assert_allclose(axes.mean(axis=0), 0, atol=0.05)
    np.testing.assert_allclose(axes.T @ axes / 4000, np.eye(3) / 3, atol=0.03)


def test_noise_has_its_width_and_its_clip():
    cloud = PointCloud(
        xyz=jnp.ones((20_000, 3)), normals=jnp.ones((20_000, 3)), mask=jnp.arange(20_000) < 19_990
    )
    sampling = dataclasses.replace(CLEAN, noise=0.01, noise_clip=0.05)
    noisy = jitter(jax.random.key(0), cloud, sampling)
    noise = np.asarray(noisy.xyz - cloud.xyz)
    np.testing.assert_array_equal(noise[19_990:], 0)
    np.testing.assert_array_equal(noisy.normals, cloud.normals)
    # 60,000 numbers: five standard errors
    np.testing.assert_allclose(noise.mean(axis=0), 0, atol=5 * 0.01 / np.sqrt(20_000))
    np.testing.assert_allclose(noise.std(), 0.01, rtol=5 / np.sqrt(120_000))
    clipped = jitter(jax.random.key(0), cloud, dataclasses.replace(sampling, noise_clip=0.01))
    clipped = np.asarray(clipped.xyz - cloud.xyz)[:19_990]
    assert np.abs(clipped).max() <= 0.01 + 1e-6  # rounding of 1 + 0.01
    outside = np.mean(np.abs(clipped) > 0.01 - 1e-6)
    np.testing.assert_allclose(outside, 0.3173, atol=0.01)  # beyond one standard deviation
    other = np.asarray(jitter(jax.random.key(1), cloud, sampling).xyz - cloud.xyz)
    assert abs(np.corrcoef(noise[:, 0], other[:, 0])[0, 1]) < 5 / np.sqrt(20_000)


@pytest.mark.parametrize(("drawn", "clean"), [(pairs, CLEAN), (shape_pairs, CLEAN_SHAPES)])
def test_both_clouds_of_a_pair_are_noisy_and_the_label_is_not(drawn, clean: PairSampling):
    """The noise is all that separates a noisy pair from the clean one of the same key."""
    noisy, still = drawn(sampling=dataclasses.replace(clean, noise=0.01)), drawn()
    jax.tree.map(np.testing.assert_array_equal, noisy.target_from_source, still.target_from_source)
    np.testing.assert_array_equal(noisy.source.normals, still.source.normals)
    np.testing.assert_array_equal(noisy.source.xyz[~noisy.source.mask], 0)
    gaps = [a - b for a, b in zip(clouds_of(noisy), clouds_of(still), strict=True)]
    for index, gap in enumerate(gaps):
        np.testing.assert_allclose(gap.std(), 0.01, rtol=5 / np.sqrt(2 * gap.size))
        for other in gaps[:index]:  # no two share their noise
            rows = min(len(gap), len(other))
            assert np.abs(gap[:rows] - other[:rows]).max() > 0.01


def test_every_real_point_is_drawn_equally_often():
    cloud = jax.tree.map(lambda leaf: leaf[2], bank().scans)  # 30 real points of 60 rows
    tagged = cloud.replace(xyz=jnp.broadcast_to(jnp.arange(60.0)[:, None], (60, 3)))
    keys = jax.random.split(jax.random.key(0), 3000)
    subset = jax.jit(jax.vmap(lambda key: draw_subset(key, tagged, jnp.asarray(6), 8)))(keys)
    assert subset.mask.sum(axis=1).tolist() == [6] * 3000
    drawn = np.asarray(subset.xyz[..., 0])[np.asarray(subset.mask)].astype(int)
    counts = np.bincount(drawn, minlength=60)
    np.testing.assert_array_equal(counts[30:], 0)
    np.testing.assert_allclose(counts[:30], 600, atol=5 * np.sqrt(480))  # binomial, 5 deviations


def test_a_source_never_has_more_points_than_its_scan():
    """Asked for more than there are, the rest is padding."""
    cloud = jax.tree.map(lambda leaf: leaf[3], bank().scans)  # 10 real points
    subset = draw_subset(jax.random.key(0), cloud, jnp.asarray(30), 40)
    assert subset.mask.tolist() == [True] * 10 + [False] * 30
    np.testing.assert_array_equal(subset.xyz[10:], 0)


# ---- shapes ----


@pytest.mark.parametrize("index", [0, 2])
def test_without_noise_the_label_puts_every_source_point_on_the_shape(index: int):
    drawn = shape_pairs(index)
    shape, normals = np.asarray(shapes().points[index]), np.asarray(shapes().normals[index])
    assert drawn.source.xyz.shape == (BATCH, ROWS, 3)
    assert drawn.source.mask.all()
    angles = np.degrees(rotation_angle(drawn.target_from_source.rotation))
    assert 5 < angles.max() <= 20 + 1e-4  # f32 eps x 1000
    for moved, source in zip(drawn.source.xyz, in_target_frame(drawn), strict=True):
        rows = rows_of(source.xyz, shape)
        assert rows.min() >= 0
        assert len(set(rows.tolist())) == ROWS  # drawn without replacement
        assert rows.tolist() != sorted(rows.tolist())  # in random order
        np.testing.assert_allclose(source.normals, normals[rows], atol=2e-6)  # f32 eps x 20
        assert (rows_of(moved, shape) < 0).all()  # moved away first
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
    drawn = shape_pairs()
    shape = np.asarray(shapes().points[1])
    kept = [set(rows_of(cloud, shape).tolist()) for cloud in clouds_of(drawn)]
    for i, one in enumerate(kept):
        for other in kept[:i]:
            assert len(one & other) < 0.75 * ROWS
    several = [clouds_of(shape_pairs(seed=seed)) for seed in range(20)]
    means = np.array([[cloud.mean(axis=0) for cloud in clouds] for clouds in several])
    assert np.ptp(means, axis=0).max(axis=1).min() > 0.3  # other keys, other clouds
    for i in range(BATCH + 1):
        for other in range(i):
            gaps = np.linalg.norm(means[:, i] - means[:, other], axis=1)
            assert gaps.mean() > 0.2


def test_a_crop_is_a_cut_by_a_plane_that_keeps_the_share():
    """Oracle: sorted heights along the one direction that the key stands for."""
    cloud = PointCloud.create(shapes().points[0], shapes().normals[0])
    key = jax.random.key(3)
    kept = crop(key, cloud, 140)
    heights = np.asarray(cloud.xyz) @ np.asarray(jax.random.normal(key, (3,)))
    expected = np.argsort(-heights)[:140]
    assert kept.mask.all()
    rows = rows_of(np.asarray(kept.xyz), np.asarray(cloud.xyz))
    assert rows.tolist() == sorted(expected.tolist())  # in the cloud's order


def test_padding_is_cropped_first():
    cloud = PointCloud.create(shapes().points[0], shapes().normals[0])
    cloud = cloud.replace(mask=jnp.arange(POINTS) < 100, xyz=cloud.xyz.at[100:].set(99.0))
    kept = crop(jax.random.key(0), cloud, 70)
    assert kept.mask.all()
    assert np.abs(kept.xyz).max() <= 1
    assert crop(jax.random.key(0), cloud, 120).mask.tolist() == [True] * 100 + [False] * 20


def test_published_sizes():
    """Nothing is compiled."""

    def drawn(held: int) -> Pair:
        empty = ShapeBank(jnp.zeros((1, held, 3)), jnp.zeros((1, held, 3)))
        entries = jnp.zeros(BATCH, jnp.int32)
        return jax.eval_shape(lambda: empty.draw(jax.random.key(0), entries, PairSampling()))

    pair = drawn(1024)
    assert pair.source.xyz.shape == (BATCH, 717, 3)
    assert pair.source.mask.shape == (BATCH, 717)
    assert pair.target.xyz.shape == (717, 3)
    assert pair.target_from_source.rotation.shape == (BATCH, 3, 3)
    with pytest.raises(InputError, match="1023 points each, 1024 are wanted"):
        drawn(1023)
    assert shapes().size == 3
