"""Registers the test views with a trained network: errors, a table, JSON and pictures.

python -m experiments.evaluate --config vane.py [--workdir runs/vane] [--config.FIELD=VALUE ...]

Needs what ``experiments.train`` left in the work folder: the scans and a checkpoint.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import importlib.metadata
import time
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from experiments import command_line, pictures
from experiments.experiment import Experiment
from experiments.run_folder import PACKAGES, git_commit, read_log, write_json
from vanejax.dataset import ScanSet, describe_source, load_scan_set
from vanejax.metrics import (
    PoseErrors,
    SurfaceFit,
    mean_per_axis,
    mean_per_view,
    pose_errors,
    summary,
    surface_fit,
)
from vanejax.models.rpmnet import rpmnet
from vanejax.pairs import Drawing, Pair, ScanBank, draw_source, draw_target, make_bank
from vanejax.part import Part
from vanejax.registration import Register, Registration
from vanejax.rigid import RigidTransform
from vanejax.training import Variables

TEST_STREAM = 0x7E57  # folded into key(seed): training and validation draw from other keys

MEASURES = {
    "rotation_error_deg": "rotation error (deg)",
    "translation_error_mm": "translation error (mm)",
    "rmse_mm": "RMSE, eq. 1 (mm)",
    "ffmde_abs_mm": "FFMDE, absolute (mm)",
    "ffmde_signed_mm": "FFMDE, signed, eq. 2 (mm)",
    "time_s": "time (s)",
}


@flax.struct.dataclass
class Results:
    """Registrations of V views, on the host.

    Attributes:
      pairs: what was registered, unit-sphere units; a target for each view: [V, N], [V, M], [V].
      registration: [V] what was found.
      errors: [V] against the labels.
      fit: [V] of the moved source to its own target: noisy points both, as the network got them.
      fit_at_truth: [V] the same under the true pose: what density and noise alone amount to.
      time_s: [V] f64, wall clock of a registration without compilation.
    """

    pairs: Pair
    registration: Registration
    errors: PoseErrors
    fit: SurfaceFit
    fit_at_truth: SurfaceFit
    time_s: np.ndarray


def evaluate(
    config: Experiment,
    scans: ScanSet,
    variables: Variables,
    folder: Path,
    *,
    part: Part | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Registers the test views with RPM-Net, from the identity, and reports.

    Args:
      config: the network, how pairs are drawn, and the seed.
      scans: all views; those with `Viewpoints.is_test` are registered.
      variables: trained weights.
      folder: receives evaluation.json and pictures.
      part: where given, pictures that need the CAD part are drawn too.
      progress: whether to show a progress bar.

    Returns:
      What evaluation.json holds; numbers that are not finite are None.
    """
    test = scans.test
    bank = make_bank(test, num_reference=config.data.num_reference)
    register = make_register(config, variables)
    results = register_views(
        register,
        bank,
        config.make_drawing(scans),
        seed=config.seed,
        unit_mm=scans.radius_mm,
        progress=progress,
    )
    report = {
        "method": f"RPM-Net, {config.model.test_iterations} iterations, no initial guess",
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "device": str(jax.devices()[0].device_kind),
        "commit": git_commit(),
        "versions": {name: _version(name) for name in PACKAGES},
        "part": {"name": scans.source["part"], "sha256": scans.source["part_sha256"]},
        "seed": config.seed,
        "config": dataclasses.asdict(config),
    }
    report = _plain(report | summarize(results, test))
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "evaluation.json", report)
    pictures.draw(results, test, hardest_views(test), read_log(folder), folder)
    if part is not None:
        pictures.draw_with_part(results, test, hardest_views(test), part, config, folder)
    print(table(report))
    return report


def make_register(config: Experiment, variables: Variables) -> Register:
    """RPM-Net as configured for tests, jitted once for all views."""
    model, iterations = config.make_model(), config.model.test_iterations

    # variables are an argument: as constants of the program they would be folded at compile time
    @jax.jit
    def run(variables: Variables, *pair_and_key: Any) -> Registration:
        return rpmnet(model, variables, iterations=iterations)(*pair_and_key)

    return functools.partial(run, variables)


def register_views(
    register: Register,
    bank: ScanBank,
    drawing: Drawing,
    *,
    seed: int,
    unit_mm: float,
    progress: bool = True,
) -> Results:
    """Draws a pair from each view of the bank, registers it from the identity and measures.

    View v draws its points, noise and pose from ``fold_in(fold_in(key(seed), TEST_STREAM), v)``:
    the same pairs for every method, whatever it does.

    Args:
      register: any method; jitted already if it should be.
      bank: V views.
      drawing: as in training.
      seed: of the pairs.
      unit_mm: length of the unit-sphere unit, the part's radius.
      progress: whether to show a progress bar.
    """

    @jax.jit
    def draw(key: jax.Array, bank: ScanBank, view: jax.Array) -> Pair:
        target_key, source_key = jax.random.split(key)
        source, truth = draw_source(source_key, bank, view, drawing)
        target = draw_target(target_key, bank, drawing)
        return Pair(source=source, target=target, target_from_source=truth)

    @jax.jit
    def measure(pair: Pair, found: RigidTransform) -> tuple[PoseErrors, SurfaceFit, SurfaceFit]:
        truth = pair.target_from_source
        fits = (
            surface_fit(pair.source.transform(pose), pair.target, unit_mm=unit_mm)
            for pose in (found, truth)
        )
        return pose_errors(found, truth, unit_mm=unit_mm), *fits

    stream = jax.random.fold_in(jax.random.key(seed), TEST_STREAM)
    init = RigidTransform.identity()
    rows = []
    views = range(bank.scans.mask.shape[0])
    for view in tqdm(views, "evaluating", unit="view", disable=not progress):
        draw_key, register_key = jax.random.split(jax.random.fold_in(stream, view))
        pair = jax.block_until_ready(draw(draw_key, bank, jnp.asarray(view)))
        if view == 0:  # compiles
            jax.block_until_ready(register(pair.source, pair.target, init, register_key))
        start = time.perf_counter()
        found = jax.block_until_ready(register(pair.source, pair.target, init, register_key))
        seconds = time.perf_counter() - start
        measured = measure(pair, found.target_from_source)
        rows.append(jax.device_get(Results(pair, found, *measured, time_s=np.float64(seconds))))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def hardest_views(scans: ScanSet) -> np.ndarray:
    """Indices of the least visible view of each elevation, in its order (paper, section III.D)."""
    elevation, fraction = scans.viewpoints.elevation_deg, scans.visible_fraction
    return np.array(
        [
            np.flatnonzero(elevation == level)[np.argmin(fraction[elevation == level])]
            for level in np.unique(elevation)
        ]
    )


def summarize(results: Results, scans: ScanSet) -> dict[str, Any]:
    """Figures over all views and over the hardest, and a row for each view.

    A view counts as not finite where its pose or any measure is; such views are left out of means
    and counted beside them.
    """
    errors, fit = results.errors, results.fit
    columns = {
        "rotation_error_deg": errors.rotation_deg,
        "translation_error_mm": errors.translation_mm,
        "rmse_mm": fit.rmse_mm,
        "ffmde_signed_mm": fit.ffmde_signed_mm,
        "ffmde_abs_mm": fit.ffmde_abs_mm,
        "time_s": results.time_s,
        "mre_deg": np.asarray(mean_per_view(errors.rotation_axes_deg)),
        "mte_mm": np.asarray(mean_per_view(errors.translation_axes_mm)),
    }
    finite = np.all([np.isfinite(column) for column in columns.values()], axis=0)
    hardest = hardest_views(scans)
    rows = [
        {
            "elevation_deg": scans.viewpoints.elevation_deg[view],
            "azimuth_deg": scans.viewpoints.azimuth_deg[view],
            "visible_fraction": scans.visible_fraction[view],
            "source_points": results.pairs.source.mask[view].sum(),
            "converged": results.registration.converged[view],
        }
        | {name: column[view] for name, column in columns.items()}
        | {
            "rotation_error_axes_deg": errors.rotation_axes_deg[view],
            "translation_error_axes_mm": errors.translation_axes_mm[view],
        }
        for view in range(len(scans))
    ]
    truth = results.fit_at_truth
    return {
        "views": len(scans),
        "non_finite_views": int(np.sum(~finite)),
        "summary": {name: summary(column) for name, column in columns.items()},
        "mre_per_axis_deg": mean_per_axis(errors.rotation_axes_deg[finite]),
        "mte_per_axis_mm": mean_per_axis(errors.translation_axes_mm[finite]),
        "at_true_pose": {
            "rmse_mm": summary(truth.rmse_mm),
            "ffmde_signed_mm": summary(truth.ffmde_signed_mm),
            "ffmde_abs_mm": summary(truth.ffmde_abs_mm),
        },
        "hardest": {
            "rows": hardest,
            "summary": {name: summary(column[hardest]) for name, column in columns.items()},
        },
        "rows": rows,
    }


def table(report: dict[str, Any]) -> str:
    """The report as aligned text."""
    lines = [f"{report['part']['name']}: {report['method']}"]
    for title, part in (
        (f"{report['views']} test views", report["summary"]),
        (f"{len(report['hardest']['rows'])} hardest views", report["hardest"]["summary"]),
    ):
        columns = ("mean", "median", "p95", "max")
        lines += ["", f"{title:<28}" + "".join(f"{column:>10}" for column in columns)]
        for name, label in MEASURES.items():
            values = "".join(_cell(part[name][column]) for column in columns)
            lines.append(f"  {label:<26}{values}")
    axes = [("MRE, eq. 8 (deg)", "mre_per_axis_deg"), ("MTE, eq. 9 (mm)", "mte_per_axis_mm")]
    lines += ["", f"{'mean error per axis':<28}{'x':>10}{'y':>10}{'z':>10}"]
    for label, name in axes:
        lines.append(f"  {label:<26}" + "".join(map(_cell, report[name])))
    floor = report["at_true_pose"]
    lines += [
        "",
        "At the true pose, density and noise of the points alone give a mean RMSE of "
        f"{_cell(floor['rmse_mm']['mean']).strip()} mm",
        f"and a mean absolute FFMDE of {_cell(floor['ffmde_abs_mm']['mean']).strip()} mm.",
    ]
    if report["non_finite_views"]:
        lines += [
            "",
            f"WARNING: {report['non_finite_views']} of {report['views']} views gave numbers that "
            "are not finite; the figures above leave them out.",
        ]
    return "\n".join(lines)


def _cell(value: float | None) -> str:
    return f"{'-':>10}" if value is None else f"{value:>10.4f}"


def _plain(value: Any) -> Any:
    """Numbers, lists and dicts that strict JSON can hold: no arrays, None where not finite."""
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _plain(np.asarray(value).tolist())
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def main(config: Experiment, workdir: Path) -> None:
    """Evaluates the trained network of a work folder."""
    from experiments.train import load_variables  # train imports this module

    config.check()
    part = config.make_part()
    camera, viewpoints = config.make_camera(), config.make_viewpoints(part)
    expected = describe_source(part, camera, viewpoints, config.data.voxel_mm)
    scans = load_scan_set(workdir / "scans.npz", expected=expected)
    evaluate(config, scans, load_variables(workdir, config), workdir, part=part)


if __name__ == "__main__":
    CONFIG = command_line.define_config()
    WORKDIR = command_line.define_workdir()
    command_line.run(lambda: main(CONFIG.value, command_line.workdir(WORKDIR, CONFIG)))
