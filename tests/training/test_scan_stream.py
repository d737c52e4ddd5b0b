"""Scans without end: each a function of its number alone, on the part, from where it should be."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from example_scans import solid
from hypothesis import given, settings
from hypothesis import strategies as st

from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.pointcloud import PointCloud
from vanejax.scanner import Camera, Scanner, Sensor, preset
from vanejax.training.online_scans import OnlineScans, RandomViews, ScanStream
from vanejax.training.pairs import PairSampling, draw_pairs

CENTER = np.array([30.0, -20.0, 10.0])
HALF = np.array([40.0, 25.0, 15.0])
BOX_CAMERA = Camera(width=160, height=128, near_mm=100.0)
SAMPLING = PairSampling(num_reference=256, num_source=200, noise=0.0)


@pytest.fixture(scope="module")
def box() -> Part:
    return solid(trimesh.creation.box(bounds=[CENTER - HALF, CENTER + HALF]))


@pytest.fixture(scope="module")
def stream(box) -> ScanStream:
    points, normals, _ = box.sample(900, seed=0)
    reference = PointCloud.create(
        jnp.asarray((points - box.center) / box.radius, jnp.float32),
        jnp.asarray(normals, jnp.float32),
    )
    return ScanStream(
        part=box,
        reference=reference,
        sensor=Sensor(camera=BOX_CAMERA),
        views=RandomViews(),
        castings=[Scanner(box)],
        batch_size=3,
        sampling=SAMPLING,
        voxel_mm=4.0,
        seed=7,
    )


def off_the_box_mm(points: np.ndarray, part: Part) -> np.ndarray:
    """[n] distance from the box's surface, of points [n, 3] in unit-sphere units."""
    return np.abs((np.abs(points * part.radius) - HALF).max(axis=1))


def test_points_lie_on_the_part_and_normals_stand_on_it(stream, box):
    points, normals = stream.scan(11)
    assert 32 <= len(points) <= stream.sampling.num_source
    # float32 of 400 mm, there and back
    assert off_the_box_mm(points, box).max() < 2e-3
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    axis = np.argmin(np.abs(np.abs(points * box.radius) - HALF), axis=1)
    inner = np.sort(HALF - np.abs(points * box.radius), axis=1)[:, 1] > 8  # no edge is near
    outward = np.sign(points[np.arange(len(points)), axis])
    along = normals[np.arange(len(points)), axis] * outward
    assert inner.sum() > 20
    np.testing.assert_allclose(along[inner], 1, atol=1e-3)


def test_a_scan_is_a_function_of_seed_and_number(stream):
    for one, same in zip(stream.scan(5), stream.scan(5), strict=True):
        np.testing.assert_array_equal(one, same)
    other = dataclasses.replace(stream, seed=8)
    for changed in (stream.scan(6), other.scan(5)):
        assert changed[0].shape != stream.scan(5)[0].shape or np.any(
            changed[0] != stream.scan(5)[0]
        )


def test_a_step_takes_its_own_numbers(stream):
    bank = stream.of_step(4)
    assert bank.size == 3
    for row, number in enumerate((12, 13, 14)):
        points, normals = stream.scan(number)
        count = len(points)
        assert bank.source_sizes[row] == count
        np.testing.assert_array_equal(bank.scans.mask[row], np.arange(200) < count)
        np.testing.assert_array_equal(bank.scans.xyz[row, :count], points)
        np.testing.assert_array_equal(bank.scans.normals[row, :count], normals)
        np.testing.assert_array_equal(bank.scans.xyz[row, count:], 0)


@pytest.mark.parametrize("workers", [1, 3])
def test_threads_ahead_change_nothing(stream, workers):
    with stream.steps(2, 30, workers=workers) as banks:
        ahead = [np.asarray(next(banks).scans.xyz) for _ in range(3)]  # then the context is left
    for step, found in zip((2, 3, 4), ahead, strict=True):
        np.testing.assert_array_equal(found, stream.of_step(step).scans.xyz)
    with stream.steps(5, 7, workers=workers) as banks:
        assert len(list(banks)) == 2


def test_validation_is_never_trained_on(stream):
    held = stream.for_validation(2)
    first = stream.of_step(0)
    assert not np.array_equal(held.scans.xyz[0], first.scans.xyz[0])
    np.testing.assert_array_equal(held.scans.xyz, stream.for_validation(2).scans.xyz)


def test_every_step_has_the_same_shapes_and_compiles_once(stream):
    # a function of its own: other tests jit `draw_pairs` too, and would share its cache
    draw = jax.jit(lambda key, bank: draw_pairs(key, bank, jnp.arange(3), SAMPLING))
    for step in range(3):
        pairs = draw(jax.random.key(step), stream.of_step(step))
        # the label takes every source back onto the part
        pair = jax.tree.map(lambda leaf: np.asarray(leaf[1]), pairs.source)
        back = jax.tree.map(lambda leaf: np.asarray(leaf[1]), pairs.target_from_source)
        points = back.apply(pair.xyz[pair.mask].astype(np.float64))
        assert off_the_box_mm(points, stream.part).max() < 5e-3
    assert draw._cache_size() == 1


def test_as_many_points_as_the_part_s_share(stream):
    """M X / Y, with X the thinned points of the scan: about 256 times the share that is seen."""
    sizes = [len(stream.scan(number)[0]) for number in range(6)]
    # from above 40 deg the box shows its top, and up to two of its sides
    assert 0.2 * 256 < min(sizes) < max(sizes) <= 200


def test_a_casting_is_scanned_and_the_cad_s_pose_is_the_label(stream, box):
    cast = solid(trimesh.creation.box(bounds=[CENTER - HALF - 1, CENTER + HALF + 1]))
    points, _ = dataclasses.replace(stream, castings=[Scanner(cast)]).scan(0)
    np.testing.assert_allclose(off_the_box_mm(points, box), 1.0, atol=2e-3)


def test_castings_differ_within_their_ranges(box):
    """80 x 50 x 30 mm: stock to 0.5 mm, 1 % of the size, 0.39 mm of bow (DCTG 6), 0.3 of waves."""
    settings = OnlineScans(sensor="ideal", casting_mm=0.5, castings=12)
    parts, again = (settings.make_parts(box, seed=3) for _ in range(2))
    assert [p.sha256 for p in parts] == [p.sha256 for p in again]
    assert len({p.sha256 for p in parts}) == 12
    assert all(p.closed for p in parts)
    larger = np.array([p.extent_mm for p in parts]) - 2 * HALF
    # less to all sides: 1 % of the size; more: stock too; and waves and bow either way
    assert np.all(larger > -0.01 * 2 * HALF - 0.3)
    assert np.all(larger < 0.01 * 2 * HALF + 1.0 + 0.39 + 0.6)
    volume = np.array([p.mesh.volume for p in parts]) / np.prod(2 * HALF)
    assert volume.min() < 1.02 < 1.06 < volume.max()  # they do differ
    middle = np.array([p.center for p in parts]) - box.center
    assert np.abs(middle).max() < 0.6  # the label is the pose of the CAD model
    assert settings.make_parts(box, seed=4)[0].sha256 != parts[0].sha256
    assert OnlineScans(sensor="ideal").make_parts(box, seed=3) == [box]


def test_a_large_part_has_castings_too():
    large = solid(trimesh.creation.box((900, 200, 100)))
    assert len(OnlineScans(casting_mm=0.5, castings=1).make_parts(large, seed=0)) == 1


def test_a_measured_scan_is_noisy_and_stays_near(stream, box):
    sensor = preset("paper_camera").scaled(0.125)
    points, _ = dataclasses.replace(stream, sensor=sensor).scan(0)
    off = off_the_box_mm(points, box)
    assert 0.005 < np.median(off) < 0.2


def test_a_part_that_nobody_sees_is_an_error(stream):
    far = dataclasses.replace(stream, views=RandomViews(distance_mm=(5000.0, 6000.0)))
    with pytest.raises(InputError, match="20 random views in a row"):
        far.scan(0)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.floats(100, 2000), st.floats(0, 300), st.floats(-90, 80))
def test_views_keep_their_ranges(seed, near, more, low):
    views = RandomViews(distance_mm=(near, near + more), elevation_deg=(low, low + 10), aside=0.05)
    pose = views.draw(np.random.default_rng(seed), CENTER)
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose.rotation) > 0
    x, y, z = pose.apply(CENTER[None])[0]
    distance = -z
    assert near * (1 - 1e-9) <= distance <= (near + more) * (1 + 1e-9)
    assert max(abs(x), abs(y)) <= 0.05 * distance * (1 + 1e-9)
    back = pose.inverse().rotation[:, 2]  # from the part to the camera
    elevation = np.degrees(np.arcsin(np.clip(back[2], -1, 1)))
    assert low - 1e-5 <= elevation <= low + 10 + 1e-5


@pytest.mark.parametrize(
    ("name", "value"),
    [("distance_mm", (500.0, 300.0)), ("distance_mm", (0.0, 1.0)), ("elevation_deg", (0.0, 91.0))],
)
def test_ranges_that_hold_nothing_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        RandomViews(**{name: value}).check("online")
