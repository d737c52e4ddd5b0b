"""Table planes in a scan: larger than any face of the part, with all else on the sensor's side."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import ndimage

from vanejax.cad.part import Part
from vanejax.scans.robust_statistics import robust_sigma
from vanejax.scans.voxels import Voxels

PLANES_TRIED = 3
TRIPLETS = 600
TRIPLET_POINTS = 3_000
# of the part's radius: what a plane is sought with, and the bounds of what it is taken away with
PLANE_REACH, LEAST_THICKNESS, MOST_THICKNESS = 0.01, 0.004, 0.12
THICKNESS_SIGMAS = 4.0
# a plane of the part is not wider than the part, nor larger than its largest flat face
WIDER, LARGER = 1.1, 1.5
BEHIND_SHARE = 0.05  # of what is not the table, what may lie behind it: strays, its own edge


@dataclasses.dataclass(frozen=True, eq=False)
class Plane:
    """Points x with ``normal @ x = offset_mm``.

    Attributes:
      normal: [3] f64, unit, towards what stands on it.
      offset_mm: along it.
      thickness_mm: points nearer than this were taken for the table.
    """

    normal: np.ndarray
    offset_mm: float
    thickness_mm: float

    def height_mm(self, points: np.ndarray) -> np.ndarray:
        """[N] f64 of points [N, 3], mm: above the plane."""
        return points @ self.normal - self.offset_mm


def find_tables(
    voxels: Voxels, part: Part, sensor_origin: np.ndarray | None, seed: int
) -> tuple[Plane, ...]:
    """The planes that are none of the part's, largest first."""
    rng = np.random.default_rng([seed, len(voxels.of_point)])
    middle = voxels.middle
    remaining, untried = np.ones(len(middle), bool), np.ones(len(middle), bool)
    tables: list[Plane] = []
    for _ in range(PLANES_TRIED):
        untried_points = middle[remaining & untried]
        if len(untried_points) < 3:
            break
        plane = _best_plane(untried_points, part, rng)
        on = np.abs(plane.height_mm(middle)) <= plane.thickness_mm
        standing = _standing(plane, middle[remaining & ~on], sensor_origin)
        if standing is not None and _is_beyond(part, plane, middle[remaining & on], voxels.size_mm):
            tables.append(standing)
            remaining &= ~on
        untried &= ~on
    return tuple(tables)


def _best_plane(middle: np.ndarray, part: Part, rng: np.random.Generator) -> Plane:
    """The plane through three of the points [V, 3] that most others lie on, fitted to those."""
    sample = middle[rng.integers(len(middle), size=min(TRIPLET_POINTS, len(middle)))]
    normal, offset = _random_planes(middle, rng)
    on = np.count_nonzero(np.abs(sample @ normal.T - offset) <= PLANE_REACH * part.radius, axis=0)
    best = int(np.argmax(on))
    plane = Plane(normal[best], float(offset[best]), 2 * PLANE_REACH * part.radius)
    for _ in range(3):
        near = middle[np.abs(plane.height_mm(middle)) <= plane.thickness_mm]
        if len(near) < 3:
            break
        mean = near.mean(axis=0)
        normal = np.linalg.eigh((near - mean).T @ (near - mean))[1][:, 0]
        offset = float(normal @ mean)
        height = np.abs(middle @ normal - offset)
        plane = Plane(normal, offset, _thickness_mm(height, plane.thickness_mm, part))
    return plane


def with_noise_thickness(plane: Plane, points: np.ndarray, part: Part) -> Plane:
    """As thick as the noise of the points [N, 3]; the means of voxels have less."""
    height = np.abs(plane.height_mm(points))
    thickness = 2 * PLANE_REACH * part.radius
    for _ in range(3):
        thickness = _thickness_mm(height, thickness, part)
    return dataclasses.replace(plane, thickness_mm=thickness)


def _thickness_mm(height: np.ndarray, thickness_mm: float, part: Part) -> float:
    """From the noise of points at heights [N] mm, above 0, from a plane so thick so far."""
    close = height[height <= 2 * thickness_mm]
    sigma_mm = float(robust_sigma(close)) if len(close) else 0.0
    least, most = LEAST_THICKNESS * part.radius, MOST_THICKNESS * part.radius
    return float(np.clip(THICKNESS_SIGMAS * sigma_mm, least, most))


def _random_planes(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals [T, 3] and offsets [T], mm, of planes through three of the points [V, 3]."""
    a, b, c = points[rng.integers(len(points), size=(3, TRIPLETS))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    # three points on a line fix no plane
    normal, a = normal[length > 0] / length[length > 0, None], a[length > 0]
    return normal, np.einsum("ni,ni->n", normal, a)


def _standing(plane: Plane, others: np.ndarray, sensor_origin: np.ndarray | None) -> Plane | None:
    """The plane with its normal to the side on which all else stands; None if there is none."""
    if not len(others):
        return None
    above = float(np.mean(plane.height_mm(others) > 0))
    if min(above, 1 - above) > BEHIND_SHARE:
        return None
    if above < 0.5:
        plane = Plane(-plane.normal, -plane.offset_mm, plane.thickness_mm)
    if sensor_origin is not None and plane.height_mm(np.asarray(sensor_origin)[None])[0] <= 0:
        return None
    return plane


def _is_beyond(part: Part, plane: Plane, on: np.ndarray, size_mm: float) -> bool:
    """Whether a connected patch of the plane, points [V, 3], is more than any face of the part."""
    axes = np.linalg.svd(plane.normal[None])[2][1:]
    cell_mm = 3 * size_mm
    cell = np.floor(on @ axes.T / cell_mm).astype(np.int64)
    cell -= cell.min(axis=0)
    # of the table, which is millions of cells only where a stray lies far away in the plane
    cell = cell[(cell < 4096).all(axis=1)]
    image = np.zeros(cell.max(axis=0) + 1, bool)
    image[cell[:, 0], cell[:, 1]] = True
    patch, _ = ndimage.label(image, np.ones((3, 3)))
    largest = np.argwhere(patch == 1 + np.argmax(np.bincount(patch[image])[1:]))
    angle = np.radians(np.arange(0, 180, 5))
    across = largest @ np.stack([np.cos(angle), np.sin(angle)])
    width = cell_mm * float(np.ptp(across, axis=0).max())
    if width > WIDER * 2 * part.radius:
        return True
    area = len(largest) * cell_mm**2 - 4 * cell_mm * width  # less a cell all around
    return area > LARGER * largest_slab_mm2(part, 2 * plane.thickness_mm)


def largest_slab_mm2(part: Part, thickness_mm: float, *, seed: int = 0) -> float:
    """Area of the part's surface that lies within a thickness of one plane, the most there is.

    Of both sides and of curved surface too: a table must be larger than what any view could take
    for one.
    """
    sample = part.sample(4_000, seed)[0]
    normal, offset = _random_planes(sample, np.random.default_rng(seed))
    on = np.abs(sample @ normal.T - offset) <= thickness_mm
    return float(part.triangles.areas().sum() * np.mean(on, axis=0).max())
