"""RPM-Net trained on generic shapes against RPM-Net trained on virtual scans (paper, Figs 8, 9).

The command is `experiments.public_vs_virtual`.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.compare import figures, training_summary
from experiments.evaluate import registered
from experiments.runner import markdown
from experiments.runner import study_command as study
from experiments.runner.evaluation_report import hardest_views
from experiments.runner.experiment import Experiment
from experiments.runner.machine import report_head
from experiments.runner.registrations import Results
from experiments.runner.trained import given_runs, trained
from experiments.studies.comparison.table import training_line
from experiments.train import load_or_scan
from vanejax import plotting
from vanejax.errors import InputError
from vanejax.files import read_json
from vanejax.matching.metrics import mean_per_axis, mean_per_view
from vanejax.training.dataset import ScanSet

PUBLIC, VIRTUAL = "public", "virtual"
VIEWS = ("hardest", "all")
PAPER_REDUCTION = 0.8  # "a combined reduction of approximately 80%"


def of_virtual_scans(config: Experiment) -> Experiment:
    """The same recipe, trained on scans of the part."""
    config = copy.deepcopy(config)
    config.name = f"{config.name}-{VIRTUAL}"
    config.data.shapes = ""
    return config


def public_vs_virtual(
    config: Experiment, workdir: Path, runs: Mapping[str, Path], *, progress: bool = True
) -> dict[str, Any]:
    """Trains both networks where no run is given, and compares them on the part's test views.

    ``workdir`` receives the runs, public_vs_virtual.json, whose content is returned, and pictures;
    ``runs`` are folders of finished runs, under "public" and "virtual".

    Raises:
      InputError: settings, parts or folders that cannot be used.
    """
    config.check()
    if not config.data.shapes:
        raise InputError(
            "config.data.shapes is empty: name a ModelNet40 folder, a file of shapes, or solids"
        )
    part = config.make_part()
    workdir.mkdir(parents=True, exist_ok=True)
    scans = load_or_scan(config, part, workdir / "scans.npz")
    sources, results = {}, {}
    for name, settings in ((VIRTUAL, of_virtual_scans(config)), (PUBLIC, config)):
        print(f"trained on {name} data: {runs.get(name, 'training')}")
        folder = runs.get(name, workdir / name)
        network = trained(settings, part, scans, workdir / name, runs.get(name))
        shapes = folder / "shapes.json"
        source = {"title": "virtual scans of the part"}
        if folder.is_file():
            source = {"title": f"whatever {folder.name} was trained on"}
        elif shapes.exists():
            source = read_json(shapes)
        sources[name] = source | {"training": training_summary(network)}
        results[name] = registered(settings, scans, network.variables, progress=progress)
    head = report_head(part, seed=config.seed, config=dataclasses.asdict(config))
    report = {"name": config.name, **head, "trained_on": sources, **compared(results, scans.test)}
    report = study.save(workdir, "public_vs_virtual", report)
    for title, views in reported_views(scans.test).items():
        series = {
            sources[name]["title"]: plotting.AxisErrors(
                result.errors.rotation_axes_deg[views], result.errors.translation_axes_mm[views]
            )
            for name, result in results.items()
        }
        plotting.save_figure(plotting.axis_errors(series), workdir / f"axis_errors_{title}.png")
    print(table(report))
    return report


def picture(report: Mapping[str, Any], views: str) -> Figure:
    """The paper's Figs 8 and 9 of a record, which holds the errors' means only.

    The picture shows the means over views and over axes of errors [V, 3]; the product of both over
    the mean of all is such errors. ``views`` are "hardest" or "all".
    """
    series = {}
    for source in (VIRTUAL, PUBLIC):
        means = report[f"{views}_views"][source]
        errors = [
            np.outer(means[f"{name}_per_view_{unit}"], means[f"{name}_per_axis_{unit}"])
            / np.mean(means[f"{name}_per_axis_{unit}"])
            for name, unit in (("mre", "deg"), ("mte", "mm"))
        ]
        series[report["trained_on"][source]["title"]] = plotting.AxisErrors(*errors)
    return plotting.axis_errors(series)


def reported_views(test: ScanSet) -> dict[str, np.ndarray]:
    """Indices of the views that errors are reported on, by their name in the record."""
    return {"all": np.arange(len(test)), "hardest": hardest_views(test)}


def compared(results: Mapping[str, Results], test: ScanSet) -> dict[str, Any]:
    """Errors of both on all test views and on the hardest, and by how much one is lower."""
    rows = reported_views(test)
    report: dict[str, Any] = {"views": {name: len(views) for name, views in rows.items()}}
    report |= {name: figures(result, test) for name, result in results.items()}
    for name, views in rows.items():
        errors = {}
        for source, result in results.items():
            turns = result.errors.rotation_axes_deg[views]
            shifts = result.errors.translation_axes_mm[views]
            errors[source] = {
                "mre_per_axis_deg": mean_per_axis(turns),
                "mte_per_axis_mm": mean_per_axis(shifts),
                "mre_per_view_deg": mean_per_view(turns),
                "mte_per_view_mm": mean_per_view(shifts),
            }
        turned, moved = (
            1.0 - float(np.mean(errors[VIRTUAL][key]) / np.mean(errors[PUBLIC][key]))
            for key in ("mre_per_axis_deg", "mte_per_axis_mm")
        )
        report[f"{name}_views"] = errors | {
            "reduction": {
                "rotation": turned,
                "translation": moved,
                "combined": 0.5 * (turned + moved),
                "paper": PAPER_REDUCTION,
            }
        }
    return report


def table(report: Mapping[str, Any]) -> str:
    """Markdown: MRE and MTE per axis of both, and the reduction beside the paper's."""
    rows = []
    for views in VIEWS:
        for name in (PUBLIC, VIRTUAL):
            errors = report[f"{views}_views"][name]
            summary = report[name]["hardest" if views == "hardest" else "summary"]
            axes = (
                ", ".join(f"{value:.2f}" for value in errors[key])
                for key in ("mre_per_axis_deg", "mte_per_axis_mm")
            )
            means = (
                f"{summary[key]['mean']:.2f}"
                for key in ("rotation_error_deg", "translation_error_mm")
            )
            count = f"{report['views'][views]}, {views}"
            rows.append([report["trained_on"][name]["title"], count, *axes, *means])
    head = ["trained on", "views", "MRE x, y, z (deg)", "MTE x, y, z (mm)", "rotation (deg)"]
    lines = [markdown.table([*head, "translation (mm)"], rows)]
    for views in VIEWS:
        fall = report[f"{views}_views"]["reduction"]
        lines += [
            "",
            f"Virtual scans lower the error by {fall['combined']:.0%} on the {views} views "
            f"(rotation {fall['rotation']:.0%}, translation {fall['translation']:.0%}); the paper "
            f"says about {fall['paper']:.0%}.",
        ]
    trained_on = [source for source in report["trained_on"].values() if source["training"]]
    lines += ["", *(training_line(source["title"], source["training"]) for source in trained_on)]
    return "\n".join(lines)


def main(config: Experiment, workdir: Path, words: list[str]) -> None:
    """Compares, with the runs of the command line."""
    public_vs_virtual(config, workdir, given_runs(words, (PUBLIC, VIRTUAL)))
