"""What the tests of experiments share."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

from experiments.pages.reproduction.studies import recorded


@pytest.fixture(scope="session")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where compiled programs are kept: these tests compile the same ones again and again."""
    return tmp_path_factory.mktemp("programs")


@pytest.fixture(scope="module")
def hasty_compiler(programs: Path) -> Iterator[None]:
    """XLA without most of its passes, and each program once: they compile longer than they run."""
    wanted = {
        "jax_disable_most_optimizations": True,
        "jax_compilation_cache_dir": str(programs),
        "jax_persistent_cache_min_compile_time_secs": 0,
    }
    before = {name: jax.config.values[name] for name in wanted}
    for name, value in wanted.items():
        jax.config.update(name, value)
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Runs a study with arguments of its command: its report, which is what NAME.json holds."""

    def run(study: ModuleType, name: str, *arguments: str) -> dict[str, Any]:
        report = study.main(study.make_parser().parse_args([*arguments, "--out", str(tmp_path)]))
        assert json.loads((tmp_path / f"{name}.json").read_text()) == report
        return report

    return run


@pytest.fixture(scope="session")
def results() -> dict[str, Any]:
    """The recorded results by name; not to be changed."""
    return recorded()
