"""What a network that saw virtual scans is worth on real ones, by how real the virtual ones were.

python -m experiments.sensor_transfer FOLDER [--sensor consumer_depth] [--steps 1500]
    [--starts 20] [--out DIR]

FOLDER is that of `experiments.real_scans`. For each part there two RPM-Nets are trained on virtual
scans: by the sensor, and by an ideal camera of the same pixels and range. All else is alike: views,
distances, noise added, seed and steps. Both then register the real scans from the same rough poses
up to 45 deg and half a part radius away, alone and with the fine registration after it. An
interrupted run goes on where it stopped. Results: a table and sensor_transfer.json in ``--out``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments.runner import markdown
from experiments.runner import study_command as study
from experiments.runner.experiment import (
    DataSettings,
    Experiment,
    PartSettings,
    TrainingSettings,
)
from experiments.runner.run_folder import RunFolder
from experiments.runner.vane_views import perturb
from experiments.studies.real_scans.study import RIGHT_DEG, RIGHT_MM, KnownScan, load_truth
from experiments.train import fit, load_or_scan
from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.localization.fine_registration import refine
from vanejax.localization.matched_poses import match_poses
from vanejax.localization.residuals import measurement_model
from vanejax.rigid import RigidTransform
from vanejax.scanner.sensor import preset
from vanejax.scans.measured_scan import MeasuredScan
from vanejax.scans.scan_file import load_scan
from vanejax.training.export import export_workdir
from vanejax.training.online_scans import OnlineScans
from vanejax.training.rpmnet_loss import RpmNetLoss
from vanejax.training.weight_file import TrainedMatcher

START_DEG, START_SHARE = 45.0, 0.5  # of the part's radius
DISTANCES_MM = (170.0, 390.0)  # between which the real scans were taken
IDEAL = "ideal"  # the network that saw no effects
NO_NETWORK = "none: the rough pose"
_STARTS = 0x7247  # folded into the seed


def recipe(known: KnownScan, sensor: str, *, effects: bool, steps: int, seed: int) -> Experiment:
    """The training for one part; only ``online.effects`` tells two of them apart."""
    return Experiment(
        name=f"{known.cad.stem}_{sensor if effects else IDEAL}",
        seed=seed,
        part=PartSettings(path=str(known.cad), units=known.cad_units),
        data=DataSettings(num_reference=512),
        online=OnlineScans(
            sensor=sensor,
            distance_mm=DISTANCES_MM,
            elevation_deg=(-90.0, 90.0),
            effects=effects,
            # as many pixels as the depth camera has
            resolution=min(1.0, 424 / preset(sensor).camera.width),
        ),
        loss=RpmNetLoss(matching=0.02, matching_sigma=0.02),
        training=TrainingSettings(steps=steps, learning_rate=2e-3, quick_compilation=False),
    )


def network(config: Experiment, folder: Path) -> TrainedMatcher:
    """Trained in ``folder``, or what was trained there before."""
    config.check()
    with RunFolder(folder) as run:
        part = config.make_part()
        run.claim(config, part)
        fit(config, part, load_or_scan(config, part, folder / "scans.npz"), run)
    return export_workdir(folder, folder / "model.npz", checkpoint="last")


class Trial:
    """Registers real scans of one part with several networks."""

    def __init__(self, part: Part, networks: dict[str, TrainedMatcher]) -> None:
        self.part, self.networks = part, networks
        self._model = measurement_model(part, np.zeros(3))

    def rows(
        self, known: KnownScan, *, starts: int, rng: np.random.Generator
    ) -> list[dict[str, Any]]:
        """What every network finds in one scan, from each start."""
        extent = self.part.extent_mm
        points = load_scan(known.scan, units=known.scan_units, part_extent_mm=extent).points
        scan = MeasuredScan(points, None, np.zeros(3))
        inits = [self._start(known, rng) for _ in range(starts)]
        guesses = RigidTransform(
            np.stack([init.rotation for init in inits]),
            np.stack([init.translation for init in inits]),
        )
        rows: list[dict[str, Any]] = [{"scan": known.scan.name} for _ in inits]
        for name, matcher in self.networks.items():
            began = time.perf_counter()
            found = match_poses(matcher, scan, guesses, iterations=matcher.iterations)
            seconds = (time.perf_counter() - began) / starts
            for index, row in enumerate(rows):
                matched = RigidTransform(found.rotation[index], found.translation[index])
                fine = refine(self._model, points, matched).part_from_camera
                row[name] = {
                    "alone": _errors(known, matched) | {"time_s": seconds},
                    "refined": _errors(known, fine),
                }
        for row, init in zip(rows, inits, strict=True):
            fine = refine(self._model, points, init).part_from_camera
            row[NO_NETWORK] = {"alone": _errors(known, init), "refined": _errors(known, fine)}
        return rows

    def _start(self, known: KnownScan, rng: np.random.Generator) -> RigidTransform:
        """A pose beside one of the right ones."""
        right = known.camera_from_part[rng.integers(len(known.camera_from_part))]
        return perturb(
            RigidTransform.from_matrix(right).inverse(),
            self.part,
            deg=rng.uniform(0, START_DEG),
            mm=rng.uniform(0, START_SHARE) * self.part.radius,
            rng=rng,
        )


def _errors(known: KnownScan, found: RigidTransform) -> dict[str, Any]:
    rotation_deg, translation_mm = known.error(found)
    return {
        "rotation_deg": rotation_deg,
        "translation_mm": translation_mm,
        "right": bool(rotation_deg < RIGHT_DEG and translation_mm < RIGHT_MM),
    }


def summarize(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> dict[str, Any]:
    """How many are right and their share, and medians, by network and stage."""
    return {
        name: {
            stage: {
                "registrations": len(rows),
                "right": float(np.mean([row[name][stage]["right"] for row in rows])),
                **{
                    error: float(np.median([row[name][stage][error] for row in rows]))
                    for error in ("rotation_deg", "translation_mm")
                },
            }
            for stage in ("alone", "refined")
        }
        for name in names
    }


def table(report: dict[str, Any]) -> str:
    """Markdown: a row for each way to train, for all scans and for those of each part."""
    rows = []
    for part, summary in report["summary"].items():
        for name, stages in summary.items():
            rows.append([name, part])
            for stage in (stages["alone"], stages["refined"]):
                right = round(stage["right"] * stage["registrations"])
                rows[-1] += [f"{right} of {stage['registrations']}"]
                rows[-1] += [f"{stage[error]:.2f}" for error in ("rotation_deg", "translation_mm")]
    head = [
        "network trained on",
        "part",
        "by it: right",
        "deg",
        "mm",
        "refined: right",
        "deg",
        "mm",
    ]
    return markdown.table(head, rows)


def sensor_name(text: str) -> str:
    """A preset of `vanejax.scanner.sensor`, as an argument's type."""
    try:
        preset(text)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """Trains what is missing, then registers."""
    truth = load_truth(settings.folder)
    report = study.header("RPM-Net by its training's sensor, on real scans", settings)
    rows: dict[str, list[dict[str, Any]]] = {}
    for first in {known.cad: known for known in truth}.values():
        networks = {}
        for name, effects in ((IDEAL, False), (settings.sensor, True)):
            config = recipe(
                first, settings.sensor, effects=effects, steps=settings.steps, seed=settings.seed
            )
            networks[name] = network(config, settings.out / config.name)
        trial = Trial(config.make_part(), networks)
        scans = [known for known in truth if known.cad == first.cad]
        rows[first.cad.stem] = [
            row
            for number, known in enumerate(tqdm(scans, first.cad.stem, unit="scan"))
            for row in trial.rows(
                known,
                starts=settings.starts,
                rng=np.random.default_rng([settings.seed, _STARTS, number]),
            )
        ]
    names = [IDEAL, settings.sensor, NO_NETWORK]
    together = [row for found in rows.values() for row in found]
    report |= {
        "summary": {"all": summarize(together, names)}
        | {part: summarize(found, names) for part, found in rows.items()},
        "scans": {
            scan: summarize([row for row in together if row["scan"] == scan], names)
            for scan in dict.fromkeys(row["scan"] for row in together)
        },
    }
    report = study.save(settings.out, "sensor_transfer", report)
    print(table(report))
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("sensor_transfer", __doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="as experiments.real_scans")
    parser.add_argument(
        "--sensor",
        type=sensor_name,
        default="consumer_depth",
        metavar="NAME",
        help="whose scans one network is trained on (consumer_depth)",
    )
    parser.add_argument("--steps", type=study.count, default=1500, help="of each training (1500)")
    parser.add_argument("--starts", type=study.count, default=20, help="rough poses a scan (20)")
    return parser
