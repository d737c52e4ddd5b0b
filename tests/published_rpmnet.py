"""A state dict of the published RPM-Net's names and shapes."""

from __future__ import annotations

import functools
import itertools

import numpy as np

WIDTHS = {  # name in the state dict: widths, axes of a weight before and after the pooling
    "feat_extractor": ((10, 96, 96, 192), (192, 192, 96, 96), 4, 3),
    "weights_net": ((4, 64, 64, 64, 128, 1024), (1024, 512, 256, 2), 3, 2),
}


@functools.cache
def state_dict() -> dict[str, np.ndarray]:
    """Random weights under PyTorch's names and in its shapes; gains of both signs."""
    rng = np.random.default_rng(0)
    state = {}
    for net, (before, after, *axes) in WIDTHS.items():
        for label, widths, ndim in (("prepool", before, axes[0]), ("postpool", after, axes[1])):
            for layer, (fan_in, out) in enumerate(itertools.pairwise(widths)):
                name = f"{net}.{label}.{3 * layer}"
                weight = rng.normal(size=(out, fan_in)) / np.sqrt(fan_in)
                state[f"{name}.weight"] = weight.reshape(out, fan_in, *(1,) * (ndim - 2))
                state[f"{name}.bias"] = rng.normal(size=out, scale=0.1)
                if label == "prepool" or layer < 2:
                    norm = f"{net}.{label}.{3 * layer + 1}"
                    gain = 1 + 0.2 * rng.normal(size=out)
                    state[f"{norm}.weight"] = gain * np.where(rng.uniform(size=out) < 0.2, -1, 1)
                    state[f"{norm}.bias"] = rng.normal(size=out, scale=0.3)
    # random features lie 0.003 to 0.2 apart: beta must tell them apart, alpha lie in their midst
    state["weights_net.postpool.6.bias"] = np.array([300.0, -4.0])
    return {name: value.astype(np.float32) for name, value in state.items()}
