"""ModelNet40 in both layouts, on tiny copies made by hand: what is read, and what is refused."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from vanejax.errors import InputError
from vanejax.training.modelnet40 import ModelNet40, read_modelnet40, read_off

CUBE = """OFF
# a cube of side 2 about (5, 0, 0), of quadrilaterals
8 6 12
4 -1 -1
6 -1 -1
6 1 -1
4 1 -1
4 -1 1
6 -1 1
6 1 1
4 1 1
4 3 2 1 0
4 4 5 6 7
4 0 1 5 4
4 1 2 6 5
4 2 3 7 6
4 3 0 4 7
"""
TETRAHEDRON = "OFF4 4 6\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"


def read(folder: Path, **settings) -> ModelNet40:
    defaults = {"seed": 0, "num_points": 64}
    return read_modelnet40(folder, **(defaults | settings))


@pytest.fixture
def off_tree(tmp_path: Path) -> Path:
    shapes = {"airplane": TETRAHEDRON, "lamp": CUBE, "laptop": TETRAHEDRON, "xbox": CUBE}
    for category, text in shapes.items():
        for split, numbers in (("train", (1, 2)), ("test", (3,))):
            folder = tmp_path / "ModelNet40" / category / split
            folder.mkdir(parents=True)
            for number in numbers:
                (folder / f"{category}_{number:04d}.off").write_text(text)
    (tmp_path / "ModelNet40" / "lamp" / "train" / "._lamp_0001.off").write_bytes(b"\x00\x05\x16")
    return tmp_path


def test_off_meshes_become_samples_in_the_unit_sphere(off_tree: Path):
    found = read(off_tree / "ModelNet40")
    assert found.title == (
        "ModelNet40 (OFF), train split, first 20 categories: 4 shapes of 8, "
        "where 9843 are published"
    )
    assert found.names == ["airplane_0001", "airplane_0002", "lamp_0001", "lamp_0002"]
    assert found.samples.shape == (4, 64, 6)
    assert found.samples.dtype == np.float32
    points, normals = found.samples[2, :, :3], found.samples[2, :, 3:]
    # the cube's corners are at 1: its sides at 1 / sqrt(3), and its normals along the axes
    np.testing.assert_allclose(np.abs(points).max(axis=1), 1 / np.sqrt(3), atol=1e-6)
    side = np.sign(points) * (np.abs(points) > 1 / np.sqrt(3) - 1e-6)
    np.testing.assert_allclose(normals, side, atol=1e-6)
    assert len(np.unique(side, axis=0)) == 6
    # the folder that holds it does too
    np.testing.assert_array_equal(read(off_tree).samples, found.samples)


def test_a_shape_is_sampled_alike_whatever_others_are_there(off_tree: Path):
    every = read(off_tree)
    assert np.abs(read(off_tree, seed=1).samples - every.samples).max() > 0.1
    # the same mesh under another name is sampled anew
    assert np.abs(every.samples[0] - every.samples[1]).max() > 0.1
    shutil.rmtree(off_tree / "ModelNet40" / "airplane")
    np.testing.assert_array_equal(read(off_tree).samples, every.samples[2:])


STRAY = TETRAHEDRON.replace("OFF4 4 6\n", "OFF 5 4 6\n").replace("3 0 2 1", "900 0 0\n3 0 2 1")


@pytest.mark.parametrize(
    ("text", "faces", "volume", "center"),
    [
        (TETRAHEDRON, 4, 1 / 6, 0.5),  # its header runs into the counts
        (TETRAHEDRON.replace("OFF4", "OFF\n4"), 4, 1 / 6, 0.5),
        (CUBE, 12, 8, (5, 0, 0)),  # polygons become triangles
        (STRAY, 4, 1 / 6, 0.5),  # a vertex that no face uses does not scale the shape
    ],
)
def test_a_mesh_is_read_as_it_is(tmp_path: Path, text: str, faces: int, volume: float, center):
    (tmp_path / "shape.off").write_text(text)
    part = read_off(tmp_path / "shape.off")
    assert len(part.mesh.faces) == faces
    np.testing.assert_allclose(part.triangles.volume(), volume)
    np.testing.assert_allclose(part.center, center)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("solid x", "does not start with OFF"),
        ("OFF", "no counts"),
        ("OFF\n4 x 6", "something else than numbers"),
        ("OFF\n4 4 nan", "not finite"),
        ("OFF\n-4 4 6", "cut short"),
        ("OFF\n9999999999 4 6\n0 0 0", "cut short"),
        (TETRAHEDRON[:-8], "4 faces are announced, 3 can be read"),
        (TETRAHEDRON + "3 0 1 2\n", "4 faces are announced, 4 can be read, 4 numbers are left"),
        (TETRAHEDRON.replace("3 1 2 3", "3 1 2 4"), "points at no vertex"),
        (TETRAHEDRON.replace("3 1 2 3", "3 1 2 -1"), "points at no vertex"),
        (TETRAHEDRON.replace("1 0 0", "inf 0 0"), "not finite"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n", "no area"),
        ("OFF\n3 0 0\n0 0 0\n1 0 0\n2 0 0\n", "no faces"),
    ],
)
def test_broken_off_files_are_refused(tmp_path: Path, text: str, message: str):
    path = tmp_path / "broken.off"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_off(path)


@pytest.mark.parametrize(
    ("folder", "message"),
    [
        ("nowhere", r"no such folder\. Obtain modelnet40_ply.*nothing is downloaded"),
        ("", "holds no ModelNet40"),
    ],
)
def test_what_is_not_there(tmp_path: Path, folder: str, message: str):
    with pytest.raises(InputError, match=message):
        read(tmp_path / folder)


def test_hdf5_without_h5py_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "shape_names.txt").write_text("lamp\n")
    (tmp_path / "ply_data_train0.h5").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=r"pip install 'vanejax\[modelnet\]'"):
        read(tmp_path)


LABELS = {"train0": [3, 0, 1], "train1": [2, 1], "test0": [0]}


@pytest.fixture
def hdf5_folder(tmp_path: Path) -> Path:
    """Two training files, listed out of order and by the paths of another machine."""
    h5py = pytest.importorskip("h5py", reason="the extra vanejax[modelnet] is not installed")
    folder = tmp_path / "modelnet40_ply_hdf5_2048"
    folder.mkdir()
    (folder / "shape_names.txt").write_text("airplane\nlamp\nlaptop\nxbox\n")
    listed = "data/modelnet40_ply_hdf5_2048/ply_data_{}.h5\n"
    (folder / "train_files.txt").write_text(listed.format("train1") + listed.format("train0"))
    rng = np.random.default_rng(0)
    for name, labels in LABELS.items():
        with h5py.File(folder / f"ply_data_{name}.h5", "w") as file:
            for what in ("data", "normal"):
                values = rng.normal(size=(len(labels), 100, 3)).astype(np.float32)
                values /= np.linalg.norm(values, axis=2, keepdims=True)
                file.create_dataset(what, data=values, compression="gzip")
            file["label"] = np.array(labels, np.uint8)[:, None]
    return folder


def test_hdf5_shapes_are_read_as_stored_in_the_listed_order(hdf5_folder: Path):
    import h5py

    found = read(hdf5_folder, num_points=4096)
    assert "(HDF5), train split, first 20 categories: 3 shapes of 5, where 9840" in found.title
    expected = ["lamp train 1", "airplane train 3", "lamp train 4"]
    assert found.names == expected
    with h5py.File(hdf5_folder / "ply_data_train0.h5") as file:
        np.testing.assert_array_equal(found.samples[1:, :, :3], file["data"][1:])
        np.testing.assert_array_equal(found.samples[1:, :, 3:], file["normal"][1:])
    # from the folder that holds it, and without the list, in the order of names
    assert read(hdf5_folder.parent).names == expected
    (hdf5_folder / "train_files.txt").unlink()
    assert read(hdf5_folder).names[0] == "airplane train 1"
    assert read(hdf5_folder).samples.shape == (3, 64, 6)  # some of each shape's points


def test_broken_hdf5_folders_are_refused(hdf5_folder: Path):
    (hdf5_folder / "ply_data_train1.h5").rename(hdf5_folder / "away.h5")
    with pytest.raises(InputError, match=r"lacks ply_data_train1\.h5"):
        read(hdf5_folder)
    (hdf5_folder / "ply_data_train1.h5").write_bytes(b"no HDF5")
    with pytest.raises(InputError, match=r"ply_data_train1\.h5: cannot be read as HDF5"):
        read(hdf5_folder)
    (hdf5_folder / "shape_names.txt").unlink()
    with pytest.raises(InputError, match=r"shape_names\.txt: missing"):
        read(hdf5_folder)


@pytest.mark.parametrize(
    ("datasets", "message"),
    [
        ({"normal": None}, "no dataset 'normal'"),
        ({"data": np.zeros((3, 100, 2), np.float32)}, r"\(3, 100, 2\), not \[S, P, 3\]"),
        ({"normal": np.zeros((3, 99, 3), np.float32)}, "do not belong"),
        ({"label": np.zeros(2, np.uint8)}, "do not belong"),
        ({"label": np.full(3, 4, np.uint8)}, r"outside 0\.\.3"),
        ({"label": np.zeros(3, np.float32)}, r"outside 0\.\.3"),
        ({"data": np.zeros((3, 100, 3), np.int32)}, "floating-point"),
        (
            {k: np.zeros((3, 9, 3), np.float32) for k in ("data", "normal")},
            "different numbers of points",
        ),
        ({"data": (2**40, 100, 3)}, "announces"),  # a promise of more than memory holds
    ],
)
def test_broken_hdf5_datasets_are_refused(hdf5_folder: Path, datasets, message: str):
    """Datasets of the first training file are replaced, removed, or only announced by a shape."""
    import h5py

    with h5py.File(hdf5_folder / "ply_data_train0.h5", "a") as file:
        for name, values in datasets.items():
            del file[name]
            if isinstance(values, tuple):
                file.create_dataset(name, values, "f4", compression="gzip")
            elif values is not None:
                file[name] = values
    with pytest.raises(InputError, match=message):
        read(hdf5_folder)
