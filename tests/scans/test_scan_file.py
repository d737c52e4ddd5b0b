"""Files of points: every format round trip, every damage one clear line."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from pathlib import Path

import lzf
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vanejax.errors import InputError
from vanejax.scans.point_file import PointFile, read_points
from vanejax.scans.scan_file import WRITTEN_SUFFIXES, load_scan, robust_extent, save_points

REAL_SCANS = Path(__file__).parents[3] / "shared" / "data" / "real_scans"


def sheet(count: int = 200, depth: float = 400.0) -> np.ndarray:
    rng = np.random.default_rng(count)
    x, y = rng.uniform(-50, 50, count), rng.uniform(-30, 30, count)
    return np.stack([x, y, depth + 4 * np.sin(x / 9)], axis=1)


def facing(points: np.ndarray) -> np.ndarray:
    normals = np.random.default_rng(1).normal(scale=0.2, size=points.shape)
    normals[:, 2] = -np.sign(points[:, 2])
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)


# every format, written here by other means than save_points


def ply(points, normals=None, *, form="ascii", types=("float", "float"), extra=False, faces=0):
    """A PLY file; with extras, a colour between the columns and elements around the vertices."""
    order = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    code = {"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"}
    columns = [(n, types[0], order + code[types[0]]) for n in "xyz"]
    if extra:
        columns.insert(1, ("red", "uchar", "u1"))
    if normals is not None:
        columns += [(n, types[1], order + code[types[1]]) for n in ("nx", "ny", "nz")]
    rows = np.zeros(len(points), [(n, c) for n, _, c in columns])
    for i, n in enumerate("xyz"):
        rows[n] = points[:, i]
        if normals is not None:
            rows["n" + n] = normals[:, i]
    header = ["ply", f"format {form} 1.0", "comment by a test"]
    if extra:
        header += ["element camera 1", "property short a", "property list uchar int b"]
    header += [f"element vertex {len(points)}"] + [f"property {t} {n}" for n, t, _ in columns]
    if faces:
        header += [f"element face {faces}", "property list uchar int vertex_indices"]
    data = ("\n".join([*header, "end_header"]) + "\n").encode()
    if form == "ascii":
        lines = ["7 2 5 6"] if extra else []
        lines += [" ".join(repr(value.item()) for value in row) for row in rows]
        return data + ("\n".join(lines + ["3 0 1 2"] * faces) + "\n").encode()
    if extra:
        data += struct.pack(order + "hBii", 7, 2, 5, 6)
    return data + rows.tobytes() + struct.pack(order + "Biii", 3, 0, 1, 2) * faces


def pcd(points, normals=None, *, form="binary", kind="f8", width=None, viewpoint="0 0 0 1 0 0 0"):
    names = ["x", "_", "y", "z"] + ([] if normals is None else ["normal_x", "normal_y", "normal_z"])
    dtype = [(n, "<i2", (3,)) if n == "_" else (n, "<" + kind) for n in names]
    rows = np.zeros(len(points), dtype)
    for i, n in enumerate("xyz"):
        rows[n] = points[:, i]
        if normals is not None:
            rows["normal_" + n] = normals[:, i]
    size = {"f4": "4", "f8": "8"}[kind]
    width = width or len(points)
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join("2" if n == "_" else size for n in names),
        "TYPE " + " ".join("I" if n == "_" else "F" for n in names),
        "COUNT " + " ".join("3" if n == "_" else "1" for n in names),
        f"WIDTH {width}",
        f"HEIGHT {len(points) // width}",
        f"VIEWPOINT {viewpoint}",
        f"POINTS {len(points)}",
        f"DATA {form}",
    ]
    data = ("\n".join(header) + "\n").encode()
    if form == "ascii":
        flat = [np.concatenate([np.atleast_1d(v) for v in row.tolist()]) for row in rows]
        lines = [" ".join(repr(float(v)) for v in row) for row in flat]
        return data + ("\n".join(lines) + "\n").encode()
    if form == "binary":
        return data + rows.tobytes()
    table = b"".join(np.ascontiguousarray(rows[n]).tobytes() for n in names)
    packed = lzf.compress(table, 2 * len(table) + 100)
    return data + struct.pack("<II", len(packed), len(table)) + packed


def table(points, normals=None, *, apart=" ", head="", end="\n"):
    rows = points if normals is None else np.concatenate([points, normals], axis=1)
    lines = [apart.join(map(repr, row)) for row in rows.tolist()]
    return (head + end.join(lines) + end).encode()


def npz(**arrays):
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def put(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def assert_holds(file: PointFile, points: np.ndarray, normals: np.ndarray | None = None) -> None:
    assert np.array_equal(file.points, points)
    assert file.points.dtype == np.float64
    if normals is None:
        assert file.normals is None
    else:
        assert np.array_equal(file.normals, normals.astype(np.float32))


CORNERS = st.lists(st.tuples(*[st.floats(-1e5, 1e5, width=32)] * 6), min_size=1, max_size=20).map(
    lambda rows: np.array(rows, np.float64)
)


@given(
    values=CORNERS,
    form=st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]),
    types=st.tuples(*[st.sampled_from(["float", "double", "float32", "float64"])] * 2),
    with_normals=st.booleans(),
    extra=st.booleans(),
    faces=st.integers(0, 2),
)
@settings(max_examples=60, deadline=None)
def test_ply_of_every_form(tmp_path_factory, values, form, types, with_normals, extra, faces):
    points, normals = values[:, :3], values[:, 3:] if with_normals else None
    data = ply(points, normals, form=form, types=types, extra=extra, faces=faces)
    file = read_points(put(tmp_path_factory.getbasetemp(), "any.ply", data))
    assert_holds(file, points, normals)
    assert file.num_faces == faces


@given(
    values=CORNERS,
    form=st.sampled_from(["ascii", "binary", "binary_compressed"]),
    kind=st.sampled_from(["f4", "f8"]),
    with_normals=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_pcd_of_every_form(tmp_path_factory, values, form, kind, with_normals):
    points, normals = values[:, :3], values[:, 3:] if with_normals else None
    data = pcd(points, normals, form=form, kind=kind)
    file = read_points(put(tmp_path_factory.getbasetemp(), "any.pcd", data))
    assert_holds(file, points, normals)
    assert file.format == "PCD, " + form.replace("_", " ")


@given(
    values=CORNERS,
    apart=st.sampled_from([" ", ",", ";", "\t", ", ", "  "]),
    head=st.sampled_from(["x{0}y{0}z{0}nx{0}ny{0}nz\n", "//X{0}Y{0}Z{0}Nx{0}Ny{0}Nz\n"]),
    end=st.sampled_from(["\n", "\r\n", "\n\n"]),
    bom=st.booleans(),
    suffix=st.sampled_from([".xyz", ".txt", ".csv", ".asc"]),
)
@settings(max_examples=60, deadline=None)
def test_text_of_every_form(tmp_path_factory, values, apart, head, end, bom, suffix):
    points, normals = values[:, :3], values[:, 3:]
    data = table(points, normals, apart=apart, head=head.format(apart), end=end)
    data = b"\xef\xbb\xbf" * bom + data
    file = read_points(put(tmp_path_factory.getbasetemp(), "any" + suffix, data))
    assert_holds(file, points, normals)


@given(
    values=st.lists(
        st.tuples(*[st.floats(-1e200, 1e200)] * 3, *[st.floats(-1, 1, width=32)] * 3), min_size=1
    ),
    suffix=st.sampled_from(WRITTEN_SUFFIXES),
    with_normals=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_what_is_saved_is_read_back(tmp_path_factory, values, suffix, with_normals):
    values = np.array(values)
    points, normals = values[:, :3], values[:, 3:].astype(np.float32)
    if suffix == ".pcd":  # float32
        points = np.clip(points, -1e30, 1e30).astype(np.float32).astype(np.float64)
    if suffix == ".xyz":  # no header: only unit vectors are normals
        normals = facing(points)
    path = tmp_path_factory.getbasetemp() / f"saved{suffix}"
    normals = normals if with_normals else None
    save_points(path, points, normals)
    assert_holds(read_points(path), points, normals)


def test_large_files_are_read_and_written_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr("vanejax.scans.point_records._ROWS_AT_ONCE", 7)
    monkeypatch.setattr("vanejax.scans.scan_file._ROWS_AT_ONCE", 11)
    points = sheet(60)
    for suffix in (".ply", ".csv"):
        save_points(tmp_path / f"a{suffix}", points, facing(points))
        assert_holds(read_points(tmp_path / f"a{suffix}"), points, facing(points))


def test_an_organised_cloud_with_holes(tmp_path):
    points = sheet(300)
    points[::3] = np.nan
    path = put(tmp_path, "organised.pcd", pcd(points, form="binary_compressed", width=30))
    scan = load_scan(path)
    assert scan.name == "organised"
    assert np.array_equal(scan.points, np.delete(points, np.arange(0, 300, 3), axis=0))
    assert "dropped 100 points without a measurement (not finite)" in scan.notes
    points[::3] = 0.0
    zeros = load_scan(put(tmp_path, "zeros.pcd", pcd(points, form="ascii", width=30)))
    assert np.array_equal(zeros.points, scan.points)


def test_a_pcd_viewpoint_is_the_sensor(tmp_path):
    place = np.array([10.0, -20.0, 30.0])
    data = pcd(sheet() + place, viewpoint="10 -20 30 1 0 0 0")
    scan = load_scan(put(tmp_path, "a.pcd", data))
    assert np.array_equal(scan.sensor_origin, place)
    metres = pcd((sheet() + place) / 1000, viewpoint="0.01 -0.02 0.03 1 0 0 0")
    scan = load_scan(put(tmp_path, "m.pcd", metres), units="m")
    np.testing.assert_allclose(scan.sensor_origin, place, rtol=1e-12)


def test_numpy_files(tmp_path):
    points, normals = sheet(), facing(sheet())
    for key in ("points", "xyz"):
        path = put(tmp_path, "a.npz", npz(**{key: points, "normals": normals, "other": "text"}))
        assert_holds(read_points(path), points, normals)
    np.save(tmp_path / "a.npy", points.astype(np.float32))
    assert_holds(read_points(tmp_path / "a.npy"), points.astype(np.float32))
    both = np.asfortranarray(np.concatenate([points, normals], axis=1)).astype(">f8")
    np.save(tmp_path / "b.npy", both)
    assert_holds(read_points(tmp_path / "b.npy"), points, normals)
    np.save(tmp_path / "c.npy", points.reshape(10, 20, 3))
    assert_holds(read_points(tmp_path / "c.npy"), points)


def test_text_without_names(tmp_path):
    points, normals = sheet(), facing(sheet())
    assert_holds(read_points(put(tmp_path, "a.txt", table(points, normals))), points, normals)
    colours = np.random.default_rng(0).integers(0, 255, points.shape)
    file = read_points(put(tmp_path, "b.txt", table(points, colours)))
    assert_holds(file, points)
    assert file.notes == ("columns 4 to 6 are no unit vectors (colours?) and were passed over",)
    pts = f"{len(points)}\n".encode() + table(np.concatenate([points, points[:, :1]], axis=1))
    file = read_points(put(tmp_path, "c.pts", pts))
    assert np.array_equal(file.points, points)
    assert file.notes == ("passed over 1 of 4 columns",)
    rows = b'"X (mm)","intensity","Z [mm]","Y"\n' + b"1.5,7,3.5,2.5\n" * 2
    assert np.array_equal(read_points(put(tmp_path, "d.csv", rows)).points, [[1.5, 2.5, 3.5]] * 2)
    trailing = b"1.5,2.5,3.5,\n4.5,5.5,nan,\n"
    expected = [[1.5, 2.5, 3.5], [4.5, 5.5, np.nan]]
    found = read_points(put(tmp_path, "e.csv", trailing))
    assert np.array_equal(found.points, expected, equal_nan=True)
    assert found.notes == ()


@pytest.mark.parametrize(
    "row", ["1,5;2,5;3,5", "1,5 2,5 3,5", "1,5\t-2,5\t3,5", "1,5,2,5,3,5", "-1,25,2,5,3,75"]
)
def test_decimal_commas_are_refused(tmp_path, row):
    with pytest.raises(InputError, match=r"a\.csv: .*decimal commas"):
        read_points(put(tmp_path, "a.csv", f"{row}\n".encode() * 60))


def cut(data: bytes, share: float) -> bytes:
    return data[: int(len(data) * share)]


def with_count(data: bytes, old: int, new: int) -> bytes:
    changed = data.replace(str(old).encode(), str(new).encode())
    assert changed != data
    return changed


P = sheet(777)
PLY, PLY_TEXT = ply(P, form="binary_little_endian"), ply(P)
PCD, PCD_TEXT, PCD_PACKED = (pcd(P, form=f) for f in ("binary", "ascii", "binary_compressed"))
HUGE = 10**12
DAMAGED = {
    "a.ply": [
        (cut(PLY, 0.7), "truncated: it promises 777 points"),
        (PLY[:80], "truncated: its header has no end"),
        (cut(PLY_TEXT, 0.7), "truncated, damaged, or not a table"),
        (b"\n".join(PLY_TEXT.split(b"\n")[:-9]), "promises 777 points and holds 769"),
        (with_count(PLY, 777, HUGE), "truncated: it promises 1,000,000,000,000 points"),
        (with_count(PLY, 777, 700), "the number of points in its header is wrong"),
        (with_count(PLY_TEXT, 777, 700), "promises 700 points and holds more"),
        (with_count(PLY, 777, 0), "holds no points"),
        (with_count(PLY, 777, -7), "line 4 of its PLY header makes no sense"),
        (PLY.replace(b"float y", b"float q"), "has no columns x, y and z, only x, q, z"),
        (PLY.replace(b"float y", b"hyper y"), "line 6 of its PLY header makes no sense"),
        (PLY.replace(b"vertex", b"points"), "no element 'vertex'"),
        (PLY.replace(b"float z", b"list uchar int z"), "lists inside of vertices"),
        (PLY_TEXT.replace(b"end_header\n", b"end_header\n1 2 x\n"), "or not a table of numbers"),
        (ply(P, faces=1).replace(b"face 1", b"face 99999"), "99,999 of face"),
        (table(P), "is no PLY file: it does not begin with 'ply'"),
        (b"ply\n" + b"comment x\n" * 20_000, "header has no end"),
        (PLY.replace(b"format binary_little_endian 1.0\n", b""), "header makes no sense"),
        (b"ply\nend_header\n1 2 3", "states no format"),
        (ply(P, form="binary_big_endian", extra=True).replace(b"camera 1", b"camera 900"), "trunc"),
    ],
    "a.pcd": [
        (cut(PCD, 0.7), "truncated: it promises 777 points"),
        (cut(PCD, 0.005), "truncated: its header has no DATA"),
        (cut(PCD_TEXT, 0.7), "truncated, damaged, or not a table"),
        (b"\n".join(PCD_TEXT.split(b"\n")[:-9]), "promises 777 points and holds 769"),
        (cut(PCD_PACKED, 0.7), "truncated or damaged: 777 points take"),
        (with_count(PCD, 777, HUGE), "truncated: it promises 1,000,000,000,000 points"),
        (with_count(PCD, 777, 700), "the number of points in its header is wrong"),
        (with_count(PCD_TEXT, 777, 700), "promises 700 points and holds more"),
        (with_count(PCD_PACKED, 777, 700), "truncated or damaged: 700 points take"),
        (PCD.replace(b"WIDTH 777", b"WIDTH 776"), "contradicts itself: WIDTH 776"),
        (PCD.replace(b"WIDTH 777", b"WIDTH ten"), "WIDTH 'ten' of its header is no count"),
        (PCD.replace(b"WIDTH 777\n", b"").replace(b"POINTS 777\n", b""), "missing or contra"),
        (PCD.replace(b"SIZE 8", b"SIZE 3"), "do not fit together"),
        (PCD.replace(b"COUNT 1", b"COUNT 2"), "COUNT of its header makes no sense"),
        (PCD.replace(b"COUNT 1 3", b"COUNT 1 -3"), "COUNT of its header makes no sense"),
        (PCD.replace(b"FIELDS x _ y z", b"FIELDS x _ y w"), "has no columns x, y and z"),
        (PCD.replace(b"DATA binary", b"DATA zipped"), "PCD data 'zipped' is not known"),
        (PCD.replace(b"0 0 0 1 0 0 0", b"here"), "VIEWPOINT 'here' of its header is no pose"),
        (table(P), "is no PCD file: line 1 begins with"),
        (PCD_PACKED[:-2000] + bytes(2000), "compressed data is damaged"),
    ],
    "a.xyz": [
        (b"a b c\nd e f\n", "line 2 is no row of numbers"),
        (b"scan of a vane\n", "no line in it is a row of numbers"),
        (b"1 2\n3 4\n", "a row has 2 columns instead of x, y and z: '1 2'"),
        (b"1 2 3\n4 5 oops\n", "truncated, damaged, or not a table of numbers: .*oops"),
        (b"1,2,3\n4,,6\n", "truncated, damaged, or not a table of numbers"),
        (b"3\n1 2 3\n4 5 6\n", "it promises 3 points and holds 2"),
        ("1 2 3\n".encode("utf-16"), "UTF-16"),
        (PLY, "is named .xyz but holds PLY: rename it to .ply"),
    ],
    "a.npz": [
        (cut(npz(points=P), 0.7), "damaged"),
        (npz(cloud=P, b=P), "no array 'points' or 'xyz', only cloud, b"),
        (npz(points=P[:, :2]), r"array 'points' has shape \[777, 2\], not \[N, 3\]"),
        (npz(points=P[0]), r"array 'points' has shape \[3\]"),
        (npz(points=P[:0]), "holds no points"),
        (npz(points=P, normals=P[1:]), "777 points but 776 normals"),
        (npz(points=P.astype(str)), "array 'points' holds <U"),
        (table(P), "damaged: File is not a zip file"),
    ],
    "a.npy": [(table(P), "the array is damaged, or no NumPy array")],
    "a.stl": [(b"solid", "is a CAD file, not a scan")],
    "a.docx": [(b"text", "cannot read .docx as a scan; use one of .ply, .pcd")],
    "a": [(b"text", "cannot read a file without suffix")],
}


@pytest.mark.parametrize(
    ("name", "number"), [(name, i) for name, cases in DAMAGED.items() for i in range(len(cases))]
)
def test_damaged_files_are_refused_in_one_clear_line(tmp_path, name, number):
    data, message = DAMAGED[name][number]
    with pytest.raises(InputError, match=message) as caught:
        load_scan(put(tmp_path, name, data))
    assert str(caught.value).startswith(str(tmp_path / name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a.ply", "a.pcd", "a.csv", "a.npz", "a.npy"])
def test_empty_missing_folder_and_pipe(tmp_path, name):
    with pytest.raises(InputError, match="no such file"):
        load_scan(tmp_path / name)
    with pytest.raises(InputError, match="is empty; export it again"):
        load_scan(put(tmp_path, name, b" \n"))
    os.remove(tmp_path / name)
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match="is a device or a pipe"):
        load_scan(tmp_path / name)
    os.remove(tmp_path / name)
    os.mkdir(tmp_path / name)
    with pytest.raises(InputError, match="is a folder"):
        load_scan(tmp_path / name)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may read all")
def test_a_file_that_may_not_be_read(tmp_path):
    path = put(tmp_path, "a.ply", PLY)
    path.chmod(0)
    with pytest.raises(InputError, match="cannot be read: Permission denied"):
        load_scan(path)


WHOLE = {
    **{"binary.ply": PLY, "text.ply": PLY_TEXT, "list.ply": ply(P, faces=1, extra=True)},
    **{"big.ply": ply(P, form="binary_big_endian", extra=True, faces=1)},
    **{"binary.pcd": PCD, "text.pcd": PCD_TEXT, "packed.pcd": PCD_PACKED},
    **{"a.npz": npz(points=P), "a.xyz": table(P), "a.csv": table(P, apart=",", head="x,y,z\n")},
}


@given(
    kind=st.sampled_from(sorted(WHOLE)),
    position=st.integers(0, 3000),
    value=st.binary(max_size=6),
    length=st.floats(0, 1),
)
@settings(max_examples=150, deadline=None)
def test_no_damage_gives_any_other_error(tmp_path_factory, kind, position, value, length):
    data = WHOLE[kind]
    damaged = data[:position] + value + data[position + len(value) :]
    path = put(tmp_path_factory.getbasetemp(), kind, cut(damaged, length) or b"x")
    try:
        scan = load_scan(path)
    except InputError:
        return
    assert np.isfinite(scan.points).all()


def npy_header(shape: str, descr: str = "<f8") -> bytes:
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def test_counts_in_numpy_files_are_not_trusted(tmp_path):
    data = npy_header("(1000000000000, 3)") + bytes(2400)
    with pytest.raises(InputError, match="truncated: the array promises 3,000,000,000,000 numbers"):
        load_scan(put(tmp_path, "a.npy", data))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", data)
    with pytest.raises(InputError, match="array 'points' promises 3,000,000,000,000 numbers"):
        load_scan(tmp_path / "a.npz")
    with pytest.raises(InputError, match="the array holds object"):
        load_scan(put(tmp_path, "b.npy", npy_header("(60, 3)", "|O") + bytes(2400)))


def test_too_many_points_are_refused(tmp_path, monkeypatch):
    for module in ("point_records", "point_file"):
        monkeypatch.setattr(f"vanejax.scans.{module}.MAX_POINTS", 100)
    files = {"a.ply": PLY, "a.pcd": PCD_PACKED, "a.xyz": table(P), "a.npz": npz(points=P)}
    for name, data in files.items():
        with pytest.raises(InputError, match="thin the scan first"):
            load_scan(put(tmp_path, name, data))


PART = np.array([100.0, 60.0, 10.0])


def test_metres_are_told_from_millimetres_by_the_part(tmp_path):
    save_points(tmp_path / "mm.ply", sheet())
    save_points(tmp_path / "m.ply", sheet() / 1000)
    mm = load_scan(tmp_path / "mm.ply", part_extent_mm=PART)
    m = load_scan(tmp_path / "m.ply", part_extent_mm=PART)
    assert np.array_equal(mm.points, sheet())
    np.testing.assert_allclose(m.points, sheet(), rtol=1e-15)  # one division, one product
    assert not [note for note in mm.notes if "metres" in note]
    assert m.notes[0].startswith("taken as metres: 1")
    given = load_scan(tmp_path / "m.ply", units="m", part_extent_mm=PART)
    assert np.array_equal(given.points, m.points)
    assert not [note for note in given.notes if "metres" in note]


def test_a_unit_that_cannot_be_is_refused_or_told(tmp_path):
    save_points(tmp_path / "cm.ply", sheet() / 10_000)
    with pytest.raises(InputError, match=r"cannot be told: .* 0\.011.* mm .* 11\.\d+ mm in m"):
        load_scan(tmp_path / "cm.ply", part_extent_mm=PART * 10)
    save_points(tmp_path / "cm.ply", sheet() / 10)
    with pytest.raises(InputError, match="say --units-scan cm if it is in cm"):
        load_scan(tmp_path / "cm.ply", part_extent_mm=PART * 3)
    save_points(tmp_path / "m.ply", sheet() / 1000)
    with pytest.raises(InputError, match=r"read as mm .* it looks like m: say --units-scan m"):
        load_scan(tmp_path / "m.ply", units="mm", part_extent_mm=PART)
    note = load_scan(tmp_path / "m.ply").notes[0]
    assert note.startswith("taken as millimetres, 0.11")
    assert note.endswith("if that is wrong, it is in metres")
    assert not load_scan(tmp_path / "m.ply", units="mm").notes[0].startswith("taken as")
    small = load_scan(tmp_path / "m.ply", units="m", part_extent_mm=PART * 1e5)
    assert small.notes[0].endswith("check both units")
    with pytest.raises(InputError, match="unknown unit 'parsec'"):
        load_scan(tmp_path / "m.ply", units="parsec")


@pytest.mark.parametrize(("ratio", "unit"), [(0.051, 1.0), (1.99, 1.0), (0.049, None), (2.1, None)])
def test_the_limits_of_the_guess(tmp_path, ratio, unit):
    save_points(tmp_path / "a.ply", sheet())
    part = np.array([robust_extent(sheet()) / ratio, 0.0, 0.0])
    if unit:
        assert np.array_equal(load_scan(tmp_path / "a.ply", part_extent_mm=part).points, sheet())
    else:
        with pytest.raises(InputError, match="the unit cannot be told"):
            load_scan(tmp_path / "a.ply", part_extent_mm=part)


def test_a_few_stray_points_do_not_change_the_unit():
    points = sheet(1000)
    size = robust_extent(points)
    points[:5] = 1e6
    points[5:9] = np.nan
    points[9:100] = 0
    assert abs(robust_extent(points) / size - 1) < 0.05  # quantiles move by a percent of the points
    assert robust_extent(np.full((9, 3), np.nan)) == 0


def test_saving_refuses_what_cannot_be(tmp_path):
    with pytest.raises(InputError, match=r"cannot write \.stl"):
        save_points(tmp_path / "a.stl", sheet())
    with pytest.raises(InputError, match=r"points have shape \[0, 3\]"):
        save_points(tmp_path / "a.ply", sheet()[:0])
    with pytest.raises(InputError, match="normals have shape"):
        save_points(tmp_path / "a.ply", sheet(), sheet(7))
    with pytest.raises(InputError, match="cannot be written"):
        save_points(tmp_path / "no" / "a.ply", sheet())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [1, 5])
def test_real_scans(number):
    path = REAL_SCANS / f"Separator_{number}.ply"
    if not path.exists():
        pytest.skip("the real scans are not in this checkout")
    scan = load_scan(path, part_extent_mm=np.array([53.0, 20.0, 180.0]))
    assert scan.looks_along == "-z"
    assert np.array_equal(scan.sensor_origin, np.zeros(3))
    assert scan.notes[0].startswith("taken as metres")
    assert 100 < np.ptp(scan.points, axis=0).max() < 250
    assert (np.einsum("ni,ni->n", scan.points, scan.normals) <= 0).all()
