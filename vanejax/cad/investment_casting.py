"""The part as it is cast: machining stock, waviness and distortion that its CAD model lacks.

All in the CAD model's own frame: a pose found on a scan of the casting is compared with the CAD
model's.
"""

from __future__ import annotations

import dataclasses
import math

import manifold3d
import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import LinearOperator, cg

from vanejax.cad.part import Part, part_from_mesh
from vanejax.cad.triangles import Triangles
from vanejax.errors import InputError

CUT = 3.0  # standard deviations of the waviness: 0.3 % of the surface has more, and is cut off
FEATURES = 256  # of the random field; its covariance is then off by a sixteenth of the variance
EDGES_PER_WAVELENGTH = 5  # straight edges miss 0.9 % of the waviness
EDGES_PER_BOW = 16  # along the part: they miss 0.4 % of the bow
MOST_EDGES = 200  # along the part: 1,000,000 faces
# of the largest eigenvalue of the faces' normals: below, the faces at a vertex are one plane or
# two, and the vertex is not moved along the directions that they leave open
FLAT = 0.02
# both per mm of offset: how far a face may be from where it belongs if that makes the surface
# smoother, and how far along a face its vertices give way to a corner's
SLACK_MM, REACH_MM = 0.03, 10.0


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

    Raises:
      InputError: a value that no casting can have.
    """

    allowance_mm: float = 0.5
    waviness_mm: float = 0.15
    wavelength_mm: float = 30.0
    bow_mm: float = 0.0

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


def as_cast(part: Part, casting: InvestmentCasting, rng: np.random.Generator) -> Part:
    """One casting of a part, in the CAD model's frame.

    It is closed, with finer faces where the waviness needs them; without any deviation it is the
    part itself. Waviness and direction of the bow are drawn apart: equal generators give equal
    bits, and each of the two is the same whether or not the other is switched on.

    Raises:
      InputError: the part is no solid, or too large for so short a wavelength.
    """
    if not part.closed:
        raise InputError(f"{part.name}: an open surface has no outside to leave stock on")
    field_rng, bow_rng = rng.spawn(2)
    if not (casting.allowance_mm or casting.waviness_mm or casting.bow_mm):
        return part
    points, faces = _refined(part, _longest_edge_mm(part, casting))
    offset = casting.allowance_mm + waviness(points, casting, field_rng)
    cast = points + offset[:, None] * offset_directions(points, faces)
    cast += _bow(points, casting.bow_mm, bow_rng)
    return part_from_mesh(cast, faces, name=f"{part.name} as cast")


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


def offset_directions(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """By how much each vertex moves when every face moves outward by 1 mm: [V, 3] f64.

    The field u that minimises, over the surface, ``((n . u - 1) / SLACK_MM)^2 + |grad u|^2 +
    |u - d|^2 / REACH_MM^2`` with the faces' normals n and the directions d of `_mitres`. On a
    smooth surface it is the unit normal and at the edge of a box it is sqrt(2) long, to one per
    mille. In a concave corner the mitres alone would fold the surface over: there vertices of a
    flat face that are near the corner must move along the face out of its way, and do.
    """
    shapes = Triangles(points, faces)
    area = shapes.areas()
    cross = np.cross(*np.diff(points[faces], axis=1).swapaxes(0, 1))
    normals = cross / np.maximum(2 * area, 1e-30)[:, None]
    start = _mitres(points, faces, normals)
    squares, total = _at_vertices(len(points), faces, normals, np.repeat(area[:, None] / 3, 3, 1))
    smooth = _laplacian(points, faces, area)
    own_area = np.bincount(faces.ravel(), np.repeat(area / 3, 3), len(points))[:, None]
    local = squares / SLACK_MM**2 + own_area[..., None] / REACH_MM**2 * np.eye(3)
    wanted = total / SLACK_MM**2 + own_area / REACH_MM**2 * start
    inverse = np.linalg.inv(local + smooth.diagonal()[:, None, None] * np.eye(3))

    def product(blocks: np.ndarray, flat: np.ndarray) -> np.ndarray:
        return np.einsum("vij,vj->vi", blocks, flat.reshape(-1, 3))

    def applied(flat: np.ndarray) -> np.ndarray:
        return (product(local, flat) + smooth @ flat.reshape(-1, 3)).ravel()

    size = (start.size, start.size)
    near = LinearOperator(size, lambda flat: product(inverse, flat).ravel())
    # to 1e-5 of the offset, which is below a millimetre
    options = {"x0": start.ravel(), "rtol": 1e-5, "maxiter": 500, "M": near}
    directions, _ = cg(LinearOperator(size, applied), wanted.ravel(), **options)
    return directions.reshape(-1, 3)


def _mitres(points: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The shortest d [V, 3] with ``n . d = 1`` for the faces at a vertex, weighted by angle."""
    edges = np.roll(points[faces], -1, axis=1) - points[faces]
    along = edges / np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-30)
    cosine = -np.einsum("fki,fki->fk", along, np.roll(along, 1, axis=1))
    angle = np.arccos(np.clip(cosine, -1, 1))
    squares, total = _at_vertices(len(points), faces, normals, angle)
    values, vectors = np.linalg.eigh(squares)
    known = values > FLAT * values[:, -1:]
    solved = np.einsum("vij,vi->vj", vectors, total)
    solved = np.where(known, solved / np.where(known, values, 1.0), 0.0)
    return np.einsum("vij,vj->vi", vectors, solved)


def _at_vertices(
    count: int, faces: np.ndarray, normals: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over a vertex's faces of ``w n n^T`` [V, 3, 3] and ``w n`` [V, 3]; weight [F, 3]."""
    squares, total = np.zeros((count, 3, 3)), np.zeros((count, 3))
    outer = normals[:, :, None] * normals[:, None, :]
    for k in range(3):
        np.add.at(squares, faces[:, k], weight[:, k, None, None] * outer)
        np.add.at(total, faces[:, k], weight[:, k, None] * normals)
    return squares, total


def _laplacian(points: np.ndarray, faces: np.ndarray, area: np.ndarray) -> csr_array:
    """[V, V]: ``u^T L u`` is about the integral of ``|grad u|^2`` over the surface.

    An edge weighs two thirds of its faces' area by its squared length. The cotangent formula is
    exact, but slivers make it indefinite.
    """
    first, second = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    squared = np.maximum(np.sum((points[first] - points[second]) ** 2, axis=1), 1e-12)
    weight = np.repeat(area, 3) * (2 / 3) / squared
    shape = (len(points), len(points))
    ways = csr_array((weight, (first, second)), shape=shape)
    ways = ways + ways.T
    return csr_array(diags_array(np.asarray(ways.sum(axis=1))) - ways)


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
    points = np.array(part.mesh.vertices, np.float64)
    faces = np.array(part.mesh.faces, np.uint64)
    if math.isfinite(edge_mm):
        solid = manifold3d.Manifold(manifold3d.Mesh64(points, faces))
        if solid.status() != manifold3d.Error.NoError:
            raise InputError(
                f"{part.name}: its mesh cannot be refined ({solid.status().name}); "
                "export the part again as one solid body"
            )
        mesh = solid.refine_to_length(edge_mm).to_mesh64()
        points, faces = np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts)
    return points, faces.astype(np.int64)


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
