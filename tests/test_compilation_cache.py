"""The compilation cache of the command line: where it is, and that it never gets in the way."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from vanejax.compilation_cache import cache_folder, enable


def test_where_it_is() -> None:
    assert cache_folder({"VANEJAX_CACHE_DIR": "/a", "XDG_CACHE_HOME": "/b"}) == Path("/a")
    assert cache_folder({"XDG_CACHE_HOME": "/b"}) == Path("/b/vanejax")
    assert cache_folder({}) == Path.home() / ".cache" / "vanejax"
    assert cache_folder({"VANEJAX_CACHE_DIR": "off", "XDG_CACHE_HOME": "/b"}) is None


def test_a_folder_that_cannot_be_is_no_trouble(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    assert enable({"VANEJAX_CACHE_DIR": str(tmp_path / "file")}) is None
    assert enable({"VANEJAX_CACHE_DIR": str(tmp_path / "file" / "below")}) is None
    assert enable({"VANEJAX_CACHE_DIR": "off"}) is None


PROGRAM = """
import jax
from vanejax.compilation_cache import enable
print(enable())
jax.monitoring.register_event_listener(lambda event, **_: print(event))
jax.jit(lambda x: x * 2 + 1)(3.0)
"""


def run(**environment: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=os.environ | environment,
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_second_run_compiles_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "cache"
    first, second = (run(VANEJAX_CACHE_DIR=str(folder)) for _ in range(2))
    assert first[0] == second[0] == str(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    misses, hits = "/jax/compilation_cache/cache_misses", "/jax/compilation_cache/cache_hits"
    assert misses in first
    assert misses not in second
    assert hits in second


def test_a_cache_that_is_there_already_stays(tmp_path: Path) -> None:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    printed = run(VANEJAX_CACHE_DIR=str(ours), JAX_COMPILATION_CACHE_DIR=str(theirs))
    assert printed[0] == "None"
    assert not ours.exists()
