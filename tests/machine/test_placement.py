"""The finished part in a measured blank: boxes, of which the best place is known by hand."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import trimesh
from example_result import pose

from vanejax.cad import Part, part_from_mesh
from vanejax.errors import InputError
from vanejax.machine import Placement, place
from vanejax.machine.measured_stock import finished_surface
from vanejax.machine.placement import POINTS
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Scanner, hemisphere_viewpoints
from vanejax.scans.measured_scan import MeasuredScan, clean_scan

HERE = RigidTransform.identity(dtype=np.float64)
LOW, HIGH = np.zeros(3), np.array([60.0, 40, 30])  # of the finished part
STOCK_LOW, STOCK_HIGH = np.array([1.0, 2, 3]), np.array([3.0, 2, 1])
# of noise-free points at random, 2 mm apart: a plane near an edge of the blank is off by so much
NEAR_MM = 0.02


def box(low: np.ndarray, high: np.ndarray) -> Part:
    mesh = trimesh.creation.box(bounds=[low, high])
    return part_from_mesh(mesh.vertices, mesh.faces, name="box")


def blank(low=STOCK_LOW, high=STOCK_HIGH) -> Part:
    """The part with stock on its lower and upper sides."""
    return box(LOW - low, HIGH + high)


def scan(part: Part, *, seen=lambda normals: normals[:, 0] < 2, noise_mm=0.0) -> MeasuredScan:
    """Points of the faces that are seen, from nobody knows where."""
    points, normals, _ = part.sample(20_000, 1)
    points = points + noise_mm * np.random.default_rng(0).normal(size=(len(points), 1)) * normals
    return clean_scan(points[seen(normals)], sensor_origin="unknown")


@functools.cache
def finished() -> Part:
    return box(LOW, HIGH)


def placed(part: Part, required_mm: float = 0.5, *, seen=None, noise_mm=0.0, **how) -> Placement:
    looks = {"noise_mm": noise_mm} | ({} if seen is None else {"seen": seen})
    return place([(scan(part, **looks), HERE)], finished(), required_mm, **how)


@pytest.mark.parametrize("even", [False, True])
def test_the_part_is_centred_between_opposite_faces(even: bool) -> None:
    found = placed(blank(), even=even)
    np.testing.assert_allclose(found.motion, [0, 0, 0, 1, 0, -1], atol=NEAR_MM)
    assert found.margin_mm == pytest.approx(1.5, abs=NEAR_MM)
    assert found.is_feasible
    assert found.converged
    assert found.seen_share > 0.95
    assert found.unopposed_share == 0
    np.testing.assert_allclose(np.nanmedian(found.stock_mm), 2, atol=1e-3)


def test_the_pose_is_that_of_the_part_as_placed() -> None:
    """A point of the scan on the blank's +x face is 2 mm outside the part's."""
    found = placed(blank())
    (part_from_camera,) = found.part_from_camera
    moved = part_from_camera.apply(np.array([[63.0, 20, 15]]))
    np.testing.assert_allclose(moved, [[62, 20, 16]], atol=2 * NEAR_MM)
    np.testing.assert_allclose(
        (found.blank_from_part @ part_from_camera).as_matrix(), np.eye(4), atol=1e-12
    )


def test_a_turned_blank_turns_the_part() -> None:
    points = scan(blank(np.full(3, 2.0), np.full(3, 2.0))).points - HIGH / 2
    turn = pose((1.0, -2.0, 3.0), (0.3, 0.2, -0.1))
    turned = clean_scan(turn.apply(points) + HIGH / 2, sensor_origin="unknown")
    found = place([(turned, HERE)], finished(), 0.5)
    np.testing.assert_allclose(found.blank_from_part.rotation, turn.rotation, atol=1e-3)
    np.testing.assert_allclose(found.motion[3:], turn.translation, atol=NEAR_MM)
    assert found.margin_mm == pytest.approx(1.5, abs=NEAR_MM)


def test_a_small_blank_is_short_by_half_of_what_it_lacks() -> None:
    found = placed(blank(np.ones(3), np.array([0.8, 2, 3])), required_mm=1.0)
    assert not found.is_feasible
    assert found.margin_mm == pytest.approx(-0.1, abs=NEAR_MM)
    assert {name for name, _ in found.held_by} == {"-x", "+x"}
    assert found.reason.startswith("no pose leaves the stock: short by 0.1")
    assert "+x" in found.reason


def test_fixed_axes_stay() -> None:
    found = placed(blank(), fixed=("x", "rz"))
    assert found.motion[[2, 3]].tolist() == [0, 0]
    assert found.margin_mm == pytest.approx(0.5, abs=NEAR_MM)
    assert found.least_side == "-x"


def test_what_no_scan_saw_is_unknown_and_pays_for_nothing() -> None:
    """The lower face is not seen: the part is not moved down for stock on the upper one."""
    found = placed(blank(), seen=lambda normals: normals[:, 2] > -0.5)
    unseen = found.normals[:, 2] < -0.5
    assert np.isnan(found.stock_mm[unseen]).all()
    assert found.seen_share == pytest.approx(1 - unseen.mean(), abs=0.03)
    assert found.motion[3] == pytest.approx(1, abs=NEAR_MM)
    assert found.motion[5] == pytest.approx(0, abs=NEAR_MM)
    assert not found.opposed[found.normals[:, 2] > 0.5].any()
    assert "of the machined surface" in found.reason


def test_from_one_side_the_part_moves_no_farther_than_it_must() -> None:
    found = placed(blank(), required_mm=1.5, seen=lambda normals: normals.sum(axis=1) > 0.5)
    assert found.unopposed_share == 1
    np.testing.assert_allclose(found.motion, [0, 0, 0, 0, 0, -0.5], atol=NEAR_MM)
    assert found.is_feasible


def test_the_most_even_stock_is_not_the_largest_least() -> None:
    """Two steps on one side: the least counts the lower one, evenness the larger one."""
    low, high = np.full(3, 2.0), np.full(3, 2.0)
    step = box(np.array([60.0, -2, -2]), np.array([64.0, 34, 32]))  # 5 of 6 of the +x side
    union = trimesh.boolean.union([blank(low, high).mesh, step.mesh])
    part = part_from_mesh(union.vertices, union.faces, name="stepped")
    fixed = ("rx", "ry", "rz")
    largest, even = (placed(part, even=value, fixed=fixed) for value in (False, True))
    assert largest.motion[3] == pytest.approx(0, abs=NEAR_MM)
    assert even.motion[3] > 0.5
    assert np.nanvar(even.stock_mm) < np.nanvar(largest.stock_mm)
    assert even.margin_mm < largest.margin_mm


def test_the_most_even_place_keeps_the_required_stock() -> None:
    low, high = np.full(3, 2.0), np.full(3, 2.0)
    step = box(np.array([60.0, -2, -2]), np.array([64.0, 34, 32]))
    union = trimesh.boolean.union([blank(low, high).mesh, step.mesh])
    part = part_from_mesh(union.vertices, union.faces, name="stepped")
    found = placed(part, 1.7, even=True, fixed=("rx", "ry", "rz"))
    assert found.motion[3] == pytest.approx(0.3, abs=2 * NEAR_MM)
    assert found.margin_mm == pytest.approx(0, abs=2e-3)


def test_noise_makes_the_least_stock_smaller_by_a_few_sigma() -> None:
    found = placed(blank(), noise_mm=0.05)
    np.testing.assert_allclose(found.motion[3:], [1, 0, -1], atol=0.05)
    assert 0.001 < found.margin_sigma_mm < 0.05 / 2
    assert 1.5 - 0.12 < found.margin_mm < 1.5
    # of planes through 24 points and more
    known = np.isfinite(found.sigma_mm)
    assert 0.05 / 9 < np.median(found.sigma_mm[known]) < 0.05 / 3


def test_stock_that_does_not_matter_does_not_hold_the_part() -> None:
    surface = finished_surface(finished(), POINTS)
    required = np.where(surface.normals[:, 0] < -0.5, np.nan, 0.5)
    found = place([(scan(blank()), HERE)], finished(), required)
    assert np.isnan(found.stock_mm[surface.normals[:, 0] < -0.5]).all()
    assert found.motion[3] == pytest.approx(0, abs=NEAR_MM)


def test_one_view_of_the_scanner_sees_one_side() -> None:
    part = blank(np.full(3, 1.0), np.full(3, 1.0))
    view = hemisphere_viewpoints(part.center).view(40)
    shot = Scanner(part).scan(Camera(width=400, height=320), view)
    one = (clean_scan(shot.points.astype(np.float64)), view.inverse())
    found = place([one], finished(), 0.5)
    assert 0.2 < found.seen_share < 0.6
    np.testing.assert_allclose(found.motion, 0, atol=1e-9)
    known = np.isfinite(found.stock_mm)
    np.testing.assert_allclose(found.stock_mm[known], 1, atol=NEAR_MM)
    # the sensor saw none of what turns away from it
    away = found.normals @ one[1].rotation @ view.apply(part.center[None])[0] > 0
    assert not (known & away).any()


def test_two_views_count_together() -> None:
    part = blank()
    views = [hemisphere_viewpoints(part.center).view(k) for k in (40, 58)]
    scanner = Scanner(part)
    shots = [scanner.scan(Camera(width=400, height=320), view) for view in views]
    scans = [
        (clean_scan(shot.points.astype(np.float64)), view.inverse())
        for shot, view in zip(shots, views, strict=True)
    ]
    one, two = place(scans[:1], finished(), 0.1), place(scans, finished(), 0.1)
    assert two.seen_share > one.seen_share + 0.1
    for (_, registered), part_from_camera in zip(scans, two.part_from_camera, strict=True):
        back = two.blank_from_part @ part_from_camera
        np.testing.assert_allclose(back.as_matrix(), registered.as_matrix(), atol=1e-9)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"fixed": ("w",)}, "no axis 'w' to fix; the axes are rx, ry, rz, x, y, z"),
        ({"fixed": ("rx", "ry", "rz", "x", "y", "z")}, "all axes are fixed"),
        ({"required_mm": np.inf}, "must be a finite length"),
        ({"required_mm": np.ones(3)}, "one length or"),
    ],
)
def test_what_cannot_be_asked_is_refused(how: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        placed(blank(), **how)


def test_a_scan_of_something_else_is_refused() -> None:
    far = clean_scan(scan(blank()).points + 500.0, sensor_origin="unknown")
    with pytest.raises(InputError, match="have a measured blank above them"):
        place([(far, HERE)], finished(), 0.5)
    with pytest.raises(InputError, match="no scan is given"):
        place([], finished(), 0.5)
