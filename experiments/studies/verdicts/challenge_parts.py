"""Parametric industrial parts, exactly and nearly symmetric ones among them, to try poses on.

Turned features have 96 or 120 segments, so that every 15 deg turn (and every 5-fold or 6-fold one)
maps facets to facets and an exact symmetry of the design is one of the triangles too.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold

from vanejax.cad import Part, part_from_mesh
from vanejax.cad.parametric_vane import DOUBLET, GuideVaneSegment, guide_vane
from vanejax.cad.symmetry import Axis, cyclic, dihedral, near_symmetries, pose_error, rotation_about
from vanejax.errors import InputError
from vanejax.rigid import RigidTransform

X, Y, Z = np.eye(3)
SEGMENTS = 96
ONLY_IDENTITY = cyclic(1, Z)
VANE = "vane_2"
QUARTET = GuideVaneSegment(
    vanes=4, vanes_per_ring=50, inner_radius_mm=255.0, outer_radius_mm=298.0, slot_width_mm=5.0
)
# and by how many pitches some of the vanes fall onto their neighbours
OFF_AXIS_MM = 0.5
VANES = {VANE: (DOUBLET, (-1, 1)), "vane_4": (QUARTET, (-2, -1, 1, 2))}


@dataclasses.dataclass(frozen=True, eq=False)
class ChallengePart:
    """A part with all its right answers.

    Attributes:
      part: the solid; its frame is not centred, as in most CAD files.
      symmetries: [S, 4, 4] f64, mm, part frame: every proper motion that maps the surface to
        itself, the identity first (to be combined with all turns about `continuous_axis`).
      continuous_axis: point [3] mm and unit direction [3] for a turned part, else None.
      also_tried: [K, 4, 4] motions that `near_symmetries` should try beyond its own.
    """

    part: Part
    symmetries: np.ndarray
    continuous_axis: Axis | None = None
    also_tried: np.ndarray = dataclasses.field(default_factory=lambda: np.empty((0, 4, 4)))

    @functools.cached_property
    def near_symmetries(self) -> np.ndarray:
        """[M, 4, 4] f64: see `vanejax.cad.symmetry.near_symmetries`.

        Sought on first use (0.5 to 5 s; the sphere 20 s).
        """
        return near_symmetries(
            self.part, self.symmetries, continuous_axis=self.continuous_axis, more=self.also_tried
        )

    def pose_error(
        self, part_from_camera: RigidTransform, truth: RigidTransform
    ) -> tuple[float, float]:
        """Degrees and mm to the nearest right pose: `vanejax.cad.symmetry.pose_error`."""
        return pose_error(
            part_from_camera,
            truth,
            self.symmetries,
            center=self.part.center,
            radius_mm=self.part.radius,
            continuous_axis=self.continuous_axis,
        )


class Design(NamedTuple):
    """A solid about its own origin, before it gets its place in the CAD frame."""

    solid: Manifold
    symmetries: np.ndarray = ONLY_IDENTITY
    axis: np.ndarray | None = None


def challenge_parts(names: Iterable[str] | None = None) -> dict[str, ChallengePart]:
    """The parts by name, all or those named; the same bits in every call.

    `VANE` is not one of all: the guide vane of the other experiments.

    Raises:
      InputError: a name that is neither `VANE` nor one of `names_of_parts()`.
    """
    wanted = names_of_parts() if names is None else tuple(names)
    unknown = sorted(set(wanted) - {VANE, *names_of_parts()})
    if unknown:
        raise InputError(f"no challenge part {unknown}; there are {names_of_parts()}")
    return {name: _vanes(*VANES[name]) if name in VANES else _placed(name) for name in wanted}


def names_of_parts() -> tuple[str, ...]:
    """Every name, in a fixed order."""
    return (*_designs(), "vane_4")


def _placed(name: str) -> ChallengePart:
    """The design moved to a place away from the origin, as CAD models have it."""
    design = _designs()[name]()
    mesh = design.solid.simplify(1e-4).to_mesh64()
    shift = np.round(np.random.default_rng(list(name.encode())).uniform(-60, 60, 3))
    vertices = np.asarray(mesh.vert_properties)[:, :3] + shift
    there, back = np.eye(4), np.eye(4)
    there[:3, 3], back[:3, 3] = shift, -shift
    return ChallengePart(
        part=part_from_mesh(vertices, np.asarray(mesh.tri_verts), name=name),
        symmetries=there @ design.symmetries @ back,
        continuous_axis=None if design.axis is None else (shift, design.axis),
    )


def _vanes(segment: GuideVaneSegment, pitches: tuple[int, ...]) -> ChallengePart:
    """Guide vanes; so many pitches on, some of them fall onto their neighbours."""
    part = guide_vane(segment)
    angles = np.degrees(segment.pitch_rad) * np.array(pitches)
    also = [rotation_about(Z, angle, _engine_axis(part)) for angle in angles]
    return ChallengePart(part=part, symmetries=ONLY_IDENTITY, also_tried=np.stack(also))


def _engine_axis(part: Part) -> np.ndarray:
    """[3] a point of the engine's axis, which is along z: normals of the platforms meet there."""
    mesh = part.mesh
    normals, middles = np.asarray(mesh.face_normals), np.asarray(mesh.triangles_center)
    platform = (np.abs(normals[:, 2]) < 1e-3) & (np.abs(normals[:, 1]) > 0.95)
    across = normals[platform, :2] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    along = np.sum(across * middles[platform, :2], axis=1)
    weight = np.asarray(mesh.area_faces)[platform]
    for _ in range(20):  # fillets and vanes point elsewhere
        product = across.T @ (across * weight[:, None])
        point = np.linalg.solve(product, across.T @ (along * weight))
        off = across @ point - along
        weight = np.asarray(mesh.area_faces)[platform] / (1 + (off / OFF_AXIS_MM) ** 2)
    return np.array([*point, 0.0])


def _designs() -> dict[str, Callable[[], Design]]:
    square, odd = functools.partial(_plate, 100, 100), functools.partial(_plate, 110, 70)
    return {
        "l_bracket": functools.partial(_bracket, 80.0, 50.0),
        "l_bracket_near_equal": functools.partial(_bracket, 60.0, 61.0),
        "plate_extra_hole": functools.partial(square, extra=True),
        "plate_shifted_hole": functools.partial(odd, shift=2.0),
        "box": lambda: Design(_box((80, 60, 40), (0, 0, 0)), dihedral(2, Z, X)),
        "box_chamfer": _box_chamfer,
        "u_channel": _u_channel,
        "t_piece": functools.partial(_t_piece, 45.0),
        "t_piece_uneven": functools.partial(_t_piece, 48.0),
        "flange": functools.partial(_flange, 5.0),
        "flange_odd_hole": functools.partial(_flange, 5.5),
        "gear": functools.partial(_gear, keyway=False),
        "gear_keyway": functools.partial(_gear, keyway=True),
        "shaft": functools.partial(_shaft, keyway=False),
        "shaft_keyway": functools.partial(_shaft, keyway=True),
        "spindle_flat": _spindle_flat,
        "cross_hole_cylinder": lambda: Design(
            _rod(22, 90) - _rod(7, 60, axis="x"), dihedral(2, Z, X)
        ),
        "connecting_rod": _connecting_rod,
        "hex_nut": _hex_nut,
        "elbow": _elbow,
        "pump_housing": _pump_housing,
        "hinge": _hinge,
        "bearing_block": _bearing_block,
        "wedge": _wedge,
        "sphere_flat": _sphere_flat,
        "star_knob": _star_knob,
        "separator": _separator,
        "hood": _hood,
        "turbine_wheel": functools.partial(_turbine_wheel, cut=False),
        "turbine_wheel_cut_blade": functools.partial(_turbine_wheel, cut=True),
    }


def _box(size: tuple[float, float, float], at: tuple[float, float, float]) -> Manifold:
    """A box of that size around ``at``."""
    return Manifold.cube(size, True).translate(at)


def _rod(
    radius: float,
    length: float,
    at: tuple[float, float, float] = (0, 0, 0),
    axis: str = "z",
    *,
    segments: int = SEGMENTS,
    top: float = -1.0,
) -> Manifold:
    """A cylinder (or cone to the radius ``top``) of that length around ``at``."""
    turn = {"x": (0, 90, 0), "y": (-90, 0, 0), "z": (0, 0, 0)}[axis]
    return Manifold.cylinder(length, radius, top, segments, True).rotate(turn).translate(at)


def _rods(radius: float, length: float, places: list[tuple[float, float, float]]) -> Manifold:
    """Cylinders along z."""
    return sum((_rod(radius, length, at) for at in places), Manifold())


def _polygon(corners: list[tuple[float, float]]) -> CrossSection:
    return CrossSection([np.asarray(corners, np.float64)])


def _ring(count: int, radius: float) -> list[tuple[float, float, float]]:
    """Places on a circle, the first on the x axis."""
    angles = 2 * math.pi * np.arange(count) / count
    return [(radius * math.cos(a), radius * math.sin(a), 0.0) for a in angles]


def _bracket(leg: float, other: float) -> Design:
    """Two legs of 6 mm along x and z, 40 mm wide, a gusset, and two holes in each."""
    thick, width = 6.0, 40.0
    solid = _box((leg, width, thick), (leg / 2, 0, thick / 2))
    solid += _box((thick, width, other), (thick / 2, 0, other / 2))
    gusset = _polygon([(thick, thick), (26, thick), (thick, 26)]).extrude(5)
    solid += gusset.rotate((90, 0, 0)).translate((0, 2.5, 0))
    for y in (-11, 11):
        solid -= _rod(3.5, 20, (leg - 12, y, thick / 2)) + _rod(
            3.5, 20, (thick / 2, y, other - 12), "x"
        )
    return Design(solid)


def _plate(length: float, width: float, *, extra: bool = False, shift: float = 0.0) -> Design:
    """8 mm thick with four holes; one more, small, or one of the four out of its place."""
    x, y = length / 2 - 14, width / 2 - 14
    solid = _box((length, width, 8), (0, 0, 0))
    solid -= _rods(6, 20, [(x + shift, y, 0), (-x, y, 0), (x, -y, 0), (-x, -y, 0)])
    if extra:
        solid -= _rod(4, 20, (22, 9, 0))
    return Design(solid)


def _box_chamfer() -> Design:
    bar = _box((100, 4 * math.sqrt(2), 4 * math.sqrt(2)), (0, 0, 0)).rotate((45, 0, 0))
    return Design(_box((80, 60, 40), (0, 0, 0)) - bar.translate((0, 30, 20)))


def _u_channel() -> Design:
    solid = _box((120, 50, 36), (0, 0, 18)) - _box((140, 40, 36), (0, 0, 23))
    return Design(solid - _rods(4.5, 30, [(-40, 0, 0), (40, 0, 0)]), cyclic(2, Z))


def _t_piece(right: float) -> Design:
    """A pipe tee with collars; the run's right arm may be longer than the left one's 45 mm."""
    left = 45.0
    run, mid = left + right, (right - left) / 2
    solid = _rod(16, run, (mid, 0, 0), "x") + _rod(16, 50, (0, 0, 25))
    solid += _rod(21, 10, (right - 5, 0, 0), "x") + _rod(21, 10, (5 - left, 0, 0), "x")
    solid += _rod(21, 10, (0, 0, 45))
    solid -= _rod(12, run + 2, (mid, 0, 0), "x") + _rod(12, 60, (0, 0, 30))
    return Design(solid, cyclic(2, Z) if right == left else ONLY_IDENTITY)


def _flange(one: float) -> Design:
    """Six bolt holes of radius 5 on a circle; the one on the x axis may differ."""
    places = _ring(6, 36)
    solid = _rod(50, 12) - _rod(20, 20) - _rods(5, 20, places[1:]) - _rod(one, 20, places[0])
    exact = dihedral(6, Z, X) if one == 5 else cyclic(2, X)
    return Design(solid, exact)


def _gear(*, keyway: bool) -> Design:
    """24 teeth of module 3; the keyway, 6 mm wide, is on the x axis."""
    half = math.pi / 24
    tooth = [(31.9, -1.15 * half), (36, -0.55 * half), (39, -0.25 * half)]
    corners = [
        (r * math.cos(a + 2 * half * i), r * math.sin(a + 2 * half * i))
        for i in range(24)
        for r, a in [*tooth, *((r, -a) for r, a in reversed(tooth))]
    ]
    solid = _polygon(corners).extrude(16).translate((0, 0, -8))
    solid -= _rod(12, 30) + _rod(26, 10, (0, 0, 11)) + _rod(26, 10, (0, 0, -11))
    solid += _rod(18, 16) - _rod(12, 30)
    if not keyway:
        return Design(solid, dihedral(24, Z, X))
    return Design(solid - _box((8, 6, 30), (11.4, 0, 0)), cyclic(2, X))


def _shaft(*, keyway: bool) -> Design:
    """Five steps along z, 150 mm; the keyway lies in the widest but one."""
    solid, start = Manifold(), -75.0
    for radius, length in ((10, 28), (15, 40), (21, 12), (15, 34), (12, 36)):
        solid += _rod(radius, length, (0, 0, start + length / 2), segments=144)
        start += length
    if not keyway:
        return Design(solid, axis=Z)
    slot = _box((8, 8, 20), (15, 0, -27)) + _rod(4, 8, (15, 0, -37), "x")
    return Design(solid - (slot + _rod(4, 8, (15, 0, -17), "x")))


def _spindle_flat() -> Design:
    """The same at both ends, with a flat of 3 mm in the middle, towards +x."""
    solid = _rod(16, 110) + _rod(22, 14) + _rod(11, 150)
    return Design(
        solid - _box((20, 60, 30), (23, 0, 35)) - _box((20, 60, 30), (23, 0, -35)), cyclic(2, X)
    )


def _connecting_rod() -> Design:
    """Big end at the left, small end at the right, a pocket in both sides of the shank."""
    shank = _polygon([(-60, -14), (60, -9), (60, 9), (-60, 14)]).extrude(12).translate((0, 0, -6))
    solid = shank + _rod(26, 20, (-60, 0, 0)) + _rod(15, 20, (60, 0, 0))
    pocket = _polygon([(-30, -7), (40, -4), (40, 4), (-30, 7)]).extrude(6)
    solid -= pocket.translate((0, 0, 3)) + pocket.translate((0, 0, -9))
    return Design(solid - _rod(17, 40, (-60, 0, 0)) - _rod(9, 40, (60, 0, 0)), cyclic(2, X))


def _hex_nut() -> Design:
    hexagon = Manifold.cylinder(24, 46 / math.sqrt(3), -1, 6, True)
    # the 30 deg chamfer of a nut, both sides alike
    wide = 22.5 + 24 / math.tan(math.radians(30))
    cone = _rod(wide, 24, top=22.5) ^ _rod(22.5, 24, top=wide)
    return Design((hexagon ^ cone) - _rod(14, 40), dihedral(6, Z, X))


def _elbow() -> Design:
    """A 90 deg bend of radius 40 mm with equal flanges; the half turn is about the diagonal."""

    def bend(radius: float) -> Manifold:
        return CrossSection.circle(radius, 48).translate((40, 0)).revolve(30, 90)

    def straight(radius: float, start: float, length: float) -> Manifold:
        along_x = _rod(radius, length, (-start - length / 2, 40, 0), "x")
        return along_x + _rod(radius, length, (40, -start - length / 2, 0), "y")

    # the straight ends are a little wider: equal ones would meet the bend in slivers
    solid = bend(16) + straight(16.6, -2, 16) + straight(26, 14, 8)
    solid -= bend(12) + straight(12.4, -0.5, 40)
    for y, z in ((20, 0), (-20, 0), (0, 20), (0, -20)):
        solid -= _rod(2.5, 20, (-18, 40 + y, z), "x") + _rod(2.5, 20, (40 + y, -18, z), "y")
    return Design(solid, cyclic(2, X + Y))


def _pump_housing() -> Design:
    """A volute on a foot, with inlet and outlet necks, ribs and three unequal bosses."""
    solid = _rod(42, 34) + _rod(24, 30, (0, 0, 28)) + _rod(34, 8, (0, 0, 43))
    solid += _rod(16, 62, (30, 38, 0), "y") + _rod(25, 8, (30, 65, 0), "y")
    solid += _box((70, 16, 46), (0, -46, -2)) + _box((90, 10, 60), (0, -58, -4))
    for angle, radius in ((100, 8), (165, 7), (215, 9)):
        a = math.radians(angle)
        solid += _rod(radius, 40, (44 * math.cos(a), 44 * math.sin(a), -3))
        solid -= _rod(3, 60, (44 * math.cos(a), 44 * math.sin(a), 0))
    for angle in (30, 130, 190, 330):
        solid += _box((30, 4, 26), (27, 0, 26)).rotate((0, 0, angle))
    solid -= _rod(34, 30, (0, 0, -6)) + _rod(16, 80, (0, 0, 30))
    solid -= _rod(11, 60, (30, 50, 0), "y")
    return Design(solid - _rods(4, 30, [(-36, -58, 18), (36, -58, 18)]))


def _hinge() -> Design:
    """An open butt hinge: two leaves of 30 mm, five knuckles about a pin along y."""
    solid = _rod(4, 84, axis="y") + _rod(6.5, 4, (0, 42, 0), "y")
    for i in range(5):
        y, side = -32 + 16 * i, 1 if i % 2 else -1
        solid += _rod(6.5, 15.6, (0, y, 0), "y") + _box((16, 15.6, 3), (8 * side, y, -5))
    for side in (-1, 1):
        leaf = _box((26, 80, 3), (23 * side, 0, -5))
        solid += leaf - _rods(3, 10, [(24 * side, y, -5) for y in (-28, 0, 28)])
    return Design(solid)


def _bearing_block() -> Design:
    """A pillow block; but for the grease nipple at one side it has a half turn about z."""
    solid = _box((130, 36, 14), (0, 0, 7)) + _rod(34, 36, (0, 0, 42), "y")
    solid += _box((68, 36, 36), (0, 0, 24)) - _box((20, 60, 20), (44, 0, 40))
    solid -= _rod(20, 60, (0, 0, 42), "y")
    for x in (-50, 50):
        solid -= _box((10, 11, 40), (x, 0, 7)) + _rods(5.5, 40, [(x - 5, 0, 7), (x + 5, 0, 7)])
    return Design(solid + _rod(4, 10, (0, 9, 78)))


def _wedge() -> Design:
    solid = _polygon([(0, 0), (90, 0), (90, 34)]).extrude(45)
    return Design(solid.translate((-60, -11, -22.5)))


def _sphere_flat() -> Design:
    """A turned knob's ball with a flat at +z: nothing but the flat tells any orientation."""
    arc = np.linspace(-math.pi / 2, math.asin(0.8), 48)
    corners = [(0.0, 32.0), *((40 * math.cos(a), 40 * math.sin(a)) for a in arc)]
    return Design(_polygon(corners).revolve(96), axis=Z)


def _star_knob() -> Design:
    lobes = _rods(11, 16, _ring(5, 27)) + _rod(24, 16)
    solid = lobes + _rod(13, 30, (0, 0, -15), segments=120)
    return Design(solid - _rod(5, 40, (0, 0, -20), segments=120), cyclic(5, Z))


def _separator() -> Design:
    """A long sheet of 1.5 mm with bent edges and three rows of slots; one slot is missing."""
    t = 1.5
    profile = [(-26, 10), (-26, 0), (-8, 0), (-4, 7), (4, 7), (8, 0), (26, 0), (26, 10)]
    outer = [(x, y + t) if 0 < i < 7 else (x, y) for i, (x, y) in enumerate(profile)]
    outer = [(-26 + t, 10), (-26 + t, t), *outer[2:6], (26 - t, t), (26 - t, 10)]
    solid = _polygon([*profile, *reversed(outer)]).extrude(180).rotate((90, 0, 0))
    solid = solid.translate((0, 90, 0))
    for row, x in enumerate((-17, 0, 17)):
        for i in range(9):
            if (row, i) != (2, 6):
                solid -= _box((6, 12, 30), (x, -72 + 18 * i, 4))
    return Design(solid)


def _hood() -> Design:
    """A thin-walled hood: a box skirt, a sloped roof and a round neck off its middle."""

    def shell(side: float, top: float, low: float, high: float) -> Manifold:
        skirt = _box((side, side, 12 - low), (0, 0, (12 + low) / 2))
        lower, upper = (CrossSection.square((s, s), True) for s in (side, top))
        rings = lower.extrude(0.01).translate((0, 0, 12))
        cap = upper.extrude(0.01).translate((-8, 0, high))
        return skirt + Manifold.batch_hull([rings, cap])

    solid = shell(72, 40, 0, 28) - shell(68, 36, -1, 26)
    neck = _rod(14, 16, (-8, 0, 32)) - _rod(12, 60, (-8, 0, 32))
    return Design(solid - _rod(12, 40, (-8, 0, 30)) + neck - _box((20, 12, 8), (36, 0, 2)))


def _turbine_wheel(*, cut: bool) -> Design:
    """12 twisted blades on a hub; the tip of one may be cut off by 3 mm (a repaired wheel)."""
    section = CrossSection.square((26, 3.2), True).offset(0.6, JoinType.Round, 2.0, 16)
    blade = section.extrude(32, 12, 35.0).rotate((0, 90, 0)).translate((18, 0, 0))
    hub = _rod(24, 26, segments=120) + _rod(16, 40, (0, 0, 4), segments=120)
    blade = blade.rotate((17, 0, 0))
    blades = sum((blade.rotate((0, 0, 360 * i / 12)) for i in range(12)), Manifold())
    solid = hub + blades - _rod(8, 80, segments=120)
    if not cut:
        return Design(solid, cyclic(12, Z))
    return Design(solid - _box((10, 30, 60), (52, 0, 0)))
