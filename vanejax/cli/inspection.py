"""What a file is: a scan, a CAD model, trained weights, a pose; and what to type next."""

from __future__ import annotations

import dataclasses
import os
import shlex
import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from vanejax.cad import cad_file
from vanejax.cad.cad_file import MM_PER_UNIT, read_triangles
from vanejax.cad.part import part_from_mesh
from vanejax.cad.solid_bodies import connected
from vanejax.cad.triangles import Triangles, weld
from vanejax.errors import InputError
from vanejax.files import array_header, read_head
from vanejax.scans import point_file
from vanejax.scans.measured_scan import MIN_POINTS, MeasuredScan, at_place, measured, repeats
from vanejax.scans.point_file import read_points
from vanejax.scans.point_records import PointFile
from vanejax.scans.scan_file import robust_extent
from vanejax.scans.viewpoint import sampled_rows, why_not_from

# diagonals of parts and scans that a structured-light scanner is used for
_SMALLEST_MM, _LARGEST_MM = 5.0, 3000.0
_LIKELY = ("mm", "m", "cm", "in")
_SPACING_POINTS, _SPACING_QUERIES = 1_000_000, 2_000

Kind = Literal["point cloud", "mesh", "weights", "pose", "arrays", "unknown"]


@dataclasses.dataclass(frozen=True)
class Inspection:
    """What `inspect` found; None where a question does not arise for this kind of file.

    Attributes:
      path: as given.
      kind: what the file is.
      format: how it is written, in words.
      size_bytes: of the file.
      points: points of a cloud as written, vertices of a mesh.
      faces: triangles of a mesh.
      extent: sides of the bounding box along x, y, z, in the file's unit.
      units: the likely unit of the file's numbers.
      units_reason: why.
      missing: points that are no measurement: not finite, or (0, 0, 0) where there are several.
      repeated: points that equal an earlier one exactly.
      spacing: median distance to the nearest other point, in the file's unit.
      normals: whether a cloud has them, and which way they point.
      sensor: where the sensor can have stood, or why not at the origin.
      sensor_origin: [3], file's unit; None if it is not plausible.
      looks_along: ``"+z"`` or ``"-z"``, from the sensor to the points; None if neither.
      watertight: whether the faces of a mesh, as written, close.
      bodies: connected pieces of a mesh.
      volume_mm3: of the solid, if the mesh is one or can be repaired to one, in its likely unit.
      notes: repairs and oddities, a sentence each.
      next_steps: commands that make sense now.
    """

    path: str
    kind: Kind
    format: str
    size_bytes: int
    points: int | None = None
    faces: int | None = None
    extent: tuple[float, float, float] | None = None
    units: str | None = None
    units_reason: str | None = None
    missing: int | None = None
    repeated: int | None = None
    spacing: float | None = None
    normals: str | None = None
    sensor: str | None = None
    sensor_origin: tuple[float, float, float] | None = None
    looks_along: Literal["+z", "-z"] | None = None
    watertight: bool | None = None
    bodies: int | None = None
    volume_mm3: float | None = None
    notes: tuple[str, ...] = ()
    next_steps: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain values by field name, for JSON."""
        return dataclasses.asdict(self)

    def text(self) -> str:
        """The findings as lines to read."""
        unit = self.units or ""
        rows = [("file", f"{self.path}: {self.kind}, {self.format}, {_bytes(self.size_bytes)}")]
        if self.points is not None:
            count = f"{self.points:,}" + (f", {self.faces:,} faces" if self.faces else "")
            rows.append(("points", count))
        if self.extent is not None:
            rows.append(("extent", " x ".join(f"{side:.4g}" for side in self.extent) + f" {unit}"))
            rows.append(("unit", f"{self.units or 'unclear'}: {self.units_reason}"))
        if self.spacing is not None:
            rows.append(("spacing", f"{self.spacing:.3g} {unit} to the nearest point (median)"))
        if self.missing or self.repeated:
            rows.append(("dropped", f"{self.missing:,} not measured, {self.repeated:,} repeated"))
        rows += [(n, v) for n in ("normals", "sensor") if (v := getattr(self, n)) is not None]
        if self.watertight is not None:
            closed = "watertight" if self.watertight else "not watertight"
            volume = f", {self.volume_mm3:.5g} mm^3" if self.volume_mm3 is not None else ""
            bodies = "body" if self.bodies == 1 else "bodies"
            rows.append(("surface", f"{closed}, {self.bodies:,} {bodies}{volume}"))
        rows += [("note", note) for note in self.notes]
        rows += [("next", step) for step in self.next_steps]
        return "\n".join(f"{name:<8} {value}" for name, value in rows)


def inspect(path: str | os.PathLike[str]) -> Inspection:
    """Says what a file is; any file that can be read has an answer.

    Raises:
      InputError: the file is missing, empty, a folder, unreadable or damaged.
    """
    path = Path(path)
    head = read_head(path, max_bytes=point_file.MAX_BYTES, advice="thin it first")
    suffix = path.suffix.lower()
    if suffix == ".npz" and head.startswith(b"PK"):
        arrays = _array_names(path)
        if "header" in arrays:
            return _inspect_weights(path, arrays)
        if not {"points", "xyz"} & set(arrays):
            return _inspect_arrays(path, arrays)
    if suffix == ".safetensors":
        return _inspect_weights(path, {})
    if suffix in point_file.READERS:
        file = read_points(path)
        if file.num_faces:
            return _inspect_mesh(path, file.format)
        return _inspect_cloud(path, file)
    if suffix in cad_file.READERS:
        return _inspect_mesh(path, suffix[1:].upper())
    if suffix == ".json":
        return _inspect_json(path)
    kind = "text" if b"\0" not in head and head.isascii() else "binary"
    known = ", ".join(
        dict.fromkeys((*point_file.READERS, *cad_file.READERS, ".json", ".safetensors"))
    )
    note = f"not a file that vanejax reads: {known}"
    return _inspection(path, "unknown", kind, notes=(note,))


def _inspection(path: Path, kind: Kind, written: str, **findings: Any) -> Inspection:
    return Inspection(str(path), kind, written, path.stat().st_size, **findings)


def _inspect_cloud(path: Path, file: PointFile) -> Inspection:
    keep = measured(file.points)
    zero = at_place(file.points, np.zeros(3))
    if np.count_nonzero(zero) > 1:
        keep &= ~zero
    points = file.points[keep]
    normals = None if file.normals is None else file.normals[keep]
    missing = len(file.points) - len(points)
    double = repeats(points) if len(points) else None
    notes = list(file.notes)
    if double is not None:
        points, normals = points[~double], None if normals is None else normals[~double]
    if len(points) < MIN_POINTS:
        notes.append(
            f"{len(points)} distinct points are too few for a pose, which needs {MIN_POINTS}"
        )
    units, reason = _likely_unit(robust_extent(points))
    origin = np.zeros(3) if file.viewpoint is None else file.viewpoint
    place = "the origin" if file.viewpoint is None else f"the file's viewpoint {origin}"
    why = why_not_from(points, origin)
    looks = None if why else MeasuredScan(points, None, origin).looks_along
    sensor = f"{place} {why}" if why else f"can have stood at {place}"
    if looks:
        sensor += f", looking along {looks}"
    steps = []
    if len(points) >= MIN_POINTS:
        steps = [f"vanejax register {shlex.quote(str(path))} PART.stl" + _option("scan", units)]
        if why:
            steps.append(f"{steps[0]} --sensor-origin 0,0,0   # if the sensor was there")
    return _inspection(
        path,
        "point cloud",
        file.format,
        points=len(file.points),
        extent=_extent(points),
        units=units,
        units_reason=reason,
        missing=missing,
        repeated=0 if double is None else int(np.count_nonzero(double)),
        spacing=_spacing(points),
        normals=_normals_in_words(points, normals, origin),
        sensor=sensor,
        sensor_origin=None if why else tuple(origin.tolist()),
        looks_along=looks,
        notes=tuple(notes),
        next_steps=tuple(steps),
    )


def _normals_in_words(points: np.ndarray, normals: np.ndarray | None, origin: np.ndarray) -> str:
    if normals is None:
        return "none; they are estimated where they are needed"
    if not len(points):
        return "present"
    with np.errstate(invalid="ignore", over="ignore"):
        facing = np.einsum("ni,ni->n", normals, (origin - points).astype(np.float32))
        bad = int(np.count_nonzero(~(np.abs(facing) > 0)))
        share = float(np.mean(facing > 0))
    words = "towards" if share >= 0.5 else "away from"
    lost = f"; {bad:,} are zero, not finite, or edge-on" if bad else ""
    where = "origin" if not origin.any() else "viewpoint"
    return f"present, {100 * max(share, 1 - share):.0f} % of them {words} the {where}{lost}"


def _inspect_mesh(path: Path, written: str) -> Inspection:
    vertices, faces, notes, stated = _triangles(path)
    finite = np.isfinite(vertices).all(axis=1)
    extent = _extent(vertices if finite.all() else vertices[finite])
    units, reason = _likely_unit(float(np.linalg.norm(extent or 0.0)))
    if stated:
        units, reason = stated, "by the file's own word or standard"
    scale = MM_PER_UNIT[units or "mm"]
    mesh = watertight = bodies = volume = None
    inside = len(faces) > 0 and faces.min() >= 0 and faces.max() < len(vertices)
    if inside and finite.all():
        mesh = weld(Triangles(vertices, faces))
        watertight = not np.any(mesh.edges.net)
        pairs = np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]])
        label = connected(pairs, len(mesh.points))
        bodies = len(np.unique(label[mesh.faces[:, 0]]))
    name = shlex.quote(str(path))
    option = _option("cad", units)
    try:
        if scale == 1 and mesh is not None:  # its corners need not be welded twice
            part = part_from_mesh(mesh.points, mesh.faces, name=path.name)
        else:
            part = part_from_mesh(vertices * scale, faces, name=path.name)
        notes = (*notes, *part.notes)
        volume = part.triangles.volume()
        steps = (
            f"vanejax register SCAN.ply {name}{option}",
            f"vanejax scan {name}{option} --out scans",
        )
    except InputError as error:
        notes = (*notes, f"cannot serve as a part: {error}")
        steps = ()
        if path.suffix.lower() == ".ply":
            option = _option("scan", units)
            steps = (f"vanejax register {name} PART.stl{option}   # if this is a scan",)
    return _inspection(
        path,
        "mesh",
        written,
        points=len(vertices),
        faces=len(faces),
        extent=extent,
        units=units,
        units_reason=reason,
        watertight=watertight,
        bodies=bodies,
        volume_mm3=volume,
        notes=notes,
        next_steps=steps,
    )


def _triangles(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...], str | None]:
    """Vertices in the file's unit, faces, notes, and the unit where the format settles it."""
    suffix = path.suffix.lower()
    if suffix not in (".step", ".stp"):
        stated = "m" if suffix in (".glb", ".gltf") else None
        return *read_triangles(path, units="mm"), stated
    # a STEP file knows its unit and refuses any other, and that before the slow part of reading it
    refusal = None
    for unit in MM_PER_UNIT:
        try:
            vertices, faces, notes = read_triangles(path, units=unit)
        except InputError as error:
            refusal = refusal or error
        else:
            return vertices / MM_PER_UNIT[unit], faces, notes, unit
    raise refusal


def _inspect_weights(path: Path, arrays: dict[str, str]) -> Inspection:
    from vanejax.training.weight_file import load_model

    try:
        matcher = load_model(path)
    except InputError as error:
        inspection = _inspect_arrays(path, arrays)
        return dataclasses.replace(inspection, notes=(*inspection.notes, str(error)))
    notes = (
        f"trained for the part {matcher.part_name} (sha256 {matcher.part_sha256[:12]}), radius "
        f"{matcher.radius_mm:.4g} mm",
        f"{matcher.sampling.num_reference:,} reference and up to {matcher.sampling.num_source:,} "
        f"source points, {matcher.iterations} iterations",
    )
    return _inspection(
        path,
        "weights",
        "safetensors of vanejax" if path.suffix == ".safetensors" else "NumPy archive of vanejax",
        notes=notes,
        next_steps=(f"vanejax register SCAN.ply PART.stl --weights {shlex.quote(str(path))}",),
    )


def _inspect_arrays(path: Path, arrays: dict[str, str]) -> Inspection:
    shown = [f"{name}: {shape}" for name, shape in list(arrays.items())[:20]]
    if len(arrays) > len(shown):
        shown.append(f"and {len(arrays) - len(shown)} more arrays")
    notes = (*shown, "a scan would have an array 'points' or 'xyz'")
    return _inspection(path, "arrays", "NumPy archive", notes=notes)


def _array_names(path: Path) -> dict[str, str]:
    """Shape and type, in words, by name of the arrays in an archive; nothing else is read."""
    words = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                name = info.filename.removesuffix(".npy")
                with archive.open(info) as file:
                    try:
                        shape, _, dtype = array_header(file)
                        words[name] = f"{list(shape)} {dtype}"
                    except ValueError:
                        words[name] = "no array"
    except Exception as error:  # a damaged archive can raise anything: zlib's, struct's, zipfile's
        raise InputError(f"{path}: damaged: {error}; copy or export it again") from error
    return words


def _inspect_json(path: Path) -> Inspection:
    from vanejax.machine.pose_file import read_pose

    try:
        pose = read_pose(path)
    except InputError as error:
        return _inspection(path, "unknown", "JSON", notes=(str(error),))
    back = np.asarray(pose.inverse().translation)
    return _inspection(
        path,
        "pose",
        "JSON",
        notes=(f"part_from_camera; the part is at {np.round(back, 3)} mm in the scan",),
        next_steps=(f"vanejax register SCAN.ply PART.stl --init {shlex.quote(str(path))}",),
    )


def _likely_unit(size: float) -> tuple[str | None, str]:
    """The unit in which a diagonal of ``size`` is one of a scanned part, and why."""
    if not size:
        return None, "it has no extent"
    sizes = {unit: size * MM_PER_UNIT[unit] for unit in _LIKELY}
    fitting = [unit for unit in _LIKELY if _SMALLEST_MM <= sizes[unit] <= _LARGEST_MM]
    if not fitting:
        return None, f"{size:.4g} across is no part for a scanner in any of {', '.join(_LIKELY)}"
    others = ", ".join(f"{unit} ({sizes[unit]:.4g} mm)" for unit in fitting[1:])
    reason = f"{sizes[fitting[0]]:.4g} mm across"
    return fitting[0], reason + (f"; possible: {others}" if others else "")


def _option(which: str, units: str | None) -> str:
    return f" --units-{which} {units}" if units not in (None, "mm") else ""


def _extent(points: np.ndarray) -> tuple[float, float, float] | None:
    return tuple(np.ptp(points, axis=0).tolist()) if len(points) else None


def _spacing(points: np.ndarray) -> float | None:
    """Median distance to the nearest other point, at some points of the cloud's middle."""
    if len(points) < 2:
        return None
    if len(points) > _SPACING_POINTS:  # a slab has the density of the whole, a thinned cloud not
        half = 0.5 * _SPACING_POINTS / len(points)
        low, high = np.quantile(points[:, 0], [0.5 - half, 0.5 + half])
        slab = points[(points[:, 0] >= low) & (points[:, 0] <= high)]
        points = slab if 1 < len(slab) < 2 * _SPACING_POINTS else points[:_SPACING_POINTS]
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    queries = points[sampled_rows(len(points), _SPACING_QUERIES)]
    distance, _ = tree.query(queries, [2], workers=-1)
    return float(np.median(distance))


def _bytes(size: int) -> str:
    power = min(3, max(0, len(str(size)) - 1) // 3)
    return f"{size / 1000**power:.3g} {('bytes', 'kB', 'MB', 'GB')[power]}"
