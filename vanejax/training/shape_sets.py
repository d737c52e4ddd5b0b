"""Sets of generic shapes to train on, from whatever the user has, and what to call them."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import numpy as np

from vanejax.errors import InputError
from vanejax.files import read_arrays
from vanejax.training.generic_solids import make_solids
from vanejax.training.modelnet40 import read_modelnet40, thinned

NUM_SOLIDS = 200
RADIUS = 1.001  # of the unit sphere once its points are rounded to float16


@dataclasses.dataclass(frozen=True, eq=False)
class ShapeSet:
    """Shapes, each sampled in a frame of its own: points and normals [S, P, 3] f32, names [S].

    Points lie in the unit sphere, normals have unit length. ``title`` is what every output calls
    the set; ``sha256`` is of points and normals (little-endian) and names: the same for the same
    training data, wherever they came from.
    """

    points: np.ndarray
    normals: np.ndarray
    names: tuple[str, ...]
    title: str
    sha256: str


def load_shapes(where: str, *, seed: int, num_points: int = 4096) -> ShapeSet:
    """The shapes that ``where`` stands for.

    Args:
      where: ``solids`` or ``solids:COUNT`` (procedural, see `vanejax.training.generic_solids`); a
        folder of ModelNet40, see `vanejax.training.modelnet40`; or a .npz file with
        ``points_normals`` [S, P, 6], float16 or float32, in the unit sphere, and ``names`` [S].
      seed: of the solids, of the samples on meshes, and of which points are kept.
      num_points: of each shape, at least 1; fewer where the file holds fewer.

    Raises:
      InputError: nothing of the kind is there, or it cannot be used; the message says why.
    """
    if num_points < 1:
        raise InputError(f"num_points={num_points}: ask for at least 1")
    if seed < 0:
        raise InputError(f"seed={seed}: must not be negative")
    kind, _, count = where.partition(":")
    if kind == "solids":
        wanted = _count(count, where) if count else NUM_SOLIDS
        samples, names = make_solids(wanted, seed, num_points)
        title = f"{wanted} procedural solids of seed {seed} (random, not ModelNet40)"
        return _shape_set(samples, names, title)
    path = Path(where)
    if path.suffix == ".npz":
        samples, names = _read_npz(path)
        title = f"{len(names)} shapes of the file {path.name}"
        return _shape_set(thinned(samples, num_points, seed), names, title, path)
    return _shape_set(*read_modelnet40(path, seed=seed, num_points=num_points), path)


def _count(text: str, where: str) -> int:
    if not (text.isascii() and text.isdigit()) or int(text) < 1:
        raise InputError(f"{where!r}: write solids:COUNT with a positive number, as in solids:200")
    return int(text)


def _shape_set(
    samples: np.ndarray, names: list[str], title: str, path: Path | None = None
) -> ShapeSet:
    """Checks samples [S, P, 6] and gives their normals unit length."""
    samples = samples.astype(np.float32)
    points, normals = np.ascontiguousarray(samples[..., :3]), samples[..., 3:]
    reach = np.linalg.norm(points, axis=2).max(axis=1)
    # a point on a face without area has no normal: it becomes a copy of one that has
    usable = np.linalg.norm(normals, axis=2) > 0
    problems = {
        "has numbers that are not finite": ~np.isfinite(samples).all(axis=(1, 2)),
        f"reaches {reach.max():.3g} from its origin; shapes should be moved and scaled into the "
        "unit sphere": np.where(reach > RADIUS, reach, 0.0),
        "has no normals, all are of length zero": ~usable.any(axis=1),
    }
    for words, extent in problems.items():
        if extent.any():
            raise InputError(f"{path}: shape {names[int(np.argmax(extent))]!r} {words}")
    row = np.where(usable, np.arange(usable.shape[1]), usable.argmax(axis=1)[:, None])[..., None]
    points, normals = (np.take_along_axis(part, row, axis=1) for part in (points, normals))
    normals = normals / np.linalg.norm(normals, axis=2, keepdims=True)
    digest = hashlib.sha256(points.astype("<f4").tobytes())
    digest.update(normals.astype("<f4").tobytes())
    digest.update("\n".join(names).encode())
    return ShapeSet(points, normals, tuple(names), title, digest.hexdigest())


def _read_npz(path: Path) -> tuple[np.ndarray, list[str]]:
    """Samples [S, P, 6] and names [S], nothing unpickled."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    try:
        arrays, _ = read_arrays(path)
        samples, names = arrays["points_normals"], arrays["names"]
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    except KeyError as error:
        raise InputError(f"{path}: should hold 'points_normals' and 'names'") from error
    if samples.ndim != 3 or samples.shape[2] != 6 or 0 in samples.shape:
        raise InputError(f"{path}: points_normals has shape {samples.shape}, not [S, P, 6]")
    if samples.dtype.kind != "f" or samples.dtype.itemsize not in (2, 4):
        raise InputError(f"{path}: points_normals is {samples.dtype}, not float16 or float32")
    if names.shape != samples.shape[:1] or names.dtype.kind != "U":
        raise InputError(f"{path}: names should be {len(samples)} strings")
    return samples, names.tolist()
