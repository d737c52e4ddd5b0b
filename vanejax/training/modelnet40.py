"""ModelNet40 as the user has it: the HDF5 files of PointNet, or the tree of OFF meshes.

Nothing is downloaded. Wu et al., 3D ShapeNets (CVPR 2015); RPM-Net (Yew and Lee, CVPR 2020) is
trained on the training split of the first 20 of its 40 categories, and so are networks here.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from vanejax.cad.part import Part
from vanejax.cad.triangles import in_use, renumbered
from vanejax.errors import InputError
from vanejax.training.generic_solids import unit_samples

HDF5_FOLDER, OFF_FOLDER = "modelnet40_ply_hdf5_2048", "ModelNet40"
PUBLISHED = {"HDF5": 9840, "OFF": 9843}  # shapes of the training split, all categories
LAST_OF_FIRST_20 = "lamp"  # the next is the laptop: so the half is the same in a partial copy
MAX_NUMBERS = 2**29  # of one HDF5 dataset, 4 bytes each: a compressed file may promise any size
MAX_BYTES = 2**29  # of an OFF file; the largest published one has 36 MB

_Read = tuple[np.ndarray, list[str], int]  # samples, names, and shapes of the split, all categories


class ModelNet40(NamedTuple):
    """Some shapes of ModelNet40: samples [S, P, 6] f32, names [S], and how they are called.

    Points lie in the unit sphere: from HDF5 as they are stored (about the mean of the points), from
    OFF about the middle of the bounding box. A normal [3:] is its face's, of unit length; the
    meshes' faces may look either way. Names are ``airplane_0001`` from OFF, ``airplane train 0``
    (place in the split) from HDF5.
    """

    samples: np.ndarray
    names: list[str]
    title: str


def read_modelnet40(folder: Path, *, seed: int, num_points: int) -> ModelNet40:
    """Reads the training split of the first 20 categories.

    Args:
      folder: ``modelnet40_ply_hdf5_2048`` or ``ModelNet40`` under any name, or what holds it.
      seed: of the samples on OFF meshes, or of which points are taken of more than `num_points`.
      num_points: P, of each shape; from HDF5 at most the 2048 that the files hold.

    Raises:
      InputError: no ModelNet40 is there, or a file cannot be used; the message says which and why.
    """
    for place in (folder, folder / HDF5_FOLDER, folder / OFF_FOLDER):
        if any(place.glob("ply_data_*.h5")) or (place / "train_files.txt").is_file():
            layout, found = "HDF5", _read_hdf5(place)
        elif any(place.glob("*/*/*.off")):
            layout, found = "OFF", _read_off_tree(place, seed, num_points)
        else:
            continue
        samples, names, size = found
        if not names:
            raise InputError(f"{place}: holds no train shapes of the first 20 categories")
        published = PUBLISHED[layout]
        whole = "as published" if size == published else f"where {published} are published"
        title = (
            f"ModelNet40 ({layout}), train split, first 20 categories: {len(names)} "
            f"shapes of {size}, {whole}"
        )
        return ModelNet40(thinned(samples, num_points, seed), names, title)
    problem = "holds no ModelNet40" if folder.is_dir() else "there is no such folder"
    raise InputError(
        f"{folder}: {problem}. Obtain {HDF5_FOLDER}.zip (point clouds, published with PointNet) or "
        f"{OFF_FOLDER}.zip (OFF meshes, from Princeton's ModelNet page), unpack it anywhere and "
        "give its folder; nothing is downloaded for you"
    )


def _read_hdf5(folder: Path) -> _Read:
    categories_file = folder / "shape_names.txt"
    if not categories_file.is_file():
        raise InputError(f"{categories_file}: missing; it names the categories of the labels")
    category_names = categories_file.read_text(encoding="utf-8", errors="replace").split()
    samples, names, size = [], [], 0
    for path in _hdf5_files(folder):
        data, labels = _read_hdf5_file(path, len(category_names))
        of = [category_names[label] for label in labels]
        kept = np.array([name <= LAST_OF_FIRST_20 for name in of], bool)
        samples.append(data[kept])
        names += [f"{of[i]} train {size + i}" for i in np.flatnonzero(kept)]
        size += len(data)
    if len({part.shape[1] for part in samples}) > 1:
        raise InputError(f"{folder}: the files hold different numbers of points for a shape")
    return np.concatenate(samples), names, size


def _hdf5_files(folder: Path) -> list[Path]:
    """The files in the order that `train_files.txt` gives, whose paths are another machine's."""
    listing = folder / "train_files.txt"
    if listing.is_file():
        lines = listing.read_text(encoding="utf-8", errors="replace").split()
        files = [folder / line.replace("\\", "/").rpartition("/")[2] for line in lines]
    else:
        files = sorted(folder.glob("ply_data_train*.h5"))
    missing = [path.name for path in files if not path.is_file()]
    if missing or not files:
        raise InputError(
            f"{folder}: lacks {', '.join(missing) or 'ply_data_train*.h5'}; unpack the whole of "
            f"{HDF5_FOLDER}.zip"
        )
    return files


def _read_hdf5_file(path: Path, num_categories: int) -> tuple[np.ndarray, np.ndarray]:
    """Samples [S, P, 6] f32 and labels [S] of one file."""
    try:
        import h5py
    except ImportError as error:
        raise InputError(
            f"{path}: HDF5 files need an extra: pip install 'vanejax[modelnet]' (it brings h5py)"
        ) from error
    try:
        with h5py.File(path, "r") as file:
            stored = {}
            for name in ("data", "normal", "label"):
                if name not in file or not isinstance(file[name], h5py.Dataset):
                    raise InputError(f"{path}: holds no dataset {name!r}")
                if file[name].size > MAX_NUMBERS:
                    raise InputError(f"{path}: {name!r} announces {file[name].size:,} numbers")
                stored[name] = np.asarray(file[name])
    except (OSError, KeyError, RuntimeError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as HDF5: {error}") from error
    points, normals, labels = stored["data"], stored["normal"], stored["label"]
    if points.ndim != 3 or points.shape[2] != 3 or points.shape[1] < 1:
        raise InputError(f"{path}: 'data' has shape {points.shape}, not [S, P, 3]")
    if normals.shape != points.shape or labels.size != len(points):
        raise InputError(
            f"{path}: 'normal' {normals.shape} and 'label' {labels.shape} do not belong to "
            f"'data' {points.shape}"
        )
    if labels.dtype.kind not in "iu" or np.any((labels < 0) | (labels >= num_categories)):
        raise InputError(f"{path}: a label is outside 0..{num_categories - 1}")
    if points.dtype.kind != "f" or normals.dtype.kind != "f":
        raise InputError(f"{path}: 'data' and 'normal' should be floating-point numbers")
    return np.concatenate([points, normals], axis=2).astype(np.float32), labels.reshape(-1)


def thinned(samples: np.ndarray, num_points: int, seed: int) -> np.ndarray:
    """``num_points`` random rows of each shape [P, 6], or the samples where they have no more."""
    held = samples.shape[1]
    if held <= num_points:
        return samples
    rng = np.random.default_rng(seed)
    return np.stack([shape[rng.permutation(held)[:num_points]] for shape in samples])


def _read_off_tree(folder: Path, seed: int, num_points: int) -> _Read:
    # beside a mesh, an archive made on a Mac has a file of its own, such as ._lamp_0001.off
    files = sorted(p for p in folder.glob("*/train/*.off") if not p.name.startswith("."))
    kept = [path for path in files if path.parents[1].name <= LAST_OF_FIRST_20]
    samples = np.empty((len(kept), num_points, 6), np.float32)
    for row, path in zip(samples, kept, strict=True):
        # its own seed: a shape is sampled alike whatever others are there
        own = hashlib.sha256(f"{seed} {path.stem}".encode()).digest()[:8]
        row[:] = unit_samples(read_off(path), num_points, int.from_bytes(own))
    return samples, [path.stem for path in kept], len(files)


def read_off(path: Path) -> Part:
    """The mesh of an OFF file as it is: not closed, its faces not turned, in a unit of its own.

    Headers that run into the counts (``OFF123 456 0``, as in some hundred files of ModelNet40) are
    read; polygons are cut into triangles.

    Raises:
      InputError: the file is no OFF file, is cut short, or has no surface.
    """
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"{path}: is larger than {MAX_BYTES / 2**20:.0f} MiB")
    data = path.read_bytes().lstrip()
    if not data.startswith(b"OFF"):
        raise InputError(f"{path}: is no OFF file: it does not start with OFF")
    lines = data[3:].splitlines()
    words = b"\n".join(line.partition(b"#")[0] for line in lines).split()
    try:
        # numbers only: what else could be turned into them, such as nan, is caught below
        numbers = np.array(words, np.float64)
    except ValueError as error:
        raise InputError(f"{path}: holds something else than numbers: {error}") from error
    if len(numbers) < 3 or not np.isfinite(numbers).all():
        raise InputError(f"{path}: holds no counts, or numbers that are not finite")
    vertex_count, face_count = numbers[:2]
    if vertex_count < 0 or len(numbers) < 3 + 3 * vertex_count:
        raise InputError(f"{path}: is cut short: {vertex_count:g} vertices are announced")
    start = 3 + 3 * int(vertex_count)
    vertices = numbers[3:start].reshape(-1, 3)
    faces = _triangles(numbers[start:], face_count, path)
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: has no faces, or one that points at no vertex")
    used = in_use(faces, len(vertices))
    mesh = trimesh.Trimesh(vertices[used], renumbered(faces, used), process=False)
    part = Part(mesh=mesh, name=path.stem, closed=False)
    if not part.triangles.areas().sum() > 0:
        raise InputError(f"{path}: its faces have no area")
    return part


def _triangles(numbers: np.ndarray, face_count: float, path: Path) -> np.ndarray:
    """Faces [F, 3] of a list ``corners, index, index, ...``; a polygon becomes a fan."""
    if len(numbers) == 4 * face_count and np.all(numbers[::4] == 3):
        return numbers.reshape(-1, 4)[:, 1:].astype(np.int64)
    faces, at, done = [], 0, 0
    while at < len(numbers) and done < face_count:
        corners = int(numbers[at])
        polygon = numbers[at + 1 : at + 1 + corners].astype(np.int64)
        if corners < 1 or len(polygon) < corners:
            break
        faces += [(polygon[0], *polygon[i : i + 2]) for i in range(1, corners - 1)]
        at, done = at + 1 + corners, done + 1
    if at != len(numbers) or done != face_count:
        raise InputError(
            f"{path}: {face_count:g} faces are announced, {done} can be read, "
            f"{len(numbers) - at} numbers are left"
        )
    return np.array(faces, np.int64).reshape(-1, 3)
