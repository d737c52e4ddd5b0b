"""Writing files that appear complete or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from vanejax.errors import InputError


@contextlib.contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
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
    """Writes a UTF-8 text file.

    Raises:
      InputError: as `whole_file`.
    """
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def check_writable(path: str | os.PathLike[str]) -> None:
    """Finds out before long work whether `whole_file` will be able to write ``path``.

    An existing file is not touched.

    Raises:
      InputError: as `whole_file`.
    """
    with contextlib.suppress(_Tried), whole_file(path) as partial:
        partial.touch()
        raise _Tried


class _Tried(Exception):
    """Leaves the block of `whole_file` before it replaces anything."""
