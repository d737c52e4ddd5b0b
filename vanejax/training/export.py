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
from vanejax.training.dataset import ScanSet, load_scan_set
from vanejax.training.pairs import PairSampling
from vanejax.training.train_step import OptimizerSettings, TrainState, make_optimizer
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
    """Writes the weights of a training run with all that inference needs.

    Args:
      workdir: as ``experiments.train`` left it: run.json, scans.npz and checkpoints/. It is only
        read, so a run that still goes on may be exported.
      path: the file to write: safetensors, or .npz by that suffix.
      checkpoint: the one with the smallest error on the validation pairs, or the newest.

    Returns:
      What was written.

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
    part = run.get("part")
    if not isinstance(part, dict) or not isinstance(run.get("config"), dict):
        raise InputError(f"{record}: does not say which config and part the run is of")
    scans = load_scan_set(workdir / "scans.npz")
    hashes = str(part.get("sha256")), str(scans.source.get("part_sha256"))
    if hashes[0] != hashes[1]:
        raise InputError(
            f"{workdir}: run.json is about the part {hashes[0][:12]}, scans.npz about "
            f"{hashes[1][:12]}: the folder mixes two runs"
        )
    try:
        config = run["config"]
        settings = dict(config["model"])
        iterations = settings.pop("test_iterations")
        name = settings.pop("name", "rpmnet")  # runs of older versions are all RPM-Net's
        if name != "rpmnet":
            raise InputError(
                f"{workdir} is a run of {name!r}: register takes the weights of an RPM-Net"
            )
        model = model_from_dict(settings, str(record))
        sampling = _sampling(config["data"], scans)
        voxel_mm = config["data"]["voxel_mm"]
        camera = Camera.from_dict(scans.source["camera"])
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{workdir}: run.json or scans.npz has no {error}; another version wrote it"
        ) from error
    variables, step = _read_weights(workdir, model, checkpoint)
    evaluation = None  # the run's own figures on its test views
    if (figures := workdir / "evaluation.json").exists():
        names, values = ("views", "summary", "date"), _read_object(figures)
        evaluation = {name: values[name] for name in names if name in values}
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
        | {name: run.get(name) for name in ("versions", "commit", "started")}
        | {"experiment": config.get("name"), "seed": config.get("seed"), "config": config}
        | {"evaluation": evaluation},
    )
    save_model(path, matcher)
    return matcher


def _sampling(data: dict[str, Any], scans: ScanSet) -> PairSampling:
    names = {field.name for field in dataclasses.fields(PairSampling)} - {"num_source"}
    sampling = PairSampling(**{name: data[name] for name in names})
    return dataclasses.replace(sampling, num_source=data.get("num_source", 0)).fitted(scans)


def _read_weights(workdir: Path, model: RpmNet, checkpoint: Which) -> tuple[Any, int]:
    """The averaged weights as numpy arrays, and the step that they are of."""
    folder = workdir / "checkpoints"
    if not folder.is_dir():
        raise InputError(f"{workdir}: holds no checkpoints; train first")
    variables = abstract_variables(model)
    # only its structure counts, which no number changes
    optimizer = make_optimizer(OptimizerSettings())
    like = TrainState(
        step=jax.ShapeDtypeStruct((), np.int32),
        variables=variables,
        average=variables,
        opt_state=jax.eval_shape(optimizer.init, variables),
    )
    with Checkpoints(folder) as checkpoints:
        steps = {"best": checkpoints.best_step, "last": checkpoints.latest_step}
        step = steps[checkpoint]
        if step is None and checkpoint == "best" and steps["last"] is not None:
            raise InputError(f"{folder}: none was validated yet; take the last checkpoint")
        state = checkpoints.restore(like, step=step)
    return jax.tree.map(np.asarray, state.average), int(state.step)


def _read_object(path: Path) -> dict[str, Any]:
    values = read_json(path)
    return values if isinstance(values, dict) else {}
