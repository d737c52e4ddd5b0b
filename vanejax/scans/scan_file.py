"""Scans on disk: any file of points becomes a `MeasuredScan` in millimetres, and points a file."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np

from vanejax.cad.cad_file import MM_PER_UNIT
from vanejax.errors import InputError
from vanejax.files import atomic_write
from vanejax.scans.measured_scan import MeasuredScan, at_place, clean_scan, measured
from vanejax.scans.point_file import read_points
from vanejax.scans.viewpoint import sampled_rows

WRITTEN_SUFFIXES = (".ply", ".pcd", ".xyz", ".csv", ".npz")

# of the part's diagonal: a scan shows some of the part, or the part and what is around it
_SMALLEST, _LARGEST = 0.05, 2.0
_CANNOT_BE = 20.0
_METRES_BELOW = 2.0
_SAMPLE = 200_000
_ROWS_AT_ONCE = 100_000


def load_scan(
    path: str | os.PathLike[str],
    *,
    units: str = "auto",
    part_extent_mm: np.ndarray | None = None,
    sensor_origin: str | np.ndarray = "auto",
) -> MeasuredScan:
    """Reads and cleans a scan: PLY, PCD, XYZ, TXT, CSV, ASC, PTS, NPZ or NPY.

    PLY may be a mesh (its vertices are used). Text may have a header line that names its columns;
    without one, three columns are x, y, z and three more are normals if they are unit vectors. NPZ
    has ``points`` or ``xyz`` [..., 3] and may have ``normals``. What else a file holds is ignored.

    The scan is in mm; `MeasuredScan.notes` says what was dropped and assumed. A file that cannot be
    read, is no scan, or makes no sense in ``units`` raises InputError that says what to do.

    Args:
      path: the file.
      units: of the numbers in the file: mm, cm, m, in, ft or um. ``"auto"`` takes millimetres, or
        metres where only those fit the part.
      part_extent_mm: [3], the sides of the part's bounding box, `Part.extent_mm`, for ``"auto"``
        and to refuse a wrong unit; None if no part is known.
      sensor_origin: see `clean_scan`; [3] in mm, whatever the file's unit. Where a PCD file states
        a viewpoint, ``"auto"`` looks there.
    """
    path = Path(path)
    if units != "auto" and units not in MM_PER_UNIT:
        raise InputError(f"unknown unit {units!r}; use auto or one of {', '.join(MM_PER_UNIT)}")
    file = read_points(path)
    size = robust_extent(file.points)
    diagonal = None if part_extent_mm is None else float(np.linalg.norm(part_extent_mm))
    scale, notes = _millimetres(size, units, diagonal, path)
    notes = (*file.notes, *notes)
    if file.num_faces:
        notes = (*notes, f"is a mesh of {file.num_faces:,} faces: its vertices are used")
    scan = clean_scan(
        file.points if scale == 1 else file.points * scale,
        file.normals,
        name=str(path),
        sensor_origin=sensor_origin,
        stated_origin=None if file.viewpoint is None else file.viewpoint * scale,
    )
    return dataclasses.replace(scan, name=path.stem, notes=(*notes, *scan.notes))


def robust_extent(points: np.ndarray) -> float:
    """Diagonal of the box that holds points [N, 3] but for the outer 1 % at each side.

    Points that are not finite, or at (0, 0, 0), do not count; 0 where no others are there.
    """
    points = points[sampled_rows(len(points), _SAMPLE)]
    points = points[measured(points) & ~at_place(points, np.zeros(3))]
    if not len(points):
        return 0.0
    low, high = np.percentile(points, [1, 99], axis=0)
    return float(np.linalg.norm(high - low))


def _millimetres(
    size: float, units: str, diagonal: float | None, path: Path
) -> tuple[float, tuple[str, ...]]:
    """Millimetres per unit of the file, and what is to be said about it.

    From the cloud's `robust_extent` in that unit and the part's diagonal in mm.
    """
    if not size or (diagonal is None and units != "auto"):
        return MM_PER_UNIT.get(units, 1.0), ()
    if diagonal is None:
        note = f"taken as millimetres, {size:.3g} mm large: if that is wrong, it is in metres"
        return 1.0, (note,) if size < _METRES_BELOW else ()
    fits = lambda unit: _SMALLEST <= size * MM_PER_UNIT[unit] / diagonal <= _LARGEST  # noqa: E731
    if units == "auto":
        if fits("mm"):
            return 1.0, ()
        if fits("m"):
            return 1000.0, (
                f"taken as metres: {1000 * size:.4g} mm large, the part {diagonal:.4g} mm",
            )
        raise InputError(
            f"{path}: the unit cannot be told: the scan is {size:.4g} mm large in millimetres and "
            f"{1000 * size:.4g} mm in metres, the part {diagonal:.4g} mm; "
            + _unit_advice(size, diagonal, [unit for unit in MM_PER_UNIT if fits(unit)])
        )
    scale = MM_PER_UNIT[units]
    ratio = size * scale / diagonal
    if 1 / _CANNOT_BE <= ratio <= _CANNOT_BE:
        return scale, ()
    found = f"read as {units} the scan is {size * scale:.4g} mm large, the part {diagonal:.4g} mm"
    others = [unit for unit in MM_PER_UNIT if fits(unit)]
    if others:
        raise InputError(
            f"{path}: {found}; it looks like {others[0]}: say --units-scan {others[0]}"
        )
    return scale, (f"{found}: check both units",)


def _unit_advice(size: float, diagonal: float, fitting: list[str]) -> str:
    """What to say on the command line where neither millimetres nor metres fit the part.

    The part's unit may be the wrong one: it is named where a scan in mm or m then covers the part
    as a whole view of it does.
    """
    for unit, factor in MM_PER_UNIT.items():
        covered = [scale * size / (factor * diagonal) for scale in (1.0, 1000.0)]
        if unit != "mm" and any(0.4 <= share <= 1.1 for share in covered):
            return (
                f"say --units-cad {unit} if the part is in {unit} "
                f"({factor * diagonal:.4g} mm large), "
                + (f"--units-scan {fitting[0]} if the scan is" if fitting else "or check both")
            )
    if fitting:
        return f"say --units-scan {fitting[0]} if it is in {fitting[0]}"
    return "crop it to the part, check the part's unit, or say --units-scan mm (or m)"


def save_points(
    path: str | os.PathLike[str], points: np.ndarray, normals: np.ndarray | None = None
) -> None:
    """Writes points and normals [N, 3], mm, as binary .ply or .pcd, as .xyz, .csv or .npz.

    The file appears complete or not at all, and replaces what is there. Points keep every bit of
    float64, but for PCD, where PCL expects float32 (0.03 micrometres at 500 mm); normals keep every
    bit of float32. InputError for another suffix, other shapes, or a place that cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in WRITTEN_SUFFIXES:
        raise InputError(
            f"{path}: cannot write {suffix or 'a file without suffix'}; use one of "
            + ", ".join(WRITTEN_SUFFIXES)
        )
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise InputError(
            f"{path}: points have shape {list(points.shape)}, not [N, 3], N at least 1"
        )
    if normals is not None:
        normals = np.asarray(normals, np.float32)
        if normals.shape != points.shape:
            raise InputError(
                f"{path}: normals have shape {list(normals.shape)}, points {list(points.shape)}"
            )
    with atomic_write(path) as partial:
        if suffix == ".npz":
            arrays = {"points": points} | ({} if normals is None else {"normals": normals})
            with partial.open("wb") as file:  # given a name, numpy would append .npz to it
                np.savez(file, **arrays)
        elif suffix in (".ply", ".pcd"):
            _write_records(partial, points, normals, suffix)
        else:
            _write_text(partial, points, normals, suffix)


def _write_records(path: Path, points: np.ndarray, normals: np.ndarray | None, suffix: str) -> None:
    wide = suffix == ".ply"
    names = ["x", "y", "z"]
    if normals is not None:
        names += ["nx", "ny", "nz"] if wide else ["normal_x", "normal_y", "normal_z"]
    dtype = np.dtype([(n, "<f8" if wide and i < 3 else "<f4") for i, n in enumerate(names)])
    if wide:
        kinds = {"<f8": "double", "<f4": "float"}
        lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
        lines += [f"property {kinds[dtype[name].str]} {name}" for name in names] + ["end_header"]
    else:
        width = len(names)
        lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7"]
        lines += ["FIELDS " + " ".join(names), "SIZE" + " 4" * width, "TYPE" + " F" * width]
        lines += ["COUNT" + " 1" * width, f"WIDTH {len(points)}", "HEIGHT 1"]
        lines += ["VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(points)}", "DATA binary"]
    records = np.empty(len(points), dtype)
    columns = points.T if normals is None else (*points.T, *normals.T)
    for name, column in zip(names, columns, strict=True):
        records[name] = column
    with path.open("wb") as file:
        file.write(("\n".join(lines) + "\n").encode())
        records.tofile(file)


def _write_text(path: Path, points: np.ndarray, normals: np.ndarray | None, suffix: str) -> None:
    apart = "," if suffix == ".csv" else " "
    with path.open("w", encoding="ascii", newline="\n") as file:
        if suffix == ".csv":
            file.write("x,y,z\n" if normals is None else "x,y,z,nx,ny,nz\n")
        for start in range(0, len(points), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            lines = [apart.join(map(repr, row)) for row in points[rows].tolist()]
            if normals is not None:  # nine digits are a float32
                tails = [apart.join(f"{v:.9g}" for v in row) for row in normals[rows].tolist()]
                lines = [head + apart + tail for head, tail in zip(lines, tails, strict=True)]
            file.write("\n".join(lines) + "\n")
