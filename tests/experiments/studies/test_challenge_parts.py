"""The challenge parts against arithmetic, and their symmetries against the surfaces."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.studies.verdicts.challenge_parts import challenge_parts, names_of_parts
from vanejax.cad.symmetry import DenseSurface, cyclic, rotation_about
from vanejax.rigid import RigidTransform

# samples as discs of a 0.4 mm wide neighbourhood on facets of 4 deg: their sag, and no more
EXACT_MM = 0.006


@pytest.fixture(scope="module")
def parts():
    return challenge_parts()


def inscribed(radius: float, segments: int = 96) -> float:
    """Area of the polygon that stands for a circle."""
    return 0.5 * segments * radius**2 * math.sin(2 * math.pi / segments)


def transforms(matrices: np.ndarray) -> list[RigidTransform]:
    return [RigidTransform.from_matrix(m) for m in matrices]


def test_every_part_is_one_closed_solid_of_hand_size(parts):
    assert len(parts) >= 25
    assert tuple(parts) == names_of_parts()
    for name, challenge in parts.items():
        assert challenge.part.mesh.is_watertight, name
        assert challenge.part.mesh.body_count == 1, name
        assert challenge.part.notes == (), name
        assert 40 <= challenge.part.extent_mm.max() <= 200, name


@pytest.mark.parametrize(
    ("name", "volume"),
    [
        ("box", 80 * 60 * 40),
        ("box_chamfer", 80 * 60 * 40 - 0.5 * 4 * 4 * 80),
        ("wedge", 0.5 * 90 * 34 * 45),
        ("plate_extra_hole", 8 * (100 * 100 - 4 * inscribed(6) - inscribed(4))),
        ("flange", 12 * (inscribed(50) - inscribed(20) - 6 * inscribed(5))),
        ("u_channel", 120 * (50 * 36 - 40 * 31) - 2 * 5 * inscribed(4.5)),
    ],
)
def test_volumes(parts, name, volume):
    # coordinates are float32: 4e-6 of 100 mm
    assert parts[name].part.mesh.volume == pytest.approx(volume, rel=1e-5)


def test_two_builds_are_equal_to_the_bit(parts):
    names = ["gear_keyway", "elbow", "vane_4"]
    again = challenge_parts(names)
    assert list(again) == names
    for name in names:
        assert again[name].part.sha256 == parts[name].part.sha256


def test_symmetries_are_groups_of_rigid_motions_that_keep_the_surface(parts):
    expected = {"box": 4, "flange": 12, "gear": 48, "gear_keyway": 2, "hex_nut": 12, "elbow": 2}
    for name, challenge in parts.items():
        group = challenge.symmetries
        assert len(group) == expected.get(name, len(group)), name
        np.testing.assert_allclose(group[0], np.eye(4), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(group[:, :3, :3]), 1, atol=1e-12)
        # closed: every product is an element
        products = np.einsum("aij,bjk->abik", group, group).reshape(-1, 1, 4, 4)
        gaps = np.abs(products - group[None]).max(axis=(2, 3)).min(axis=1)
        assert gaps.max() < 1e-9, name
        surface = DenseSurface(challenge.part)
        assert max(surface.mismatch_mm(m, 800) for m in group) < EXACT_MM, name


def test_a_turned_part_is_kept_by_every_turn(parts):
    for name in ("shaft", "sphere_flat"):
        challenge = parts[name]
        point, direction = challenge.continuous_axis
        surface = DenseSurface(challenge.part)
        for angle in (1.1, 77.7, 200.0):
            # sag of the facets: 40 (1 - cos(180 deg / 96)) = 0.02
            assert surface.mismatch_mm(rotation_about(direction, angle, point)) < 0.03, name
    turned = [name for name, part in parts.items() if part.continuous_axis is not None]
    assert turned == ["shaft", "sphere_flat"]


@pytest.mark.parametrize(
    ("name", "angles_deg"),
    [
        ("u_channel", []),
        ("bearing_block", [180]),
        pytest.param("l_bracket_near_equal", [180], marks=pytest.mark.slow),
        pytest.param("box_chamfer", [180, 180, 180], marks=pytest.mark.slow),
    ],
)
def test_near_symmetries_are_found_and_are_not_exact(parts, name, angles_deg):
    challenge = parts[name]
    turns = Rotation.from_matrix(challenge.near_symmetries[:, :3, :3].reshape(-1, 3, 3))
    # a point-to-plane fit of a part to itself turns it by a degree for the feature that differs
    np.testing.assert_allclose(np.degrees(turns.magnitude()), angles_deg, atol=2.5)
    surface = DenseSurface(challenge.part)
    for matrix in challenge.near_symmetries:
        assert EXACT_MM < surface.mismatch_mm(matrix) < 0.02 * challenge.part.radius


@pytest.mark.slow
def test_the_flange_with_one_wider_hole_is_near_every_turn_by_a_hole(parts):
    challenge = parts["flange_odd_hole"]
    near = transforms(challenge.near_symmetries)
    turns = transforms(cyclic(6, np.array([0.0, 0, 1]), challenge.part.center)[1:])
    for turn in turns:
        assert min(challenge.pose_error(turn, n)[0] for n in near) < 1


@pytest.fixture(scope="module")
def truth():
    rotation = Rotation.from_euler("xyz", [20, -35, 140], degrees=True).as_matrix()
    return RigidTransform(rotation, np.array([12.0, -30.0, 240.0]))


@pytest.mark.parametrize("name", ["gear", "box", "elbow", "star_knob", "l_bracket", "shaft"])
def test_pose_error_is_the_disturbance_whichever_symmetric_answer_was_found(parts, truth, name):
    challenge = parts[name]
    center = challenge.part.center
    turn = rotation_about(np.array([0.0, 1.0, 0.0]), 2.0, center)  # for the shaft: across its axis
    disturbance = RigidTransform(np.eye(3), np.array([0.6, 0.0, 0.8])).as_matrix() @ turn
    for symmetry in transforms(challenge.symmetries):
        found = symmetry @ RigidTransform.from_matrix(disturbance) @ truth
        np.testing.assert_allclose(challenge.pose_error(found, truth), (2.0, 1.0), atol=1e-6)


def test_turns_about_a_continuous_axis_are_free_but_a_flip_is_not(parts, truth):
    challenge = parts["shaft"]
    point, direction = challenge.continuous_axis
    for angle in (-170.0, 33.0, 180.0):
        found = RigidTransform.from_matrix(rotation_about(direction, angle, point)) @ truth
        np.testing.assert_allclose(challenge.pose_error(found, truth), 0, atol=1e-6)
        flip = RigidTransform.from_matrix(rotation_about(np.array([1.0, 0, 0]), 180, point))
        assert challenge.pose_error(flip @ found, truth)[0] == pytest.approx(180)
