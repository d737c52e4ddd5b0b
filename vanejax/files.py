"""Files written atomically, and files of arrays (.npz, safetensors) read without trust."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import safetensors.numpy

from vanejax.errors import InputError

_MAX_HEADER_BYTES = 1 << 22  # of safetensors: names, shapes and metadata
_MAX_ARRAYS = 10_000
_MAX_INFLATION = 8  # numbers hardly compress: what unpacks to more is no file of measurements


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Gives a temporary path beside ``path``, which takes that name once the block has ended.

    Where the block raises, ``path`` is left as it was and the temporary file is removed. A link is
    followed: the file that it points to is replaced.

    Raises:
      InputError: the file cannot be written, or is a folder, a device or a pipe.
    """
    path = Path(path)
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file")
    # replacing /dev/stdout by a file would need no more than the rights to
    if target.exists() and not target.is_file():
        raise InputError(f"{path}: is a device or a pipe; give the name of a file")
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        yield partial
        os.replace(partial, target)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Writes a UTF-8 text file by `atomic_write`."""
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: str | os.PathLike[str], value: Any, *, allow_nan: bool = True) -> None:
    """Writes JSON by `atomic_write`; ValueError for NaN and infinity without ``allow_nan``."""
    write_text(path, json.dumps(value, indent=2, allow_nan=allow_nan) + "\n")


def read_json(path: str | os.PathLike[str]) -> Any:
    """Reads a JSON file.

    Raises:
      InputError: it cannot be read.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error})") from error


def read_head(path: Path, *, max_bytes: int, advice: str) -> bytes:
    """The first 64 KiB of a file.

    Raises:
      InputError: the file is missing, a folder, a device, empty, unreadable, or larger than
        ``max_bytes``, for which the message gives the advice.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the file in it")
    if not path.exists():
        raise InputError(f"{path}: no such file (looked in {path.parent.absolute()})")
    if not path.is_file():
        raise InputError(f"{path}: is a device or a pipe; give a file")
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(1 << 16)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if size > max_bytes:
        limit = f"{size / 2**30:.1f} GiB are more than {max_bytes / 2**30:.0f} GiB"
        raise InputError(f"{path}: {limit}; {advice}")
    if size <= 1 << 16 and not head.strip():
        raise InputError(f"{path}: is empty; export it again")
    return head


def check_writable(path: str | os.PathLike[str]) -> None:
    """Finds out before long work whether `atomic_write` will be able to write ``path``.

    An existing file is not touched.

    Raises:
      InputError: as `atomic_write`.
    """
    with contextlib.suppress(_Tried), atomic_write(path) as partial:
        partial.touch()
        raise _Tried


class _Tried(Exception):
    """Leaves the block of `atomic_write` before it replaces anything."""


def array_header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether columns come first, and dtype of the array that starts here.

    Raises:
      ValueError: this is no array, or one of a format later than 2.0.
    """
    formats = np.lib.format
    version = formats.read_magic(file)
    readers = {(1, 0): formats.read_array_header_1_0, (2, 0): formats.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"array format {version}, expected 1.0 or 2.0")
    try:
        return readers[version](file)
    # what Python's own parsers make of rubbish
    except (SyntaxError, tokenize.TokenError, RecursionError, MemoryError, TypeError) as error:
        raise ValueError("an array without a header") from error


def write_arrays(
    path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], header: Mapping[str, Any]
) -> None:
    """Writes arrays and a header by `atomic_write`, with a checksum of the arrays.

    The suffix decides: .npz has the header as JSON in an array ``header``, any other file is
    safetensors with each value of the header as JSON in its metadata.

    Raises:
      InputError: as `atomic_write`.
    """
    arrays = {name: np.asarray(value, order="C") for name, value in arrays.items()}
    header = {**header, "sha256": arrays_sha256(arrays)}
    with atomic_write(path) as partial, open(partial, "wb") as file:
        if Path(path).suffix.lower() == ".npz":
            text = json.dumps(header, sort_keys=True).encode()
            np.savez(file, header=np.frombuffer(text, np.uint8), **arrays)
        else:
            metadata = {name: json.dumps(value, sort_keys=True) for name, value in header.items()}
            file.write(safetensors.numpy.save(arrays, metadata))


def read_arrays(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays by name, and the header, of an .npz or safetensors file; its contents say which.

    Nothing is unpickled, and no size in the file is trusted. A header that is not there, or that
    is no JSON object, is empty. The checksum is compared where vanejax wrote one.

    Raises:
      ValueError: damaged, neither of the two, or an array does not hold what its header announces;
        the message says what, not which file.
      OSError: the file cannot be read.
    """
    path = Path(path)
    with open(path, "rb") as file:
        head = file.read(8)
    arrays, header = _read_npz(path) if head[:2] == b"PK" else _read_safetensors(path, head)
    ours = str(header.get("format")).startswith("vanejax ")
    if ours and header.get("sha256", "") not in ("", arrays_sha256(arrays)):
        raise ValueError("its checksum is wrong")
    return arrays, header


def read_versioned_arrays(
    path: str | os.PathLike[str], file_format: str, version: int, *, words: str, remedy: str
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """`read_arrays` of a file of vanejax's own format, which its header names.

    Args:
      path: the file.
      file_format, version: that its header must have.
      words: for messages, what the file should be, such as "a scan set".
      remedy: for messages, what to do about another file.

    Raises:
      InputError: no such file, no file, damaged, or of another format or version.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file (looked in {path.parent.absolute()})")
    if not path.is_file():
        raise InputError(f"{path}: is a folder or a device, not {words}")
    try:
        arrays, header = read_arrays(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: truncated or not {words} ({error}); {remedy}") from error
    if header.get("format") != file_format:
        raise InputError(f"{path}: not {words} of vanejax; {remedy}")
    if header.get("version") != version:
        raise InputError(
            f"{path}: {words} of version {header.get('version')!r}, this program reads {version}; "
            f"{remedy}"
        )
    return arrays, header


def arrays_sha256(arrays: Mapping[str, np.ndarray]) -> str:
    """A digest of names, dtypes, shapes and contents of arrays."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        value = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {value.dtype.str} {value.shape}".encode())
        digest.update(value.data if value.size else b"")
    return digest.hexdigest()


def _read_safetensors(path: Path, head: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    if len(head) < 8 or int.from_bytes(head, "little") > _MAX_HEADER_BYTES:
        raise ValueError("neither an .npz nor a safetensors file")
    try:
        # shapes, offsets and the file's size are compared when it is opened
        with safetensors.safe_open(path, framework="numpy") as file:
            names = file.keys()
            if len(names) > _MAX_ARRAYS:
                raise ValueError(f"holds {len(names)} arrays, more than {_MAX_ARRAYS}")
            arrays = {name: file.get_tensor(name) for name in names}
            metadata = file.metadata() or {}
    except (safetensors.SafetensorError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(str(error)) from error
    return arrays, {name: _json_or(text, text) for name, text in metadata.items()}


def _read_npz(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            names = [entry.filename.removesuffix(".npy") for entry in entries]
            if len(set(names)) != len(names) or len(names) > _MAX_ARRAYS:
                raise ValueError(f"holds an array twice, or more than {_MAX_ARRAYS}")
            # no entry unpacks to more than it announces
            size = sum(entry.file_size for entry in entries)
            if size > _MAX_INFLATION * path.stat().st_size + (1 << 16):
                raise ValueError(f"would unpack to {size} bytes, far more than it has")
            arrays = {
                name: _read_array(archive, entry)
                for name, entry in zip(names, entries, strict=True)
            }
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(str(error)) from error
    text = arrays.pop("header", np.empty(0, np.uint8)).tobytes()
    header = _json_or(text, {})
    return arrays, header if isinstance(header, dict) else {}


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(entry) as file:
        shape, fortran, dtype = array_header(file)
        data = file.read()
    if dtype.hasobject or len(data) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{entry.filename} does not hold the array that it announces")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")


def _json_or(text: str | bytes, default: Any) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return default
