"""A trained matcher in one self-contained file: weights, settings, and the part it knows.

The file is safetensors, or .npz by that suffix: the weights under their paths in the network, the
thinned surface of the part, and a header (JSON): settings, the part's hash, figures of the run.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from vanejax.cad import NearestFace, Part
from vanejax.errors import InputError
from vanejax.files import read_versioned_arrays, write_arrays
from vanejax.matching.rpmnet import RpmNet
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Camera
from vanejax.training.pairs import PairSampling

FORMAT = "vanejax matcher"
VERSION = 1
SAME_SURFACE = 1e-3  # of the radius: how far two files of one part may be apart
PRETRAINED = "pretrained"  # in place of a file's name
_WORDS = (PRETRAINED, "shipped")  # the second is the word of older versions

# what a header may hold: a number's kind, least and largest value, wide, but no network is beyond
_MODEL = {
    "num_neighbors": (int, 1, 1024),
    "radius": (float, 1e-6, 100.0),
    "sinkhorn_iterations": (int, 1, 1000),
    "feature_width": (int, 8, 4096),
}
_HEADER = {
    "model": _MODEL,
    "iterations": (int, 1, 1000),
    "drawing": {  # of pairs: the fields of `PairSampling`
        "num_reference": (int, 16, 1 << 22),
        "num_source": (int, 16, 1 << 22),
        "noise": (float, 0.0, 10.0),
        "noise_clip": (float, 0.0, 10.0),
        "max_rotation_deg": (float, 0.0, 180.0),
        "max_translation": (float, 0.0, 100.0),
    },
    "voxel_mm": (float, 1e-6, 1e6),
    "part": {
        "name": str,
        "sha256": str,
        "center_mm": [(float, -1e9, 1e9)] * 3,
        "radius_mm": (float, 1e-6, 1e9),
    },
    "camera": dict,
    "trained": dict,
}
_REFERENCE = ("reference_points", "reference_normals")


@dataclasses.dataclass(frozen=True, eq=False)
class TrainedMatcher:
    """An RPM-Net trained for one part, and all that inference with it needs.

    The network sees unit-sphere units of the part: ``(x_part - center) / radius_mm``.

    Attributes:
      model: the network.
      variables: its weights, numpy f32; the moving average that training kept.
      iterations: of the network at inference.
      sampling: how pairs were drawn in training: points, noise, and the poses it learned to undo.
      voxel_mm: thinning of scan and part before points are drawn.
      center, radius_mm: of the part: [3] f64, mm, part frame.
      reference_points: [Y, 3] f32, mm, part frame: its surface, thinned.
      reference_normals: [Y, 3] f32, unit, outward.
      part_name, part_sha256: the part it was trained for.
      camera: that the scans of its training were taken with.
      trained: where it comes from, such as step, versions and commit.
    """

    model: RpmNet
    variables: Mapping[str, Any]
    iterations: int
    sampling: PairSampling
    voxel_mm: float
    center: np.ndarray
    radius_mm: float
    reference_points: np.ndarray
    reference_normals: np.ndarray
    part_name: str
    part_sha256: str
    camera: Camera
    trained: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def knows(self, part: Part) -> bool:
        """Whether the network was trained for this part, or for the same surface in another file.

        Another file of the part has another hash. The surface is the same where every reference
        point lies on it and all of it is near one of them.
        """
        if part.sha256 == self.part_sha256:
            return True
        slack = SAME_SURFACE * self.radius_mm
        shift = np.abs(part.center - self.center).max()
        if max(shift, abs(part.radius - self.radius_mm)) > slack:
            return False
        points = self.reference_points.astype(np.float64)
        off = np.linalg.norm(NearestFace(part).closest_points(points).points - points, axis=1)
        gaps, _ = cKDTree(points).query(part.sample(len(points), 0)[0])
        # no point of a surface is farther from the point that its voxel keeps than its diagonal
        return bool(off.max() <= slack and gaps.max() <= 2 * self.voxel_mm)

    def check_part(self, part: Part) -> None:
        """Refuses a part that the network was not trained for.

        Raises:
          InputError: names both parts and their hashes.
        """
        if not self.knows(part):
            raise InputError(
                f"the weights were trained for {self.part_name} (sha256 {self.part_sha256[:12]}), "
                f"this part is {part.name} (sha256 {part.sha256[:12]}): train for it, give that "
                "part, or leave the weights out"
            )


def save_model(path: str | os.PathLike[str], matcher: TrainedMatcher) -> None:
    """Writes the file; it appears complete or not at all.

    Raises:
      InputError: it cannot be written, or the matcher is not one that `load_model` would take.
    """
    header = {
        "format": FORMAT,
        "version": VERSION,
        "units": "mm and degrees; radius, noise and max_translation in radii of the part",
        "model": {name: getattr(matcher.model, name) for name in _MODEL},
        "iterations": matcher.iterations,
        "drawing": dataclasses.asdict(matcher.sampling),
        "voxel_mm": matcher.voxel_mm,
        "part": {
            "name": matcher.part_name,
            "sha256": matcher.part_sha256,
            "center_mm": np.asarray(matcher.center, np.float64).tolist(),
            "radius_mm": float(matcher.radius_mm),
        },
        "camera": matcher.camera.to_dict(),
        "trained": dict(matcher.trained),
    }
    arrays = {name: np.asarray(leaf) for name, leaf in _by_name(matcher.variables).items()}
    arrays |= {name: np.asarray(getattr(matcher, name)) for name in _REFERENCE}
    _matcher(json.loads(json.dumps(header)), arrays, str(path))
    write_arrays(path, arrays, header)


def load_model(path: str | os.PathLike[str]) -> TrainedMatcher:
    """Reads what `save_model` wrote.

    Raises:
      InputError: no such file, truncated, of another kind or version, or arrays that are not those
        of the network that its header describes.
    """
    arrays, header = read_versioned_arrays(
        path, FORMAT, VERSION, words="a weights file", remedy="`vanejax export WORKDIR` makes them"
    )
    return _matcher(header, arrays, str(path))


def find_weights(name: str | os.PathLike[str], part: Part) -> TrainedMatcher:
    """The matcher of a file, or the pretrained one where ``name`` is "pretrained" ("shipped").

    Pretrained weights come with the package: an RPM-Net for the built-in guide vane.

    Raises:
      InputError: the file cannot be read, or there is no network for this part.
    """
    if os.fspath(name) not in _WORDS:
        matcher = load_model(name)
        matcher.check_part(part)
        return matcher
    folder = resources.files("vanejax.training") / "pretrained_weights"
    with resources.as_file(folder / "guide_vane.safetensors") as path:
        pretrained = load_model(path)
    if not pretrained.knows(part):
        raise InputError(
            f"there are no pretrained weights for {part.name}, only for the built-in guide vane "
            "(vane); train for it and export, or leave the weights out: registration works without"
        )
    return pretrained


def abstract_variables(model: RpmNet) -> Any:
    """The shapes and dtypes of a network's weights; nothing is computed."""

    def init() -> Any:
        # how many points there are does not change the weights
        cloud = PointCloud.create(jnp.zeros((4, 3)), jnp.zeros((4, 3)))
        return model.init(jax.random.key(0), cloud, cloud, RigidTransform.identity(), 1)

    return jax.eval_shape(init)


def model_from_dict(values: Any, where: str) -> RpmNet:
    """The network of a dict of its settings, each checked.

    Raises:
      InputError: a setting is missing, unknown or cannot be; the message starts with ``where``.
    """
    settings = _checked(values, _MODEL, f"{where}: model")
    if (width := settings["feature_width"]) % 8:
        raise InputError(f"{where}: model: feature_width={width} is no multiple of 8")
    return RpmNet(**settings)


def _matcher(header: dict[str, Any], arrays: dict[str, np.ndarray], where: str) -> TrainedMatcher:
    """Checks everything that a header and arrays hold, and puts it together."""
    values = _checked({name: header[name] for name in _HEADER if name in header}, _HEADER, where)
    try:
        camera = Camera.from_dict(values["camera"])
    except (InputError, TypeError, ValueError) as error:
        raise InputError(f"{where}: camera: {error}") from error
    model = model_from_dict(values["model"], where)
    variables = _variables(model, arrays, where)
    points, normals = (arrays[name] for name in _REFERENCE)
    if points.shape != normals.shape or points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"{where}: reference_points {points.shape} and reference_normals {normals.shape} "
            "should both be [Y, 3]"
        )
    sampling = PairSampling(**values["drawing"])
    if len(points) < sampling.num_reference:
        raise InputError(
            f"{where}: {len(points)} reference points, fewer than the {sampling.num_reference} "
            "that are to be drawn from them"
        )
    part = values["part"]
    return TrainedMatcher(
        model=model,
        variables=variables,
        iterations=values["iterations"],
        sampling=sampling,
        voxel_mm=values["voxel_mm"],
        center=np.array(part["center_mm"]),
        radius_mm=part["radius_mm"],
        reference_points=points,
        reference_normals=normals,
        part_name=part["name"],
        part_sha256=part["sha256"],
        camera=camera,
        trained=values["trained"],
    )


def _variables(model: RpmNet, arrays: Mapping[str, np.ndarray], where: str) -> Any:
    """The tree of weights, after names, shapes, dtypes and values were checked."""
    abstract = abstract_variables(model)
    expected = _by_name(abstract)
    names = {*expected, *_REFERENCE}
    if differing := sorted(names ^ set(arrays)):
        listed = [f"{'missing' if name in names else 'unknown'}: {name}" for name in differing[:5]]
        raise InputError(f"{where}: not the arrays of this network; {', '.join(listed)}")
    for name, value in arrays.items():
        shape = expected[name].shape if name in expected else value.shape
        if value.shape != shape or value.dtype != np.float32:
            raise InputError(
                f"{where}: {name} is {value.dtype} {value.shape}, the network's is float32 {shape}"
            )
        if not np.isfinite(value).all():
            raise InputError(f"{where}: {name} holds values that are not finite")
    return jax.tree.unflatten(jax.tree.structure(abstract), [arrays[name] for name in expected])


def _by_name(tree: Any) -> dict[str, Any]:
    """The leaves of a tree, named such as ``params/feature_net/prepool_0/dense/kernel``."""
    return {
        jax.tree_util.keystr(place, simple=True, separator="/"): leaf
        for place, leaf in jax.tree.leaves_with_path(tree)
    }


def _checked(value: Any, schema: Any, where: str) -> Any:
    """A value of JSON that is as the schema has it; whole numbers become floats where it says."""
    if isinstance(schema, dict):
        names = sorted(value) if isinstance(value, dict) else []
        if names != sorted(schema):
            raise InputError(f"{where}: has {names}, should have {sorted(schema)}")
        return {
            name: _checked(value[name], part, f"{where}: {name}") for name, part in schema.items()
        }
    if isinstance(schema, list):
        if not isinstance(value, list) or len(value) != len(schema):
            raise InputError(f"{where}={value!r} should be {len(schema)} numbers")
        return [_checked(item, part, where) for item, part in zip(value, schema, strict=True)]
    if isinstance(schema, type):
        if not isinstance(value, schema):
            raise InputError(f"{where}={value!r} should be of type {schema.__name__}")
        return value
    kind, low, high = schema
    numbers = int if kind is int else int | float
    if not isinstance(value, numbers) or isinstance(value, bool) or not low <= value <= high:
        raise InputError(f"{where}={value!r} should be {kind.__name__}, from {low:g} to {high:g}")
    return kind(value)
