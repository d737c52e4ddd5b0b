"""Airfoil sections: Pritchard's parameters are found again on the contour."""

from __future__ import annotations

import dataclasses
import math

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.spatial
from matplotlib.path import Path

from vanejax.cad.airfoil import Airfoil, Section, require_simple
from vanejax.errors import InputError

PITCH_MM = 36.0
AIRFOIL = Airfoil(
    axial_chord_mm=36.0,
    tangential_chord_mm=39.0,
    inlet_angle_deg=5.0,
    exit_angle_deg=-70.0,
    inlet_half_wedge_deg=22.0,
    unguided_turning_deg=7.0,
    leading_edge_radius_mm=3.7,
    trailing_edge_radius_mm=0.7,
    throat_mm=12.0,
)


# indices into the contour: suction side, leading edge, pressure side, trailing edge
LEADING_EDGE = np.arange(62, 81)
TRAILING_EDGE = np.append(np.arange(128, 138), 0)


@pytest.fixture(scope="module")
def section() -> Section:
    return AIRFOIL.section(PITCH_MM)


def fit_circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Algebraic least squares of x^2 + y^2 = 2 x a + 2 y b + c."""
    rows = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    a, b, c = np.linalg.lstsq(rows, np.sum(points**2, -1), rcond=None)[0]
    return np.array([a, b]), math.sqrt(c + a**2 + b**2)


def dense(contour: np.ndarray, count: int = 40_000) -> np.ndarray:
    """Points along the closed polygon, equally spaced."""
    closed = np.concatenate([contour, contour[:1]])
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.linspace(0, length[-1], count, endpoint=False)
    return np.stack([np.interp(at, length, closed[:, i]) for i in (0, 1)], -1)


def test_edges_are_circles_of_the_given_radii_and_places(section: Section) -> None:
    leading, radius = fit_circle(section.contour_mm[LEADING_EDGE])
    # the points lie on the circles to rounding
    assert radius == pytest.approx(AIRFOIL.leading_edge_radius_mm, abs=1e-9)
    trailing, radius = fit_circle(section.contour_mm[TRAILING_EDGE])
    assert radius == pytest.approx(AIRFOIL.trailing_edge_radius_mm, abs=1e-9)
    np.testing.assert_allclose(trailing, [0, 0], atol=1e-9)
    assert leading[1] == pytest.approx(AIRFOIL.tangential_chord_mm, abs=1e-9)


def test_chords_and_stagger(section: Section) -> None:
    leading, _ = fit_circle(section.contour_mm[LEADING_EDGE])
    # the outermost point may lie half a step (0.15 rad at most) beside the vertex: r (1 - cos)
    assert np.ptp(section.contour_mm[:, 0]) == pytest.approx(AIRFOIL.axial_chord_mm, abs=0.03)
    assert math.degrees(math.atan2(leading[1], leading[0])) == pytest.approx(
        180 + AIRFOIL.stagger_deg, abs=1e-9
    )


def test_metal_angles_and_wedges(section: Section) -> None:
    """The mean direction of both sides at an edge is the metal angle, half the difference wedge."""
    leading, trailing = LEADING_EDGE, TRAILING_EDGE
    angle = np.degrees(np.arctan2(section.normals[:, 1], section.normals[:, 0]))
    suction, pressure = angle[leading[0]] - 90, angle[leading[-1]] + 90
    assert (suction + pressure) / 2 == pytest.approx(AIRFOIL.inlet_angle_deg, abs=1e-9)
    assert (suction - pressure) / 2 == pytest.approx(AIRFOIL.inlet_half_wedge_deg, abs=1e-9)
    suction, pressure = angle[trailing[-1]] - 90, (angle[trailing[0]] + 90 + 180) % 360 - 180
    assert (suction + pressure) / 2 == pytest.approx(AIRFOIL.exit_angle_deg, abs=1e-9)


def test_normals_are_those_of_the_contour(section: Section) -> None:
    """On a curve whose tangent has no jump, a chord's normal is the mean of its ends' normals."""
    chord = np.roll(section.contour_mm, -1, axis=0) - section.contour_mm
    expected = np.stack([chord[:, 1], -chord[:, 0]], -1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    mean = section.normals + np.roll(section.normals, -1, axis=0)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    # exact on arcs; on a cubic of 1 mm steps the third derivative costs below 0.01 rad
    np.testing.assert_allclose(mean, expected, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(section.normals, axis=1), 1, rtol=1e-12)


def test_throat_is_the_neighbours_smallest_distance(section: Section) -> None:
    """Pritchard's throat: from the neighbour's trailing-edge circle to the suction side."""
    neighbour = np.array([0.0, PITCH_MM])
    nearest = np.linalg.norm(dense(section.contour_mm) - neighbour, axis=1).min()
    # sagitta of the facets, 0.006 mm
    assert nearest - AIRFOIL.trailing_edge_radius_mm == pytest.approx(AIRFOIL.throat_mm, abs=0.006)
    # and no place of the passage is narrower
    passage = scipy.spatial.cKDTree(section.contour_mm + neighbour).query(section.contour_mm)[0]
    assert passage.min() > AIRFOIL.throat_mm - 0.006


def test_facets_are_fine(section: Section) -> None:
    step = np.linalg.norm(np.roll(section.contour_mm, -1, axis=0) - section.contour_mm, axis=1)
    cosine = np.sum(section.normals * np.roll(section.normals, -1, axis=0), axis=1)
    sagitta = step * np.arccos(np.clip(cosine, -1, 1)) / 8  # of an arc: chord times turning / 8
    assert sagitta.max() < 0.02
    assert step.min() > 0.05  # and no facet collapses


def test_offset_moves_every_side_out_by_the_distance(section: Section) -> None:
    distance, _ = scipy.spatial.cKDTree(dense(section.contour_mm)).query(section.offset(2.0))
    np.testing.assert_allclose(distance, 2.0, atol=0.01)  # sagitta of the facets
    assert not Path(section.contour_mm).contains_points(section.offset(2.0)).any()


def test_toward_blends_every_parameter() -> None:
    other = dataclasses.replace(AIRFOIL, axial_chord_mm=40.0, exit_angle_deg=-72.0)
    assert AIRFOIL.toward(other, 0) == AIRFOIL
    assert AIRFOIL.toward(other, 1) == other
    between = AIRFOIL.toward(other, 0.25)
    assert (between.axial_chord_mm, between.exit_angle_deg) == (37.0, -70.5)


@hypothesis.settings(max_examples=60, deadline=None, derandomize=True)
@hypothesis.given(
    st.floats(0.05, 20),
    st.floats(0.9, 1.05),
    st.fixed_dictionaries(
        {
            "exit_angle_deg": st.floats(-76, -60),
            "inlet_angle_deg": st.floats(-20, 20),
            "inlet_half_wedge_deg": st.floats(8, 30),
            "unguided_turning_deg": st.floats(1, 15),
        }
    ),
)
def test_section_scales_with_its_lengths(scale: float, blockage: float, angles: dict) -> None:
    """Any parameters make a simple contour or an error; all lengths times s: contour times s."""
    throat = PITCH_MM * math.cos(math.radians(angles["exit_angle_deg"])) * blockage
    airfoil = dataclasses.replace(AIRFOIL, **angles, throat_mm=throat)
    try:
        section = airfoil.section(PITCH_MM)
    except InputError:
        hypothesis.assume(False)
    require_simple(section.contour_mm, "it")
    names = [f.name for f in dataclasses.fields(airfoil) if f.name.endswith("_mm")]
    larger = dataclasses.replace(airfoil, **{n: scale * getattr(airfoil, n) for n in names})
    np.testing.assert_allclose(
        larger.section(scale * PITCH_MM).contour_mm,
        scale * section.contour_mm,
        atol=1e-8 * scale,  # the wedge is solved to 1e-13 rad; f64 elsewhere
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axial_chord_mm": 0.0}, "axial_chord_mm is 0"),
        ({"throat_mm": -1.0}, "throat_mm is -1"),
        ({"trailing_edge_radius_mm": float("nan")}, "trailing_edge_radius_mm is nan"),
        ({"tangential_chord_mm": float("inf")}, "tangential_chord_mm is inf"),
        ({"exit_angle_deg": 70.0}, "from -85 to -10"),
        ({"inlet_angle_deg": "0"}, "inlet_angle_deg is '0'"),
        ({"inlet_half_wedge_deg": True}, "inlet_half_wedge_deg is True"),
        ({"leading_edge_radius_mm": 18.0}, "do not fit into axial_chord_mm"),
        ({"throat_mm": 30.0}, "try throat_mm near 12.3"),
        ({"axial_chord_mm": 14.0}, "must lie downstream"),
        ({"tangential_chord_mm": 80.0, "inlet_half_wedge_deg": 5.0}, "crosses itself near"),
    ],
)
def test_impossible_airfoils_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        dataclasses.replace(AIRFOIL, **changes).section(PITCH_MM)


def test_a_folded_offset_and_a_clockwise_contour_are_refused(section: Section) -> None:
    with pytest.raises(InputError, match="the vane crosses itself"):
        require_simple(section.offset(-5.0), "the vane")  # thinner than that at the rear
    with pytest.raises(InputError, match="the vane crosses itself"):
        require_simple(section.contour_mm[::-1], "the vane")
