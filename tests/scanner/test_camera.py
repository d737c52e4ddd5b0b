"""The camera model of Table 2, the viewpoints of Algorithm 1 and the labels of eqs 4 to 7."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vanejax.errors import InputError
from vanejax.scanner.camera import Camera, field_of_view_deg, hemisphere_viewpoints, look_at

CENTER = np.array([3.0, -7.0, 40.0])
coordinates = st.floats(-1e3, 1e3, allow_nan=False)
points = st.tuples(coordinates, coordinates, coordinates).map(np.array)


def test_field_of_view_is_the_paper_s_near_field():
    assert field_of_view_deg(230, 300) == pytest.approx(np.degrees(0.73), abs=0.2)  # 0.73 rounded
    camera = Camera()
    np.testing.assert_allclose(camera.extent_mm(300), (230, 140), rtol=1e-12)
    # the table's far field, 1000 x 600 mm at 1300 mm, is the same cone to its rounding
    np.testing.assert_allclose(camera.extent_mm(1300), (1000, 600), rtol=0.012)
    assert camera.fx == pytest.approx(1280 / (230 / 300))
    assert camera.fy == pytest.approx(1024 / (140 / 300))


def test_axes_of_the_image():
    camera = Camera()
    ahead, right, up = camera.project(np.array([[0, 0, -400], [10, 0, -400], [0, 10, -400]]))
    np.testing.assert_allclose(ahead, (640, 512))
    assert right[0] > ahead[0]
    assert right[1] == ahead[1]
    assert up[1] < ahead[1]
    assert up[0] == ahead[0]
    corner = camera.project(np.array([-115.0, 70.0, -300.0]))
    np.testing.assert_allclose(corner, (0, 0), atol=1e-9)  # f64 eps x 1e3 pixels


@settings(max_examples=50, deadline=None)
@given(
    width=st.integers(1, 3000),
    height=st.integers(1, 3000),
    fov_x_deg=st.floats(1, 170),
    fov_y_deg=st.floats(1, 170),
    distance=st.floats(1e-3, 1e5),
    data=st.data(),
)
def test_rays_project_to_their_pixel_centre(width, height, fov_x_deg, fov_y_deg, distance, data):
    camera = Camera(width, height, fov_x_deg, fov_y_deg)
    columns = np.array(data.draw(st.lists(st.integers(0, width - 1), min_size=1, max_size=5)))
    row = data.draw(st.integers(0, height - 1))
    x, y = camera.slopes(columns, row)
    rays = np.stack([x, np.full(len(x), y), np.full(len(x), -1.0)], axis=-1)
    expected = np.stack([columns + 0.5, np.full(len(columns), row + 0.5)], axis=-1)
    # f64 eps x pixels x 100
    np.testing.assert_allclose(camera.project(distance * rays), expected, atol=1e-10 * 3000)


def test_scaled_sees_the_same_with_fewer_pixels():
    small = Camera().scaled(0.25)
    assert (small.width, small.height) == (320, 256)
    np.testing.assert_allclose(small.extent_mm(400), Camera().extent_mm(400), rtol=1e-12)
    assert Camera().scaled(1e-6).width == 1
    for factor in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="factor"):
            Camera().scaled(factor)


def test_dict_round_trip_and_wrong_names():
    camera = Camera(width=640, fov_y_deg=30.0, far_mm=900.0)
    assert Camera.from_dict(camera.to_dict()) == camera
    with pytest.raises(InputError, match=r"fov_z_deg.*near_mm"):
        Camera.from_dict({"fov_z_deg": 3})


@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 0},
        {"height": 10.5},
        {"width": True},
        {"fov_x_deg": 180.0},
        {"fov_y_deg": float("nan")},
        {"near_mm": 0.0},
        {"near_mm": 1300.0},
        {"far_mm": float("inf")},
        {"near_mm": float("nan")},
    ],
)
def test_impossible_cameras_are_refused(wrong):
    name = next(iter(wrong))
    with pytest.raises(InputError, match=name):
        Camera(**wrong)


@settings(max_examples=200, deadline=None)
@given(position=points, target=points, shift=points)
@example(position=np.array([0.0, 62.0, -6.103515625e-05]), target=np.zeros(3), shift=np.zeros(3))
def test_look_at_laws(position, target, shift):
    distance = np.linalg.norm(position - target)
    if distance < 1e-3:
        return
    pose = look_at(position, target)
    rotation = pose.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)  # f64 eps x 1e4
    assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-12)
    scale = 1e-12 * 4e3  # relative f64 error x largest coordinate
    np.testing.assert_allclose(pose.apply(target[None])[0], (0, 0, -distance), atol=scale)
    np.testing.assert_allclose(pose.apply(position[None])[0], 0, atol=scale)
    # up stays up; the fallback serves sights within 1e-6 of the y axis, and may lean by as much
    assert rotation[1, 1] >= -1.001e-6
    if abs(rotation[2, 1]) < 0.9999:  # away from the fallback, moving the scene turns nothing
        moved = look_at(position + shift, target + shift)
        # sums of 1e3 mm round to 2e-13, over the least distance 1e-3 and sin(D, y) 0.014
        np.testing.assert_allclose(moved.rotation, rotation, atol=1e-7)


def test_look_at_is_eqs_4_to_7_with_unit_axes():
    position = np.array([120.0, -60.0, 380.0])
    d = position / np.linalg.norm(position)
    r = np.cross([0.0, 1.0, 0.0], d)
    r /= np.linalg.norm(r)
    u = np.cross(d, r)
    axes, shift = np.eye(4), np.eye(4)
    axes[:3, :3] = [r, u, d]
    shift[:3, 3] = -position
    np.testing.assert_allclose(look_at(position, np.zeros(3)).as_matrix(), axes @ shift, atol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_look_at_along_the_up_vector(sign):
    pose = look_at(np.array([0.0, sign * 400.0, 0.0]), np.zeros(3))
    expected = [[1, 0, 0], [0, 0, -sign], [0, sign, 0]]
    np.testing.assert_allclose(pose.rotation, expected, atol=1e-15)
    almost = look_at(np.array([1e-5, sign * 400.0, 0.0]), np.zeros(3)).rotation
    np.testing.assert_allclose(almost @ almost.T, np.eye(3), atol=1e-12)  # f64 eps x 1e4


def test_look_at_refuses_what_has_no_direction():
    with pytest.raises(InputError, match="stands at"):
        look_at(CENTER, CENTER)
    with pytest.raises(InputError, match="finite"):
        look_at(np.array([0.0, np.nan, 1.0]), CENTER)
    with pytest.raises(InputError, match=r"\[..., 3\]"):
        look_at(np.zeros(2), CENTER)


def test_algorithm_1_on_the_intended_sphere():
    views = hemisphere_viewpoints(CENTER)
    assert len(views) == 216
    assert views.elevation_deg[:37].tolist() == [60.0] * 36 + [65.0]  # elevation is the outer loop
    assert views.azimuth_deg[:4].tolist() == [0.0, 10.0, 20.0, 30.0]
    offset = views.position - CENTER
    np.testing.assert_allclose(np.linalg.norm(offset, axis=-1), 400, rtol=1e-13)
    a, b = np.radians(views.elevation_deg), np.radians(views.azimuth_deg)
    expected = 400 * np.stack([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)], -1)
    np.testing.assert_allclose(offset, expected, atol=1e-10)  # f64 eps x 1e3 mm x 100
    targets = views.camera_from_part.apply(np.broadcast_to(CENTER, (216, 1, 3)))[:, 0]
    np.testing.assert_allclose(targets, np.tile([0, 0, -400], (216, 1)), atol=1e-10)


def test_the_printed_formula_is_no_sphere():
    views = hemisphere_viewpoints(CENTER, formula="printed")
    distance = np.linalg.norm(views.position - CENTER, axis=-1)
    on_x = distance[np.isin(views.azimuth_deg, [0, 180])]
    assert on_x.min() == pytest.approx(489.9, abs=0.05)  # 400 sqrt(2) sin 60, to its last digit
    assert on_x.max() == pytest.approx(563.5, abs=0.05)  # 400 sqrt(2) sin 85
    np.testing.assert_allclose(distance[np.isin(views.azimuth_deg, [90, 270])], 400)
    targets = views.camera_from_part.apply(np.broadcast_to(CENTER, (216, 1, 3)))[:, 0]
    np.testing.assert_allclose(targets[:, 2], -distance)  # the cameras still look at the part


def test_the_split_by_azimuth():
    views = hemisphere_viewpoints(CENTER)
    assert views.is_test.sum() == 54
    assert (~views.is_test).sum() == 162
    assert set(views.azimuth_deg[views.is_test]) == set(range(0, 360, 40))
    test_views = views.select(views.is_test)
    assert len(test_views) == 54
    assert test_views.is_test.all()
    index = np.flatnonzero(views.is_test)[10]
    np.testing.assert_array_equal(
        test_views.view(10).as_matrix(), views.camera_from_part.as_matrix()[index]
    )


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"distance_mm": 0.0}, "distance_mm"),
        ({"formula": "spheer"}, "spheer.*sphere, printed"),
        ({"elevations_deg": ()}, "at least one"),
        ({"elevations_deg": (91.0,)}, "90"),
        ({"azimuths_deg": (np.nan,)}, "finite"),
        ({"center": [0.0, 0.0]}, "center"),
    ],
)
def test_impossible_viewpoints_are_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        hemisphere_viewpoints(**({"center": CENTER} | wrong))
