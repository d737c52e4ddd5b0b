"""What this machine is and can do: the facts that a time means nothing without."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from pathlib import Path

import jax
import jax.numpy as jnp

MATMUL_SIZE = 2048
PEERS = ("open3d", "small_gicp", "torch")


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


def peer_versions() -> dict[str, str | None]:
    """Installed versions of the libraries that are compared with; None where there is none."""
    found: dict[str, str | None] = {}
    for name in PEERS:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def flops_per_second(repeats: int, size: int = MATMUL_SIZE) -> list[float]:
    """The rate of each of some products of two square float32 matrices in JAX.

    This is what the machine can do at best, which a network's arithmetic is measured against.
    """
    matrix = jnp.ones((size, size), jnp.float32)
    multiply = jax.jit(jnp.matmul)
    multiply(matrix, matrix).block_until_ready()
    rates = []
    for _ in range(repeats):
        began = time.perf_counter()
        multiply(matrix, matrix).block_until_ready()
        rates.append(2 * size**3 / (time.perf_counter() - began))
    return rates
