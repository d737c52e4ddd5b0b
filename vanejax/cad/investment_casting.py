"""The part as it is cast: stock, waviness, shrinkage, bow and missing pieces.

All in the CAD model's own frame: the true pose of a casting is the pose of the part as designed.
`dimensional_tolerance_mm` says what a casting may differ by. Training scans and studies draw their
castings from here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import manifold3d
import numpy as np

from vanejax.cad.part import Part, part_from_mesh
from vanejax.cad.surface_offset import offset_directions
from vanejax.errors import InputError

CUT = 3.0  # standard deviations of the waviness: 0.3 % of the surface has more, and is cut off
FEATURES = 256  # of the random field; its covariance is then off by a sixteenth of the variance
EDGES_PER_WAVELENGTH = 5  # straight edges miss 0.9 % of the waviness
EDGES_PER_BOW = 16  # along the part: they miss 0.4 % of the bow
MOST_EDGES = 200  # along the part: 1,000,000 faces
# share of the surface whose faces an offset may turn over; at the concave corners of usual parts
# it is below 0.4 %, where a wall is gone or a pocket is full it is several times this
TURNED_OVER = 0.02
MOST_SCALE_ERROR = 0.1
SAME_SIDE = 0.7  # cosine: a face looks along an axis up to 45 deg
CORNERS_TRIED = 200


@dataclasses.dataclass(frozen=True, kw_only=True)
class InvestmentCasting:
    """How a casting differs from its CAD model; the defaults are an investment casting's.

    The offset along the outward normal is ``allowance_mm + w``, with w a Gaussian random field of
    zero mean, cut off at `CUT` standard deviations: with the defaults it is 0.05 to 0.95 mm.

    Attributes:
      allowance_mm: machining stock, the same everywhere; negative where too little is left.
      waviness_mm: standard deviation of w; 0 for none.
      wavelength_mm: correlation length of w: points r apart correlate by
        ``exp(-(r / wavelength_mm)^2 / 2)``. Its crests lie some 3.6 of these lengths apart.
      bow_mm: how far the middle of the part's longest side is from the line between its ends after
        cooling, in a random direction across it; 0 for none. It comes on top of the offset.
      scale_error: by how much the casting is larger than the CAD model, relative, about the middle
        of the part's bounding box: negative where it shrank more than the pattern allowed for. The
        offset is added after it.

    Raises:
      InputError: a value that no casting can have.
    """

    allowance_mm: float = 0.5
    waviness_mm: float = 0.15
    wavelength_mm: float = 30.0
    bow_mm: float = 0.0
    scale_error: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not math.isfinite(value):
                raise InputError(f"casting {name} must be finite, got {value!r}")
        for name in ("waviness_mm", "bow_mm"):
            if (value := getattr(self, name)) < 0:
                raise InputError(
                    f"casting {name} must be 0 mm or more, got {value!r}; "
                    "its sign is drawn at random"
                )
        if self.wavelength_mm <= 0:
            raise InputError(
                f"casting wavelength_mm must be above 0 mm, got {self.wavelength_mm!r}; "
                "15 to 60 mm is usual"
            )
        if abs(self.scale_error) >= MOST_SCALE_ERROR:
            raise InputError(
                f"casting scale_error must be within {MOST_SCALE_ERROR:g}, got "
                f"{self.scale_error!r}; it is relative: 0.01 is 1 %"
            )


def as_cast(part: Part, casting: InvestmentCasting, rng: np.random.Generator) -> Part:
    """One casting of a part, in the CAD model's frame.

    It is closed, with finer faces where the waviness needs them; without any deviation it is the
    part itself. Waviness and direction of the bow are drawn apart: equal generators give equal
    bits, and each of the two is the same whether or not the other is switched on.

    Raises:
      InputError: the part is no solid, is too large for so short a wavelength, or loses its walls
        or pockets. One that is a small share of the part is not noticed: there the surface crosses
        itself.
    """
    _check_closed(part)
    field_rng, bow_rng = rng.spawn(2)
    has_offset = casting.allowance_mm or casting.waviness_mm
    if not (has_offset or casting.bow_mm or casting.scale_error):
        return part
    points, faces = _refined(part, _longest_edge_mm(part, casting))
    points = points + casting.scale_error * (points - part.center)
    cast = points + _bow(points, casting.bow_mm, bow_rng)
    if has_offset:
        offset = casting.allowance_mm + waviness(points, casting, field_rng)
        cast += offset[:, None] * offset_directions(points, faces)
    return _moved(part, points, cast, faces)


def with_stock_on_one_side(part: Part, axis: Sequence[float] | np.ndarray, stock_mm: float) -> Part:
    """A casting with ``stock_mm`` on the faces that look along ``axis`` [3], in the CAD's frame.

    The faces within 45 deg of the axis move along it, so that a face at 40 deg has 0.77 of the
    stock along its normal. The faces beside them grow to stay closed.

    Raises:
      InputError: the part is no solid, the axis has no direction, no face looks along it, or the
        part loses its walls or pockets, see `as_cast`.
    """
    _check_closed(part)
    axis, length = np.asarray(axis, np.float64), float(np.linalg.norm(axis))
    if axis.shape != (3,) or not (0 < length < math.inf and math.isfinite(stock_mm)):
        raise InputError(
            "stock on one side needs an axis x, y, z that is not zero, and a finite stock in mm; "
            f"got {axis.tolist()} and {stock_mm!r}"
        )
    points, faces = np.array(part.mesh.vertices, np.float64), np.asarray(part.mesh.faces)
    looking = np.asarray(part.mesh.face_normals) @ (axis / length) > SAME_SIDE
    if not looking.any():
        raise InputError(f"{part.name}: no face looks along {axis.tolist()}; choose another axis")
    cast = points.copy()
    cast[np.unique(faces[looking])] += stock_mm * axis / length
    return _moved(part, points, cast, faces)


def without_a_corner(
    part: Part,
    rng: np.random.Generator,
    *,
    sides: tuple[float, float],
    volume: tuple[float, float],
) -> Part:
    """A casting of which a box at a random corner of the bounding box is missing.

    Args:
      part: a solid.
      rng: equal generators give equal bits.
      sides: (least, most) of the box, as shares of the part's sides.
      volume: (least, most) of what is missing, as shares of the part's volume.

    Raises:
      InputError: the part is no solid, or no random box takes away so much.
    """
    _check_closed(part)
    solid, low = _solid(part), np.asarray(part.mesh.bounds[0], np.float64)
    for _ in range(CORNERS_TRIED):
        size = rng.uniform(*sides, 3) * part.extent_mm
        corner = low + rng.integers(0, 2, 3) * (part.extent_mm - size)
        rest = solid - manifold3d.Manifold.cube(size).translate(corner)
        if volume[0] < 1 - rest.volume() / solid.volume() < volume[1]:
            return part_from_mesh(*_arrays(rest), name=f"{part.name} as cast")
    raise InputError(
        f"{part.name}: none of {CORNERS_TRIED} boxes at its corners, {sides[0]:g} to {sides[1]:g} "
        f"of its sides, takes away {volume[0]:g} to {volume[1]:g} of its volume; widen a range"
    )


def waviness(
    points: np.ndarray, casting: InvestmentCasting, rng: np.random.Generator
) -> np.ndarray:
    """The random field w [N] f64, mm, at points [N, 3] in mm, cut off at `CUT` deviations.

    Random Fourier features (Rahimi and Recht, NIPS 2007): wave vectors k ~ N(0, 1 / wavelength^2)
    and ``w = waviness / sqrt(F) sum a cos(k . x) + b sin(k . x)`` with a, b ~ N(0, 1), which has
    the covariance ``waviness^2 exp(-|r|^2 / (2 wavelength^2))``.
    """
    waves = rng.normal(size=(FEATURES, 3)) / casting.wavelength_mm
    cosines, sines = rng.normal(size=(2, FEATURES)) * casting.waviness_mm / math.sqrt(FEATURES)
    if not casting.waviness_mm:
        return np.zeros(len(points))
    phase = points @ waves.T
    field = np.cos(phase) @ cosines + np.sin(phase) @ sines
    return np.clip(field, -CUT * casting.waviness_mm, CUT * casting.waviness_mm)


def _longest_edge_mm(part: Part, casting: InvestmentCasting) -> float:
    """How long an edge of the casting may be to follow its shape."""
    length = float(part.extent_mm.max())
    edge = length / EDGES_PER_BOW if casting.bow_mm else math.inf
    if casting.waviness_mm:
        edge = min(edge, casting.wavelength_mm / EDGES_PER_WAVELENGTH)
    if edge * MOST_EDGES < length:
        least = EDGES_PER_WAVELENGTH * length / MOST_EDGES
        raise InputError(
            f"{part.name}: a part of {length:.3g} mm needs too many faces for wavelength_mm="
            f"{casting.wavelength_mm!r}; take {least:.2g} mm or more"
        )
    return edge


def _refined(part: Part, edge_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [V, 3] f64 and faces [F, 3] of the same surface, with no edge above ``edge_mm``.

    By manifold3d, which splits an edge on both its faces at once; else the surface would tear.
    """
    if not math.isfinite(edge_mm):
        return np.array(part.mesh.vertices, np.float64), np.array(part.mesh.faces, np.int64)
    return _arrays(_solid(part).refine_to_length(edge_mm))


def _solid(part: Part) -> manifold3d.Manifold:
    points = np.array(part.mesh.vertices, np.float64)
    faces = np.array(part.mesh.faces, np.uint64)
    solid = manifold3d.Manifold(manifold3d.Mesh64(points, faces))
    if solid.status() != manifold3d.Error.NoError:
        raise InputError(
            f"{part.name}: its mesh cannot be refined or cut ({solid.status().name}); "
            "export the part again as one solid body"
        )
    return solid


def _arrays(solid: manifold3d.Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Points [V, 3] f64 and faces [F, 3] i64."""
    mesh = solid.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int64)


def _check_closed(part: Part) -> None:
    if not part.closed:
        raise InputError(
            f"{part.name}: no casting can be made of an open surface; "
            "export the part as one solid body"
        )


def _moved(part: Part, before: np.ndarray, after: np.ndarray, faces: np.ndarray) -> Part:
    """The part with its vertices [V, 3] moved, where this leaves a solid."""
    old, new = (
        np.cross(*np.diff(points[faces], axis=1).swapaxes(0, 1)) for points in (before, after)
    )
    area = np.linalg.norm(old, axis=1)
    turned = np.sum(old * new, axis=1) < 0
    volume = np.sum(after[faces[:, 0]] * new)  # times 6, signed
    if volume <= 0 or area[turned].sum() > TURNED_OVER * area.sum():
        raise InputError(
            f"{part.name}: with this stock the part loses its walls or fills its pockets; "
            "the amount must be below half of their width"
        )
    return part_from_mesh(after, faces, name=f"{part.name} as cast")


def _bow(points: np.ndarray, bow_mm: float, rng: np.random.Generator) -> np.ndarray:
    """Displacements [N, 3] f64, mm, of points [N, 3] by a quadratic bend across the longest side.

    ``bow (s^2 - 1/3)`` with s from -1 to 1 along that side: over it the mean is zero, so that the
    bow is as little of a translation as it can be.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    long = int(np.argmax(high - low))
    angle = rng.uniform(0, 2 * np.pi)
    across = np.zeros(3)
    across[[k for k in range(3) if k != long]] = np.cos(angle), np.sin(angle)
    s = (2 * points[:, long] - low[long] - high[long]) / (high[long] - low[long])
    return bow_mm * np.outer(s**2 - 1 / 3, across)
