"""A guide-vane segment: the turbine nozzle part that stands in for the paper's unpublished CAD.

It is built in ring coordinates (axial mm, downstream from the trailing edges; angle about the
engine's axis, radians; radius mm) and delivered in the part's frame: x along the circumference, y
radially outward, z upstream; the origin is the middle of the axis-aligned bounding box.
"""

from __future__ import annotations

import dataclasses
import math

import manifold3d
import numpy as np

from vanejax.cad.airfoil import Airfoil, require_number, require_simple
from vanejax.cad.part import Part, part_from_mesh
from vanejax.errors import InputError

# Facets of this length on the platforms' radius of 300 mm leave a sagitta of 0.003 mm.
_PLATFORM_STEP_MM = 2.5
_FILLET_ROWS = 9
_SPAN_ROWS = 14
# Fillets sink this far into the platform and so cross it at an angle of about 16 deg: a surface
# that only touches it, as an ideal fillet does, has no clear line of intersection.
_FILLET_SUNK_MM = 0.1
# The cuts leave slivers; edges and bumps below this size are merged away.
_SLIVER_MM = 1e-3
# The two ring coordinates in which an airfoil's section and a platform's profile are drawn.
_SECTION, _PROFILE = (0, 1), (0, 2)
_INNER_AIRFOIL = Airfoil(
    axial_chord_mm=33.0,
    tangential_chord_mm=34.5,
    inlet_angle_deg=0.0,
    exit_angle_deg=-69.0,
    inlet_half_wedge_deg=22.0,
    unguided_turning_deg=7.0,
    leading_edge_radius_mm=3.5,
    trailing_edge_radius_mm=0.7,
    throat_mm=10.9,
)
_OUTER_AIRFOIL = dataclasses.replace(
    _INNER_AIRFOIL,
    axial_chord_mm=36.5,
    tangential_chord_mm=40.5,
    exit_angle_deg=-71.0,
    leading_edge_radius_mm=3.7,
    throat_mm=12.1,
)


@dataclasses.dataclass(frozen=True)
class GuideVaneSegment:
    """All sizes of a guide-vane segment; the defaults are a high-pressure turbine's doublet.

    Attributes:
      vanes: number of vanes in the segment, 1 or more.
      vanes_per_ring: number of vanes in the whole ring; it sets the pitch.
      inner_radius_mm: of the inner platform's gas-path surface, a cylinder.
      outer_radius_mm: of the outer platform's gas-path surface at the trailing edges.
      outer_wall_angle_deg: by how much that surface closes in downstream (a cone).
      inner_airfoil: section at the inner platform.
      outer_airfoil: section at the outer platform; every parameter changes linearly along the
        span between the two, which gives twist and taper. Trailing edges are stacked radially.
      fillet_radius_mm: between vane and platform.
      platform_thickness_mm: radial, of both platforms.
      platform_overhang_mm: axial, in front of and behind the longest airfoil.
      slash_angle_deg: of the platforms' ends to the axial direction, along the vanes' stagger.
      segment_gap_mm: between neighbouring segments of the ring.
      rail_thickness_mm: axial, of all rails and radial, of their hooks.
      outer_rail_height_mm: radial, of the two rails on the outer platform.
      hook_length_mm: axial, of the outer rails' hooks, which both point downstream.
      inner_rail_height_mm: radial, of the single rail below the inner platform.
      slot_width_mm: of the anti-rotation slot in the forward outer rail, left of the middle seen
        from upstream with the outer platform on top; 0 for none.
    """

    vanes: int = 2
    vanes_per_ring: int = 54
    inner_radius_mm: float = 275.0
    outer_radius_mm: float = 325.0
    outer_wall_angle_deg: float = 7.0
    inner_airfoil: Airfoil = _INNER_AIRFOIL
    outer_airfoil: Airfoil = _OUTER_AIRFOIL
    fillet_radius_mm: float = 2.5
    platform_thickness_mm: float = 4.0
    platform_overhang_mm: float = 4.0
    slash_angle_deg: float = 38.0
    segment_gap_mm: float = 0.4
    rail_thickness_mm: float = 3.5
    outer_rail_height_mm: float = 10.0
    hook_length_mm: float = 4.5
    inner_rail_height_mm: float = 11.0
    slot_width_mm: float = 7.0

    def __post_init__(self) -> None:
        """Checks every size alone and against its neighbours."""
        for name, low, high in (("vanes", 1, 1000), ("vanes_per_ring", 3, 1000)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise InputError(
                    f"GuideVaneSegment: {name} is {value!r}, but it must be a whole number from "
                    f"{low} to {high}."
                )
        if self.vanes > self.vanes_per_ring // 2:
            raise InputError(
                f"GuideVaneSegment: vanes is {self.vanes}, more than half of vanes_per_ring = "
                f"{self.vanes_per_ring}; a segment spans at most half of the ring."
            )
        for name in ("inner_airfoil", "outer_airfoil"):
            if not isinstance(getattr(self, name), Airfoil):
                raise InputError(f"GuideVaneSegment: {name} must be an Airfoil.")
        for entry in dataclasses.fields(self):
            if entry.name.endswith(("_mm", "_deg")):
                require_number("GuideVaneSegment", entry.name, getattr(self, entry.name), -1e4, 1e4)
        throat = min(self.inner_airfoil.throat_mm, self.outer_airfoil.throat_mm)
        ranges = {
            "inner_radius_mm": (1, 1e4),
            "outer_radius_mm": (self.inner_radius_mm + 1, 1e4),
            "outer_wall_angle_deg": (-30, 30),
            "fillet_radius_mm": (0, 0.45 * throat),
            "platform_thickness_mm": (5 * _FILLET_SUNK_MM, 0.5 * self.inner_radius_mm),
            "platform_overhang_mm": (self.fillet_radius_mm, 1e3),
            "slash_angle_deg": (-75, 75),
            "segment_gap_mm": (0, 0.5 * self.inner_pitch_mm),
            "rail_thickness_mm": (0.1, 0.2 * self.length_mm),
            "outer_rail_height_mm": (2 * self.rail_thickness_mm, 1e3),
            "hook_length_mm": (0, 0.375 * self.length_mm - self.rail_thickness_mm),
            "inner_rail_height_mm": (0.1, 0.5 * self.inner_radius_mm),
            "slot_width_mm": (0, 0.4 * self.inner_pitch_mm),
        }
        for name, (low, high) in ranges.items():
            require_number("GuideVaneSegment", name, getattr(self, name), low, high)
        ends = self.outer_wall_radius_mm(np.array([self.front_mm, self.rear_mm]))
        height, needed = ends.min() - self.inner_radius_mm, 2.5 * self.fillet_radius_mm
        if height <= needed:
            raise InputError(
                f"GuideVaneSegment: the gas path is only {height:.3g} mm high at its lower end, "
                f"but the fillets need more than {needed:.3g} mm; make outer_radius_mm larger."
            )

    @property
    def pitch_rad(self) -> float:
        """Angle between neighbouring vanes in radians."""
        return 2 * math.pi / self.vanes_per_ring

    @property
    def inner_pitch_mm(self) -> float:
        """Distance between neighbours along the inner platform."""
        return self.inner_radius_mm * self.pitch_rad

    @property
    def gap_rad(self) -> float:
        """Angle between neighbouring segments in radians."""
        return self.segment_gap_mm / self.inner_radius_mm

    @property
    def front_mm(self) -> float:
        """Axial place of the platforms' upstream edge, negative."""
        airfoils = (self.inner_airfoil, self.outer_airfoil)
        longest = max(a.axial_chord_mm - a.trailing_edge_radius_mm for a in airfoils)
        return -longest - self.platform_overhang_mm

    @property
    def rear_mm(self) -> float:
        """Axial place of the platforms' downstream edge."""
        airfoils = (self.inner_airfoil, self.outer_airfoil)
        return max(a.trailing_edge_radius_mm for a in airfoils) + self.platform_overhang_mm

    @property
    def length_mm(self) -> float:
        """Axial length of the platforms."""
        return self.rear_mm - self.front_mm

    def outer_wall_radius_mm(self, axial_mm: np.ndarray | float) -> np.ndarray | float:
        """Radius [...] of the outer gas-path surface at axial places [...] in mm."""
        return self.outer_radius_mm - math.tan(math.radians(self.outer_wall_angle_deg)) * axial_mm

    def airfoil_at(self, span: float) -> Airfoil:
        """The section at a fraction of the span, 0 at the inner and 1 at the outer platform."""
        return self.inner_airfoil.toward(self.outer_airfoil, span)


DOUBLET = GuideVaneSegment()
"""Two vanes, 115 x 88 x 45 mm: the part of the default experiments."""


def guide_vane(segment: GuideVaneSegment = DOUBLET) -> Part:
    """Builds the segment as one watertight solid without inner walls.

    The part is in the frame of the module's docstring; the same segment gives the same vertices
    and faces, bit for bit.

    Raises:
      InputError: if an airfoil crosses itself, or a vane does not fit onto its platforms.
    """
    vane = _vane_rings(segment)
    middle = _platform_middle(segment, vane)
    pitches = (np.arange(segment.vanes) - (segment.vanes - 1) / 2) * segment.pitch_rad
    solids = [_loft(vane + np.array([0, pitch, 0]), _SECTION) for pitch in pitches]
    width = segment.vanes * segment.pitch_rad - segment.gap_rad
    inner, outer, rail_slot = _platform_profiles(segment)
    solids += [_swept(segment, profile, middle, width) for profile in (inner, outer)]
    solid = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    if segment.slot_width_mm > 0:
        left = middle - 0.25 * segment.vanes * segment.pitch_rad
        width = segment.slot_width_mm / segment.outer_radius_mm
        solid -= _swept(segment, rail_slot, left, width)
    mesh = solid.simplify(_SLIVER_MM).to_mesh64()
    vertices = np.asarray(mesh.vert_properties)[:, :3]
    vertices = vertices - 0.5 * (vertices.min(0) + vertices.max(0))
    return part_from_mesh(vertices, np.asarray(mesh.tri_verts), name="guide-vane segment")


def _vane_rings(segment: GuideVaneSegment) -> np.ndarray:
    """[S, P, 3] ring coordinates (axial mm, angle, radius mm) of one vane from root to tip.

    Near a platform the section grows outward by a quarter circle, which makes the fillet, and
    goes on with the fillet's full width to the middle of the platform.
    """
    fillet = segment.fillet_radius_mm
    turn = np.linspace(np.pi / 2, 0, _FILLET_ROWS)
    foot = fillet * (1 - np.sin(turn)) - _FILLET_SUNK_MM
    flare = fillet * (1 - np.cos(turn))
    sunk = 0.5 * segment.platform_thickness_mm
    height = segment.outer_radius_mm - segment.inner_radius_mm
    between = np.linspace(foot[-1], height - foot[-1], _SPAN_ROWS + 2)[1:-1]
    if fillet == 0:
        foot, flare = foot[:1], flare[:1]
    above = np.concatenate([[-sunk], foot, between, height - foot[::-1], [height + sunk]])
    grown = np.concatenate([[fillet], flare, np.zeros(_SPAN_ROWS), flare[::-1], [fillet]])
    rings = []
    for place, offset in zip(above, grown, strict=True):
        span = min(max(place / height, 0.0), 1.0)
        radius = segment.inner_radius_mm + span * height
        section = segment.airfoil_at(span).section(radius * segment.pitch_rad)
        contour = section.offset(offset)
        require_simple(contour, f"section at {100 * span:.0f}% of the span with its fillet")
        axial, tangential = contour.T
        # rows between the cylinder inside and the cone outside lean with both
        lean = span * (segment.outer_wall_radius_mm(axial) - segment.outer_radius_mm)
        height_mm = segment.inner_radius_mm + place + lean
        rings.append(np.stack([axial, tangential / radius, height_mm], -1))
    return np.stack(rings)


def _platform_middle(segment: GuideVaneSegment, vane: np.ndarray) -> float:
    """Angle of the platforms' middle at axial 0, so that the vanes stand centred between them."""
    across = vane[..., 1] - _slash(segment, vane[..., 0])
    low, high = across.min(), across.max()
    room = segment.pitch_rad - segment.gap_rad
    if high - low >= room:
        raise InputError(
            f"GuideVaneSegment: along slash_angle_deg = {segment.slash_angle_deg:g} a vane with "
            f"its fillets is {(high - low) * segment.inner_radius_mm:.2f} mm wide, but a pitch "
            f"leaves {room * segment.inner_radius_mm:.2f} mm; choose a slash angle nearer to the "
            f"stagger ({-segment.airfoil_at(0.5).stagger_deg:.0f} deg) or fewer vanes_per_ring."
        )
    return float(0.5 * (low + high))


def _slash(segment: GuideVaneSegment, axial_mm: np.ndarray) -> np.ndarray:
    """Angle by which the platforms' ends are displaced at an axial place.

    Linear in the axial place: neighbours turned by a multiple of the pitch fit without overlap.
    """
    radius = 0.5 * (segment.inner_radius_mm + segment.outer_radius_mm)
    return -math.tan(math.radians(segment.slash_angle_deg)) * axial_mm / radius


def _platform_profiles(segment: GuideVaneSegment) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Polygons [Q, 2] (axial mm, radius mm), counter-clockwise: inner, outer, slot's cutter."""
    front, rear, length = segment.front_mm, segment.rear_mm, segment.length_mm
    thick, rail = segment.platform_thickness_mm, segment.rail_thickness_mm
    hook, tall = segment.hook_length_mm, segment.outer_rail_height_mm

    top = segment.inner_radius_mm
    bottom, lip = top - thick, top - 0.5 * thick
    foot = bottom - segment.inner_rail_height_mm
    at = front + 0.62 * length
    # lips of half thickness at both ends, where the seals of the neighbouring parts overlap
    step = min(0.08 * length, 4.0)
    inner = [
        (front, lip), (front + step, lip), (front + step, bottom), (at, bottom), (at, foot),
        (at + rail, foot), (at + rail, bottom), (rear - step, bottom), (rear - step, lip),
        (rear, lip), (rear, top), (front, top),
    ]  # fmt: skip

    def back(axial: float) -> float:
        """Radius of the outer platform's outer surface."""
        return float(segment.outer_wall_radius_mm(axial)) + thick

    forward, aft = front + 0.12 * length, rear - rail - hook - 0.02 * length
    outer = [(front, back(front) - thick), (rear, back(rear) - thick), (rear, back(rear))]
    crowns = []
    for place in (aft, forward):
        web, tip = place + rail, place + rail + hook
        crown = max(back(place), back(tip)) + tall
        outer += [(web, back(web)), (web, crown - rail)]
        outer += [(tip, crown - rail), (tip, crown)] if hook > 0 else [(web, crown)]
        outer += [(place, crown), (place, back(place))]
        crowns.append(crown)
    outer += [(front, back(front))]
    low, high = crowns[1] - 0.6 * tall, crowns[1] + 1
    left, right = forward - 0.05 * length, forward + rail + hook + 0.05 * length
    slot = [(left, low), (right, low), (right, high), (left, high)]
    return tuple(_subdivide(np.array(p)) for p in (inner, outer, slot))


def _subdivide(polygon: np.ndarray) -> np.ndarray:
    """The same polygon with axial steps of at most the platform's step: ends are helices."""
    points = []
    for start, end in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        count = max(1, math.ceil(abs(end[0] - start[0]) / _PLATFORM_STEP_MM))
        points.append(start + (end - start) * np.linspace(0, 1, count, endpoint=False)[:, None])
    return np.concatenate(points)


def _swept(
    segment: GuideVaneSegment, profile: np.ndarray, middle: float, width: float
) -> manifold3d.Manifold:
    """A profile [Q, 2] turned about the axis by an angle ``width`` between two slashed ends."""
    first, last = middle - width / 2, middle + width / 2
    steps = math.ceil((last - first) * segment.outer_radius_mm / _PLATFORM_STEP_MM)
    angles = np.linspace(first, last, steps + 1)
    axial, radius = profile.T
    turned = angles[:, None] + _slash(segment, axial)
    return _loft(np.stack(np.broadcast_arrays(axial, turned, radius), -1), _PROFILE)


def _loft(rings: np.ndarray, flat: tuple[int, int]) -> manifold3d.Manifold:
    """The solid, in x, y, z about the engine's axis, whose skin joins rings [S, P, 3].

    ``flat`` names the two ring coordinates in which the first and the last ring are simple
    polygons, counter-clockwise; their triangles close the ends.
    """
    stations, count, _ = rings.shape
    axial, angle, radius = np.moveaxis(rings, -1, 0)
    vertices = np.stack([radius * np.sin(angle), radius * np.cos(angle), -axial], -1)
    corner = np.arange(count)
    after = np.roll(corner, -1)
    rows = count * np.arange(stations - 1)[:, None]
    quads = np.stack([rows + corner, rows + after, rows + count + after, rows + count + corner], -1)
    # angles are in radians: at the size of the ring they are as long as the axial coordinates
    scaled = rings * [1.0, radius.mean(), 1.0]
    ends = [manifold3d.triangulate([scaled[i][:, flat]]) for i in (0, -1)]
    faces = np.concatenate(
        [
            quads[..., [0, 1, 2]].reshape(-1, 3),
            quads[..., [0, 2, 3]].reshape(-1, 3),
            ends[0][:, ::-1],
            ends[1] + count * (stations - 1),
        ]
    )
    # (axial, angle, radius) -> (x, y, z) mirrors; so does reading a profile as (axial, radius)
    if flat == _SECTION:
        faces = faces[:, ::-1]
    return manifold3d.Manifold(manifold3d.Mesh64(vertices.reshape(-1, 3), faces.astype(np.uint64)))
