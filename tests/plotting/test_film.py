"""The film of a registration: it stops at every pose, bends nothing and asks for nothing."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vanejax.errors import InputError
from vanejax.plotting.film import between, registration_film
from vanejax.rigid import RigidTransform

POINTS = np.random.default_rng(0).uniform(-40, 40, (50, 3)) + np.array([300.0, 0, 0])
NAMES = ["start <b>", "after iteration 1", "after iteration 2"]


def poses() -> list[RigidTransform]:
    turns = Rotation.from_rotvec(np.outer([0.7, 0.1, 0.0], [0.0, 0.6, 0.8])).as_matrix()
    return [RigidTransform(turn, np.array([0.0, 9.0 * k, 0.0])) for k, turn in enumerate(turns)]


def test_between_two_poses_the_centre_goes_straight_and_nothing_is_bent():
    film = between(poses(), POINTS.mean(axis=0), 4)
    assert len(film) == 9
    clouds = [pose.apply(POINTS) for pose in film]
    for k, pose in enumerate(poses()):
        np.testing.assert_allclose(clouds[4 * k], pose.apply(POINTS), atol=1e-9)  # f64, 300 mm
    steps = np.diff([cloud.mean(axis=0) for cloud in clouds[:5]], axis=0)
    np.testing.assert_allclose(steps, np.tile(steps[0], (4, 1)), atol=1e-9)
    sizes = [np.linalg.norm(cloud - cloud.mean(axis=0)) for cloud in clouds]
    np.testing.assert_allclose(sizes, sizes[0])


def test_the_page_holds_every_picture_and_names_no_other_place():
    page = registration_film(POINTS, poses(), NAMES, POINTS, frames_per_pose=2)
    frames = set(re.findall(r'"data:image/png;base64,([^"]*)"', page.replace("\\\n", "")))
    assert len(frames) == 5
    assert not re.search(r"https?:|<link|@import|fa-", page)
    assert "▶" in page


def test_what_cannot_be_shown_is_refused():
    true, broken = poses()[0], RigidTransform(np.full((3, 3), np.nan), np.zeros(3))
    for points, chosen, names, words in (
        (POINTS, [true], ["one"], "1 poses with 1 names; a film needs two"),
        (POINTS, [true, true], ["one"], "2 poses with 1 names"),
        (POINTS, [true, broken], ["one", "two"], "not finite"),
        (POINTS[:, :2], [true, true], ["one", "two"], r"shape \(50, 2\)"),
    ):
        with pytest.raises(InputError, match=words):
            registration_film(points, chosen, names, POINTS)
