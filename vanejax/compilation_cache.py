"""JAX's persistent compilation cache for the command line: a second run need not compile again."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

VARIABLE = "VANEJAX_CACHE_DIR"


def enable(environment: Mapping[str, str] = os.environ) -> Path | None:
    """Switches the cache on for this process, in the user's own cache folder.

    That is ``$VANEJAX_CACHE_DIR``, or ``$XDG_CACHE_HOME/vanejax``, or ``~/.cache/vanejax``.
    ``VANEJAX_CACHE_DIR=off`` leaves it off, and so does a folder that cannot be written. Where
    JAX has a cache already (``$JAX_COMPILATION_CACHE_DIR``), that one stays.

    Returns:
      The folder, or None where nothing was switched on.
    """
    folder = cache_folder(environment)
    if folder is None:
        return None
    import jax

    if jax.config.jax_compilation_cache_dir is not None:
        return None
    try:
        # for this user alone: what is read from here is run
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # everything: the many small programs of a start cost seconds together
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


def cache_folder(environment: Mapping[str, str]) -> Path | None:
    """Where the cache belongs, or None if it is off or there is no home folder."""
    given = environment.get(VARIABLE, "")
    if given.lower() == "off":
        return None
    if given:
        return Path(given)
    if base := environment.get("XDG_CACHE_HOME", ""):
        return Path(base) / "vanejax"
    try:
        return Path.home() / ".cache" / "vanejax"
    except RuntimeError:
        return None
