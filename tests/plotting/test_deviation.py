"""Pictures of deviations show each point where it is, with its sign, and hide what is hidden."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from example_registration import NOISE_MM, Registration, example_registration
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text

from vanejax.cad import part_from_mesh
from vanejax.localization.deviation_patches import scaled_pose
from vanejax.localization.pose_result import FormDeviation, PointStatus, Verification
from vanejax.plotting import deviation_map, overlay_before_after, residual_histogram, stock_map
from vanejax.plotting.canvas import FAR_ABOVE, NO_PARTNER
from vanejax.plotting.deviation import (
    color_limit_mm,
    deviation_colors,
    deviation_maps,
    overlay_pictures,
)
from vanejax.plotting.scene import Picture, Scene, reader_rotation, scale_bar_mm
from vanejax.rigid import RigidTransform
from vanejax.scans import MeasuredScan

HALF = np.array([30.0, 20.0, 10.0])
BLUE = np.array([[0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A box with corners at plus and minus `HALF` mm."""
    box = trimesh.creation.box(2 * HALF)
    return Scene(part_from_mesh(box.vertices, box.faces, name="box"))


def blue(picture: Picture) -> np.ndarray:
    """[H, W]: where the picture has a blue dot."""
    red, _, blue, opacity = np.moveaxis(picture.image, -1, 0)
    return (blue > 0.5) & (red < 0.2) & (opacity == 1)


def one_dot(scene: Scene, point: list[float], *, lift_mm: float = 0.0) -> Picture:
    points = np.array([point])
    frame = scene.frame(np.eye(3), [points])
    return scene.draw(np.eye(3), points, BLUE, frame=frame, lift_mm=lift_mm)


def place_mm(picture: Picture, mask: np.ndarray) -> np.ndarray:
    """Mean (x, y) of the pixels of a mask, mm."""
    left, right, bottom, top = picture.extent_mm
    row, column = np.argwhere(mask).mean(axis=0) + 0.5
    height, width = mask.shape
    return np.array([left + column / width * (right - left), top - row / height * (top - bottom)])


def texts(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(Text))


# ---------------------------------------------------------------- the scene


@pytest.mark.parametrize("point", [[12.0, -7.0, 10.0], [-29.0, 19.0, 10.0], [45.0, 5.0, 0.0]])
def test_a_dot_is_where_its_point_is(scene, point):
    picture = one_dot(scene, point)
    away = 1.05 * scene.part.radius / np.sin(np.radians(6))
    pixel_mm = picture.width_mm / picture.image.shape[1]
    expected = np.array(point[:2]) * away / (away - point[2])
    np.testing.assert_allclose(place_mm(picture, blue(picture)), expected, atol=pixel_mm)


def test_the_part_has_its_size(scene):
    picture = one_dot(scene, [0.0, 0.0, -10.0])  # behind the box, so not seen
    assert not blue(picture).any()
    away = 1.05 * scene.part.radius / np.sin(np.radians(6))
    pixel_mm = picture.width_mm / picture.image.shape[1]
    wide = np.count_nonzero(picture.image[..., 3].any(axis=0)) * pixel_mm
    # the front face, which is nearer than the plane that the picture's millimetres are of
    assert abs(wide - 2 * HALF[0] * away / (away - HALF[2])) < 2 * pixel_mm


def test_a_point_below_the_surface_is_seen_only_if_lifted(scene):
    assert not blue(one_dot(scene, [0.0, 0.0, 9.7])).any()
    assert blue(one_dot(scene, [0.0, 0.0, 9.7], lift_mm=0.5)).any()
    assert not blue(one_dot(scene, [0.0, 0.0, 9.2], lift_mm=0.5)).any()


def test_a_guess_far_away_does_not_shrink_the_picture(scene):
    near, far = one_dot(scene, [0.0, 0.0, 10.0]), one_dot(scene, [2000.0, 0.0, 0.0])
    assert far.extent_mm == near.extent_mm


def test_a_map_of_white_noise_has_no_colour(scene):
    """Points that deviate to the outside are nearer to the reader; they must not win by that."""
    rng = np.random.default_rng(0)
    deviation = rng.choice([-0.2, 0.2], 40_000)
    flat = rng.uniform(-1, 1, (len(deviation), 2)) * 0.95 * HALF[:2]
    points = np.column_stack([flat, HALF[2] + deviation])
    colors = np.where(deviation[:, None] > 0, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    frame = scene.frame(np.eye(3), [points])
    image = scene.draw(np.eye(3), points, colors, frame=frame, lift_mm=0.4).image
    dotted = (image[..., 1] < 0.05) & (image[..., 3] == 1)
    red, blue_ = image[dotted][:, 0].mean(), image[dotted][:, 2].mean()
    # about 100,000 pixels of a fair coin: 0.01 is many standard deviations
    assert abs(red - blue_) < 0.01


def test_the_reader_stands_where_the_sensor_is():
    case = example_registration()
    pose = case.result.part_from_camera
    rotation = reader_rotation(case.scan, case.part, pose)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    sensor = rotation @ (pose.translation - pose.apply(case.scan.points).mean(axis=0))
    np.testing.assert_allclose(sensor / np.linalg.norm(sensor), [0, 0, 1], atol=0.02)
    # our camera's y is up: so it is in the picture
    assert (rotation @ pose.rotation[:, 1])[1] > 0.95


def test_a_camera_that_looks_along_plus_z_gives_the_same_picture():
    case = example_registration()
    flip = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    other = dataclasses.replace(case.scan, points=flip.apply(case.scan.points))
    pose = case.result.part_from_camera
    np.testing.assert_allclose(
        reader_rotation(other, case.part, pose @ flip),
        reader_rotation(case.scan, case.part, pose),
        atol=1e-12,
    )


def test_without_a_sensor_the_reader_sees_what_was_measured():
    case = example_registration()
    pose = case.result.part_from_camera
    unknown = dataclasses.replace(case.scan, sensor_origin=None)
    known = reader_rotation(case.scan, case.part, pose)
    cosine = reader_rotation(unknown, case.part, pose)[2] @ known[2]
    assert cosine > np.cos(np.radians(35))
    around = MeasuredScan(case.part.sample(3000, 1)[0], None, None)
    rotation = reader_rotation(around, case.part, RigidTransform.identity(dtype=np.float64))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("width", "length"), [(100.0, 20.0), (200.0, 50.0), (0.4, 0.1), (39.0, 5.0), (40.0, 10.0)]
)
def test_the_scale_bar_is_a_round_length(width, length):
    assert scale_bar_mm(width) == pytest.approx(length)


# ---------------------------------------------------------------- the figures


def with_deviations(deviation_mm: list[float], tolerance_mm: float = 0.4) -> Verification:
    deviation = np.asarray(deviation_mm, np.float64)
    status = np.where(np.abs(deviation) <= tolerance_mm, PointStatus.INLIER, PointStatus.BEFORE)
    verification = example_registration().result.verification
    return dataclasses.replace(verification, deviation_mm=deviation, status=status)


def casting(form: FormDeviation) -> Registration:
    """The example's scan of a part with that stock and size, at the pose that belongs to it."""
    case = example_registration()
    pose, size = case.result.part_from_camera, 1 + form.scale_error
    points = (case.scan.points + form.stock_mm * case.scan.normals) * size
    pose = scaled_pose(pose, case.part.center, size)
    refinement = dataclasses.replace(case.result.refinement, form=form)
    scan = dataclasses.replace(case.scan, points=points)
    case = case.replace(part_from_camera=pose, refinement=refinement)
    return dataclasses.replace(case, scan=scan)


def redness(picture: Picture) -> float:
    """How much more red than blue the picture is, on average over what is drawn."""
    drawn = picture.image[picture.image[..., 3] == 1]
    return float((drawn[:, 0] - drawn[:, 2]).mean())


@pytest.mark.parametrize(
    ("deviations", "limit"),
    [
        (np.linspace(-0.25, 0.25, 101), 0.3),
        ([0.3, -0.3, np.nan], 0.3),
        ([0.301, 0.301], 0.4),
        (np.r_[np.full(9, 0.1), 50.0], 0.1),
        ([4.2], 5.0),
        ([4.2, 0.25], 0.3),
        ([np.nan], 0.001),
        ([], 0.001),
    ],
)
def test_the_colours_end_at_a_round_figure(deviations, limit):
    assert color_limit_mm(with_deviations(deviations)) == pytest.approx(limit)


def test_colours_have_a_sign():
    above, below, none, zero, beyond = deviation_colors(np.array([0.2, -0.2, np.nan, 0, 9]), 0.3)
    assert above[0] > above[2] + 0.3
    assert below[2] > below[0] + 0.3
    np.testing.assert_allclose(none, to_rgb(NO_PARTNER))
    assert zero.min() > 0.7  # pale
    np.testing.assert_allclose(beyond, to_rgb(FAR_ABOVE))


@pytest.mark.parametrize(
    ("form", "title"),
    [
        (FormDeviation(stock_mm=0.8, stock_sigma_mm=0.01), "without stock"),
        (FormDeviation(stock_mm=-0.8, stock_sigma_mm=0.01), "without stock"),
        (
            FormDeviation(stock_mm=0.8, scale_error=-0.01, scale_sigma=0.001),
            "without stock and the difference of size",
        ),
    ],
)
def test_stock_is_seen_before_it_is_taken_out_and_not_after(form, title):
    case = casting(form)
    maps = deviation_maps(case.result, case.scan, Scene(case.part))
    assert maps.titles == ("as measured", title)
    assert maps.limit_mm >= 0.8
    for measured, left in maps.pictures:
        assert measured.extent_mm == left.extent_mm
        assert np.sign(form.stock_mm) * redness(measured) > 0.15
        assert abs(redness(left)) < 0.05


def test_the_figure_of_a_casting_names_what_was_found():
    case = casting(FormDeviation(stock_mm=0.8, stock_sigma_mm=0.013))
    figure = deviation_map(case.result, case.scan, case.part)
    words = texts(figure)
    for wanted in ("stock 0.800 ± 0.013 mm", "as measured", "without stock", "not measured"):
        assert wanted in words
    bar = figure.axes[-1]
    low, high = bar.get_ylim()
    assert low == -high
    assert bar.get_yticks()[[0, -1]] == pytest.approx([low, high])


def test_a_part_as_designed_has_one_map():
    case = casting(FormDeviation(field="form", field_mm=0.1, field_length_mm=20.0))
    maps = deviation_maps(case.result, case.scan, Scene(case.part))
    assert maps.titles == ("as measured",)
    assert [len(row) for row in maps.pictures] == [1, 1]


def test_material_that_is_missing_is_seen_where_it_should_be(scene):
    """Points far below the surface would be hidden by the part that they are missing from."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-1, 1, (40_000, 2)) * 0.95 * HALF[:2]
    missing = flat[:, 0] > 10
    points = np.column_stack([flat, np.where(missing, HALF[2] - 5.0, HALF[2])])
    deviation = points[:, 2] - HALF[2]
    status = np.where(missing, PointStatus.BEHIND, PointStatus.INLIER)
    case = example_registration()
    verification = dataclasses.replace(
        case.result.verification,
        deviation_mm=deviation, status=status, checked=np.arange(len(points)),
    )  # fmt: skip
    origin = np.array([0.0, 0.0, 400.0])
    case = case.replace(
        verification=verification,
        part_from_camera=RigidTransform.identity(dtype=np.float64),
        sensor_origin=origin,
    )
    maps = deviation_maps(case.result, MeasuredScan(points, None, origin), scene)
    picture = maps.pictures[0][0]
    dark = (picture.image[..., :3].max(axis=-1) < 0.3) & (picture.image[..., 3] == 1)
    size_mm = (picture.width_mm / picture.image.shape[1]) ** 2
    # of 18.5 x 38 mm, seen from about 30 radii; the dots add a rim
    assert np.count_nonzero(dark) * size_mm == pytest.approx(18.5 * 38, rel=0.1)
    assert maps.below_share == pytest.approx(missing.mean())


def test_the_reader_steps_to_the_side_where_the_part_hides_less():
    wall = trimesh.creation.box((2, 40, 40)).apply_translation((0, 0, 20))
    base = trimesh.creation.box((80, 40, 2))
    part = part_from_mesh(*_joined(wall, base), name="bracket")
    for side in (1, -1):
        x = side * np.linspace(2, 38, 500)
        points = np.column_stack([x, np.linspace(-19, 19, 500), np.ones(500)])
        scan = MeasuredScan(points, None, np.array([0.0, 0.0, 400.0]))
        pose = RigidTransform.identity(dtype=np.float64)
        yaw = Scene(part).fuller_side(scan, pose, yaw_deg=48.0, pitch_deg=0.0)
        reader = reader_rotation(scan, part, pose, yaw_deg=yaw)
        assert np.sign(reader[2, 0]) == side


def _joined(*solids: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    both = trimesh.util.concatenate(solids)
    return both.vertices, both.faces


def test_the_map_says_its_unit_its_limits_and_what_has_no_partner():
    case = example_registration()
    figure = deviation_map(case.result, case.scan, case.part)
    words = texts(figure)
    assert "(mm)" in words
    deviation = case.result.verification.deviation_mm
    assert f"no partner: {100 * np.isnan(deviation).mean():.1f} %" in words
    limit = color_limit_mm(case.result.verification)
    assert figure.axes[-1].get_ylim() == pytest.approx((-limit, limit))


def test_the_histogram_counts_every_point_once():
    case = example_registration()
    verification = case.result.verification
    axes = residual_histogram(case.result).axes[0]
    limit = axes.get_xlim()[1]
    expected = np.histogram(
        verification.deviation_mm[verification.status == PointStatus.INLIER],
        np.linspace(-limit, limit, 97),
    )[0]
    # inliers are the lowest of the stacked outlines; of each bin it has two corners
    outline = {patch.get_label(): patch.get_xy()[:, 1] for patch in axes.patches}["inlier"]
    np.testing.assert_array_equal(outline[1:193:2], expected)
    x, y = next(line for line in axes.lines if "noise" in line.get_label()).get_data()
    inliers = np.count_nonzero(verification.status == PointStatus.INLIER)
    area = np.trapezoid(y, x) / (2 * limit / 96)
    assert area == pytest.approx(inliers, rel=1e-3)  # cut at more than 6 sigma
    assert y.max() / y[np.argmin(np.abs(x - NOISE_MM))] == pytest.approx(np.exp(0.5), rel=0.03)


@pytest.mark.parametrize("noise", [0.0, np.nan])
def test_a_histogram_without_noise_or_partners_is_drawn(noise):
    case = example_registration()
    refinement = dataclasses.replace(case.result.refinement, noise_mm=noise)
    verification = dataclasses.replace(
        case.result.verification,
        deviation_mm=np.full(len(case.scan.points), np.nan),
        status=np.full(len(case.scan.points), PointStatus.BESIDE, np.uint8),
    )
    result = dataclasses.replace(case.result, refinement=refinement, verification=verification)
    figure = residual_histogram(result)
    figure.canvas.draw()
    assert "noise" not in texts(figure)


def test_before_and_after_have_one_frame_and_differ():
    case = example_registration()
    before, after = overlay_pictures(
        case.scan, Scene(case.part), case.result.before, case.result.part_from_camera
    )
    assert before.extent_mm == after.extent_mm
    red, blue_ = (after.image[..., k] for k in (0, 2))
    solid = after.image[..., 3] == 1
    for color in (red > blue_ + 0.2, blue_ > red + 0.2):  # CAD and scan
        assert np.count_nonzero(color & solid) > 0.05 * np.count_nonzero(solid)
    differs = np.abs(before.image - after.image).max(axis=-1) > 0.2
    assert np.count_nonzero(differs) > 0.1 * np.count_nonzero(solid)
    words = texts(overlay_before_after(case.result, case.scan, case.part))
    assert {"before", "after", "scan", "CAD"} <= set(words.split("\n"))


def test_the_map_of_the_stock_spans_it_and_is_grey_where_it_is_unknown():
    mesh = trimesh.creation.box((40.0, 60.0, 10.0))
    part = part_from_mesh(mesh.vertices, mesh.faces, name="box")
    points, normals, _ = part.sample(2000, 0)
    stock = np.where(normals[:, 2] > 0.5, 1.0, np.where(normals[:, 2] < -0.5, np.nan, 2.0))
    above, below, bar = stock_map(part, points, normals, stock).axes
    assert bar.get_ylim() == pytest.approx((0.995, 2.005))
    grey = [
        np.mean(np.ptp(np.asarray(axes.images[0].get_array(), float)[..., :3], axis=2) < 0.06)
        for axes in (above, below)
    ]
    assert grey[1] > grey[0] + 0.2
