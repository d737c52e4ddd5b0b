"""Weights of published PyTorch networks as numpy arrays and as Flax variables.

Nothing in a PyTorch file is run (``torch.load(weights_only=True)``); reading it needs the extra
``vanejax[torch]``, once: `vanejax export FILE.pth --out FILE.safetensors`.
"""

from __future__ import annotations

import argparse
import itertools
import os
import pickle
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from vanejax.errors import InputError, MissingExtra
from vanejax.files import read_arrays, write_arrays

FORMAT = "vanejax state dict"
_RPMNET = (  # the network here and as published, and the channels of its parts
    ("feature_net", "feat_extractor", "prepool", (10, 96, 96, 192)),
    ("feature_net", "feat_extractor", "postpool", (192, 192, 96, 96)),
    ("annealing_net", "weights_net", "prepool", (4, 64, 64, 64, 128, 1024)),
    ("annealing_net", "weights_net", "postpool", (1024, 512, 256, 2)),
)


def load_state_dict(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Reads a state dict: a PyTorch checkpoint, or arrays of the same names (safetensors, .npz).

    The contents decide, not the suffix. In a checkpoint that holds more than the weights, the model
    is the mapping under ``state_dict``, ``model_state_dict`` or ``model``, the first of these with
    tensors in it, else the top level. Entries that are no tensors are left out, and so is the
    prefix ``module.`` (``torch.nn.DataParallel``) where every name has it.

    Returns:
      Arrays by name in PyTorch's layout ([out, in] for a linear layer); bfloat16 becomes float32.

    Raises:
      InputError: the file is missing, damaged, or holds no tensors or more than plain values.
      MissingExtra: a PyTorch file, but torch is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a .pth, .pt, .t7, .safetensors or .npz file")
    try:
        arrays = read_arrays(path)[0] if _holds_arrays(path) else _read_checkpoint(path)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); download or copy it again") from error
    if arrays and all(name.startswith("module.") for name in arrays):
        arrays = {name.removeprefix("module."): array for name, array in arrays.items()}
    if not arrays:
        raise InputError(f"{path}: holds no tensors, neither at its top level nor as a state dict")
    return arrays


def convert_state_dict(
    path: str | os.PathLike[str], out: str | os.PathLike[str]
) -> tuple[str, dict[str, np.ndarray]]:
    """Writes the weights of a published RPM-Net or PointNetLK as safetensors (or .npz).

    Returns the network's name and its state dict.

    Raises:
      InputError: as `load_state_dict`, or these are the weights of neither network.
    """
    arrays = load_state_dict(path)
    name, variables = ("RPM-Net", rpmnet_variables)
    if "dt" in arrays:
        name, variables = ("PointNetLK", pointnetlk_variables)
    try:
        variables(arrays)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    write_arrays(out, arrays, {"format": FORMAT, "network": name, "source": Path(path).name})
    return name, arrays


def _holds_arrays(path: Path) -> bool:
    """Whether this is an .npz or a safetensors file: PyTorch's files are zip archives too."""
    with open(path, "rb") as file:
        head = file.read(9)
    if head[:2] != b"PK":
        return head[8:] == b"{"  # a safetensors header, behind its length
    try:
        with zipfile.ZipFile(path) as archive:
            return all(name.endswith(".npy") for name in archive.namelist())
    except zipfile.BadZipFile as error:
        raise ValueError(str(error)) from error


def _read_checkpoint(path: Path) -> dict[str, np.ndarray]:
    try:
        import torch
    except ModuleNotFoundError as error:
        raise MissingExtra(
            f"{path}: neither safetensors nor .npz. If it is a PyTorch checkpoint, install torch "
            "to read it: pip install 'vanejax[torch]'"
        ) from error
    scalar = np._core.multiarray.scalar
    # scores and options stand beside the weights in published checkpoints
    harmless = [argparse.Namespace, np.dtype, *(type(np.dtype(k)) for k in ("f8", "f4", "i8"))]
    harmless += [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    try:
        with torch.serialization.safe_globals(harmless), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an error follows, or the file is of an old version
            loaded = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        reason = str(error).rpartition("WeightsUnpickler error: ")[2].split(". ")[0].strip()
        raise InputError(
            f"{path}: holds more than weights, or no weights ({reason[:200]}); nothing was run. If "
            'you trust it, load it in PyTorch and torch.save(model.state_dict(), "weights.pth")'
        ) from error
    except Exception as error:  # torch has many for damaged files: RuntimeError, EOFError, ...
        raise ValueError(f"{type(error).__name__}: {str(error)[:100]}") from error
    top = loaded if isinstance(loaded, Mapping) else {}
    for mapping in [*map(top.get, ("state_dict", "model_state_dict", "model")), top]:
        entries = mapping.items() if isinstance(mapping, Mapping) else ()
        tensors = {name: value for name, value in entries if isinstance(value, torch.Tensor)}
        if tensors:
            break
    if sum(value.nbytes for value in tensors.values()) > path.stat().st_size + (1 << 20):
        raise ValueError("its tensors are larger than the file: save them contiguous")
    return {
        str(name): (value.float() if value.dtype == torch.bfloat16 else value).detach().numpy()
        for name, value in tensors.items()
    }


def rpmnet_variables(state_dict: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Flax variables of the published RPM-Net's PyTorch weights.

    Raises:
      InputError: a name is missing or unknown, a shape is not RPM-Net's, a value not finite.
    """
    # learning3d names the first network feature_model
    names = {name: name.replace("feature_model.", "feat_extractor.", 1) for name in state_dict}
    weights = _StateDict({names[name]: state_dict[name] for name in state_dict}, "RPM-Net")
    params: dict[str, Any] = {"feature_net": {}, "annealing_net": {}}
    for net, prefix, label, widths in _RPMNET:
        for index, (channels, features) in enumerate(itertools.pairwise(widths)):
            # torch.nn.Sequential numbers the convolution, its norm and its ReLU: steps of three
            dense, norm = (f"{prefix}.{label}.{3 * index + offset}" for offset in (0, 1))
            kernel, bias = weights.linear(dense, channels, features)
            layer: dict[str, Any] = {"kernel": kernel, "bias": bias}
            if label == "prepool" or index < len(widths) - 2:
                scale, shift = (weights.take(f"{norm}.{x}", features) for x in ("weight", "bias"))
                layer = {"dense": layer, "norm": {"scale": scale, "bias": shift}}
            params[net][f"{label}_{index}"] = layer
    weights.check_empty()
    return jax.tree.map(np.float32, {"params": params})


def pointnetlk_variables(state_dict: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Flax variables of a published PointNetLK's PyTorch weights.

    Its batch normalisation, in evaluation, is affine and goes into the kernels.

    Raises:
      InputError: a name is missing or unknown, a shape is not PointNetLK's, a value not finite, a
        variance negative, or the Jacobian's step is not 0.01.
    """
    weights = _StateDict(state_dict, "PointNetLK")
    if not np.allclose(weights.take("dt", 1, 6), 0.01):
        raise InputError("'dt' is not 0.01: a learned step of the Jacobian is not supported")
    encoder: dict[str, np.ndarray] = {}
    for index, (channels, features) in enumerate(itertools.pairwise((3, 64, 64, 64, 128, 1024))):
        convolution, norm = (f"feature_model.{kind}{index + 1}" for kind in ("conv", "bn"))
        kernel, bias = weights.linear(convolution, channels, features)
        gain, shift, mean, variance = (
            weights.take(f"{norm}.{name}", features)
            for name in ("weight", "bias", "running_mean", "running_var")
        )
        if variance.min() < 0:
            raise InputError(f"'{norm}.running_var' holds a negative variance")
        weights.arrays.pop(f"{norm}.num_batches_tracked", None)  # of no effect in evaluation
        scale = gain / np.sqrt(variance + 1e-5)  # PyTorch's epsilon
        encoder[f"kernel_{index}"] = np.float32(kernel * scale)
        encoder[f"bias_{index}"] = np.float32((bias - mean) * scale + shift)
    weights.check_empty()
    return {"params": {"encoder": encoder}}


class _StateDict:
    """The arrays of a state dict that no layer has taken yet."""

    def __init__(self, state_dict: Mapping[str, np.ndarray], network: str) -> None:
        self.arrays = dict(state_dict)
        self.network = network

    def take(self, name: str, *shape: int) -> np.ndarray:
        """The array of this name, f64, which may have further axes of length 1 (convolutions)."""
        if name not in self.arrays:
            raise InputError(
                f"the state dict has no {name!r}: it is not a published {self.network}'s"
            )
        value = np.asarray(self.arrays.pop(name), np.float64)
        if value.shape[: len(shape)] != shape or value.size != np.prod(shape):
            raise InputError(f"{name!r} has shape {value.shape}: {self.network}'s has {shape}")
        if not np.isfinite(value).all():
            raise InputError(f"{name!r} holds values that are not finite: its training diverged")
        return value.reshape(shape)

    def linear(self, name: str, channels: int, features: int) -> tuple[np.ndarray, np.ndarray]:
        """Kernel [channels, features] and bias [features] of a linear layer or a convolution."""
        weight = self.take(f"{name}.weight", features, channels)
        return weight.T, self.take(f"{name}.bias", features)

    def check_empty(self) -> None:
        """Refuses arrays that the network does not have."""
        if self.arrays:
            names = ", ".join(sorted(self.arrays)[:5])
            raise InputError(f"the state dict has entries {self.network} lacks: {names}")
