"""What stands and lies around a part while it is scanned: table, clamps, chips, coolant drops.

All is in the part's frame, in mm, with +z up: the part stands on the table with its lowest point,
and the views of `hemisphere_viewpoints` look down on it. A scene is one surface for the scanner, so
what stands before the part hides it, and what stands beside it is measured.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.scanner.ideal_scan import Hits
from vanejax.scanner.virtual_scanner import Scanner
from vanejax.settings import check_fields, magnitude

_TABLE_MM = (600.0, 600.0, 20.0)
_AROUND = 0.25  # of the part's extent: how far from it chips and drops may fall
_STRIP_STEPS = 16  # sections along a chip
_RINGS, _SPOKES = 5, 16  # of a drop


@dataclasses.dataclass(frozen=True, eq=False)
class ClutterObject:
    """A table, clamp, chip or drop (its kind), and its closed, outward mesh in mm, part frame."""

    kind: str
    mesh: trimesh.Trimesh


@dataclasses.dataclass(frozen=True, eq=False)
class ClutterScene:
    """The part whose pose is asked for, and what else is seen."""

    part: Part
    objects: tuple[ClutterObject, ...] = ()

    @functools.cached_property
    def surface(self) -> Part:
        """All of it as one surface; the part's faces come first and keep their indices.

        Without objects it is the part itself, so that its scans are the part's, bit for bit.
        """
        if not self.objects:
            return self.part
        meshes = [self.part.mesh, *(item.mesh for item in self.objects)]
        first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        faces = [np.asarray(mesh.faces) + start for mesh, start in zip(meshes, first, strict=False)]
        # as in every part: what Embree sees
        vertices = np.concatenate([np.asarray(mesh.vertices, np.float32) for mesh in meshes])
        mesh = trimesh.Trimesh(vertices.astype(np.float64), np.concatenate(faces), process=False)
        mesh.mutable = False
        return Part(mesh=mesh, name=f"{self.part.name} in its scene", closed=self.part.closed)

    def scanner(self) -> Scanner:
        """Casts rays at the whole scene; its poses are still those of the part."""
        return Scanner(self.surface)

    def owner(self, face: np.ndarray) -> np.ndarray:
        """[N] i32, whose the faces [N] of a scan are: 0 the part's, k the k-th item's (from 1)."""
        counts = [len(self.part.mesh.faces), *(len(item.mesh.faces) for item in self.objects)]
        return np.searchsorted(np.cumsum(counts), face, side="right").astype(np.int32)


@dataclasses.dataclass(frozen=True)
class Clutter:
    """How much there is around a part; by default nothing.

    Attributes:
      table: whether it stands on one.
      tilt_deg: largest tilt of the table against the part's xy plane.
      clamps: number of jaws that hold the part.
      chips: number of chips on the part, the table and the jaws.
      drops: number of drops of coolant there.

    A number that is negative raises InputError.
    """

    table: bool = False
    tilt_deg: float = magnitude(0.0)
    clamps: int = magnitude(0)
    chips: int = magnitude(0)
    drops: int = magnitude(0)

    def __post_init__(self) -> None:
        check_fields(self, "clutter")


def clutter_scene(part: Part, clutter: Clutter, rng: np.random.Generator) -> ClutterScene:
    """The part among random things; the same state of ``rng`` gives the same scene."""
    objects: tuple[ClutterObject, ...] = ()
    if clutter.table:
        tilt = clutter.tilt_deg * rng.random() if clutter.tilt_deg else 0.0
        objects += (table(part, tilt_deg=tilt, azimuth_deg=360 * rng.random()),)
    if clutter.clamps:
        objects += clamps(part, rng, clutter.clamps)
    if clutter.chips or clutter.drops:
        # both fall on what stands already, not on each other: one scanner is enough
        below = ClutterScene(part, objects).scanner()
        objects += chips(below, part, rng, clutter.chips)
        objects += coolant_drops(below, part, rng, clutter.drops)
    return ClutterScene(part, objects)


def table(part: Part, *, tilt_deg: float = 0.0, azimuth_deg: float = 0.0) -> ClutterObject:
    """A square plate under the part, which stands in its middle and touches it at its lowest point.

    Its normal is tilted by ``tilt_deg`` against +z, towards ``azimuth_deg`` from +x about +z. A
    tilt of 90 deg or more raises InputError.
    """
    if not 0 <= tilt_deg < 90:
        raise InputError(f"a table tilted by {tilt_deg!r} deg: the tilt must be from 0 to below 90")
    part_from_plate = Rotation.from_euler("zyz", [-azimuth_deg, tilt_deg, azimuth_deg], True)
    normal = part_from_plate.as_matrix()[:, 2]
    lowest = float(np.min(np.asarray(part.mesh.vertices) @ normal))
    middle = part.center + (lowest - part.center @ normal - _TABLE_MM[2] / 2) * normal
    mesh = trimesh.creation.box(_TABLE_MM)
    vertices = part_from_plate.apply(mesh.vertices) + middle
    return ClutterObject("table", trimesh.Trimesh(vertices, mesh.faces, process=False))


def clamps(part: Part, rng: np.random.Generator, count: int) -> tuple[ClutterObject, ...]:
    """Upright jaws that touch the part from the side, evenly around it.

    Each is a block 20 to 40 mm wide and 25 to 45 mm long, that stands where the part stands. Its
    face touches the part at its outermost point in that direction, and it is 2 to 6 mm higher than
    what it holds: it hides a little of the part and is measured itself.
    """
    vertices = np.asarray(part.mesh.vertices)
    bottom = float(vertices[:, 2].min())
    start = 2 * math.pi * rng.random()
    jaws = []
    for k in range(count):
        angle = start + 2 * math.pi * (k + rng.uniform(-0.15, 0.15)) / count
        width, length, above = rng.uniform([20, 25, 2], [40, 45, 6])
        outward = np.array([math.cos(angle), math.sin(angle), 0.0])
        aside = np.array([-outward[1], outward[0], 0.0])
        out, across = vertices @ outward, vertices @ aside
        contact = int(np.argmax(out))
        middle = across[contact] + rng.uniform(-0.3, 0.3) * width
        held = (np.abs(across - middle) < width / 2) & (out > out[contact] - 0.3 * length)
        top = float(vertices[held | (np.arange(len(out)) == contact), 2].max()) + above
        box = trimesh.creation.box((length, width, top - bottom))
        place = np.array([out[contact] + length / 2, middle, (top + bottom) / 2])
        turned = (box.vertices + place) @ np.stack([outward, aside, [0.0, 0.0, 1.0]])
        jaws.append(ClutterObject("clamp", trimesh.Trimesh(turned, box.faces, process=False)))
    return tuple(jaws)


def chips(
    below: Scanner, part: Part, rng: np.random.Generator, count: int
) -> tuple[ClutterObject, ...]:
    """Curled swarf that fell from above: helical strips of 3 to 15 mm.

    Each is 0.5 to 2 mm wide and 0.1 to 0.3 mm thick, curled with a radius of 1 to 4 mm by half a
    turn to two turns. It is turned at random and lies where it first touches what the scanner
    ``below`` sees; there are fewer than ``count`` where there is nothing to lie on.
    """
    fallen = []
    for place in _places(below, part, rng, count)[0]:
        strip = _strip(rng) @ Rotation.random(rng=rng).as_matrix().T
        strip[:, :2] += place[:2] - strip[:, :2].mean(axis=0)
        ground = _seen_from_above(below, strip[:, :2])[1]
        # what reaches beyond an edge hangs free, but not lower than the place itself
        clear = np.append(strip[:, 2] - ground, strip[:, 2].min() - place[2])
        strip[:, 2] -= clear.min()
        fallen.append(ClutterObject("chip", trimesh.Trimesh(strip, _strip_faces(), process=False)))
    return tuple(fallen)


def coolant_drops(
    below: Scanner, part: Part, rng: np.random.Generator, count: int
) -> tuple[ClutterObject, ...]:
    """Drops on the upper surface: spherical caps of 1 to 5 mm radius along the surface's normal.

    The contact angle is 20 to 70 deg, so that they are a sixth to two thirds of their radius high.
    Arguments as those of `chips`.
    """
    drops = []
    for place, normal in zip(*_places(below, part, rng, count), strict=True):
        cap = _cap(rng.uniform(1, 5), math.radians(rng.uniform(20, 70)))
        turn = Rotation.align_vectors(normal[None], [[0.0, 0.0, 1.0]])[0]
        mesh = trimesh.Trimesh(turn.apply(cap) + place, _cap_faces(), process=False)
        drops.append(ClutterObject("drop", mesh))
    return tuple(drops)


def _places(
    below: Scanner, part: Part, rng: np.random.Generator, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] mm of the surface seen from above, around the part, and its normals [n, 3]."""
    low, high = np.asarray(part.mesh.bounds)[:, :2]
    around = _AROUND * (high - low)
    # as many again, for those that fall through where there is no table
    aside = rng.uniform(low - around, high + around, (4 * count, 2))
    hits, height = _seen_from_above(below, aside)
    on_surface = np.flatnonzero(hits.face >= 0)[:count]
    return np.column_stack([aside, height])[on_surface], hits.normals[on_surface]


def _seen_from_above(below: Scanner, aside: np.ndarray) -> tuple[Hits, np.ndarray]:
    """What lies under places [n, 2] mm, and its height [n] mm, -inf for nothing."""
    top = below.part.mesh.bounds[1, 2] + 1.0
    starts = np.column_stack([aside, np.full(len(aside), top)])
    hits = below.cast(starts, np.broadcast_to([0.0, 0.0, -1.0], starts.shape))
    return hits, top - hits.distance_mm


def _strip(rng: np.random.Generator) -> np.ndarray:
    """Vertices [4 S, 3] mm of a helical strip about z: four corners for each section."""
    radius, width, thick, turns = rng.uniform([1, 0.5, 0.1, 0.5], [4, 2, 0.3, 2])
    pitch = width + rng.uniform(0.5, 3)  # so that turns do not overlap
    angle = 2 * math.pi * turns * np.linspace(-0.5, 0.5, _STRIP_STEPS)
    along = pitch * angle / (2 * math.pi)
    # counter-clockwise, seen along the strip
    out = radius + thick / 2 * np.array([-1.0, 1.0, 1.0, -1.0])
    up = width / 2 * np.array([-1.0, -1.0, 1.0, 1.0])
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    aside = out[:, None] * direction[:, None]
    return np.concatenate([aside, (along[:, None] + up)[..., None]], axis=-1).reshape(-1, 3)


@functools.cache
def _strip_faces() -> np.ndarray:
    """Triangles [F, 3] of every `_strip`."""
    last = 4 * (_STRIP_STEPS - 1)
    ends = [[0, 1, 2], [0, 2, 3], [last, last + 2, last + 1], [last, last + 3, last + 2]]
    return np.concatenate([_tube_faces(_STRIP_STEPS, 4), ends])


def _tube_faces(sections: int, corners: int) -> np.ndarray:
    """Quads between rings of corners, split in two; sections follow each other along the tube."""
    ring = np.arange(corners)
    a = (corners * np.arange(sections - 1)[:, None] + ring).ravel()
    b = (corners * np.arange(sections - 1)[:, None] + (ring + 1) % corners).ravel()
    quads = [np.stack([a, a + corners, b], 1), np.stack([b, a + corners, b + corners], 1)]
    return np.concatenate(quads)


def _cap(radius: float, contact: float) -> np.ndarray:
    """Vertices [V, 3] mm of a spherical cap on the plane z = 0, with a skirt below it.

    The skirt closes the gap to a curved surface.
    """
    polar = contact * np.arange(1, _RINGS + 1) / _RINGS
    sphere = radius / math.sin(contact)
    spoke = 2 * math.pi * np.arange(_SPOKES) / _SPOKES
    circle = np.stack([np.cos(spoke), np.sin(spoke)], axis=-1)
    out = np.append(sphere * np.sin(polar), radius)
    up = np.append(sphere * (np.cos(polar) - math.cos(contact)), -0.3 * radius)
    heights = np.broadcast_to(up[:, None, None], (_RINGS + 1, _SPOKES, 1))
    rings = np.concatenate([out[:, None, None] * circle, heights], axis=-1)
    ends = [[0.0, 0.0, sphere * (1 - math.cos(contact))], [0.0, 0.0, up[-1]]]
    return np.concatenate([rings.reshape(-1, 3), ends])


@functools.cache
def _cap_faces() -> np.ndarray:
    """Triangles [F, 3] of every `_cap`."""
    ring = np.arange(_SPOKES)
    after = (ring + 1) % _SPOKES
    last = _RINGS * _SPOKES
    top = np.full(_SPOKES, last + _SPOKES)
    ends = [[top, ring, after], [top + 1, last + after, last + ring]]
    return np.concatenate([_tube_faces(_RINGS + 1, _SPOKES), *np.swapaxes(ends, 1, 2)])
