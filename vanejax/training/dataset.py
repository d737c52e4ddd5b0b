"""The virtual dataset: thinned scans of one part from many views, in memory and on disk."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.files import read_versioned_arrays, write_arrays
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Scan, Viewpoints, scan_views
from vanejax.scans.voxels import voxel_thin

FORMAT = "vanejax scan set"
VERSION = 1
_ARRAYS = ("points", "normals", "counts", "reference_points", "reference_normals", "center")


@dataclasses.dataclass(frozen=True, eq=False)
class ScanSet:
    """Thinned scans of a part with their labels, and the thinned CAD surface they belong to.

    Attributes:
      points: [V, P, 3] f32, mm, camera frame; rows past ``counts`` are zero.
      normals: [V, P, 3] f32, unit, camera frame.
      counts: [V] i32, real rows of each view: the paper's X.
      viewpoints: V poses camera_from_part with their elevation and azimuth.
      reference_points: [Y, 3] f32, mm, part frame.
      reference_normals: [Y, 3] f32, unit, outward.
      center: [3] f64, mm, part frame, and ``radius_mm``: the unit sphere, from the CAD alone.
      source: what it was made from: part name and hash, camera, voxel size, units.
    """

    points: np.ndarray
    normals: np.ndarray
    counts: np.ndarray
    viewpoints: Viewpoints
    reference_points: np.ndarray
    reference_normals: np.ndarray
    center: np.ndarray
    radius_mm: float
    source: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def visible_fraction(self) -> np.ndarray:
        """[V] f64: X / Y, the share of the part's surface that the view sees."""
        return self.counts / len(self.reference_points)

    def select(self, which: np.ndarray) -> ScanSet:
        """The views at the indices or [V] bool mask ``which``."""
        return dataclasses.replace(
            self,
            points=self.points[which],
            normals=self.normals[which],
            counts=self.counts[which],
            viewpoints=self.viewpoints.select(which),
        )

    @property
    def train(self) -> ScanSet:
        """The training views of the paper: 162 of 216."""
        return self.select(~self.viewpoints.is_test)

    @property
    def test(self) -> ScanSet:
        """The test views of the paper: 54 of 216."""
        return self.select(self.viewpoints.is_test)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes an .npz with a checksum; it appears complete or not at all."""
        header = {"format": FORMAT, "version": VERSION}
        header |= {"radius_mm": self.radius_mm, "source": dict(self.source)}
        write_arrays(path, self._arrays(), header)

    def _arrays(self) -> dict[str, np.ndarray]:
        """What a file holds, by name."""
        return {name: getattr(self, name) for name in _ARRAYS} | {
            "elevation_deg": self.viewpoints.elevation_deg,
            "azimuth_deg": self.viewpoints.azimuth_deg,
            "camera_from_part": self.viewpoints.camera_from_part.as_matrix(),
        }


def describe_source(part: Part, camera: Camera, viewpoints: Viewpoints, voxel_mm: float) -> dict:
    """What a scan set of these is made from: two that agree hold the same scans."""
    poses = np.ascontiguousarray(viewpoints.camera_from_part.as_matrix(), "<f8")
    return {
        "part": part.name,
        "part_sha256": part.sha256,
        "camera": camera.to_dict(),
        "viewpoints_sha256": hashlib.sha256(poses.tobytes()).hexdigest(),
        "voxel_mm": voxel_mm,
        "units": "mm",
    }


def make_scan_set(
    part: Part,
    camera: Camera,
    viewpoints: Viewpoints,
    *,
    voxel_mm: float = 1.5,
    progress: bool = True,
) -> ScanSet:
    """Scans a part from every viewpoint and thins scans and CAD surface alike.

    One point per voxel is kept; ``voxel_mm`` must be several times the pixel spacing, so that scans
    and CAD surface end up equally dense and X / Y is the visible share.

    Raises:
      InputError: a view that does not see the part, or a voxel that leaves too few points.
    """
    if not voxel_mm > 0:
        raise InputError(f"voxel_mm must be positive, got {voxel_mm}")

    def thin(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
        kept = voxel_thin(scan.points, voxel_mm=voxel_mm)
        return scan.points[kept], scan.normals[kept]

    scans = scan_views(part, camera, viewpoints, transform=thin, progress=progress)
    points, normals, counts = padded(scans, max(len(points) for points, _ in scans))

    # about 16 samples for each voxel that the surface crosses: hardly one is missed
    drawn = int(np.clip(16 * part.triangles.areas().sum() / voxel_mm**2, 1_000, 4_000_000))
    surface, outward, _ = part.sample(drawn, seed=0)
    kept = voxel_thin(surface, voxel_mm=voxel_mm)
    if len(kept) < 64:
        raise InputError(
            f"voxel_mm={voxel_mm} leaves {len(kept)} points of the whole part "
            f"({part.extent_mm.max():.3g} mm large); take a smaller voxel"
        )
    return ScanSet(
        points=points,
        normals=normals,
        counts=counts,
        viewpoints=viewpoints,
        reference_points=surface[kept].astype(np.float32),
        reference_normals=outward[kept].astype(np.float32),
        center=part.center,
        radius_mm=part.radius,
        source=describe_source(part, camera, viewpoints, voxel_mm),
    )


def padded(
    clouds: Sequence[tuple[np.ndarray, np.ndarray]], rows: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points and normals of clouds as [V, rows, 3] f32, zero past their counts [V] i32."""
    counts = np.array([len(points) for points, _ in clouds], np.int32)
    both = np.zeros((2, len(clouds), rows, 3), np.float32)
    for view, cloud in enumerate(clouds):
        both[:, view, : counts[view]] = cloud
    return both[0], both[1], counts


def load_scan_set(
    path: str | os.PathLike[str], *, expected: Mapping[str, Any] | None = None
) -> ScanSet:
    """Reads what `ScanSet.save` wrote; nothing in the file is unpickled or trusted.

    It must have been made from what is ``expected``, as `describe_source` gives it.

    Raises:
      InputError: no such file, not a scan set, another version, truncated, changed, or stale.
    """
    arrays, header = read_versioned_arrays(
        path, FORMAT, VERSION, words="a scan set", remedy="delete it and scan again"
    )
    if missing := {"radius_mm", "source", "sha256"} - set(header):
        raise InputError(f"{path}: its header has no {', '.join(sorted(missing))}")
    source = header["source"]
    for key, value in (expected or {}).items():
        if source.get(key) != value:
            raise InputError(
                f"{path}: stale: made with {key} = {source.get(key)}, wanted {value}; "
                "delete it or choose another folder"
            )
    try:
        poses = RigidTransform.from_matrix(arrays["camera_from_part"])
        viewpoints = Viewpoints(arrays["elevation_deg"], arrays["azimuth_deg"], poses)
        own = {name: arrays[name] for name in _ARRAYS}
        radius_mm = float(header["radius_mm"])
        scans = ScanSet(**own, viewpoints=viewpoints, radius_mm=radius_mm, source=source)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path}: not a whole scan set ({error})") from error
    views = len(scans.counts)
    consistent = (
        scans.points.ndim == 3
        and scans.points.shape == scans.normals.shape
        and len(scans.points) == len(viewpoints) == len(viewpoints.azimuth_deg) == views
        and arrays["camera_from_part"].shape == (views, 4, 4)
        and scans.reference_points.shape == scans.reference_normals.shape
        and scans.counts.min(initial=1) >= 1
        and scans.counts.max(initial=1) <= scans.points.shape[1]
    )
    if not consistent:
        raise InputError(f"{path}: the shapes of its arrays do not fit together")
    return scans
