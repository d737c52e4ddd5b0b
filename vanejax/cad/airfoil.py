"""Turbine airfoil sections by Pritchard's eleven-parameter model (ASME 85-GT-219, 1985).

The plane of a section is the unrolled cylinder: axial (downstream), then tangential, to which the
suction side faces. The origin is the centre of the trailing edge's circle. Angles are metal angles
from the axial direction, positive towards positive tangential.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
from typing import NamedTuple

import numpy as np
import scipy.optimize

from vanejax.errors import InputError

# Points per piece of the contour: at a chord of 50 mm every facet's sagitta is below 0.01 mm.
_SUCTION_ARC, _SUCTION_CUBIC, _LEADING_EDGE, _PRESSURE_CUBIC, _TRAILING_EDGE = 18, 44, 18, 48, 10


def require_number(owner: str, field: str, value: object, low: float, high: float) -> None:
    """Raises `InputError` for a value that is no number from ``low`` to ``high``."""
    number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not number or not low <= value <= high:
        raise InputError(
            f"{owner}: {field} is {value!r}, but it must be a number from {low:g} to {high:g}."
        )


class Section(NamedTuple):
    """The closed contour of one airfoil.

    Attributes:
      contour_mm: [P, 2] f64, mm (axial, tangential), counter-clockwise from the suction side's
        trailing-edge tangency: suction side, leading edge, pressure side, trailing edge.
      normals: [P, 2] f64 unit, outward, of the exact curves.
    """

    contour_mm: np.ndarray
    normals: np.ndarray

    def offset(self, distance_mm: float) -> np.ndarray:
        """The contour [P, 2] in mm moved outward by ``distance_mm`` along its normals."""
        return self.contour_mm + distance_mm * self.normals


@dataclasses.dataclass(frozen=True)
class Airfoil:
    """The parameters of one section; signs as in the module's docstring.

    Attributes:
      axial_chord_mm: axial length from the leading edge's foremost to the trailing edge's last
        point.
      tangential_chord_mm: tangential distance between the centres of the two edges' circles; with
        the axial chord it is the stagger.
      inlet_angle_deg: metal angle at the leading edge.
      exit_angle_deg: metal angle at the trailing edge, negative.
      inlet_half_wedge_deg: half of the angle between both sides where they leave the leading edge.
      unguided_turning_deg: turning of the suction side behind the throat.
      leading_edge_radius_mm: radius of the leading edge.
      trailing_edge_radius_mm: radius of the trailing edge.
      throat_mm: smallest width of the passage between two neighbours.
    """

    axial_chord_mm: float
    tangential_chord_mm: float
    inlet_angle_deg: float
    exit_angle_deg: float
    inlet_half_wedge_deg: float
    unguided_turning_deg: float
    leading_edge_radius_mm: float
    trailing_edge_radius_mm: float
    throat_mm: float

    def __post_init__(self) -> None:
        """Checks each parameter alone; `section` checks what they make together."""
        ranges = {
            "inlet_angle_deg": (-80, 80),
            "exit_angle_deg": (-85, -10),
            "inlet_half_wedge_deg": (0.1, 60),
            "unguided_turning_deg": (0.1, 40),
        }
        for field in dataclasses.fields(self):
            low, high = ranges.get(field.name, (1e-3, 1e4))
            require_number("Airfoil", field.name, getattr(self, field.name), low, high)
        edges = 2 * (self.leading_edge_radius_mm + self.trailing_edge_radius_mm)
        if edges >= self.axial_chord_mm:
            raise InputError(
                f"Airfoil: the circles of both edges ({edges:g} mm) do not fit into axial_chord_mm "
                f"= {self.axial_chord_mm:g}; make leading_edge_radius_mm smaller."
            )

    @property
    def stagger_deg(self) -> float:
        """Angle of the line from the leading to the trailing edge's centre, negative."""
        edges = self.leading_edge_radius_mm + self.trailing_edge_radius_mm
        return -math.degrees(math.atan2(self.tangential_chord_mm, self.axial_chord_mm - edges))

    def toward(self, other: Airfoil, fraction: float) -> Airfoil:
        """The airfoil whose parameters lie at ``fraction`` (0 self, 1 other) between the two."""
        pairs = zip(dataclasses.astuple(self), dataclasses.astuple(other), strict=True)
        return Airfoil(*((1 - fraction) * a + fraction * b for a, b in pairs))

    def section(self, pitch_mm: float) -> Section:
        """The contour of this airfoil in a row with the given tangential spacing.

        The suction side is a circular arc from the trailing edge to the throat and a cubic from
        there to the leading edge, the pressure side one cubic; all pieces meet with one tangent.

        Args:
          pitch_mm: tangential distance between neighbours, 2 pi radius / number of blades.

        Raises:
          InputError: if no airfoil has these parameters together, or one that crosses itself.
        """
        require_number("Airfoil.section", "pitch_mm", pitch_mm, 1e-3, 1e4)
        wedge = self._exit_half_wedge(pitch_mm)
        beta = np.radians([self.inlet_angle_deg, self.exit_angle_deg])
        inlet_wedge = math.radians(self.inlet_half_wedge_deg)
        throat_angle = beta[1] - wedge + math.radians(self.unguided_turning_deg)
        le_radius, te_radius = self.leading_edge_radius_mm, self.trailing_edge_radius_mm
        le_center = [le_radius + te_radius - self.axial_chord_mm, self.tangential_chord_mm]

        arc_angles = np.linspace(beta[1] - wedge, throat_angle, _SUCTION_ARC + 1)
        suction_end = te_radius * _direction(arc_angles[0] + math.pi / 2)
        throat = self._throat_point(pitch_mm, throat_angle)
        length = np.linalg.norm(throat - suction_end)
        arc_radius = length / (2 * math.sin(math.radians(self.unguided_turning_deg) / 2))
        arc_normals = _direction(arc_angles + math.pi / 2)
        arc = suction_end + arc_radius * (arc_normals - arc_normals[:1])

        first, last = math.pi / 2 + beta[0] + inlet_wedge, 1.5 * math.pi + beta[0] - inlet_wedge
        le_normals = _direction(np.linspace(first, last, _LEADING_EDGE + 1))
        leading = le_center + le_radius * le_normals
        first, last = beta[1] + wedge - math.pi / 2, beta[1] - wedge + math.pi / 2
        te_normals = _direction(np.linspace(first, last, _TRAILING_EDGE + 1))
        trailing = te_radius * te_normals
        if throat[0] <= leading[0, 0] or trailing[0, 0] <= leading[-1, 0]:
            raise InputError(
                f"Airfoil: the throat lies {throat[0] - leading[0, 0]:.3g} mm behind the leading "
                "edge's suction tangency, but it must lie downstream of it; make axial_chord_mm "
                "larger or throat_mm smaller."
            )
        inlet, outlet = beta[0] + inlet_wedge * np.array([1, -1]), beta[1] + wedge
        upper, above = _cubic(leading[0], inlet[0], throat, throat_angle, _SUCTION_CUBIC)
        lower, below = _cubic(leading[-1], inlet[1], trailing[0], outlet, _PRESSURE_CUBIC)
        pieces = [
            (arc, arc_normals),
            (upper[::-1], above[::-1]),
            (leading, le_normals),
            (lower, -below),
            (trailing, te_normals),
        ]
        contour = np.concatenate([points[:-1] for points, _ in pieces])
        normals = np.concatenate([directions[:-1] for _, directions in pieces])
        require_simple(contour, str(self))
        return Section(contour, normals)

    def _throat_point(self, pitch_mm: float, throat_angle: float) -> np.ndarray:
        """[2] mm: where the passage is narrowest, seen from the neighbour's trailing edge."""
        reach = self.throat_mm + self.trailing_edge_radius_mm
        return np.array([0.0, pitch_mm]) - reach * _direction(throat_angle + math.pi / 2)

    def _exit_half_wedge(self, pitch_mm: float) -> float:
        """Radians, such that a circular arc is tangent at both ends of the unguided suction side.

        An arc's chord has the mean of its end tangents' directions.
        """
        turning, exit_angle = np.radians([self.unguided_turning_deg, self.exit_angle_deg])

        def mismatch(wedge: float) -> float:
            end = self.trailing_edge_radius_mm * _direction(exit_angle - wedge + math.pi / 2)
            chord = end - self._throat_point(pitch_mm, exit_angle - wedge + turning)
            return math.atan2(chord[1], chord[0]) - (exit_angle - wedge + turning / 2)

        low, high = 0.0, math.radians(30)
        if mismatch(low) * mismatch(high) > 0:
            suggested = pitch_mm * math.cos(exit_angle)
            raise InputError(
                f"Airfoil: no trailing-edge wedge between 0 and 30 deg fits throat_mm = "
                f"{self.throat_mm:g} at a pitch of {pitch_mm:.4g} mm, exit_angle_deg = "
                f"{self.exit_angle_deg:g} and unguided_turning_deg = "
                f"{self.unguided_turning_deg:g}; try throat_mm near {suggested:.3g}."
            )
        return float(scipy.optimize.brentq(mismatch, low, high, xtol=1e-13))


def require_simple(contour_mm: np.ndarray, name: str) -> None:
    """Raises `InputError` for a closed polygon [P, 2] that crosses itself or runs clockwise."""
    start, end = contour_mm, np.roll(contour_mm, -1, axis=0)
    along = end - start

    def side(points: np.ndarray) -> np.ndarray:
        """[P, P]: on which side of edge i the point j lies."""
        offset = points[None] - start[:, None]
        return np.sign(along[:, None, 0] * offset[..., 1] - along[:, None, 1] * offset[..., 0])

    straddles = side(start) * side(end) < 0
    crossing = np.argwhere(straddles & straddles.T)
    area = 0.5 * np.sum(start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0])
    if len(crossing) or area <= 0:
        where = start[crossing[0, 0]] if len(crossing) else start.mean(0)
        raise InputError(
            f"The contour of {name} crosses itself near axial {where[0]:.2f} mm, tangential "
            f"{where[1]:.2f} mm (from the trailing edge's centre): its thickness is not positive "
            "there; make its chords larger, or its radii, its wedges or the fillet smaller."
        )


def _direction(angle: np.ndarray | float) -> np.ndarray:
    """Unit vectors [..., 2] at an angle in radians."""
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def _cubic(
    start: np.ndarray, start_angle: float, end: np.ndarray, end_angle: float, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points and upward normals [count + 1, 2] of Pritchard's cubic tangential(axial).

    They are equally spaced in a mixture of arc length and turning, so that flat stretches keep
    some points and bends get most.
    """
    width = end[0] - start[0]
    slopes = np.tan([start_angle, end_angle])
    rise = (end[1] - start[1]) / width
    # Hermite form in u = (axial - start) / width: exact at both ends
    height = np.polynomial.Polynomial(
        [0, slopes[0], 3 * rise - 2 * slopes[0] - slopes[1], slopes[0] + slopes[1] - 2 * rise]
    )
    u = np.linspace(0, 1, 2001)
    slope = height.deriv()(u)
    angle = np.arctan(slope)
    stretch, turning = np.hypot(1, slope)[1:], np.abs(np.diff(angle))
    step = stretch / stretch.sum() + 0.5 * turning / max(turning.sum(), 1e-12)
    knots = np.concatenate([[0], np.cumsum(step)])
    u = np.interp(np.linspace(0, knots[-1], count + 1), knots, u)
    points = np.stack([start[0] + width * u, start[1] + width * height(u)], -1)
    points[-1] = end
    return points, _direction(np.arctan(height.deriv()(u)) + math.pi / 2)
