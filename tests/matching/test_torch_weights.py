"""Published PyTorch weights: read from PyTorch's files where torch is there, converted once."""

from __future__ import annotations

import argparse
import builtins
import collections
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from published_rpmnet import state_dict

from vanejax.cli.program import main
from vanejax.errors import InputError, MissingExtra
from vanejax.files import read_arrays, write_arrays
from vanejax.matching.torch_weights import load_state_dict, rpmnet_variables

ARRAYS = {"a.weight": np.arange(6.0, dtype=np.float32).reshape(2, 3), "n": np.array(4)}


def assert_equal(found: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> None:
    assert list(found) == list(wanted) or set(found) == set(wanted)
    for name, value in wanted.items():
        np.testing.assert_array_equal(found[name], value, strict=True)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_of_the_same_names_need_no_torch(tmp_path: Path, save: Any) -> None:
    save(tmp_path / "a.npz", **{f"module.{name}": value for name, value in ARRAYS.items()})
    assert_equal(load_state_dict(tmp_path / "a.npz"), ARRAYS)
    write_arrays(tmp_path / "a.safetensors", ARRAYS, {})
    (tmp_path / "a.safetensors").rename(tmp_path / "a.pth")  # the contents decide
    assert_equal(load_state_dict(tmp_path / "a.pth"), ARRAYS)


def test_files_that_hold_no_weights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_state_dict(tmp_path)
    for content in (b"PK\3\4 and nothing", (20).to_bytes(8, "little") + b"{"):
        (tmp_path / "a").write_bytes(content)
        with pytest.raises(InputError, match="a: cannot be read"):
            load_state_dict(tmp_path / "a")
    np.savez(tmp_path / "a.npz")
    with pytest.raises(InputError, match="holds no tensors"):
        load_state_dict(tmp_path / "a.npz")


def test_without_torch_the_extra_is_named(tmp_path: Path, monkeypatch) -> None:
    find = builtins.__import__

    def without_torch(name: str, *arguments: Any) -> Any:
        if name == "torch":
            raise ModuleNotFoundError(name)
        return find(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", without_torch)
    (tmp_path / "a.pth").write_bytes(b"\x80\x02")
    with pytest.raises(MissingExtra, match=r"pip install 'vanejax\[torch\]'"):
        load_state_dict(tmp_path / "a.pth")


def test_the_command_converts_a_state_dict_once(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    state = state_dict()
    other_toolbox = {k.replace("feat_extractor", "feature_model"): v for k, v in state.items()}
    np.savez("trained.npz", **other_toolbox)
    assert main(["export", "trained.npz"]) == 0
    assert capsys.readouterr().out.startswith("trained.safetensors: RPM-Net, 52 arrays of 905,154")
    arrays, header = read_arrays("trained.safetensors")
    assert_equal(arrays, other_toolbox)
    assert header["network"] == "RPM-Net"
    assert main(["export", "trained.safetensors"]) == 2
    assert "would be overwritten" in capsys.readouterr().err
    jax.tree.map(np.testing.assert_array_equal, rpmnet_variables(arrays), rpmnet_variables(state))
    np.savez("other.npz", **ARRAYS)
    assert main(["export", "other.npz"]) == 2
    assert "other.npz: the state dict has no 'feat_extractor" in capsys.readouterr().err
    assert not Path("other.safetensors").exists()


@pytest.mark.parametrize("is_zip", [True, False])
@pytest.mark.parametrize("key", [None, "state_dict", "model_state_dict", "model"])
def test_checkpoints_of_torch_are_read(tmp_path: Path, key: str | None, is_zip: bool) -> None:
    torch = pytest.importorskip("torch")
    state = collections.OrderedDict(
        {f"module.{name}": torch.tensor(value) for name, value in ARRAYS.items()},
        **{"module.half": torch.ones(2, 3, dtype=torch.bfloat16).T, "module.note": "text"},
    )
    extras = {"score": np.float64(2), "step": 3, "options": argparse.Namespace(k=32)}
    path = tmp_path / "a.t7"
    saved = {key: state, **extras} if key else state
    torch.save(saved, path, _use_new_zipfile_serialization=is_zip)
    assert_equal(load_state_dict(path), ARRAYS | {"half": np.ones((3, 2), np.float32)})


class Evil:
    def __reduce__(self) -> tuple:
        return pytest.fail, ("unpickled",)


def test_what_torch_refuses_is_refused(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    path = tmp_path / "a.pth"
    cases = [
        (Evil(), "holds more than weights.*nothing was run"),
        (torch.nn.Linear(3, 2), "Linear was not an allowed global"),
        ([1, 2], "holds no tensors"),
        ({"state_dict": {"a": 1}}, "holds no tensors"),
        ({"a": torch.ones(1).expand(10**9)}, "larger than the file"),
    ]
    for value, words in cases:
        torch.save(value, path)
        with pytest.raises(InputError, match=words):
            load_state_dict(path)
    torch.save({"a": torch.zeros(100)}, path, _use_new_zipfile_serialization=False)
    for content in (path.read_bytes()[:-100], b"<html>a page</html>", b""):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"a\.pth: "):
            load_state_dict(path)
