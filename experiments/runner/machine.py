"""What a result rests on: this machine, the installed versions, the commit; and a report's head."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from vanejax.cad import Part

MATMUL_SIZE = 2048
PACKAGES = ("vanejax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "embreex")
PEERS = ("open3d", "small_gicp", "torch")


def report_head(part: Part | None, *, seed: int, config: Any) -> dict[str, Any]:
    """What was run, when, on what, from which source: the first entries of a report's JSON."""
    return {
        "date": timestamp(),
        "machine": {
            "cpu": cpu_model(),
            "processor": platform.machine(),
            "cores": cores(),
            "load": os.getloadavg()[0],
        },
        "commit": git_commit(),
        "versions": versions(),
        "python": platform.python_version(),
        "part": None if part is None else {"name": part.name, "sha256": part.sha256},
        "seed": seed,
        "config": config,
    }


def timestamp() -> str:
    """Date and time to the second, UTC, in ISO 8601."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def cpu_model() -> str:
    """The processor's name, as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def cores() -> int:
    """Those that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def versions(packages: Iterable[str] = PACKAGES) -> dict[str, str | None]:
    """Installed versions of packages; None where one is not installed."""
    installed: dict[str, str | None] = {}
    for name in packages:
        try:
            installed[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            installed[name] = None
    return installed


def git_commit() -> str | None:
    """The commit of the source tree, with "+" where it has changes; None outside of git."""
    here = Path(__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def flops_per_second(repeats: int, size: int = MATMUL_SIZE) -> list[float]:
    """The best rate of this machine: that of each of some square float32 matrix products in JAX."""
    matrix = jnp.ones((size, size), jnp.float32)
    multiply = jax.jit(jnp.matmul)
    multiply(matrix, matrix).block_until_ready()
    rates = []
    for _ in range(repeats):
        began = time.perf_counter()
        multiply(matrix, matrix).block_until_ready()
        rates.append(2 * size**3 / (time.perf_counter() - began))
    return rates
