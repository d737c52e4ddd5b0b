"""Published PyTorch weights as numpy arrays, read without torch and without running the file.

Nothing in a file is trusted: its pickle is only looked at (``inert_pickle``), and sizes, strides
and offsets are checked against the bytes that are there.
"""

from __future__ import annotations

import io
import itertools
import math
import os
import pathlib
import struct
import zipfile
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from vanejax.errors import InputError
from vanejax.matching.inert_pickle import RESAVE, Storage, Tensor, are_counts, interpret

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_VERSION = 1001
_MAX_NDIM = 32
_SLACK_BYTES = 1 << 20  # small expanded tensors (stride 0) take more memory than file
_MAX_INFLATION = 8  # weights hardly compress: what unpacks to more is no file of weights


def load_state_dict(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Reads a model's weights from a PyTorch checkpoint, or from an .npz of arrays.

    The contents decide, not the suffix (.pth, .pt, .t7, .tar, .npz): the zip format of
    torch >= 1.6, the older one, and numpy archives. torch need not be installed, and no code in
    the file is run. Memory stays below the file's size plus that of the arrays, which is at most
    the file's (8 times that for a compressed .npz), give or take what the pickle itself needs.

    In a checkpoint that holds more than the weights, the model is the mapping under
    ``state_dict``, ``model_state_dict`` or ``model``, the first of these with tensors in it,
    else the top level. Entries that are no tensors are left out. The prefix ``module.``
    (``torch.nn.DataParallel``) goes where every name has it.

    Args:
      path: file on disk; it is read only.

    Returns:
      Arrays by name in the file's order, C-contiguous, writable and of the file's type: float64,
      float32, float16, bfloat16 (``ml_dtypes.bfloat16``; JAX takes it as it is), int64, int32,
      int16, int8, uint8 or bool; from .npz also the wider unsigned integers. The layout is
      PyTorch's ([out, in] for a linear layer). Names that share one tensor in the file share one
      array.

    Raises:
      InputError: the file is missing, truncated or damaged, is no checkpoint, names anything
        but the parts of a state dict, claims sizes that its bytes do not bear out, is
        big-endian, a TorchScript archive or a Lua Torch7 file, or holds no tensors.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file. Give the path of a .pth, .pt, .t7 or .npz file.")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
    try:
        arrays = _read_zip(data) if data.startswith(b"PK\3\4") else _read_legacy(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:
        # Damaged or hostile bytes break parsers in many ways (struct, zlib, index, type, ...);
        # to the caller they are one fact, and the chained error keeps which it was.
        raise InputError(
            f"{path}: damaged or truncated ({type(error).__name__}: {ascii(str(error))[:200]}). "
            "Download or copy it again and compare its size with the source's."
        ) from error
    if all(name.startswith("module.") for name in arrays):
        arrays = {name.removeprefix("module."): array for name, array in arrays.items()}
    return arrays


def _read_zip(data: bytes) -> dict[str, np.ndarray]:
    """Since torch 1.6: <folder>/data.pkl and the storages <folder>/data/<key>; or an .npz."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {entry.filename: entry for entry in archive.infolist()}
        if entries and all(name.endswith(".npy") for name in entries):
            return _read_npz(archive, len(data))
    pickles = [name for name in entries if name.rpartition("/")[2] == "data.pkl"]
    if not pickles:
        raise InputError(f"a zip file, but neither PyTorch's nor numpy's. Instead, {RESAVE}.")
    folder = min(pickles, key=len).removesuffix("data.pkl")
    if folder + "constants.pkl" in entries:
        raise InputError(
            "a TorchScript archive, which is a program, not a state dict. In PyTorch, load it "
            'with torch.jit.load, then torch.save(loaded.state_dict(), "weights.pth").'
        )
    contents = {
        name.removeprefix(folder): _stored_bytes(data, entry)
        for name, entry in entries.items()
        if name.startswith(folder)
    }
    _require_little_endian(contents.get("byteorder", b"little") == b"little")
    storages = {
        name.removeprefix("data/"): raw
        for name, raw in contents.items()
        if name.startswith("data/")
    }
    return _model_arrays(interpret(io.BytesIO(contents["data.pkl"])), storages, len(data))


def _stored_bytes(data: bytes, entry: zipfile.ZipInfo) -> memoryview:
    """An entry's bytes where they lie. Without its checksum, which torch can be told to omit."""
    if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
        raise InputError(
            f"its entry {entry.filename[:80]!r} is compressed or encrypted, as torch.save never "
            f"writes. Take the original file, or {RESAVE}."
        )
    header = entry.header_offset
    if header < 0 or data[header : header + 4] != b"PK\3\4":
        raise ValueError("zip entry without its header")
    start = header + 30 + sum(struct.unpack_from("<HH", data, header + 26))
    # Past the end of the file the slice is short: what reads it compares lengths.
    return memoryview(data)[start : start + entry.file_size]


def _read_npz(archive: zipfile.ZipFile, file_bytes: int) -> dict[str, np.ndarray]:
    entries = archive.infolist()
    # zipfile never inflates an entry past the size that its directory states.
    if sum(entry.file_size for entry in entries) > _MAX_INFLATION * file_bytes + _SLACK_BYTES:
        raise InputError(
            f"would unpack to more than {_MAX_INFLATION} times its size, as weights never do. "
            "If the source is sound, write it again with numpy.savez (uncompressed)."
        )
    arrays = {}
    for entry in entries:
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError("packed by a method that numpy does not use. Use numpy.savez.")
        content = archive.read(entry)
        stream = io.BytesIO(content)
        # Not numpy.load: it allocates what the header claims before it looks for the bytes.
        is_first_version = np.lib.format.read_magic(stream) == (1, 0)
        read_header = getattr(np.lib.format, f"read_array_header_{2 - is_first_version}_0")
        shape, is_fortran, dtype = read_header(stream)
        name = entry.filename.removesuffix(".npy")
        if dtype.kind in "SU":
            continue
        if dtype.kind not in "biuf" or dtype.itemsize > 8 or dtype.byteorder == ">":
            raise InputError(
                f"array {name[:80]!r} is of type {str(dtype)[:40]!r}: only little-endian numbers "
                "are read (an object array would have to be unpickled). Convert it, for example "
                "array.astype(numpy.float32), and write the file again with numpy.savez."
            )
        payload = memoryview(content)[stream.tell() :]
        if not are_counts(shape) or math.prod(shape) * dtype.itemsize != payload.nbytes:
            raise ValueError(f"array {name[:80]!r} has other bytes than its shape needs")
        steps = [math.prod(shape[:i] if is_fortran else shape[i + 1 :]) for i in range(len(shape))]
        arrays[name] = _strided_copy(payload, dtype, 0, shape, steps)
    if not arrays:
        raise InputError("holds no arrays of numbers. Give the .npz with the model's weights.")
    return arrays


def _read_legacy(data: bytes) -> dict[str, np.ndarray]:
    """Before torch 1.6: pickles of magic, version, system, object and storage keys; storages."""
    if _LEGACY_MAGIC.to_bytes(10, "little") not in data[:32]:
        if data[:4] in (b"\3\0\0\0", b"\4\0\0\0", b"3\n1\n", b"4\n1\n"):
            raise InputError(
                "a file of Lua Torch7, not of PyTorch. Convert it to .npz with a Torch7 reader "
                "(for example the package torchfile) and numpy.savez."
            )
        if data[257:262] == b"ustar":
            raise InputError(f"a tar archive, PyTorch's format of 2016. Instead, {RESAVE}.")
        raise InputError(
            f"not a PyTorch checkpoint or .npz: it begins with {data[:16]!r}. A web page or a Git "
            "LFS pointer in place of the download looks like text; a plain pickle is not read "
            f"at all. Download the file again, or {RESAVE}."
        )
    stream = io.BytesIO(data)
    if interpret(stream) != _LEGACY_MAGIC or interpret(stream) != _LEGACY_VERSION:
        raise InputError(f"in an unknown version of PyTorch's format. Instead, {RESAVE}.")
    _require_little_endian(interpret(stream)["little_endian"] is True)
    dtypes: dict[str, np.dtype] = {}
    top = interpret(stream, dtypes)
    keys = interpret(stream)
    storages = {}
    start = stream.tell()
    for key in keys:
        if not isinstance(key, str) or key not in dtypes:
            raise ValueError("a storage that the pickle does not name")
        (count,) = struct.unpack_from("<q", data, start)
        end = start + 8 + count * dtypes[key].itemsize
        if count < 0 or end > len(data):
            raise ValueError(f"{count} elements of {dtypes[key]}, but the file ends before")
        storages[key] = memoryview(data)[start + 8 : end]
        start = end
    return _model_arrays(top, storages, len(data))


def _require_little_endian(is_little: bool) -> None:
    if not is_little:
        raise InputError(f"written on a big-endian machine. On a little-endian one, {RESAVE}.")


def _model_arrays(
    top: Any, storages: Mapping[str, memoryview], file_bytes: int
) -> dict[str, np.ndarray]:
    """Picks the model's tensors and copies them out, in all within the file's size."""
    if not isinstance(top, dict):
        raise InputError(
            f"holds a {type(top).__name__}, not a mapping of names to tensors. Instead, {RESAVE}."
        )
    for candidate in [*map(top.get, ("state_dict", "model_state_dict", "model")), top]:
        entries = candidate.items() if isinstance(candidate, dict) else ()
        tensors = {name: value for name, value in entries if isinstance(value, Tensor)}
        if tensors:
            break
    else:
        keys = ", ".join(repr(key[:40]) for key in list(top)[:10])
        raise InputError(
            "holds no tensors at its top level or under 'state_dict', 'model_state_dict' or "
            f"'model'; its keys are: {keys or 'none'}. Instead, {RESAVE}."
        )
    arrays: dict[str, np.ndarray] = {}
    shared: dict[Any, np.ndarray] = {}
    bytes_left = file_bytes + _SLACK_BYTES
    for name, tensor in tensors.items():
        try:
            storage = _checked_storage(tensor, storages)
        except ValueError as error:
            raise InputError(f"tensor {name[:80]!r} {error}. Download the file again.") from error
        first = storage.view_start + tensor.offset
        identity = (storage.key, storage.dtype, first, tensor.size, tensor.stride)
        if identity not in shared:
            bytes_left -= math.prod(tensor.size) * storage.dtype.itemsize
            if bytes_left < 0:
                raise InputError(
                    f"tensor {name[:80]!r} of shape {tensor.size} needs more memory than the file "
                    "has: it is expanded or overlaps others. Make the model's tensors contiguous "
                    f"(tensor.contiguous()), then {RESAVE}."
                )
            raw = storages[storage.key]
            shared[identity] = _strided_copy(raw, storage.dtype, first, tensor.size, tensor.stride)
        arrays[name] = shared[identity]
    return arrays


def _checked_storage(tensor: Tensor, storages: Mapping[str, memoryview]) -> Storage:
    """The tensor's storage; ValueError (what is wrong) if the tensor isn't wholly inside."""
    storage, size, stride = tensor.storage, tensor.size, tensor.stride
    if not isinstance(storage, Storage) or storage.key not in storages:
        raise ValueError("has no data in the file")
    stored = storages[storage.key].nbytes
    if stored != storage.count * storage.dtype.itemsize:
        raise ValueError(f"needs {storage.count} x {storage.dtype}, but {stored} bytes are there")
    if not (isinstance(size, tuple) and isinstance(stride, tuple) and len(size) == len(stride)):
        raise ValueError("has no shape")
    if len(size) > _MAX_NDIM or not are_counts((tensor.offset, *size, *stride)):
        raise ValueError("has a shape, strides or an offset out of range")
    last = tensor.offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if 0 not in size and last >= storage.view_count:
        raise ValueError(
            f"(shape {size}, strides {stride}, offset {tensor.offset}) reaches outside its "
            f"{storage.view_count} elements"
        )
    return storage


def _strided_copy(
    raw: memoryview, dtype: np.dtype, first: int, shape: tuple[int, ...], steps: Any
) -> np.ndarray:
    """C-contiguous copy of elements ``first + index * steps``; numpy checks the bounds again."""
    if 0 in shape:
        return np.zeros(shape, dtype)
    # A dimension of one may have any stride: it is never taken.
    strides = [step * dtype.itemsize if n > 1 else 0 for n, step in zip(shape, steps, strict=True)]
    # A bool's byte other than 0 and 1 is true, as in C; numpy must not see it as a bool.
    stored = np.dtype(np.uint8) if dtype.kind == "b" else dtype
    view = np.ndarray(shape, stored, buffer=raw, offset=first * dtype.itemsize, strides=strides)
    return np.array(view != 0 if dtype.kind == "b" else view, order="C")


def rpmnet_variables(state_dict: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Flax variables of the published RPM-Net's PyTorch weights.

    Args:
      state_dict: name to array, as `load_state_dict` reads it.

    Raises:
      InputError: a name is missing or unknown, a shape is not RPM-Net's, a value not finite.
    """
    weights = _StateDict(state_dict, "RPM-Net")

    def mlp(prefix: str, label: str, widths: tuple[int, ...], *, normed_last: bool) -> dict:
        layers: dict[str, Any] = {}
        for index, (channels, features) in enumerate(itertools.pairwise(widths)):
            # torch.nn.Sequential numbers the convolution, its norm and its ReLU: steps of three.
            dense, norm = (f"{prefix}.{label}.{3 * index + offset}" for offset in (0, 1))
            layer = {
                "kernel": weights.take(f"{dense}.weight", features, channels).T,
                "bias": weights.take(f"{dense}.bias", features),
            }
            if normed_last or index < len(widths) - 2:
                scale = weights.take(f"{norm}.weight", features)
                bias = weights.take(f"{norm}.bias", features)
                layer = {"dense": layer, "norm": {"scale": scale, "bias": bias}}
            layers[f"{label}_{index}"] = layer
        return layers

    def net(prefix: str, prepool: tuple[int, ...], postpool: tuple[int, ...]) -> dict[str, Any]:
        return mlp(prefix, "prepool", prepool, normed_last=True) | mlp(
            prefix, "postpool", postpool, normed_last=False
        )

    params = {
        "feature_net": net("feat_extractor", (10, 96, 96, 192), (192, 192, 96, 96)),
        "annealing_net": net("weights_net", (4, 64, 64, 64, 128, 1024), (1024, 512, 256, 2)),
    }
    weights.check_empty()
    return jax.tree.map(np.float32, {"params": params})


def pointnetlk_variables(state_dict: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Flax variables of a published PointNetLK's PyTorch weights.

    Its batch normalisation, in evaluation, is affine and goes into the kernels.

    Args:
      state_dict: name to array, as `load_state_dict` reads it.

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
        kernel = weights.take(f"{convolution}.weight", features, channels).T
        bias = weights.take(f"{convolution}.bias", features)
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

    def check_empty(self) -> None:
        """Refuses arrays that the network does not have."""
        if self.arrays:
            names = ", ".join(sorted(self.arrays)[:5])
            raise InputError(f"the state dict has entries {self.network} lacks: {names}")
