"""Generic solids by the hundred: what a network can be trained on where no ModelNet40 is at hand.

A solid is a primitive (box, cylinder, cone, torus, capsule, a prism over a random polygon, straight
or twisted) to which others are added or from which they are cut, all with random proportions.
None is, or is made to resemble, a guide vane.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from manifold3d import CrossSection, Manifold
from scipy.spatial.transform import Rotation

from vanejax.cad.part import Part, part_from_mesh
from vanejax.errors import InputError

SEGMENTS = 64
MOST_STEPS = 4  # primitives beside the first
SQUARE_SHARE = 0.6  # of the primitives that stand along the axes, as in most machined parts
REACH = 0.5  # of the first primitive's bounding box, along each side: where the others are put
SIZE_MM = 100.0  # of about the largest side: what `vanejax.cad.part` takes for a part
LEAST_CHANGE = 0.02  # of the volume: a step that does less is not seen, and its slivers are
LEAST_LEFT = 0.3  # of the volume, after a step
LEAST_FILLED = 0.02  # of the bounding box: below, it is a wire or a foil
TRIES = 20

Rng = np.random.Generator


def make_solids(count: int, seed: int, num_points: int) -> tuple[np.ndarray, list[str]]:
    """Samples [S, P, 6] of the solids number 0 to ``count`` - 1 of a seed, see `unit_samples`.

    Their names [S] are such as ``0007 box + cone - torus``.
    """
    parts = [make_solid(number, seed) for number in range(count)]
    samples = [unit_samples(part, num_points, number) for number, part in enumerate(parts)]
    return np.stack(samples), [part.name for part in parts]


def unit_samples(part: Part, num_points: int, seed: int) -> np.ndarray:
    """[P, 6] f32: points uniform over a part's area, and their unit normals.

    They are moved and scaled into the unit sphere as scans are: `Part.center` to 0, `Part.radius`
    to 1.
    """
    points, normals, _ = part.sample(num_points, seed=seed)
    return np.hstack([(points - part.center) / part.radius, normals]).astype(np.float32)


def make_solid(number: int, seed: int) -> Part:
    """One closed solid of one body; the same number and seed give the same bits."""
    rng = np.random.default_rng([seed, number])
    for _ in range(TRIES):
        solid, recipe = _composed(rng)
        low, high = _bounds(solid)
        # a lone primitive has no one pose: most turn about an axis, or by 180 deg
        if recipe in _PRIMITIVES or solid.volume() < LEAST_FILLED * np.prod(high - low):
            continue
        mesh = solid.simplify(1e-4 * SIZE_MM).to_mesh64()
        try:
            return part_from_mesh(
                np.asarray(mesh.vert_properties)[:, :3],
                np.asarray(mesh.tri_verts),
                name=f"{number:04d} {recipe}",
            )
        except InputError:
            continue  # parts that touch along an edge only, once rounded to float32
    raise InputError(f"solid {number} of seed {seed}: {TRIES} random ones in a row were no solids")


def _composed(rng: Rng) -> tuple[Manifold, str]:
    """A primitive, then up to `MOST_STEPS` others added or cut; and how that reads."""
    solid, recipe = _primitive(rng, SIZE_MM)
    low, high = _bounds(solid)
    for _ in range(rng.integers(1, MOST_STEPS + 1)):
        cut = rng.random() < 0.5
        tool, name = _primitive(rng, SIZE_MM * rng.uniform(0.3, 0.9))
        place = 0.5 * (low + high) + REACH * (high - low) * rng.uniform(-1, 1, 3)
        if rng.random() < 0.5:
            place[rng.integers(3)] = 0.0  # on a middle plane, as most holes and bosses
        tool = tool.translate(place)
        # pieces that come off and cavities that nothing sees are left out
        pieces = (solid - tool if cut else solid + tool).decompose()
        changed = max(pieces, key=Manifold.volume, default=Manifold())
        ratio = changed.volume() / solid.volume()
        if ratio < LEAST_LEFT or abs(ratio - 1) < LEAST_CHANGE:
            continue
        solid, recipe = changed, f"{recipe} {'-' if cut else '+'} {name}"
    return solid, recipe


def _primitive(rng: Rng, size: float) -> tuple[Manifold, str]:
    """One of the family, about ``size`` mm across, centred, turned; and its name."""
    names = list(_PRIMITIVES)
    name = names[rng.integers(len(names))]
    solid = _PRIMITIVES[name](rng)
    low, high = _bounds(solid)
    solid = solid.translate(-0.5 * (low + high)).scale(np.full(3, size / np.max(high - low)))
    if rng.random() < SQUARE_SHARE:
        quarters = [(0, 0, 0), (90, 0, 0), (0, 90, 0)]
        return solid.rotate(quarters[rng.integers(3)]), name
    turn = np.zeros((3, 4))
    turn[:, :3] = Rotation.random(rng=rng).as_matrix()
    return solid.transform(turn), name


def _cylinder(rng: Rng) -> Manifold:
    radius = rng.uniform(0.15, 0.6)
    return Manifold.cylinder(rng.uniform(0.2, 1.2), radius, radius, SEGMENTS)


def _cone(rng: Rng) -> Manifold:
    radius = rng.uniform(0.25, 0.6)
    return Manifold.cylinder(rng.uniform(0.3, 1.2), radius, radius * rng.uniform(0, 0.7), SEGMENTS)


def _capsule(rng: Rng) -> Manifold:
    ball = Manifold.sphere(rng.uniform(0.2, 0.6), SEGMENTS // 2)
    return Manifold.batch_hull([ball, ball.translate((0, 0, rng.uniform(0.2, 1.2)))])


def _twisted_prism(rng: Rng) -> Manifold:
    """Lofted from a polygon to the same, turned and smaller or larger."""
    twist = rng.choice([-1.0, 1.0]) * rng.uniform(20, 120)
    top = np.full(2, rng.uniform(0.5, 1.2))
    return _polygon(rng).extrude(rng.uniform(0.8, 2.0), 32, twist, top)


def _polygon(rng: Rng) -> CrossSection:
    """Three to nine corners around the origin, at uneven angles and distances."""
    corners = int(rng.integers(3, 10))
    # spaced so that no side runs close by the origin
    angles = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.25, 0.25, corners)) / corners
    reach = rng.uniform(0.4, 1.0, corners)
    return CrossSection([np.stack([reach * np.cos(angles), reach * np.sin(angles)], axis=1)])


def _torus(rng: Rng) -> Manifold:
    ring = CrossSection.circle(rng.uniform(0.2, 0.6), SEGMENTS // 2)
    return ring.translate((1.0, 0.0)).revolve(SEGMENTS)


_PRIMITIVES: dict[str, Callable[[Rng], Manifold]] = {
    "box": lambda rng: Manifold.cube(rng.uniform(0.25, 1.0, 3), True),
    "cylinder": _cylinder,
    "cone": _cone,
    "torus": _torus,
    "capsule": _capsule,
    "prism": lambda rng: _polygon(rng).extrude(rng.uniform(0.2, 1.5)),
    "twisted prism": _twisted_prism,
}


def _bounds(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner [3] of the bounding box."""
    low_high = np.asarray(solid.bounding_box())
    return low_high[:3], low_high[3:]
