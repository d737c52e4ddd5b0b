"""Virtual scans of the guide vane and of simple solids, their true poses, and poses near them."""

from __future__ import annotations

import functools

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from vanejax.cad.parametric_vane import guide_vane
from vanejax.cad.part import Part, part_from_mesh
from vanejax.localization.residuals import RayCasting, measurement_model
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Camera, hemisphere_viewpoints
from vanejax.scanner.ideal_scan import Scan

SMALL = Camera(width=160, height=128)  # sees the vane with 2,300 points
MIDDLE = Camera(width=400, height=320)  # with 14,000
VIEW = 103  # of the 216: 70 deg of elevation


def solid(*meshes: trimesh.Trimesh, name: str = "solid") -> Part:
    """Meshes as one part."""
    mesh = trimesh.util.concatenate(meshes)
    return part_from_mesh(mesh.vertices, mesh.faces, name=name)


@functools.cache
def vane() -> Part:
    return guide_vane()


@functools.cache
def box(x: float = 80.0, y: float = 50.0, z: float = 30.0) -> Part:
    """A box with its middle at (7, -4, 11) mm: no part's frame sits in its middle by itself."""
    mesh = trimesh.creation.box((x, y, z))
    return part_from_mesh(mesh.vertices + np.array([7.0, -4.0, 11.0]), mesh.faces, name="box")


@functools.cache
def bracket() -> Part:
    """An angle with legs of 80 and 50 mm and a boss at one corner: no symmetry at all."""
    legs_and_boss = [
        trimesh.creation.box(bounds=[[0, 0, 0], [80, 40, 10]]),
        trimesh.creation.box(bounds=[[0, 0, 0], [10, 40, 50]]),
        trimesh.creation.box(bounds=[[60, 5, 0], [75, 20, 25]]),
    ]
    return solid(trimesh.boolean.union(legs_and_boss), name="bracket")


@functools.cache
def model(part: Part) -> RayCasting:
    """The part seen from the scan's origin."""
    return measurement_model(part, np.zeros(3))


def ideal_scan(
    part: Part, view: RigidTransform | int = VIEW, camera: Camera = SMALL
) -> tuple[Scan, RigidTransform]:
    """What a sensor without noise measures, and the true part_from_camera."""
    if isinstance(view, int):
        view = hemisphere_viewpoints(part.center).view(view)
    return model(part).scanner.scan(camera, view), view.inverse()


def measured_points(
    part: Part,
    view: RigidTransform | int = VIEW,
    *,
    camera: Camera = SMALL,
    noise_mm: float = 0.1,
    seed: int = 0,
) -> tuple[np.ndarray, RigidTransform]:
    """Points [N, 3] f64, mm, with white noise along the rays, and the true part_from_camera."""
    scan, truth = ideal_scan(part, view, camera)
    return with_noise(exact_points(part, scan), noise_mm, seed), truth


def exact_points(part: Part, scan: Scan) -> np.ndarray:
    """The scan's points [N, 3] in f64: a scan's own are f32, good to 1e-5 mm only."""
    points = scan.points.astype(np.float64)
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    pose = scan.camera_from_part.inverse()
    sensor = np.broadcast_to(pose.translation, directions.shape)
    hits = model(part).scanner.cast(sensor, pose.rotate(directions))
    keep = np.abs(hits.distance_mm - scan.range_mm) < 0.01  # not those that slip off an edge
    return hits.distance_mm[keep, None] * directions[keep]


def with_noise(points: np.ndarray, noise_mm: float | np.ndarray, seed: int) -> np.ndarray:
    """Points [N, 3] moved along their rays from the origin."""
    rng = np.random.default_rng(seed)
    error = noise_mm * rng.normal(size=len(points))
    return points * (1 + error / np.linalg.norm(points, axis=1))[:, None]


def batch(*poses: RigidTransform) -> RigidTransform:
    """[H, 3, 3] and [H, 3] of single poses."""
    return RigidTransform(
        np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses])
    )


def motion(part: Part, turn_deg: np.ndarray, shift_mm: np.ndarray) -> RigidTransform:
    """Of the part's frame: a turn about the part's centre, then a shift."""
    turn = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix()
    return RigidTransform(turn, part.center - turn @ part.center + np.asarray(shift_mm))


def disturbed(
    part: Part, pose: RigidTransform, turn_deg: float, shift_mm: float, seed: int
) -> RigidTransform:
    """A pose off by that much about and along random directions."""
    axis, along = np.random.default_rng(seed).normal(size=(2, 3))
    axis, along = axis / np.linalg.norm(axis), along / np.linalg.norm(along)
    return motion(part, turn_deg * axis, shift_mm * along) @ pose


def small_motion(part: Part, found: RigidTransform, truth: RigidTransform) -> np.ndarray:
    """[6] e = (rotation vector in rad, translation in mm) that `Uncertainty` is about."""
    between = truth @ found.inverse()
    turn = Rotation.from_matrix(between.rotation).as_rotvec()
    return np.concatenate([turn, between.apply(part.center[None])[0] - part.center])


def pose_error(part: Part, found: RigidTransform, truth: RigidTransform) -> tuple[float, float]:
    """Degrees, and mm at the part's centre."""
    e = small_motion(part, found, truth)
    return float(np.degrees(np.linalg.norm(e[:3]))), float(np.linalg.norm(e[3:]))


def random_view(part: Part, seed: int, distance_mm: float = 400.0) -> RigidTransform:
    """camera_from_part of the part turned any way, before the camera."""
    turn = Rotation.random(random_state=seed).as_matrix()
    return RigidTransform(turn, np.array([0.0, 0.0, -distance_mm]) - turn @ part.center)
