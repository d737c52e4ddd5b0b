"""Table 1: every method of the paper on the same scans, its figures beside ours.

python -m experiments.compare --config table1.py [--methods icp,rpmnet] [--workdir runs/table1]
    [--trained rpmnet=runs/vane] [--config.FIELD=VALUE ...]

Scans the part, trains the networks that are not given (hours; kill it and give the command again:
it goes on), registers the 54 test views with each method from the same noisy points, and refines
every answer by ray casting. Settings of the classical methods come from `experiments.tune`.

VANEJAX_CACHE_DIR is where compiled programs are kept (~/.cache/vanejax); off keeps none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from absl import flags

from experiments.runner import command_line
from experiments.runner import study_command as study
from experiments.runner.evaluation_report import hardest_views, summarize
from experiments.runner.machine import PACKAGES, PEERS, report_head, versions
from experiments.runner.registrations import Results, register_views
from experiments.runner.required_accuracy import NEED_DEG, NEED_MM, within_need
from experiments.runner.trained import Trained, given_runs, trained
from experiments.studies.comparison import pictures as comparison_pictures
from experiments.studies.comparison.fine_step import FineStep
from experiments.studies.comparison.methods import TABLE_1, TITLES, make_method, settings_of
from experiments.studies.comparison.settings import NETWORKS, Comparison
from experiments.studies.comparison.table import table
from experiments.train import load_or_scan
from vanejax.errors import InputError, MissingExtra
from vanejax.files import write_text
from vanejax.matching.metrics import summary
from vanejax.training import ScanSet, make_bank


def compare(config: Comparison, workdir: Path, runs: Mapping[str, Path]) -> dict[str, Any]:
    """Trains what is to be trained, registers, refines, and reports what comparison.json holds.

    ``workdir`` receives the networks' runs, comparison.json, table.md and pictures; ``runs`` are
    the folders of networks that are trained already, by name. Errors as of `experiments.train.fit`,
    and InputError for settings, parts or folders that cannot be used.
    """
    config.check()
    experiment = config.experiment
    part = experiment.make_part()
    scans = load_or_scan(experiment, part, workdir / "scans.npz")
    test = scans.test
    if not len(test):
        raise InputError("no test views: none of the azimuths is a multiple of 40 deg")
    networks: dict[str, Trained] = {}
    for name in (name for name in config.methods if name in NETWORKS):
        print(f"{TITLES[name]}: {'taken from ' + str(runs[name]) if name in runs else 'training'}")
        networks[name] = trained(
            config.experiment_of(name), part, scans, workdir / name, runs.get(name)
        )
    bank = make_bank(test, num_reference=experiment.data.num_reference)
    sampling, fine_step = experiment.pair_sampling(scans), FineStep(part, test)
    report: dict[str, Any] = {
        "name": config.name,
        **report_head(part, seed=experiment.seed, config=dataclasses.asdict(config)),
        "versions": versions((*PACKAGES, *PEERS)),
        "views": len(test),
        "hardest": hardest_views(test),
        "need": {"rotation_deg": NEED_DEG, "translation_mm": NEED_MM},
        "methods": [],
    }
    shown: dict[str, Results] = {}
    for name in config.methods:
        try:
            register = make_method(name, config, networks.get(name))
        except MissingExtra as missing:
            report["methods"].append({"name": name, "title": TITLES[name], "skipped": str(missing)})
            continue
        print(f"{TITLES[name]}: registering")
        results = register_views(
            register, bank, sampling, seed=experiment.seed, unit_mm=scans.radius_mm
        )
        report["methods"].append(
            {
                "name": name,
                "title": TITLES[name],
                "paper": dataclasses.asdict(TABLE_1[name]) if name in TABLE_1 else None,
                "settings": settings_of(name, config),
                "training": training_summary(networks.get(name)),
                "alone": figures(results, test),
                "refined": figures(fine_step(results), test),
            }
        )
        shown[name] = results
    report = study.save(workdir, "comparison", report)
    write_text(workdir / "table.md", table(report))
    if shown:
        comparison_pictures.draw(report, shown, test, workdir)
    print(table(report))
    return report


def figures(results: Results, scans: ScanSet) -> dict[str, Any]:
    """Summaries over all views and the hardest, the success rate, and every view's pose error."""
    measures = summarize(results, scans)
    rotation, translation = results.errors.rotation_deg, results.errors.translation_mm
    return {
        "success": np.mean(within_need(rotation, translation)),
        "non_finite_views": measures["non_finite_views"],
        "summary": measures["summary"],
        "hardest": measures["hardest"]["summary"],
        "mre_per_axis_deg": measures["mre_per_axis_deg"],
        "mte_per_axis_mm": measures["mte_per_axis_mm"],
        "at_true_pose": measures["at_true_pose"],
        "converged": np.mean(results.registration.converged),
        "turned_over": np.mean(~(rotation < 90)),
        "overlap": summary(results.registration.overlap),
        "rotation_error_deg": rotation,
        "translation_error_mm": translation,
    }


def training_summary(network: Trained | None) -> dict[str, Any] | None:
    """How a network was trained; None where there is none."""
    if network is None or network.record is None:
        return None
    return network.record.summary(network.config.training.steps) | {
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(network.variables)),
        "model": type(network.config.make_network().model).__name__,
    }


def main(config: Comparison, workdir: Path, methods: list[str], runs: list[str]) -> None:
    """Compares the methods of the command line, or the config's where it names none."""
    config.methods = tuple(methods) or config.methods
    compare(config, workdir, given_runs(runs, NETWORKS))


if __name__ == "__main__":
    CHOICE = flags.DEFINE_list(
        "methods", [], "these only, such as icp,rpmnet; the config's if none"
    )
    RUNS = flags.DEFINE_multi_string(
        "trained", [], "NAME=FOLDER: take this network from a finished run instead of training it"
    )
    command_line.run(
        lambda config, workdir: main(config, workdir, CHOICE.value, RUNS.value), tree=Comparison
    )
