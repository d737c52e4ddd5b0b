"""Arrays come back as they were written; a lie or damage is a ValueError and nothing else."""

import io
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vanejax.files import array_header, read_stored_arrays


def header_of(text: bytes, version: bytes = b"\x01\x00") -> bytes:
    return b"\x93NUMPY" + version + len(text).to_bytes(2, "little") + text


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "arrays.npz"
    np.savez(path, points=np.arange(12.0).reshape(4, 3), face=np.arange(4, dtype=np.int32))
    return path


def test_arrays_come_back(path: Path) -> None:
    arrays = read_stored_arrays(path)
    assert sorted(arrays) == ["face", "points"]
    np.testing.assert_array_equal(arrays["points"], np.arange(12.0).reshape(4, 3))
    assert arrays["face"].dtype == np.int32


@pytest.mark.parametrize(
    "text",
    [b"{'descr': '<f8', 'shape", b"(" * 400, b"{'descr': '<f8'}", b"\xff\xfe", b"", b"[1, 2"],
    ids=["cut", "nested", "lacking", "no text", "empty", "unclosed"],
)
def test_rubbish_in_place_of_a_header_is_a_value_error(text: bytes) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy's own remark on what it could not parse
        with pytest.raises(ValueError, match=r"."):
            array_header(io.BytesIO(header_of(text)))


def test_a_later_format_is_named() -> None:
    with pytest.raises(ValueError, match=r"array format \(9, 0\)"):
        array_header(io.BytesIO(header_of(b"{}", b"\x09\x00")))


def test_an_array_larger_than_its_bytes_is_refused_without_allocating(tmp_path: Path) -> None:
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"
    with zipfile.ZipFile(tmp_path / "lie.npz", "w") as archive:
        archive.writestr("points.npy", header_of(text) + b"1234")
    with pytest.raises(ValueError, match=r"points\.npy does not hold the array that it announces"):
        read_stored_arrays(tmp_path / "lie.npz")


def test_objects_are_not_unpickled(tmp_path: Path) -> None:
    np.savez(tmp_path / "o.npz", a=np.array([print, None], dtype=object))
    with pytest.raises(ValueError, match="does not hold"):
        read_stored_arrays(tmp_path / "o.npz")


def test_compressed_and_repeated_arrays_are_refused(tmp_path: Path, path: Path) -> None:
    np.savez_compressed(tmp_path / "c.npz", a=np.zeros(9))
    with pytest.raises(ValueError, match="compressed"):
        read_stored_arrays(tmp_path / "c.npz")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr("face.npy", b"again")
    with pytest.raises(ValueError, match="twice"):
        read_stored_arrays(path)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damage_never_escapes_as_another_error(tmp_path_factory, data: st.DataObject) -> None:
    path = tmp_path_factory.mktemp("damage") / "a.npz"
    np.savez(path, a=np.arange(5.0))
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(raw[: data.draw(st.integers(1, len(raw)))]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            arrays = read_stored_arrays(path)
        except ValueError:
            return
    assert all(isinstance(array, np.ndarray) for array in arrays.values())
