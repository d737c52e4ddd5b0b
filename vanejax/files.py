"""Files written whole or not at all, and NumPy's files read without trust."""

from __future__ import annotations

import contextlib
import json
import math
import os
import tokenize
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from vanejax.errors import InputError


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


def read_stored_arrays(path: Path) -> dict[str, np.ndarray]:
    """Every array of an .npz file as `numpy.savez` writes it, by name.

    Raises:
      ValueError: damaged, compressed, or an array does not hold what its header announces; the
        message says what, not which file.
      OSError: the file cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            names = [entry.filename.removesuffix(".npy") for entry in entries]
            if len(set(names)) != len(names):
                raise ValueError("holds an array twice")
            # stored entries that are not twice there are no larger together than the file
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
                raise ValueError("holds compressed arrays")
            if sum(entry.file_size for entry in entries) > path.stat().st_size:
                raise ValueError("announces more bytes than it has")
            return {
                name: _read_array(archive, entry)
                for name, entry in zip(names, entries, strict=True)
            }
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(str(error)) from error


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(entry) as file:
        shape, fortran, dtype = array_header(file)
        data = file.read()
    if dtype.hasobject or fortran or len(data) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{entry.filename} does not hold the array that it announces")
    return np.frombuffer(data, dtype).reshape(shape)
