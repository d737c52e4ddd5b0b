"""Reading the triangles of CAD files. Whatever a file holds, the answer is arrays or `InputError`.

No count that a file states is trusted before it is held against the bytes that are there, nothing
is unpickled, textures and materials are not followed, and nothing is written.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from vanejax.cad.mesh_repair import MAX_FACES
from vanejax.errors import InputError
from vanejax.files import read_head

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "ft": 304.8, "um": 1e-3}
"""Units of length and their size in mm."""

MAX_BYTES = 2**30

# 0.01 mm between a curved face and its triangles, and 0.1 rad (6 deg) between neighbours
_STEP_TOLERANCE = {"tol_linear": 0.01, "tol_angular": 0.1}
_COARSER = "export it with a coarser tolerance (0.01 mm is enough)"

Mesh = tuple[np.ndarray, np.ndarray, tuple[str, ...]]
"""Vertices [V, 3] f64 in mm, faces [F, 3] i32 or i64, and a sentence per oddity passed over."""


def read_triangles(path: Path, *, units: str) -> Mesh:
    """All triangles of a file with a suffix of `READERS`; they need not be finite or closed.

    Raises:
      InputError: the file is missing, empty, truncated, too large or of another kind.
    """
    if units not in MM_PER_UNIT:
        raise InputError(f"unknown unit {units!r}; use one of {', '.join(MM_PER_UNIT)}")
    suffix = path.suffix.lower()
    if suffix not in READERS and path.is_file():
        what, known = suffix or "a file without suffix", ", ".join(READERS)
        raise InputError(f"{path}: cannot read {what}; use one of {known}")
    read_head(path, max_bytes=MAX_BYTES, advice=_COARSER)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    return READERS[suffix](data, path, units)


_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def _read_stl(data: bytes, path: Path, units: str) -> Mesh:
    corners, notes = _stl_corners(data, path)
    corners *= MM_PER_UNIT[units]
    return corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3), notes


def _stl_corners(data: bytes, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Corners [3F, 3] f64 in file units."""
    stated = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
    held = max(len(data) - 84, 0)
    exact = len(data) >= 84 and held == stated * _FACET.itemsize
    if not exact and data[:256].lstrip()[:5].lower() == b"solid":
        return _read_ascii_stl(data, path), ()
    if not exact and b"\0" not in data[:1024]:
        raise InputError(f"{path}: is no STL file: it holds neither facets nor binary triangles")
    if stated * _FACET.itemsize > held or len(data) < 84:
        raise InputError(
            f"{path}: truncated: it promises {stated:,} triangles ({stated * 50:,} bytes) and "
            f"holds {held:,} bytes of them; copy or export it again"
        )
    if not stated:
        raise InputError(f"{path}: an STL file without triangles; export it again")
    extra = held - stated * _FACET.itemsize
    corners = np.empty((stated, 3, 3))
    corners[:] = np.frombuffer(data, _FACET, count=stated, offset=84)["corners"]
    notes = (f"passed over {extra} bytes after the last triangle",) if extra else ()
    return corners.reshape(-1, 3), notes


def _read_ascii_stl(data: bytes, path: Path) -> np.ndarray:
    """Corners [3F, 3] f64 of the text form of STL."""
    lines = re.findall(rb"\bvertex\s+([^\r\n]*)", data, re.IGNORECASE)
    if not lines:
        raise InputError(f"{path}: an STL file without triangles, or another text; export it again")
    if len(lines) > 3 * MAX_FACES:
        raise InputError(
            f"{path}: {len(lines) // 3:,} triangles are more than {MAX_FACES:,}; {_COARSER}"
        )
    facets = len(re.findall(rb"\bendfacet\b", data, re.IGNORECASE))
    if 3 * facets != len(lines) or not re.search(rb"\bendsolid\b", data[-2048:], re.IGNORECASE):
        raise InputError(
            f"{path}: truncated or damaged: {len(lines)} vertices in {facets} complete facets"
            f"{'' if b'endsolid' in data[-2048:].lower() else ', no endsolid at the end'}; "
            "copy or export it again"
        )
    try:
        corners = np.loadtxt(lines, np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise InputError(f"{path}: a vertex is not three numbers: {error}") from error
    if corners.shape[1] != 3:
        raise InputError(f"{path}: a vertex has {corners.shape[1]} numbers instead of 3")
    return corners


def _read_scene(data: bytes, path: Path, units: str) -> Mesh:
    vertices, faces = _scene_triangles(data, path, path.suffix.lower())
    return vertices * MM_PER_UNIT[units], faces, ()


def _read_step(data: bytes, path: Path, units: str) -> Mesh:
    vertices, faces = _scene_triangles(_glb_of_step(data, path, units), path, ".glb")
    return vertices * 1000.0, faces, ()  # OpenCASCADE writes metres


def _scene_triangles(data: bytes, path: Path, suffix: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] of every mesh in the file, each where its node puts it."""
    promised = {".ply": _ply_counts, ".glb": _gltf_counts, ".gltf": _gltf_counts}
    counts = promised[suffix](data, path) if suffix in promised else {}
    for element, count in counts.items():
        # every element takes a byte or more; glTF may keep them in a file beside it
        if count > (MAX_BYTES if suffix == ".gltf" else len(data)):
            raise InputError(
                f"{path}: truncated: it promises {count:,} of {element} in {len(data):,} bytes; "
                "copy or export it again"
            )
    options = {} if suffix == ".ply" else {"skip_materials": True}
    resolver = trimesh.resolvers.FilePathResolver(str(path)) if suffix == ".gltf" else None
    try:
        scene = trimesh.load_scene(
            io.BytesIO(data), file_type=suffix[1:], resolver=resolver, process=False, **options
        )
        placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
        placed = [(matrix, scene.geometry[geometry]) for matrix, geometry in placed]
    except Exception as error:  # a damaged file can raise anything in a parser
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(
            f"{path}: is no readable {suffix[1:].upper()} file: {reason}; export it again"
        ) from error
    meshes = [(m, g) for m, g in placed if isinstance(g, trimesh.Trimesh) and len(g.faces)]
    if not meshes:
        what = "no triangles; export the solid body"
        if any(isinstance(g, trimesh.PointCloud) for _, g in placed):
            what = "points but no faces: a scan, not a CAD model; give the CAD file"
        raise InputError(f"{path}: holds {what}")
    if any(np.shape(mesh.vertices)[1:] != (3,) for _, mesh in meshes):
        raise InputError(f"{path}: damaged: a vertex is not three numbers; export it again")
    faces = sum(len(mesh.faces) for _, mesh in meshes)
    if faces > MAX_FACES:
        raise InputError(
            f"{path}: {faces:,} faces are more than {MAX_FACES:,}, which fit in memory; {_COARSER}"
        )
    if suffix == ".ply" and len(meshes[0][1].faces) < counts.get("face", 0):
        raise InputError(
            f"{path}: truncated: it promises {counts['face']:,} faces and holds "
            f"{len(meshes[0][1].faces):,}; copy or export it again"
        )
    vertices = [np.asarray(mesh.vertices) @ m[:3, :3].T + m[None, :3, 3] for m, mesh in meshes]
    first = np.cumsum([0, *map(len, vertices[:-1])])
    faces = [
        np.asarray(mesh.faces, np.int64) + i for i, (_, mesh) in zip(first, meshes, strict=True)
    ]
    return np.concatenate(vertices), np.concatenate(faces)


def _ply_counts(data: bytes, path: Path) -> dict[str, int]:
    """How many of each element a PLY header promises."""
    header = data[: max(data.find(b"end_header"), 0)]
    if not data.startswith(b"ply") or not header:
        raise InputError(f"{path}: is no PLY file: it has no header; export it again")
    elements = re.findall(rb"^element\s+(\w+)\s+(\d{1,18})\s*$", header, re.MULTILINE)
    return {name.decode(): int(count) for name, count in elements}


def _gltf_counts(data: bytes, path: Path) -> dict[str, int]:
    """The largest accessor that a GLB or GLTF file promises."""
    try:
        if data[:4] == b"glTF":
            length = int.from_bytes(data[12:16], "little")
            data = data[20 : 20 + length]
        accessors = json.loads(data).get("accessors", [])
        return {"an accessor's elements": max([int(a["count"]) for a in accessors], default=0)}
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: is no readable glTF file; export it again") from error


def _glb_of_step(data: bytes, path: Path, units: str) -> bytes:
    """GLB, in metres, of a STEP file; OpenCASCADE reads the file's own unit."""
    if not data[:1024].lstrip().startswith(b"ISO-10303-21"):
        raise InputError(f"{path}: is no STEP file: it does not start with ISO-10303-21")
    try:
        import cascadio
    except ImportError as error:
        raise InputError(
            f"{path}: STEP files need an extra: pip install 'vanejax[step]' (it brings cascadio), "
            "or export the part as STL"
        ) from error
    own = _step_unit(data)
    if own not in (None, units):
        raise InputError(
            f"{path}: the STEP file says that its unit is {own!r}, not {units!r}: use units={own!r}"
        )
    glb = cascadio.load(data, file_type="step", **_STEP_TOLERANCE)
    if not glb:
        raise InputError(f"{path}: OpenCASCADE finds no shape in this STEP file; export it again")
    return glb


def _step_unit(data: bytes) -> str | None:
    """The unit of length of a STEP file, None where it names none or several."""
    names = {"MILLI": "mm", "CENTI": "cm", "MICRO": "um", None: "m", "INCH": "in", "FOOT": "ft"}
    units = set()
    for listed in re.findall(rb"GLOBAL_UNIT_ASSIGNED_CONTEXT\s*\(\s*\(([^)]*)\)", data):
        for entity in re.findall(rb"#\d+", listed):
            match = re.search(rb"(?<!\w)" + entity + rb"\s*=\s*([^;]*);", data)
            body = match[1].decode("latin-1").upper() if match else ""
            if "LENGTH_UNIT" not in body:
                continue
            si = re.search(r"SI_UNIT\s*\(\s*(?:\.(\w+)\.|\$)\s*,\s*\.METRE\.", body)
            based = re.search(r"CONVERSION_BASED_UNIT\s*\(\s*'(\w+)'", body)
            units.add(names.get(si[1]) if si else names.get(based[1]) if based else None)
    return units.pop() if len(units) == 1 else None


READERS: dict[str, Callable[[bytes, Path, str], Mesh]] = {
    ".stl": _read_stl,
    **dict.fromkeys((".obj", ".ply", ".glb", ".gltf"), _read_scene),
    **dict.fromkeys((".step", ".stp"), _read_step),
}
"""By suffix, what reads the bytes of a file, its path and unit into a mesh: a new format goes here.

Raises InputError for a file that is damaged, truncated or too large.
"""
