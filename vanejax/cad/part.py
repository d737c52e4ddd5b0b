"""The workpiece: a CAD file becomes a closed solid in millimetres, with samples of its surface."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import os
from pathlib import Path

import numpy as np
import trimesh

from vanejax.cad.cad_file import MM_PER_UNIT, read_triangles
from vanejax.cad.mesh_repair import open_surface, repair_solid
from vanejax.cad.triangles import Triangles
from vanejax.errors import InputError
from vanejax.files import atomic_write

# in the order in which a wrong unit is likely: "ft" comes last, few write CAD in it
_UNIT_NAMES = {
    "mm": "millimetres",
    "m": "metres",
    "in": "inches",
    "cm": "centimetres",
    "um": "micrometres",
    "ft": "feet",
}

SIZES_MM = (5.75, 1166.8)
"""The smallest and the largest part that the paper's camera resolves and sees whole, mm."""

_SMALL = 5  # times the smallest size: worth a note about the unit


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """A workpiece in its own frame, the CAD model's.

    Attributes:
      mesh: closed surface, outward faces, mm, read-only. Its vertices are float32
        values (exact in STL and in Embree), sorted, and so are its faces: the same geometry has
        the same arrays, and face ids mean the same, whatever file it came from.
      name: for reports; the file's stem.
      notes: what was repaired, a sentence each.
      closed: whether it is a solid; if not, its faces may look either way, and are seen from both
        sides.
    """

    mesh: trimesh.Trimesh
    name: str
    notes: tuple[str, ...] = ()
    closed: bool = True

    @functools.cached_property
    def triangles(self) -> Triangles:
        """The mesh as two arrays, not copied; to go through its faces block by block."""
        return Triangles(np.asarray(self.mesh.vertices), np.asarray(self.mesh.faces))

    @functools.cached_property
    def center(self) -> np.ndarray:
        """[3] f64, mm: the middle of the axis-aligned bounding box."""
        return np.asarray(self.mesh.bounds, np.float64).mean(axis=0)

    @functools.cached_property
    def radius(self) -> float:
        """The largest distance of a vertex from `center`, mm."""
        return float(np.linalg.norm(self.mesh.vertices - self.center[None], axis=1).max())

    @functools.cached_property
    def extent_mm(self) -> np.ndarray:
        """[3] f64: sides of the axis-aligned bounding box."""
        return np.ptp(self.mesh.bounds, axis=0)

    @functools.cached_property
    def sha256(self) -> str:
        """Hex digest of the geometry: float32 vertices, then int32 faces, little-endian."""
        digest = hashlib.sha256(np.ascontiguousarray(self.mesh.vertices, "<f4").tobytes())
        digest.update(np.ascontiguousarray(self.mesh.faces, "<i4").tobytes())
        return digest.hexdigest()

    def sample(self, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``count`` points drawn uniformly over the area; the same seed gives the same points.

        Returns:
          points [N, 3] f64, mm; outward unit normals [N, 3] f64; face [N] i32.
        """
        if count < 1:
            raise InputError(f"cannot draw {count} points; ask for at least 1")
        rng = np.random.default_rng(seed)
        total = np.cumsum(self.triangles.areas())
        # side="right" never lands on a face without area
        face = np.searchsorted(total, rng.random(count) * total[-1], side="right")
        corners = self.triangles.points[self.triangles.faces[face]]
        a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        cross = np.cross(ab, ac)
        u, v = rng.random((2, count, 1))
        outside = u + v > 1  # the other half of the parallelogram: fold it back
        u, v = np.where(outside, 1 - u, u), np.where(outside, 1 - v, v)
        normals = cross / np.linalg.norm(cross, axis=1, keepdims=True)
        return a + u * ab + v * ac, normals, face.astype(np.int32)

    def export(self, path: str | os.PathLike[str]) -> None:
        """Writes .stl, .ply or .obj in mm, or .glb in metres (as its standard says).

        The file appears complete or not at all. STL and PLY keep every bit: `load_part` with
        ``units="mm"`` gives the same `sha256`.

        Raises:
          InputError: unknown suffix, or a folder that cannot be written.
        """
        path = Path(path)
        suffix = path.suffix.lower()
        if suffix not in (".stl", ".ply", ".obj", ".glb"):
            raise InputError(
                f"{path}: cannot write {suffix or 'a file without suffix'}; "
                "use .stl, .ply, .obj or .glb"
            )
        written = self.mesh
        if suffix == ".glb":
            # glTF is in metres: the node scales, so that the vertices keep every bit
            written = trimesh.Scene()
            written.add_geometry(self.mesh, transform=np.diag([1e-3, 1e-3, 1e-3, 1.0]))
        data = written.export(file_type=suffix[1:])
        with atomic_write(path) as partial:
            partial.write_bytes(data.encode() if isinstance(data, str) else data)


def load_part(
    path: str | os.PathLike[str],
    *,
    units: str,
    sizes_mm: tuple[float, float] = SIZES_MM,
    must_be_closed: bool = True,
) -> Part:
    """Reads a CAD file: STL, OBJ, PLY, GLB, GLTF, or STEP with the extra ``vanejax[step]``.

    Args:
      path: the file; nothing is written beside it.
      units: the unit of the numbers in the file: mm, cm, m, in, ft or um. GLB and GLTF are in
        metres by their standard, so ``"m"`` unless the exporter broke it. STEP knows its unit:
        `units` must agree with it.
      sizes_mm: the smallest and the largest size that make sense, from
        `vanejax.scanner.Camera.part_sizes_mm`: outside of them the unit is wrong.
      must_be_closed: whether to refuse what is no solid. Registration needs none.

    Returns:
      The part in mm, repaired where that is safe; `Part.notes` says what was done.

    Raises:
      InputError: the file cannot be read or is no closed solid, or its size makes no sense in
        `units`; the message says why and what to do.
    """
    path = Path(path)
    vertices, faces, notes = read_triangles(path, units=units)
    finite = vertices
    if not np.isfinite(vertices).all():
        finite = vertices[np.isfinite(vertices).all(axis=1)]
    if len(finite):
        notes += _check_size(float(np.ptp(finite, axis=0).max()), units, sizes_mm, path)
    part = part_from_mesh(vertices, faces, name=path.name, must_be_closed=must_be_closed)
    return dataclasses.replace(part, name=path.stem, notes=(*notes, *part.notes))


def part_from_mesh(
    vertices: np.ndarray, faces: np.ndarray, *, name: str, must_be_closed: bool = True
) -> Part:
    """A part from vertices [V, 3] in mm and faces [F, 3], checked and repaired.

    Raises:
      InputError: it is no closed solid and cannot be made one safely, see `repair_solid`; or,
        without ``must_be_closed``, it is no surface at all.
    """
    closed = True
    try:
        solid, notes = repair_solid(vertices, faces, name=name)
    except InputError as error:
        if must_be_closed:
            raise
        solid, notes = open_surface(vertices, faces, name=name)
        why = str(error).removeprefix(f"{name}: ").partition(";")[0]
        notes = (*notes, f"is taken as an open surface, seen from both sides ({why})")
        closed = False
    mesh = trimesh.Trimesh(solid.points, solid.faces, process=False)
    mesh.mutable = False  # center, radius and sha256 are remembered
    return Part(mesh=mesh, name=name, notes=notes, closed=closed)


def _check_size(
    read: float, units: str, sizes_mm: tuple[float, float], path: Path
) -> tuple[str, ...]:
    """Refuses a longest side ``read`` in mm that the camera does not see, and names a likely unit.

    The answer is empty, or a note where the part is so small that the unit may be wrong.
    """
    smallest, largest = sizes_mm
    sizes = {unit: read / MM_PER_UNIT[units] * MM_PER_UNIT[unit] for unit in _UNIT_NAMES}
    fitting = [unit for unit in sizes if smallest <= sizes[unit] <= largest and unit != units]
    others = ", ".join(f"{unit!r} ({sizes[unit]:.3g} mm)" for unit in fitting)
    if smallest <= read <= largest:
        if read > _SMALL * smallest or not others:
            return ()
        return (f"is only {read:.3g} mm large; if that is wrong, the unit may be {others}",)
    problem = (
        f"more than the {largest:.0f} mm that the camera sees"
        if read > largest
        else f"less than the {smallest:.1f} mm that the camera resolves well"
    )
    message = f"{path}: read as {units} the part is {read:.3g} mm large, {problem}; "
    if not fitting:
        raise InputError(message + "no unit makes it fit: is it the right file and camera?")
    best = fitting[0]
    raise InputError(
        message
        + f"it looks like {_UNIT_NAMES[best]} ({sizes[best]:.3g} mm): use units={best!r}"
        + (f" (possible: {others})" if len(fitting) > 1 else "")
    )
