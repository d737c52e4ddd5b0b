"""From the work folder of a training run to one file of weights."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from vanejax.errors import InputError
from vanejax.files import read_json
from vanejax.matching.rpmnet import RpmNet
from vanejax.scanner.camera import Camera
from vanejax.training.checkpoint import Checkpoints
from vanejax.training.dataset import load_scan_set
from vanejax.training.pairs import PairSampling
from vanejax.training.train_step import OptimizerSettings, first_state, make_optimizer
from vanejax.training.weight_file import (
    TrainedMatcher,
    abstract_variables,
    model_from_dict,
    save_model,
)

Which = Literal["best", "last"]


def export_workdir(
    workdir: str | os.PathLike[str], path: str | os.PathLike[str], *, checkpoint: Which = "best"
) -> TrainedMatcher:
    """Writes the weights of a training run with all that inference needs, and returns them.

    Args:
      workdir: as ``experiments.train`` left it: run.json, scans.npz and checkpoints/. It is only
        read, so a run that still goes on may be exported.
      path: the file to write: safetensors, or .npz by that suffix.
      checkpoint: the one with the smallest error on the validation pairs, or the newest.

    Raises:
      InputError: the folder holds no such run, its pieces do not fit together, or the file cannot
        be written.
    """
    workdir = Path(workdir)
    if not workdir.is_dir():
        raise InputError(
            f"{workdir}: no such folder; give the work folder of a training run, or a checkpoint"
        )
    record = workdir / "run.json"
    if not record.exists():
        raise InputError(f"{record}: no such file; {workdir} is no training run")
    run = _read_object(record)
    part, config = run.get("part"), run.get("config")
    if not isinstance(part, dict) or not isinstance(config, dict):
        raise InputError(f"{record}: does not say which config and part the run is of")
    scans = load_scan_set(workdir / "scans.npz")
    hashes = str(part.get("sha256")), str(scans.source.get("part_sha256"))
    if hashes[0] != hashes[1]:
        raise InputError(
            f"{workdir}: run.json is about the part {hashes[0][:12]}, scans.npz about "
            f"{hashes[1][:12]}: the folder mixes two runs"
        )
    try:
        settings = dict(config["model"])
        iterations = settings.pop("test_iterations")
        name = settings.pop("name", "rpmnet")  # runs of older versions are all RPM-Net's
        if name != "rpmnet":
            raise InputError(
                f"{workdir} is a run of {name!r}: register takes the weights of an RPM-Net"
            )
        model = model_from_dict(settings, str(record))
        data = {"num_source": 0} | config["data"]  # older versions have no such setting
        names = [field.name for field in dataclasses.fields(PairSampling)]
        sampling = PairSampling(**{name: data[name] for name in names}).fitted(scans)
        voxel_mm = data["voxel_mm"]
        camera = Camera.from_dict(scans.source["camera"])
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{workdir}: run.json or scans.npz has no {error}; another version wrote it"
        ) from error
    variables, step = _read_weights(workdir, model, checkpoint)
    evaluation = None  # the run's own figures on its test views
    if (figures := workdir / "evaluation.json").exists():
        values = _read_object(figures)
        evaluation = {key: values[key] for key in ("views", "summary", "date") if key in values}
    matcher = TrainedMatcher(
        model=model,
        variables=variables,
        iterations=iterations,
        sampling=sampling,
        voxel_mm=voxel_mm,
        center=scans.center,
        radius_mm=scans.radius_mm,
        reference_points=scans.reference_points,
        reference_normals=scans.reference_normals,
        part_name=part.get("name"),
        part_sha256=hashes[0],
        camera=camera,
        trained={"step": step, "checkpoint": checkpoint}
        | {key: run.get(key) for key in ("versions", "commit", "started")}
        | {"experiment": config.get("name"), "seed": config.get("seed"), "config": config}
        | {"evaluation": evaluation},
    )
    save_model(path, matcher)
    return matcher


def _read_weights(workdir: Path, model: RpmNet, checkpoint: Which) -> tuple[Any, int]:
    """The averaged weights as numpy arrays, and the step that they are of."""
    folder = workdir / "checkpoints"
    if not folder.is_dir():
        raise InputError(f"{workdir}: holds no checkpoints; train first")
    # only its structure counts, which no number changes
    optimizer = make_optimizer(OptimizerSettings())
    like = jax.eval_shape(lambda some: first_state(optimizer, some), abstract_variables(model))
    with Checkpoints(folder) as checkpoints:
        step = checkpoints.best_step if checkpoint == "best" else checkpoints.latest_step
        if step is None and checkpoints.latest_step is not None:
            raise InputError(f"{folder}: none was validated yet; take the last checkpoint")
        state = checkpoints.restore(like, step=step)
    return jax.tree.map(np.asarray, state.average), int(state.step)


def _read_object(path: Path) -> dict[str, Any]:
    values = read_json(path)
    return values if isinstance(values, dict) else {}
