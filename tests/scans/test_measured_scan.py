"""Cleaning of scans, and where their sensor stood."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vanejax.cad import guide_vane
from vanejax.errors import InputError
from vanejax.scanner import Camera, Scanner, hemisphere_viewpoints
from vanejax.scans.measured_scan import clean_scan, repeats
from vanejax.scans.viewpoint import why_not_from


def wavy(count: int = 400, depth: float = 400.0, seed: int = 0) -> np.ndarray:
    """A wavy sheet of 100 x 60 mm in front of the origin: what one view may measure."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-50, 50, count), rng.uniform(-30, 30, count)
    return np.stack([x, y, depth + 4 * np.sin(x / 9) + 3 * np.cos(y / 7)], axis=1)


@pytest.fixture(scope="module")
def vane_view():
    part = guide_vane()
    views = hemisphere_viewpoints(part.center)
    return part, views, Scanner(part).scan(Camera().scaled(0.25), views.view(40))


def test_a_clean_scan_stays_as_it_is():
    points = wavy()
    normals = np.tile([0.0, 0.0, -2.0], (len(points), 1))
    scan = clean_scan(points, normals)
    assert np.array_equal(scan.points, points)
    assert scan.points.dtype == np.float64
    assert scan.normals.dtype == np.float32
    assert np.array_equal(scan.normals, np.tile(np.float32([0, 0, -1]), (len(points), 1)))
    assert np.array_equal(scan.sensor_origin, np.zeros(3))
    assert scan.notes == ("the sensor is taken to stand at the scan's origin, looking along +z",)


def test_what_is_no_measurement_is_dropped_and_told():
    points = wavy(300)
    dirty = points.copy()
    dirty[[3, 4]] = np.nan
    dirty[5, 1] = np.inf
    dirty[6, 2] = -3.4e38  # the largest float, as some writers mark a miss
    dirty[[7, 8, 9]] = 0.0
    dirty[[20, 21]] = points[19]
    before = dirty.copy()
    scan = clean_scan(dirty)
    gone = [3, 4, 5, 6, 7, 8, 9, 20, 21]
    assert np.array_equal(scan.points, np.delete(points, gone, axis=0))
    assert np.array_equal(dirty, before, equal_nan=True)
    assert scan.notes[:3] == (
        "dropped 4 points without a measurement (not finite)",
        "dropped 3 points without a measurement (0, 0, 0)",
        "dropped 2 points that repeat another exactly",
    )


def test_normals_follow_their_points():
    points = wavy(1000)
    normals = np.random.default_rng(1).normal(size=points.shape)
    normals[:, 2] = -np.abs(normals[:, 2]) - 3
    dirty, labels = points.copy(), normals.copy()
    dirty[10] = np.nan
    dirty[12] = dirty[11]
    labels[13] = 0
    labels[14, 1] = np.nan
    scan = clean_scan(dirty, labels)
    left = np.delete(np.arange(1000), [10, 12, 13, 14])
    assert np.array_equal(scan.points, points[left])
    expected = normals[left] / np.linalg.norm(normals[left], axis=1, keepdims=True)
    np.testing.assert_allclose(scan.normals, expected, atol=3e-7)  # float32 eps x 3
    assert "dropped 2 points whose normal is zero or not finite" in scan.notes


def test_mostly_bad_normals_are_dropped_but_not_their_points():
    points = wavy(400)
    normals = np.tile([0.0, 0.0, -1.0], (400, 1))
    normals[:5] = 0  # 1.25 %
    scan = clean_scan(points, normals)
    assert scan.normals is None
    assert len(scan.points) == 400
    assert scan.notes[0] == "dropped all normals: 5 of 400 are zero or not finite"
    normals[4] = [0, 0, -1]  # 1 %
    few = clean_scan(points, normals)
    assert np.array_equal(few.points, points[4:])
    assert len(few.normals) == 396


def test_normals_face_a_known_sensor_and_are_left_alone_otherwise():
    points = wavy()
    normals = np.random.default_rng(0).normal(size=points.shape).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    known = clean_scan(points, normals)
    assert (np.einsum("ni,ni->n", known.points, known.normals) <= 0).all()
    np.testing.assert_allclose(np.abs(known.normals), np.abs(normals), atol=1e-6)
    assert any(note.startswith("turned ") for note in known.notes)
    unknown = clean_scan(points, normals, sensor_origin="unknown")
    np.testing.assert_allclose(unknown.normals, normals, atol=1e-6)
    away = clean_scan(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    assert (away.normals == [0, 0, -1]).all()
    assert "the normals pointed away from the sensor and were turned round" in away.notes


def test_fewer_than_fifty_distinct_points_are_refused():
    assert len(clean_scan(wavy(50)).points) == 50
    with pytest.raises(InputError, match=r"scan: 49 distinct points are left of 49; .* least 50"):
        clean_scan(wavy(49))
    with pytest.raises(InputError, match=r"49 distinct points are left of 98 \(dropped 49 points"):
        clean_scan(np.concatenate([wavy(49), wavy(49)]), name="scan")
    with pytest.raises(InputError, match="0 distinct points"):
        clean_scan(np.full((100, 3), np.nan))
    with pytest.raises(InputError, match="0 distinct points"):
        clean_scan(np.zeros((0, 3)))


@given(
    start=st.tuples(*[st.floats(-500, 500)] * 3),
    tip=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    length=st.floats(1.0, 300.0),
    decimals=st.sampled_from([None, "float32", 3]),
)
@settings(max_examples=60, deadline=None)
def test_points_on_a_line_are_refused_whatever_their_rounding(start, tip, length, decimals):
    t = np.random.default_rng(0).uniform(0, length, 300)[:, None]
    points = np.array(start) + t * np.array(tip) / np.linalg.norm(tip)
    if decimals == "float32":
        points = points.astype(np.float32)
    elif decimals and length > 20:
        points = points.round(decimals)
    with pytest.raises(InputError, match=r"on one line .* could turn about it"):
        clean_scan(points)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((60, 2)), r"shape \[60, 2\]"),
        (np.zeros(60), r"shape \[60\]"),
        (np.full((60, 3), "1.0"), "numbers in mm"),
        (np.zeros((60, 3), complex), "complex128"),
    ],
)
def test_arrays_of_other_shapes_are_refused(points, message):
    with pytest.raises(InputError, match=message):
        clean_scan(points)


def test_a_given_sensor_is_used_whatever_the_cloud_says():
    origin = np.array([1.0, 2.0, 900.0])
    scan = clean_scan(wavy(), sensor_origin=origin)
    assert np.array_equal(scan.sensor_origin, origin)
    assert scan.looks_along == "-z"
    inside = clean_scan(wavy(), sensor_origin=(0.0, 0.0, 400.0))
    assert np.array_equal(inside.sensor_origin, [0, 0, 400])
    points = wavy()
    there = clean_scan(points, sensor_origin=points[7])
    assert len(there.points) == len(points) - 1
    assert "dropped 1 points at the sensor's place" in there.notes


@pytest.mark.parametrize("origin", ["here", "0,0,0", (1, 2), (1, 2, np.nan), None, [[1, 2, 3]]])
def test_a_sensor_that_is_no_place_is_refused(origin):
    with pytest.raises(InputError, match="sensor_origin must be"):
        clean_scan(wavy(), sensor_origin=origin)


def test_a_single_view_of_the_vane_has_its_sensor_at_the_origin(vane_view):
    _, _, view = vane_view
    scan = clean_scan(view.points, view.normals)
    assert np.array_equal(scan.sensor_origin, np.zeros(3))
    assert scan.looks_along == "-z"
    # its normals faced the camera: none is turned (float32 eps x 5)
    np.testing.assert_allclose(scan.normals, view.normals, atol=6e-7)


@pytest.mark.parametrize("count", [60, 300, 2000])
def test_a_thin_single_view_still_has(vane_view, count):
    points = vane_view[2].points
    drawn = np.random.default_rng(0).choice(len(points), count, replace=False)
    assert why_not_from(points[drawn], np.zeros(3)) == ""


def test_merged_and_moved_clouds_have_an_unknown_sensor(vane_view):
    part, views, view = vane_view
    other = Scanner(part).scan(Camera().scaled(0.25), views.view(58))
    camera_from_part = views.view(40)
    merged = np.concatenate(
        [view.points, camera_from_part.apply(views.view(58).inverse().apply(other.points))]
    )
    scan = clean_scan(merged)
    assert scan.sensor_origin is None
    assert "surfaces behind each other" in scan.notes[-1]
    surface = camera_from_part.apply(part.sample(3000, 0)[0])
    assert "behind each other" in why_not_from(surface, np.zeros(3))
    in_part_frame = camera_from_part.inverse().apply(view.points.astype(np.float64))
    assert "inside the cloud" in why_not_from(in_part_frame, np.zeros(3))
    aside = in_part_frame + np.array([400.0, 0.0, 0.0])
    assert "behind each other" in why_not_from(aside, np.zeros(3))
    z = np.random.default_rng(0).uniform(1, 400, 500)
    assert "at the edge" in why_not_from(np.stack([0.1 * z, -0.2 * z, z], 1), np.zeros(3))


def test_a_point_near_the_origin_is_no_view():
    few = np.zeros((1, 3))
    assert "so few" in why_not_from(few, np.zeros(3))
    assert why_not_from(np.zeros((60, 3)), np.zeros(3))  # no direction at all, and no NaN


def slow_repeats(points: np.ndarray) -> np.ndarray:
    seen, out = set(), []
    for point in points.tolist():
        key = tuple(0.0 if value == 0 else value for value in point)
        out.append(key in seen)
        seen.add(key)
    return np.array(out)


@given(st.lists(st.tuples(*[st.sampled_from([0.0, -0.0, 1.0, 2.0, 1e-300, 5e30])] * 3), min_size=1))
@settings(max_examples=200, deadline=None)
def test_repeats_are_those_of_a_slow_loop(rows):
    points = np.array(rows)
    found = repeats(points)
    expected = slow_repeats(points)
    if found is None:
        assert not expected.any()
    else:
        assert np.array_equal(found, expected)


def test_repeats_that_only_share_a_hash_are_kept(monkeypatch):
    """Rows whose hashes collide are compared in full."""
    points = np.random.default_rng(0).integers(0, 3, (500, 3)).astype(np.float64)
    monkeypatch.setattr("vanejax.scans.measured_scan._HASH_FACTOR", np.uint64(0))  # all collide
    assert np.array_equal(repeats(points), slow_repeats(points))
