"""One entry point to generic shapes: what they are called, and what is refused."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from vanejax.errors import InputError
from vanejax.training.generic_solids import make_solids
from vanejax.training.shape_sets import load_shapes


def some_shapes(dtype: type = np.float16) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(2, 50, 2, 3))
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    samples = vectors.reshape(2, 50, 6).astype(dtype)
    return {"points_normals": samples, "names": np.array(["a cup", "a door"])}


def saved(folder: Path, save=np.savez_compressed, **arrays: np.ndarray) -> str:
    path = folder / "shapes.npz"
    save(path, **arrays)
    return str(path)


def test_solids_are_called_solids():
    shapes = load_shapes("solids:3", seed=5, num_points=100)
    assert shapes.title == "3 procedural solids of seed 5 (random, not ModelNet40)"
    samples, names = make_solids(3, 5, num_points=100)
    np.testing.assert_array_equal(shapes.points, samples[..., :3])
    np.testing.assert_allclose(shapes.normals, samples[..., 3:], atol=1e-6)
    assert shapes.names == tuple(names)
    again, other = (load_shapes("solids:3", seed=seed, num_points=100) for seed in (5, 6))
    assert again.sha256 == shapes.sha256
    assert other.sha256 != shapes.sha256


@pytest.mark.parametrize(
    ("where", "settings", "message"),
    [(f"solids:{count}", {}, "solids:COUNT") for count in (0, -3, "many", 2.5)]
    + [
        ("solids", {"num_points": 0}, "num_points=0"),
        ("solids", {"seed": -1}, "seed=-1"),
        ("none.npz", {}, "no such file"),
    ],
)
def test_what_stands_for_no_shapes(where: str, settings: dict, message: str):
    with pytest.raises(InputError, match=message):
        load_shapes(where, **({"seed": 0} | settings))


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_a_file_is_read_and_its_normals_mended(tmp_path: Path, save, dtype):
    arrays = some_shapes(dtype)
    arrays["points_normals"][..., 3:] *= 0.5
    shapes = load_shapes(saved(tmp_path, save, **arrays), seed=0)
    assert shapes.title == "2 shapes of the file shapes.npz"
    assert shapes.names == ("a cup", "a door")
    assert shapes.points.dtype == shapes.normals.dtype == np.float32
    np.testing.assert_array_equal(shapes.points, arrays["points_normals"][..., :3])
    np.testing.assert_allclose(np.linalg.norm(shapes.normals, axis=2), 1, atol=1e-6)
    along = np.sum(shapes.normals * arrays["points_normals"][..., 3:], axis=2)
    np.testing.assert_allclose(along, 0.5, atol=1e-3)  # float16
    digest = hashlib.sha256(shapes.points.tobytes() + shapes.normals.tobytes())
    digest.update(b"a cup\na door")
    assert shapes.sha256 == digest.hexdigest()


def test_fewer_points_are_a_seeded_choice_of_rows(tmp_path: Path):
    where = saved(tmp_path, **some_shapes())
    every = load_shapes(where, seed=0)
    some, other = (load_shapes(where, seed=seed, num_points=30) for seed in (0, 1))
    for shape in range(2):
        rows = [np.flatnonzero((every.points[shape] == p).all(axis=1)) for p in some.points[shape]]
        rows = np.concatenate(rows)
        assert len(set(rows.tolist())) == 30
        np.testing.assert_array_equal(some.normals[shape], every.normals[shape, rows])
    assert np.abs(some.points - other.points).max() > 0.1


def test_a_point_without_normal_becomes_a_copy_of_another(tmp_path: Path):
    arrays = some_shapes(np.float32)
    arrays["points_normals"][1, 7, 3:] = 0
    shapes = load_shapes(saved(tmp_path, **arrays), seed=0)
    np.testing.assert_array_equal(shapes.points[1, 7], shapes.points[1, 0])
    np.testing.assert_array_equal(shapes.normals[1, 7], shapes.normals[1, 0])
    np.testing.assert_array_equal(shapes.points[1, 8], arrays["points_normals"][1, 8, :3])
    arrays["points_normals"][1, :, 3:] = 0
    with pytest.raises(InputError, match="'a door' has no normals"):
        load_shapes(saved(tmp_path, **arrays), seed=0)


def test_broken_files_are_refused(tmp_path: Path):
    good = some_shapes()
    samples, names = good["points_normals"], good["names"]
    nan, far = samples.copy(), samples.copy()
    nan[1, 3, 4], far[1, 3, 0] = np.nan, 2.0
    cases = {
        "should hold": {"points_normals": samples},
        r"\(2, 50, 3\), not \[S, P, 6\]": good | {"points_normals": samples[..., :3]},
        r"\(0, 50, 6\), not": {"points_normals": samples[:0], "names": names[:0]},
        "is float64": good | {"points_normals": samples.astype(np.float64)},
        "2 strings": good | {"names": names[:1]},
        "2 strings ": good | {"names": np.array([1, 2])},
        "does not hold": good | {"names": np.array(["a", None], object)},
        "'a door' has numbers that are not finite": good | {"points_normals": nan},
        r"'a door' reaches 2\.": good | {"points_normals": far},
    }
    for message, arrays in cases.items():
        with pytest.raises(InputError, match=message.strip()):
            load_shapes(saved(tmp_path, **arrays), seed=0)
    path = Path(saved(tmp_path, **good))
    whole = path.read_bytes()
    damaged = bytearray(whole)
    damaged[len(whole) // 3] ^= 0xFF
    stream = 30 + len("points_normals.npy") + 20  # past the local header and its sizes
    not_deflate = whole[:stream] + b"\xff" * 4 + whole[stream + 4 :]
    for data in (b"", b"PK", whole[: len(whole) // 2], bytes(damaged), not_deflate):
        path.write_bytes(data)
        with pytest.raises(InputError, match="cannot be read"):
            load_shapes(str(path), seed=0)


def test_a_folder_of_modelnet40_says_how_much_of_it_is_there(tmp_path: Path):
    folder = tmp_path / "lamp" / "train"
    folder.mkdir(parents=True)
    mesh = "OFF 4 4 6\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
    (folder / "lamp_0001.off").write_text(mesh)
    shapes = load_shapes(str(tmp_path), seed=0, num_points=32)
    assert "first 20 categories: 1 shapes of 1, where 9843 are published" in shapes.title
    assert shapes.points.shape == (1, 32, 3)
    assert shapes.names == ("lamp_0001",)
    (tmp_path / "lamp").rename(tmp_path / "laptop")  # the first of the other half
    with pytest.raises(InputError, match="no train shapes of the first 20"):
        load_shapes(str(tmp_path), seed=0)
