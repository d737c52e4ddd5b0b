"""A PyTorch checkpoint's pickle as inert data: followed opcode by opcode, never executed.

To unpickle is to run whatever code the file's author chose. Here ``pickletools`` decodes the
opcodes, and every class or function that the file names stays a name. The few names that a state
dict needs have a meaning; any other ends the reading.
"""

from __future__ import annotations

import dataclasses
import pickletools
from typing import Any, BinaryIO

import ml_dtypes
import numpy as np

from vanejax.errors import InputError

RESAVE = 'save only the weights in PyTorch: torch.save(model.state_dict(), "weights.pth")'

_STORAGES = {
    "torch DoubleStorage": np.dtype("<f8"),
    "torch FloatStorage": np.dtype("<f4"),
    "torch HalfStorage": np.dtype("<f2"),
    "torch BFloat16Storage": np.dtype(ml_dtypes.bfloat16),
    "torch LongStorage": np.dtype("<i8"),
    "torch IntStorage": np.dtype("<i4"),
    "torch ShortStorage": np.dtype("<i2"),
    "torch CharStorage": np.dtype("i1"),
    "torch ByteStorage": np.dtype("u1"),
    "torch BoolStorage": np.dtype("?"),
}
_DICTS = {"collections OrderedDict", "collections defaultdict", "builtins dict", "__builtin__ dict"}
_TENSORS = {"torch._utils _rebuild_tensor", "torch._utils _rebuild_tensor_v2"}
_PARAMETERS = {
    "torch._utils _rebuild_parameter",
    "torch._utils _rebuild_parameter_with_state",
}
# What stands beside the weights in published checkpoints (scores, settings, optimiser states):
# a call of one of these gives a placeholder, whatever its arguments.
_PASSED_OVER = {
    *("torch Size", "torch device", "torch strided"),
    *("torch float64", "torch float32", "torch float16", "torch bfloat16", "torch bool"),
    *("torch int64", "torch int32", "torch int16", "torch int8", "torch uint8"),
    *("numpy.core.multiarray scalar", "numpy.core.multiarray _reconstruct"),
    *("numpy._core.multiarray scalar", "numpy._core.multiarray _reconstruct"),
    *("numpy dtype", "numpy ndarray", "_codecs encode", "argparse Namespace"),
    *("collections Counter", "builtins set", "builtins list", "builtins int", "builtins float"),
    *("__builtin__ set", "__builtin__ list", "__builtin__ int", "__builtin__ float"),
}
_ALLOWED = _DICTS | _TENSORS | _PARAMETERS | _PASSED_OVER | _STORAGES.keys()

_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_LITERALS = {
    *("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINSTRING", "SHORT_BINSTRING"),
    *("BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
}
_SHORT_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}

_MAX_STEPS = 2_000_000  # a tensor takes about 40 opcodes: 50,000 tensors, in seconds
_MAX_BITS = 80  # the largest number that torch itself writes is its 77-bit magic number


@dataclasses.dataclass(frozen=True, eq=False, slots=True)
class Storage:
    """Where elements lie: ``view_count`` of them from ``view_start``, out of ``count`` in all."""

    key: str
    dtype: np.dtype
    count: int
    view_start: int
    view_count: int


@dataclasses.dataclass(frozen=True, eq=False, slots=True)
class Tensor:
    """What a file claims about a tensor, all of it unchecked; offset and stride in elements."""

    storage: Any
    offset: Any
    size: Any
    stride: Any


class PassedOver:
    """An object that is no tensor and that no state dict needs."""


@dataclasses.dataclass(frozen=True, eq=False, slots=True)
class _Named:
    """A class or function that the file names: the name ("module attribute"), not the thing."""

    name: str


def are_counts(values: tuple[Any, ...]) -> bool:
    """Whether all values are whole numbers from 0 to 2^62 (bool is not one)."""
    return all(type(value) is int and 0 <= value < 1 << 62 for value in values)


def interpret(stream: BinaryIO, dtypes: dict[str, np.dtype] | None = None) -> Any:
    """Follows one pickle's opcodes to its end, where the stream is left.

    Args:
      stream: at the pickle's first byte.
      dtypes: gains the element type of every storage that the pickle names, by its key.

    Returns:
      None, bool, int, float, str, bytes, tuples and lists and dicts of these, ``Tensor``,
      ``Storage`` or ``PassedOver``. Containers may hold themselves. Dicts keep their string keys
      alone: a tuple of tuples of one another takes forever to hash.

    Raises:
      InputError: the pickle names or does what no state dict needs, or is too long.
      Exception: of many kinds (index, type, value, ...) on bytes that are no sound pickle.
    """
    stack: list[Any] = []
    below: list[list[Any]] = []
    memo: dict[int, Any] = {}
    argument: Any
    for step, (opcode, argument, _) in enumerate(pickletools.genops(stream)):
        if step >= _MAX_STEPS:
            raise InputError(f"takes more than {_MAX_STEPS} pickle steps. Instead, {RESAVE}.")
        name = opcode.name
        if name in _LITERALS:
            if type(argument) is int and argument.bit_length() > _MAX_BITS:
                raise ValueError(f"a number of more than {_MAX_BITS} bits")
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name in ("BINPUT", "LONG_BINPUT", "MEMOIZE"):
            memo[len(memo) if name == "MEMOIZE" else argument] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(memo[argument])
        elif name in _SHORT_TUPLES:
            items = [stack.pop() for _ in range(_SHORT_TUPLES[name])]
            stack.append(tuple(reversed(items)))
        elif name in ("EMPTY_LIST", "EMPTY_DICT"):
            stack.append([] if name == "EMPTY_LIST" else {})
        elif name == "EMPTY_SET":
            stack.append(PassedOver())
        elif name == "MARK":
            below.append(stack)
            stack = []
        elif name in ("TUPLE", "APPENDS", "ADDITEMS", "SETITEMS"):
            items, stack = stack, below.pop()
            if name == "TUPLE":
                stack.append(tuple(items))
            else:
                _fill(stack[-1], items, is_mapping=name == "SETITEMS")
        elif name in ("APPEND", "SETITEM"):
            items = [stack.pop() for _ in range(1 if name == "APPEND" else 2)]
            _fill(stack[-1], items[::-1], is_mapping=name == "SETITEM")
        elif name in ("GLOBAL", "STACK_GLOBAL"):
            if name == "STACK_GLOBAL":
                attribute, module = stack.pop(), stack.pop()
                argument = module + " " + attribute
            if argument not in _ALLOWED:
                raise InputError(
                    f"names {argument.replace(' ', '.')[:120]!r}, which is no part of a state "
                    f"dict; nothing was run. If you trust the file, torch.load it and {RESAVE}."
                )
            stack.append(_Named(argument))
        elif name in ("REDUCE", "NEWOBJ"):
            arguments, function = stack.pop(), stack.pop()
            stack.append(_call(function, arguments))
        elif name == "BUILD":  # attributes (such as a state dict's _metadata): not needed
            stack.pop()
            if not isinstance(stack[-1], dict | Tensor | PassedOver):
                raise ValueError("attributes set on what has none")
        elif name == "BINPERSID":
            storage = _storage(stack.pop())
            if dtypes is not None:
                dtypes.setdefault(storage.key, storage.dtype)
            stack.append(storage)
        elif name == "STOP":
            return stack.pop()
        elif name not in ("PROTO", "FRAME"):
            raise InputError(f"uses pickle's {name}, as no state dict does. Instead, {RESAVE}.")
    raise ValueError("pickle without an end")


def _fill(target: Any, items: list[Any], *, is_mapping: bool) -> None:
    """Appends items to a list, or sets them (key, value, key, value, ...) in a mapping."""
    if isinstance(target, PassedOver):
        return
    if is_mapping and isinstance(target, dict):
        pairs = zip(items[::2], items[1::2], strict=True)
        target.update((key, value) for key, value in pairs if isinstance(key, str))
    elif not is_mapping and isinstance(target, list):
        target.extend(items)
    else:
        raise ValueError("items put into what cannot hold them")


def _call(function: Any, arguments: Any) -> Any:
    """What the file's call of a listed name stands for."""
    if not isinstance(function, _Named) or not isinstance(arguments, tuple):
        raise ValueError("a call of what cannot be called")
    if function.name in _DICTS:
        mapping: dict[str, Any] = {}
        if arguments and isinstance(arguments[0], list):  # Python 2's OrderedDict: [[key, value]]
            for key, value in arguments[0]:
                _fill(mapping, [key, value], is_mapping=True)
            # Emptied, so that a hostile file cannot have one long list walked a million times.
            arguments[0].clear()
        return mapping
    if function.name in _TENSORS:
        if len(arguments) > 6 and arguments[6]:
            raise InputError(f"holds a lazy conjugate or negative. Resolve it, then {RESAVE}.")
        return Tensor(*arguments[:4])
    if function.name in _PARAMETERS:
        return arguments[0]
    if function.name in _PASSED_OVER:
        return PassedOver()
    raise ValueError("a storage is called")


def _storage(saved: Any) -> Storage:
    """From torch's ("storage", type, key, device, count[, None or (key, start, count)])."""
    kind, storage_type, key, _, count, *view = saved
    if not (isinstance(kind, str) and kind == "storage" and isinstance(key, str)):
        raise ValueError("unknown kind of storage")
    start, view_count = view[0][1:] if view and view[0] is not None else (0, count)
    if not are_counts((count, start, view_count)) or start + view_count > count:
        raise ValueError("storage sizes out of range")
    return Storage(key, _STORAGES[storage_type.name], count, start, view_count)
