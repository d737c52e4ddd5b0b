"""The virtual camera, its viewpoints on the hemisphere, and their pose labels.

Camera frame: origin at the camera, x right, y up, +z from the part to the camera, so the camera
looks along -z and the depth of a point is ``-z``. Image: column to the right, row downwards; the
centre of pixel (column, row) is (column + 0.5, row + 0.5). All is float64, in mm and degrees.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vanejax.errors import InputError
from vanejax.rigid import RigidTransform

FORMULAS = ("sphere", "printed")
TEST_AZIMUTH_STEP_DEG = 40.0


def field_of_view_deg(extent_mm: float, distance_mm: float) -> float:
    """Full opening angle that spans ``extent_mm`` at ``distance_mm``: paper, eq. 3.

    ``tan(w / 2) = ab / (2 oc)``. The text calls ab the diagonal of the field of view, but its
    0.73 rad = 41.9 deg is what the 230 mm *width* at 300 mm gives; the height is another angle.
    """
    return math.degrees(2 * math.atan(extent_mm / (2 * distance_mm)))


@dataclasses.dataclass(frozen=True)
class Camera:
    """Pinhole model of the structured-light camera; the defaults are the paper's Table 2.

    The near field of view, 230 x 140 mm at 300 mm, gives 41.9 x 26.3 deg by eq. 3. With
    1280 x 1024 pixels the pixels are not square (``fx`` differs from ``fy``): so does the table.

    Attributes:
      width, height: image size in pixels.
      fov_x_deg, fov_y_deg: full horizontal and vertical opening angles.
      near_mm, far_mm: clip planes, as depths along the optical axis (PCL's clip distances).

    A value that no camera can have raises InputError.
    """

    width: int = 1280
    height: int = 1024
    fov_x_deg: float = field_of_view_deg(230.0, 300.0)
    fov_y_deg: float = field_of_view_deg(140.0, 300.0)
    near_mm: float = 300.0
    far_mm: float = 1300.0

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if isinstance(size, bool) or not isinstance(size, int | np.integer) or size < 1:
                raise InputError(f"camera {name} must be a whole number of pixels, got {size!r}")
        for name in ("fov_x_deg", "fov_y_deg"):
            angle = getattr(self, name)
            if not 0 < angle < 180:
                raise InputError(f"camera {name} must lie between 0 and 180 degrees, got {angle!r}")
        if not 0 < self.near_mm < self.far_mm < math.inf:
            raise InputError(
                "camera clip distances must satisfy 0 < near_mm < far_mm, in millimetres; got "
                f"near_mm={self.near_mm!r}, far_mm={self.far_mm!r}"
            )

    @property
    def fx(self) -> float:
        """Horizontal focal length in pixels."""
        return self.width / (2 * math.tan(math.radians(self.fov_x_deg) / 2))

    @property
    def fy(self) -> float:
        """Vertical focal length in pixels."""
        return self.height / (2 * math.tan(math.radians(self.fov_y_deg) / 2))

    @property
    def cx(self) -> float:
        """Column of the optical axis: the middle of the image."""
        return self.width / 2

    @property
    def cy(self) -> float:
        """Row of the optical axis: the middle of the image."""
        return self.height / 2

    def extent_mm(self, depth_mm: float) -> tuple[float, float]:
        """Width and height of the field of view at a depth, both in mm."""
        return depth_mm * self.width / self.fx, depth_mm * self.height / self.fy

    @property
    def part_sizes_mm(self) -> tuple[float, float]:
        """The smallest and the largest part that makes sense before this camera.

        A fortieth of the near field's width, and the diagonal of the far field.
        """
        return self.extent_mm(self.near_mm)[0] / 40, math.hypot(*self.extent_mm(self.far_mm))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Camera-frame points [..., 3] in mm to continuous (column, row) [..., 2] f64.

        NaN at or behind the camera's plane.
        """
        points = np.asarray(points, np.float64)
        depth = np.where(points[..., 2] < 0, -points[..., 2], np.nan)
        column = self.cx + self.fx * points[..., 0] / depth
        row = self.cy - self.fy * points[..., 1] / depth
        return np.stack([column, row], axis=-1)

    def slopes(self, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """X and y, f64, of the rays ``depth * (x, y, -1)`` through pixels of any shapes."""
        x = (np.asarray(columns, np.float64) + 0.5 - self.cx) / self.fx
        y = (self.cy - 0.5 - np.asarray(rows, np.float64)) / self.fy
        return x, y

    def scaled(self, factor: float) -> Camera:
        """The same field of view and clip planes with ``factor`` times the pixels per side."""
        if not 0 < factor < math.inf:
            raise InputError(f"resolution factor must be positive, got {factor!r}")
        width, height = (max(1, round(size * factor)) for size in (self.width, self.height))
        return dataclasses.replace(self, width=width, height=height)

    def to_dict(self) -> dict[str, Any]:
        """Plain values by field name, for files."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Camera:
        """Inverse of `to_dict`; a wrong name is an error that lists the right ones."""
        names = [field.name for field in dataclasses.fields(cls)]
        wrong = sorted(set(values) - set(names))
        if wrong:
            raise InputError(f"no camera field {', '.join(wrong)}; the fields are {names}")
        return cls(**values)


def look_at(position: np.ndarray, target: np.ndarray) -> RigidTransform:
    """camera_from_part of cameras at ``position`` that look at ``target``: paper, eqs 4 to 7.

    ``D = P - target`` (4), ``R = u0 x D`` (5), ``U = D x R`` (6), and camera_from_part has the
    rows R, U, D and the translation ``-[R U D] P`` (7); the axes are made unit vectors, as the text
    says and the equations do not. The up vector ``u0 = (0, 1, 0)`` gives no R for a camera along
    the part's y axis: there R is +x.

    Positions are [..., 3], targets [3] or [..., 3], mm, part frame; the result, rotations
    [..., 3, 3] and translations [..., 3] f64, maps ``target`` to (0, 0, -r). Non-finite
    coordinates, or a camera at its target, raise InputError.
    """
    position, target = np.asarray(position, np.float64), np.asarray(target, np.float64)
    if position.shape[-1:] != (3,) or target.shape[-1:] != (3,):
        raise InputError(f"look_at needs [..., 3] points, got {position.shape}, {target.shape}")
    if not (np.isfinite(position).all() and np.isfinite(target).all()):
        raise InputError("look_at needs finite coordinates in millimetres")
    d = position - target
    distance = np.linalg.norm(d, axis=-1, keepdims=True)
    if (distance == 0).any():
        raise InputError("the camera stands at the point it should look at; move it away")
    d = d / distance
    # u0 x D = (D_z, 0, -D_x); below 1e-6 its direction is rounding error
    r = np.stack([d[..., 2], np.zeros_like(d[..., 0]), -d[..., 0]], axis=-1)
    length = np.linalg.norm(r, axis=-1, keepdims=True)
    along_y = length < 1e-6
    r = np.where(along_y, np.array([1.0, 0.0, 0.0]), r / np.where(along_y, 1.0, length))
    u = np.cross(d, r)
    u = u / np.linalg.norm(u, axis=-1, keepdims=True)
    # second cross product: keeps R orthogonal to D in the fallback too
    rotation = np.stack([np.cross(u, d), u, d], axis=-2)
    position = np.broadcast_to(position, d.shape)
    return RigidTransform(rotation, -(rotation @ position[..., None])[..., 0])


@dataclasses.dataclass(frozen=True, eq=False)
class Viewpoints:
    """Camera poses around a part; V views.

    Attributes:
      elevation_deg: [V] f64, alpha of Algorithm 1: angle above the part's xy plane.
      azimuth_deg: [V] f64, beta of Algorithm 1: angle about the part's z axis, from x.
      camera_from_part: the label M of eq. 7; rotation [V, 3, 3], translation [V, 3] f64, mm.
    """

    elevation_deg: np.ndarray
    azimuth_deg: np.ndarray
    camera_from_part: RigidTransform

    def __len__(self) -> int:
        return len(self.elevation_deg)

    @property
    def position(self) -> np.ndarray:
        """Camera positions [V, 3] f64, mm, part frame."""
        return self.camera_from_part.inverse().translation

    @property
    def is_test(self) -> np.ndarray:
        """[V] bool: azimuth in 0, 40, ..., 320 (paper, section III.D); 54 of the 216 views."""
        turns = self.azimuth_deg / TEST_AZIMUTH_STEP_DEG
        return np.abs(turns - np.round(turns)) < 1e-9

    def view(self, index: int | np.ndarray) -> RigidTransform:
        """camera_from_part of one view: rotation [3, 3], translation [3]; or of several."""
        return RigidTransform(*(values[index] for values in self.camera_from_part))

    def select(self, which: np.ndarray) -> Viewpoints:
        """The views at the indices, slice or [V] bool mask ``which``, in that order."""
        return Viewpoints(self.elevation_deg[which], self.azimuth_deg[which], self.view(which))


def hemisphere_viewpoints(
    center: np.ndarray,
    *,
    distance_mm: float = 400.0,
    elevations_deg: Sequence[float] = (60.0, 65.0, 70.0, 75.0, 80.0, 85.0),
    azimuths_deg: Sequence[float] = tuple(range(0, 360, 10)),
    formula: str = "sphere",
) -> Viewpoints:
    """The viewpoints of Algorithm 1, elevation in the outer loop: 6 x 36 = 216 by default.

    The cameras look at ``center`` [3] mm, part frame, from r = ``distance_mm`` away, at elevations
    a from -90 to 90 and azimuths b. ``"sphere"`` is what the text means, a hemisphere about the
    part's centre: ``r (cos a cos b, cos a sin b, sin a)``. ``"printed"`` is what the algorithm
    prints, ``r (sin a cos b, cos a sin b, sin a)``: no sphere, 490 to 563 mm away at azimuth 0.
    Values that give no viewpoint raise InputError.
    """
    center = np.asarray(center, np.float64)
    if center.shape != (3,) or not np.isfinite(center).all():
        raise InputError(f"the center must be three finite coordinates in mm, got {center}")
    if not 0 < distance_mm < math.inf:
        raise InputError(f"distance_mm must be positive, got {distance_mm!r}")
    if formula not in FORMULAS:
        raise InputError(f"no viewpoint formula {formula!r}; there are {', '.join(FORMULAS)}")
    elevations, azimuths = (np.asarray(a, np.float64) for a in (elevations_deg, azimuths_deg))
    if elevations.ndim != 1 or azimuths.ndim != 1 or not elevations.size or not azimuths.size:
        raise InputError("elevations_deg and azimuths_deg must each list at least one angle")
    if not (np.abs(elevations) <= 90).all() or not np.isfinite(azimuths).all():
        raise InputError("elevations must lie between -90 and 90 degrees, azimuths be finite")
    elevation, azimuth = (m.ravel() for m in np.meshgrid(elevations, azimuths, indexing="ij"))
    a, b = np.radians(elevation), np.radians(azimuth)
    x_factor = np.cos(a) if formula == "sphere" else np.sin(a)
    offset = np.stack([x_factor * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)], axis=-1)
    return Viewpoints(elevation, azimuth, look_at(center + distance_mm * offset, center))
