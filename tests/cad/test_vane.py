"""The guide-vane segment: one solid of the right size, in its frame, for many parameters."""

from __future__ import annotations

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.optimize
import scipy.spatial

from vanejax.cad import Part
from vanejax.cad.parametric_vane import DOUBLET, GuideVaneSegment, guide_vane
from vanejax.errors import InputError

FOLDED = dataclasses.replace(
    DOUBLET.outer_airfoil, tangential_chord_mm=90.0, inlet_half_wedge_deg=5.0
)


@pytest.fixture(scope="module")
def part() -> Part:
    return guide_vane()


def engine_axis(part: Part, segment: GuideVaneSegment) -> np.ndarray:
    """[2] x and y in mm of the engine's axis in the part's frame: the foot of the inner rail lies
    on a cylinder of known radius about it.
    """
    radius = segment.inner_radius_mm - segment.platform_thickness_mm - segment.inner_rail_height_mm
    vertices = part.mesh.vertices[:, :2]
    sagitta = radius * (1 - math.cos(segment.vanes * math.pi / segment.vanes_per_ring * 1.5))
    low = vertices[vertices[:, 1] < vertices[:, 1].min() + sagitta]
    start = [0.0, low[:, 1].max() - radius]
    fit = scipy.optimize.least_squares(
        lambda axis: np.linalg.norm(low - axis, axis=1) - radius, start, xtol=1e-12
    )
    assert np.abs(fit.fun).max() < 1e-3  # or these vertices are not the foot
    return fit.x


def test_is_one_watertight_solid(part: Part) -> None:
    assert part.mesh.is_watertight
    assert part.mesh.is_winding_consistent
    assert part.mesh.body_count == 1
    assert part.notes == ()  # nothing had to be repaired
    # the gas passages go through: one between the two vanes, none elsewhere (V - E + F = 2 - 2g)
    assert part.mesh.euler_number == 0


def test_has_no_inner_walls(part: Part) -> None:
    """Just outside of every face is air, just inside is metal (parity of rays)."""
    points, normals, _ = part.sample(4000, seed=0)
    step_mm = 0.02
    # 1 in 1000: points nearer than the step to an edge of the obtuse foot of a fillet
    assert np.mean(part.mesh.contains(points + step_mm * normals)) < 1e-3
    assert np.mean(part.mesh.contains(points - step_mm * normals)) > 1 - 1e-3


def test_facets_are_fine_and_not_degenerate(part: Part) -> None:
    assert 20_000 < len(part.mesh.faces) < 100_000
    assert part.mesh.area_faces.min() > 0
    edges = np.diff(part.mesh.triangles[:, [0, 1, 2, 0]], axis=1)
    longest = np.linalg.norm(edges, axis=2).max(1)
    slender = 2 * part.mesh.area_faces / longest < 1e-3
    # what remains of the cuts' slivers is too small for a ray or a sample to meet
    assert part.mesh.area_faces[slender].sum() < 1e-5 * part.mesh.area


def test_frame_leading_edges_up_the_engine_and_outer_platform_up(part: Part) -> None:
    cut = part.mesh.section(plane_origin=[0, 0, 0], plane_normal=[0, 1, 0])
    assert len(cut.discrete) == DOUBLET.vanes
    for loop in cut.discrete:
        np.testing.assert_array_equal(loop[0], loop[-1])
        x, z = loop[:-1, 0], loop[:-1, 2]
        moment = x * np.roll(z, -1) - np.roll(x, -1) * z
        centroid = np.sum((z + np.roll(z, -1)) * moment) / (3 * np.sum(moment))
        assert centroid > (z.min() + z.max()) / 2 + 1  # the thick end is upstream
        leading, trailing = loop[loop[:, 2].argmax()], loop[loop[:, 2].argmin()]
        assert leading[0] > trailing[0] + 20  # x: turned by the stagger
    x, y = part.mesh.vertices[:, 0], part.mesh.vertices[:, 1]
    assert np.ptp(x[y > 25]) > np.ptp(x[y < -25]) + 5  # a ring grows with its radius


@pytest.mark.parametrize("span", [0.2, 0.5, 0.8])
def test_surface_is_the_airfoils(part: Part, span: float) -> None:
    """Through loft, union, rounding and recentring the sections stay where their formulas say."""
    segment = DOUBLET
    radius = segment.inner_radius_mm * (1 - span) + segment.outer_radius_mm * span
    section = segment.airfoil_at(span).section(radius * segment.pitch_rad)
    axis = engine_axis(part, segment)
    rear = part.mesh.vertices[:, 2].min() + segment.rear_mm  # z of axial 0
    for vane in (-0.5, 0.5):
        for outward_mm in (-0.03, 0.03):  # facets 0.01, blending along the span 0.01
            axial, tangential = section.offset(outward_mm).T
            angle = tangential / radius + vane * segment.pitch_rad
            lean = span * (segment.outer_wall_radius_mm(axial) - segment.outer_radius_mm)
            x, y = (radius + lean) * np.sin(angle), (radius + lean) * np.cos(angle)
            points = np.stack([x + axis[0], y + axis[1], rear - axial], -1)
            assert (part.mesh.contains(points) == (outward_mm < 0)).all()


@pytest.mark.parametrize(
    "change",
    [np.diag([-1, -1, 1]), np.diag([1, -1, -1]), np.diag([-1, 1, -1]), np.diag([-1, 1, 1])],
)
def test_is_far_from_symmetric(part: Part, change: np.ndarray) -> None:
    points, _, _ = part.sample(20_000, seed=0)
    other, _, _ = part.sample(4_000, seed=1)
    tree = scipy.spatial.cKDTree(points)
    assert np.mean(tree.query(other)[0]) < 1  # spacing of the samples: sqrt(area / N) / 2 = 0.6
    assert np.mean(tree.query(other @ change)[0]) > 3


def test_same_segment_same_bits(part: Part) -> None:
    assert guide_vane(GuideVaneSegment()).sha256 == part.sha256
    code = "from vanejax.cad.parametric_vane import guide_vane; print(guide_vane().sha256)"
    other = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONHASHSEED": "7"},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=True,
    )
    assert other.stdout.strip() == part.sha256
    assert guide_vane(GuideVaneSegment(fillet_radius_mm=2.4)).sha256 != part.sha256


def test_neighbours_in_the_ring_do_not_overlap(part: Part) -> None:
    """Turned by its own width about the engine's axis, a segment leaves the gap to itself."""
    axis = engine_axis(part, DOUBLET)
    points, _, _ = part.sample(20_000, seed=0)

    def overlaps(angle: float) -> bool:
        c, s = math.cos(angle), math.sin(angle)
        turned = (points[:, :2] - axis) @ np.array([[c, -s], [s, c]]) + axis
        return part.mesh.contains(np.concatenate([turned, points[:, 2:]], axis=1)).any()

    width, gap = DOUBLET.vanes * DOUBLET.pitch_rad, DOUBLET.segment_gap_mm / DOUBLET.inner_radius_mm
    assert not overlaps(width)
    assert not overlaps(width - 0.8 * gap)
    assert overlaps(width - 1.2 * gap)


@pytest.mark.slow
@hypothesis.settings(max_examples=15, deadline=None, derandomize=True)
@hypothesis.given(
    st.fixed_dictionaries(
        {
            "vanes": st.integers(1, 4),
            "vanes_per_ring": st.integers(44, 60),
            "outer_radius_mm": st.floats(300, 345),
            "fillet_radius_mm": st.floats(0, 3.5),
            "slash_angle_deg": st.floats(36, 46),
            "outer_wall_angle_deg": st.floats(-12, 12),
            "platform_thickness_mm": st.floats(1, 6),
            "rail_thickness_mm": st.floats(1, 4.5),
            "hook_length_mm": st.floats(0, 8),
        }
    )
)
def test_any_segment_is_a_solid_or_refused(sizes: dict) -> None:
    try:
        part = guide_vane(GuideVaneSegment(**sizes))
    except InputError:
        return  # three of four are built
    assert part.mesh.is_watertight
    assert part.mesh.body_count == 1
    assert part.mesh.volume > 0
    assert part.mesh.euler_number == 2 - 2 * (sizes["vanes"] - 1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vanes": 0}, "vanes is 0"),
        ({"vanes": 2.0}, "must be a whole number"),
        ({"vanes": 40}, "more than half of vanes_per_ring"),
        ({"inner_radius_mm": float("nan")}, "inner_radius_mm is nan"),
        ({"outer_radius_mm": 200.0}, "outer_radius_mm is 200.0, but it must be a number from 276"),
        ({"outer_radius_mm": "325"}, "outer_radius_mm is '325'"),
        ({"fillet_radius_mm": 6.0}, "fillet_radius_mm"),
        ({"platform_overhang_mm": 1.0}, "platform_overhang_mm"),
        ({"platform_thickness_mm": -4.0}, "platform_thickness_mm"),
        ({"hook_length_mm": 30.0}, "hook_length_mm"),
        ({"slot_width_mm": 50.0}, "slot_width_mm"),
        ({"outer_radius_mm": 280.0}, "gas path is only"),
        ({"slash_angle_deg": 0.0}, "slash angle nearer to the stagger"),
        ({"vanes_per_ring": 90}, "throat_mm"),
        ({"inner_airfoil": None}, "inner_airfoil must be an Airfoil"),
        ({"outer_airfoil": FOLDED}, "crosses itself"),
    ],
)
def test_impossible_segments_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        guide_vane(GuideVaneSegment(**changes))
