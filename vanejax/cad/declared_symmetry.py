"""What a user knows of a part's symmetry: in words, then checked against the CAD model.

`Symmetry` is what the user says, such as ``z:180``. `PartSymmetry` is what that is on a part: the
motions and the free axis that make poses one, in the part's frame, f64, mm.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
from scipy.spatial.transform import Rotation

from vanejax.cad.part import Part
from vanejax.cad.surface import NearestFace, Surface
from vanejax.cad.symmetry import (
    Axis,
    DenseSurface,
    near_symmetries,
    nearest_equivalents,
    rotation_about,
)
from vanejax.errors import InputError
from vanejax.rigid import RigidTransform

AXES = dict(zip("xyz", np.eye(3), strict=True))
LEAST_ANGLE_DEG = 6.0  # finer turns are hardly told from a rotation by any angle
MOST_MOTIONS = 120
COMPARED_POINTS, EXACT_POINTS = 4000, 100
ANY_ANGLES_DEG = (7.3, 41.9, 93.1, 155.7)  # stand for a rotation by any angle
# of the part's radius: the largest difference between the surface and itself after the motion.
# Below the first it is a symmetry of the CAD model. A declared one may differ by more, with a
# note, up to the second, and on average up to the third; more is another part or axis
EXACT, GROSS, GROSS_MEAN = 0.005, 0.1, 0.01
FOUND = 0.003  # likewise, of one that is found in the CAD model
SNAPPED_DEG = 1.0  # an axis or angle that is found is the round one nearby


@dataclasses.dataclass(frozen=True)
class Symmetry:
    """What is said of a part's symmetry.

    Attributes:
      turns: the axis of the CAD frame, x, y or z, and the number n of turns by 360/n deg about it
        that map the part to itself; None for a rotation by any angle.
      automatic: whether it is to be found in the CAD model instead.
    """

    turns: tuple[tuple[str, int | None], ...] = ()
    automatic: bool = False

    @classmethod
    def parse(cls, text: str) -> Symmetry:
        """From ``none``, ``auto``, or terms such as ``z:180`` and ``x:any`` with commas between.

        Raises:
          InputError: anything else; an angle below 6 deg or that is no whole part of 360 deg.
        """
        if text.strip() in ("none", "auto"):
            return cls(automatic=text.strip() == "auto")
        return cls(tuple(_parse_turn(term.strip(), text) for term in text.split(",")))

    def __str__(self) -> str:
        """As `parse` reads it."""
        if self.automatic:
            return "auto"
        terms = (
            f"{axis}:{360 / order:g}" if order else f"{axis}:any" for axis, order in self.turns
        )
        return ",".join(terms) or "none"

    def on(self, part: Part) -> PartSymmetry | None:
        """The symmetry of a part; None for none.

        Every axis of symmetry goes through the middle of the part's surface, except where the CAD
        model is less symmetric than declared. So the axes go through that, the part's centre or
        the origin of the CAD frame: the point about which the part fits itself best.

        Raises:
          InputError: the CAD model does not have it; the terms have no finite group, or more
            than one free axis.
        """
        if self.automatic:
            return _found(part)
        return _declared(self, part) if self.turns else None


@dataclasses.dataclass(frozen=True, eq=False)
class PartSymmetry:
    """Motions after which a part is to be taken as unmoved.

    Attributes:
      declared: what the user said.
      motions: [S, 4, 4] f64, mm, part frame: a group, the identity first.
      free_axis: point [3] mm and unit direction [3], part frame, of a rotation by any angle; None
        where there is none.
      difference_mm: the largest distance between the CAD surface and itself after such a motion.
      center, radius_mm: of the part.
    """

    declared: Symmetry
    motions: np.ndarray
    free_axis: Axis | None
    difference_mm: float
    center: np.ndarray
    radius_mm: float

    @property
    def is_exact(self) -> bool:
        """Whether the CAD model has it; else it is the user's word."""
        return self.difference_mm <= EXACT * self.radius_mm

    def nearest(self, part_from_camera: RigidTransform, other: RigidTransform) -> RigidTransform:
        """Of the poses equivalent to each of a batch [H, 3, 3], the nearest to one other pose."""
        return nearest_equivalents(
            part_from_camera,
            other,
            self.motions,
            center=self.center,
            radius_mm=self.radius_mm,
            continuous_axis=self.free_axis,
        )

    def canonical(
        self, part_from_camera: RigidTransform, guess: RigidTransform | None = None
    ) -> RigidTransform:
        """Of all equivalents of one pose the nearest to a guess; without one, the least turned.

        The least turned one has the smallest angle between the part's axes and the camera's.
        """
        if guess is None:
            place = part_from_camera.inverse().apply(self.center[None])[0]
            guess = RigidTransform(np.eye(3), self.center - place)
        batch = RigidTransform(part_from_camera.rotation[None], part_from_camera.translation[None])
        nearest = self.nearest(batch, guess)
        return RigidTransform(nearest.rotation[0], nearest.translation[0])

    def in_words(self, *, guess: bool) -> str:
        """What is assumed, with the figure of the check, and which of the poses is reported."""
        name = f"symmetry {self.declared}: "
        if len(self.motions) == 1 and self.free_axis is None:
            return name + "none was found in the CAD model"
        one = f"{len(self.motions)} poses are one" if len(self.motions) > 1 else ""
        if self.free_axis is not None:
            direction = ", ".join(f"{v:.2f}" for v in self.free_axis[1])
            free = f"the rotation about ({direction}) is free"
            one = f"{one}, and {free}" if one else free
        differs = (
            f"the CAD model differs from itself by at most {max(self.difference_mm, 1e-3):.2g} mm"
        )
        if not self.is_exact:
            return (
                f"{name}{one} by your word, though {differs} after such a turn; the pose that fits "
                "best is reported"
            )
        which = "nearest to the guess" if guess else "least turned from the camera's axes"
        return f"{name}{one} ({differs}); the pose {which} is reported"


def _parse_turn(term: str, text: str) -> tuple[str, int | None]:
    axis, colon, angle = term.partition(":")
    if axis not in AXES or not colon:
        raise InputError(
            f"symmetry {text}: {term or 'an empty term'} is no axis and angle; write z:180 (a half "
            "turn about z), z:any (a rotation by any angle), several with commas, auto or none; "
            "axes are x, y and z of the CAD frame"
        )
    if angle == "any":
        return axis, None
    try:
        value = float(angle)
    except ValueError:
        value = math.nan
    if not value > 0:
        raise InputError(f"symmetry {text}: the angle {angle} is neither degrees above 0 nor any")
    if value < LEAST_ANGLE_DEG:
        raise InputError(
            f"symmetry {text}: {value:g} deg is less than {LEAST_ANGLE_DEG:g} deg; use {axis}:any"
        )
    order = round(360 / value)
    if order < 2 or abs(360 / value - order) > 1e-3 * order:  # 51.43 is a seventh
        raise InputError(
            f"symmetry {text}: {value:g} deg is no half, third or other whole part of 360 deg"
        )
    return axis, order


class _Comparison:
    """How far a part's surface is from itself after a motion."""

    def __init__(self, part: Part) -> None:
        self._dense, self._faces = DenseSurface(part), NearestFace(part)
        self._sample, _, _ = part.sample(COMPARED_POINTS, seed=4)

    def mean_mm(self, motions: np.ndarray) -> float:
        """The mean distance after the worst of motions [K, 4, 4]."""
        return max(float(np.mean(self._distances(motion)[1])) for motion in motions)

    def largest_mm(self, motions: np.ndarray) -> float:
        """The largest distance after the worst of motions [K, 4, 4]."""
        largest = 0.0
        for motion in motions:
            points, distance = self._distances(motion)
            # near edges samples are too far by their spacing: exact where they say the most
            points = points[np.argsort(-distance)[:EXACT_POINTS]]
            off = self._faces.closest_points(points).points - points
            largest = max(largest, float(np.linalg.norm(off, axis=1).max()))
        return largest

    def _distances(self, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points [N, 3] of the surface after the motion and its inverse, and distances [N]."""
        transform = RigidTransform.from_matrix(motion)
        moved = transform.apply(self._sample), transform.inverse().apply(self._sample)
        points = np.concatenate(moved)
        return points, self._dense.nearest(points)[1]


def _declared(symmetry: Symmetry, part: Part) -> PartSymmetry:
    """What a user says, on the part, if it is nearly so."""
    comparison, tried = _Comparison(part), []
    for point in (Surface(part).moments[0], part.center, np.zeros(3)):
        generators = np.concatenate([_turns(axis, order, point) for axis, order in symmetry.turns])
        tried.append((comparison.mean_mm(generators), generators, point))
    mean, generators, point = min(tried, key=lambda one: one[0])
    largest = comparison.largest_mm(generators)
    if largest > GROSS * part.radius or mean > GROSS_MEAN * part.radius:
        raise InputError(
            f"symmetry {symmetry}: the CAD model does not have it: after such a turn its surface "
            f"is up to {largest:.2g} mm off itself, {mean:.2g} mm on average ({part.radius:.0f} mm "
            "radius); check the axis, or leave it out"
        )
    free = {axis for axis, order in symmetry.turns if order is None}
    if len(free) > 1:
        raise InputError(f"symmetry {symmetry}: more than one free axis; one is allowed")
    axis = AXES[free.pop()] if free else None
    turns = [
        _turns(name, order, point)
        for name, order in symmetry.turns
        if order is not None and (axis is None or not np.array_equal(AXES[name], axis))
    ]
    motions = _group(np.concatenate(turns) if turns else np.empty((0, 4, 4)))
    if motions is None or (axis is not None and not _keeps(motions, axis)):
        raise InputError(
            f"symmetry {symmetry}: such turns together make more than {MOST_MOTIONS} poses one; no "
            "part but a ball is like that"
        )
    free_axis = None if axis is None else (point, axis)
    return PartSymmetry(symmetry, motions, free_axis, largest, part.center, part.radius)


def _found(part: Part) -> PartSymmetry:
    """The symmetry that the CAD model has, to `FOUND`."""
    comparison = _Comparison(part)
    middle, principal = Surface(part).moments
    directions = np.concatenate([np.eye(3), principal])
    limit = FOUND * part.radius
    free, largest = [], 0.0
    for direction in directions:
        if any(abs(direction @ other) > math.cos(math.radians(SNAPPED_DEG)) for other in free):
            continue
        turns = np.stack([rotation_about(direction, a, middle) for a in ANY_ANGLES_DEG])
        difference = comparison.largest_mm(turns)
        if difference <= limit:
            free.append(direction)
            largest = max(largest, difference)
    if len(free) > 1:
        raise InputError("symmetry auto: the part is a ball; its rotation cannot be found")
    free_axis = (middle, free[0]) if free else None
    group = np.eye(4)[None]
    found = near_symmetries(part, group, continuous_axis=free_axis)
    snapped = [_snapped(motion, middle, directions) for motion in found]
    # those about round axes first: they make others, of which the axis is known less well
    for motion, _ in sorted(snapped, key=lambda pair: not pair[1]):
        if _is_known(motion, group):
            continue
        difference = comparison.largest_mm(motion[None])
        larger = _group(np.concatenate([group, motion[None]]))
        if difference <= limit and larger is not None and (not free or _keeps(larger, free[0])):
            group, largest = larger, max(largest, difference)
    automatic = Symmetry(automatic=True)
    return PartSymmetry(automatic, group, free_axis, largest, part.center, part.radius)


def _snapped(
    motion: np.ndarray, middle: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, bool]:
    """A rotation about the middle by a whole part of a turn, and whether its axis is a round one.

    Round axes are the directions [K, 3] and those half way between two of them.
    """
    vector = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    angle_deg = math.degrees(np.linalg.norm(vector))
    axis = vector / np.linalg.norm(vector)
    order = next(
        (n for n in range(2, 61) if abs((angle_deg * n / 360 + 0.5) % 1 - 0.5) * 360 < n), None
    )
    if order is not None:
        angle_deg = round(angle_deg * order / 360) * 360 / order
    halves = [(a + sign * b) for a, b in itertools.combinations(directions, 2) for sign in (1, -1)]
    halves = [half / np.linalg.norm(half) for half in halves if np.linalg.norm(half) > 0.1]
    round_axes = np.concatenate([directions, np.stack(halves)])
    cosine = round_axes @ axis
    near = np.flatnonzero(np.abs(cosine) > math.cos(math.radians(SNAPPED_DEG)))
    if len(near):
        axis = round_axes[near[0]] * np.sign(cosine[near[0]])
    return rotation_about(axis, angle_deg, middle), bool(len(near))


def _turns(axis: str, order: int | None, point: np.ndarray) -> np.ndarray:
    """[K, 4, 4]: the smallest turn about an axis through a point, or those that stand for any."""
    angles = ANY_ANGLES_DEG if order is None else (360 / order,)
    return np.stack([rotation_about(AXES[axis], angle, point) for angle in angles])


def _is_known(motion: np.ndarray, group: np.ndarray) -> bool:
    """Whether a rotation [4, 4] is one of a group [S, 4, 4] about the same point."""
    cosine = 0.5 * (np.einsum("ij,sij->s", motion[:3, :3], group[:, :3, :3]) - 1)
    return bool((cosine > math.cos(math.radians(2 * SNAPPED_DEG))).any())


def _group(generators: np.ndarray) -> np.ndarray | None:
    """[S, 4, 4] the group of rotations [K, 4, 4] about one point; None if it is too large."""
    group = np.eye(4)[None]
    fresh = [np.eye(4)]
    while fresh:
        product = fresh.pop()
        for generator in generators:
            motion = generator @ product
            if not _is_known(motion, group):
                group = np.concatenate([group, motion[None]])
                fresh.append(motion)
        if len(group) > MOST_MOTIONS:
            return None
    return group


def _keeps(group: np.ndarray, axis: np.ndarray) -> bool:
    """Whether every motion of a group [S, 4, 4] maps an axis [3] to itself."""
    along = np.abs(group[:, :3, :3] @ axis @ axis)
    return bool((along > math.cos(math.radians(SNAPPED_DEG))).all())
