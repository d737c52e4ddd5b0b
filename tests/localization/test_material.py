"""Missing and extra material: where it is, how much, and that noise, edges and tables are none."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import trimesh
from example_scans import ideal_scan, model, solid, with_noise

from vanejax.cad.part import Part
from vanejax.localization.material import material_regions
from vanejax.localization.pose_batch import stack
from vanejax.localization.pose_result import MaterialRegion, PointStatus
from vanejax.localization.residuals import measurement_model
from vanejax.localization.verification import verify
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Camera, look_at

TOLERANCE_MM = 0.3
CAMERA = Camera(width=320, height=256)


@functools.cache
def plate(with_rib: bool) -> Part:
    """60 x 40 x 10 mm, with a rib of 8 x 30 x 15 mm on it, whose top is 20 mm from the origin."""
    boxes = [trimesh.creation.box(bounds=[[-30, -20, -5], [30, 20, 5]])]
    if with_rib:
        boxes.append(trimesh.creation.box(bounds=[[8, -15, 0], [16, 15, 20]]))
    return solid(trimesh.boolean.union(boxes) if with_rib else boxes[0], name="plate")


def points_and_truth(part: Part) -> tuple[np.ndarray, RigidTransform]:
    """A scan from obliquely above."""
    view = look_at(np.array([150.0, 60.0, 300.0]), np.zeros(3))
    scan, truth = ideal_scan(part, view, CAMERA)
    return with_noise(scan.points.astype(np.float64), 0.05, 0), truth


def regions_of(
    scanned: Part, sought: Part, more: np.ndarray | None = None
) -> tuple[MaterialRegion, ...]:
    """Of a scan under its true pose, with more points [m, 3], mm, of the part's frame in it."""
    points, truth = points_and_truth(scanned)
    if more is not None:
        points = np.concatenate([points, truth.inverse().apply(more)])
    seen = measurement_model(sought, np.zeros(3))
    checked = np.arange(len(points))
    found = verify(seen, truth, points, checked, tolerance_mm=TOLERANCE_MM, view=None)
    return material_regions(seen, truth, points, found.status, tolerance_mm=TOLERANCE_MM)


def test_a_part_that_is_its_cad_model_has_none():
    assert regions_of(plate(True), plate(True)) == ()


def test_a_rib_that_the_cad_model_lacks_is_extra():
    (region,) = regions_of(plate(True), plate(False))
    assert not region.is_missing
    # the top, 8 x 30 mm, and the two sides that are seen, 15 x 30 and 15 x 8 mm
    assert region.area_mm2 == pytest.approx(8 * 30 + 15 * 30 + 15 * 8, rel=0.15)
    np.testing.assert_allclose(region.center, [14, 1, 15], atol=2)
    assert region.depth_mm == pytest.approx(15, abs=0.5)
    points, truth = points_and_truth(plate(True))
    true_share = np.mean(truth.apply(points)[:, 2] > 5.3)
    assert region.share == pytest.approx(true_share, rel=0.1)


def test_a_rib_that_the_scan_lacks_is_missing():
    (region,) = regions_of(plate(False), plate(True))
    assert region.is_missing
    # where the CAD model has its surface, and not where the light went on to
    assert 8 < region.center[0] < 16.5
    assert 5 < region.center[2] < 20
    assert 5 < region.depth_mm < 20
    assert 0.02 < region.share < 0.3


def test_what_touches_nothing_is_none():
    """A table far below, where the part does not hide it."""
    x, y = np.meshgrid(np.linspace(-120, 120, 120), np.linspace(60, 120, 30))
    table = np.stack([x.ravel(), y.ravel(), np.full(x.size, -40.0)], axis=1)
    assert regions_of(plate(True), plate(True), more=table) == ()


def test_scattered_points_are_none():
    """Flying pixels: 8 % of the points, and no two of them near each other."""
    rng = np.random.default_rng(0)
    dust = rng.uniform([-30, -20, 6], [30, 20, 20], (700, 3))
    assert regions_of(plate(True), plate(True), more=dust) == ()


def test_a_shallow_offset_is_a_deviation_of_form():
    points, truth = points_and_truth(plate(True))
    poses = model(plate(True)).residuals(stack(truth), points)
    off = poses.jacobian[0][:, 3:] @ truth.rotation * (truth.apply(points)[:, :1] > 0)
    status = np.where(np.any(off != 0, axis=1), PointStatus.BEFORE, PointStatus.INLIER)
    for offset_mm, count in ((0.7, 0), (3.0, 1)):
        found = material_regions(
            model(plate(True)), truth, points + offset_mm * off, status, tolerance_mm=TOLERANCE_MM
        )
        assert len(found) == count
