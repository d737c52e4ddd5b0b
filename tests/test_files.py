"""Files appear complete or not at all; arrays come back, and damage is a ValueError."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given, settings
from hypothesis import strategies as st

from vanejax.errors import InputError
from vanejax.files import (
    array_header,
    atomic_write,
    check_writable,
    read_arrays,
    write_arrays,
    write_text,
)

ARRAYS = {"points": np.arange(12.0).reshape(4, 3), "count": np.array(4, np.int32)}
HEADER = {"format": "vanejax test", "sizes": [1, 2.5], "name": "ü", "nothing": None}


def write_half(path: Path, error: BaseException) -> None:
    with atomic_write(path) as partial:
        partial.write_text("half")
        raise error


def test_a_text_is_written_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "one")
    write_text(path, "zwei, drei: ü")
    assert path.read_text(encoding="utf-8") == "zwei, drei: ü"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (RuntimeError("half"), pytest.raises(RuntimeError, match="half")),
        (KeyboardInterrupt(), pytest.raises(KeyboardInterrupt)),
        (OSError(28, "No space left on device"),
         pytest.raises(InputError, match=r"a\.txt: cannot be written: No space left")),
    ],
    ids=["bug", "interrupt", "full disk"],
)  # fmt: skip
def test_what_fails_on_the_way_leaves_the_old_file(tmp_path: Path, error, raised) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with raised:
        write_half(path, error)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_is_followed(tmp_path: Path) -> None:
    target, link = tmp_path / "target.txt", tmp_path / "link.txt"
    link.symlink_to(target)
    write_text(link, "text")
    assert link.is_symlink()
    assert target.read_text() == "text"


def test_what_cannot_be_a_file_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("kept")
    for path, words in (
        (tmp_path, "is a folder"),
        (Path("/dev/null"), "is a device"),
        (tmp_path / "none" / "a.txt", "No such file or directory"),
        (file / "a.txt", "Not a directory"),
        ("", "is a folder"),
    ):
        with pytest.raises(InputError, match=words):
            check_writable(path)
        with pytest.raises(InputError, match=words):
            write_text(path, "text")
    assert Path("/dev/null").is_char_device()
    assert file.read_text() == "kept"


def test_checking_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    check_writable(path)
    assert not list(tmp_path.iterdir())
    path.write_text("old")
    check_writable(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["a.npz", "a.safetensors", "a"])
def test_arrays_come_back(tmp_path: Path, name: str) -> None:
    write_arrays(tmp_path / name, ARRAYS, HEADER)
    arrays, header = read_arrays(tmp_path / name)
    assert set(arrays) == set(ARRAYS)
    for key, value in ARRAYS.items():
        np.testing.assert_array_equal(arrays[key], value, strict=True)
    assert len(header.pop("sha256")) == 64
    assert header == HEADER
    write_arrays(tmp_path / name, ARRAYS, header | {"sha256": "of other arrays"})
    assert read_arrays(tmp_path / name)[1]["sha256"] != "of other arrays"


def test_arrays_of_other_programs_are_read(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", f=np.asfortranarray(ARRAYS["points"]), e=np.zeros(0))
    arrays, header = read_arrays(tmp_path / "a.npz")
    np.testing.assert_array_equal(arrays["f"], ARRAYS["points"])
    assert (arrays["e"].shape, header) == ((0,), {})
    data = safetensors.numpy.save(ARRAYS, {"format": "pt", "sha256": "0", "note": "words"})
    (tmp_path / "a.safetensors").write_bytes(data)
    assert read_arrays(tmp_path / "a.safetensors")[1]["note"] == "words"
    np.savez(tmp_path / "b.npz", header=np.frombuffer(b"[1, 2", np.uint8))
    assert read_arrays(tmp_path / "b.npz") == ({}, {})


def header_of(text: bytes, version: bytes = b"\x01\x00") -> bytes:
    return b"\x93NUMPY" + version + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(
    "text",
    [b"{'descr': '<f8', 'shape", b"(" * 400, b"{'descr': '<f8'}", b"\xff\xfe", b"", b"[1, 2"],
    ids=["cut", "nested", "lacking", "no text", "empty", "unclosed"],
)
def test_a_damaged_header_of_an_array_is_a_value_error(text: bytes) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy's own remark on what it could not parse
        with pytest.raises(ValueError, match=r"."):
            array_header(io.BytesIO(header_of(text)))


def npz_of(content: bytes) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("a.npy", content)
    return data.getvalue()


def saved(save, *args, **arrays) -> bytes:
    data = io.BytesIO()
    save(data, *args, **arrays)
    return data.getvalue()


def twice() -> bytes:
    data = io.BytesIO(saved(np.savez, a=np.zeros(3)))
    with warnings.catch_warnings(), zipfile.ZipFile(data, "a") as archive:
        warnings.simplefilter("ignore")
        archive.writestr("a.npy", b"again")
    return data.getvalue()


def safetensors_of(table: object, data: bytes = b"1234") -> bytes:
    text = table if isinstance(table, bytes) else json.dumps(table).encode()
    return len(text).to_bytes(8, "little") + text + data


HUGE = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }"
ENTRY = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}
EMPTY = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (npz_of(header_of(HUGE) + b"1234"), r"a\.npy does not hold the array that it announces"),
        (npz_of(header_of(HUGE.replace(b"10000", b"-1.05"))), "."),
        (npz_of(header_of(b"{}", b"\x09\x00")), r"array format \(9, 0\)"),
        (saved(np.savez, a=np.array([print, None], object)), "does not hold"),
        (saved(np.savez_compressed, a=np.zeros(1 << 20)), "would unpack to 8388736 bytes"),
        (twice(), "an array twice"),
        (b"PK\3\4 and nothing", "."),
        (b"", "neither an .npz nor a safetensors file"),
        (b"<html> a page </html>", "neither"),
        ((1 << 40).to_bytes(8, "little") + b"{}", "neither"),
        (safetensors_of({"a": ENTRY | {"shape": [10**12]}}), "."),
        (safetensors_of({"a": ENTRY | {"data_offsets": [0, 400]}}), "."),
        (safetensors_of({"a": ENTRY, "b": ENTRY}), "."),
        (safetensors_of({"a": ENTRY | {"dtype": "F8_E8M0", "shape": [4]}}), "."),
        (safetensors_of({"a": {}}), "."),
        (safetensors_of(b"{" * 10_000), "."),
        (safetensors_of({f"a{i}": EMPTY for i in range(10_001)}, b""), "10001 arrays"),
    ],
)  # fmt: skip
def test_damage_and_lies_are_value_errors(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(ValueError, match=words):
        read_arrays(tmp_path / "a")


@pytest.mark.parametrize("name", ["a.npz", "a.safetensors"])
def test_a_changed_array_is_noticed(tmp_path: Path, name: str) -> None:
    arrays = {"a": np.arange(5.0)}
    write_arrays(tmp_path / name, arrays, HEADER)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content.replace(np.float64(3).tobytes(), np.float64(7).tobytes()))
    with pytest.raises(ValueError, match=r"CRC|checksum"):
        read_arrays(tmp_path / name)


@settings(max_examples=100, deadline=None)
@given(data=st.data(), name=st.sampled_from(["a.npz", "a.safetensors"]))
def test_damage_is_noticed_and_never_another_error(tmp_path_factory, data, name: str) -> None:
    path = tmp_path_factory.mktemp("damage") / name
    write_arrays(path, {"a": np.arange(5.0)}, {})
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(raw[: data.draw(st.integers(1, len(raw)))]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            arrays, _ = read_arrays(path)
        except ValueError:
            return
    (array,) = arrays.values()  # nothing was changed
    np.testing.assert_array_equal(array, np.arange(5.0))
