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
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments.runner import markdown
from experiments.runner import study_command as study
from experiments.runner.experiment import DataSettings, Experiment, PartSettings, TrainingSettings
from experiments.runner.run_folder import RunFolder
from experiments.runner.vane_views import perturb
from experiments.studies.real_scans.study import KnownScan, load_truth
from experiments.train import fit, load_or_scan
from vanejax.errors import InputError
from vanejax.localization import RayCasting, measurement_model, pose_batch, refine
from vanejax.localization.matched_poses import match_poses
from vanejax.rigid import RigidTransform
from vanejax.scanner.sensor import preset
from vanejax.scans import MeasuredScan
from vanejax.training import RpmNetLoss, TrainedMatcher
from vanejax.training.export import export_workdir
from vanejax.training.online_scans import OnlineScans

START_DEG, START_SHARE = 45.0, 0.5  # of the part's radius
DISTANCES_MM = (170.0, 390.0)  # between which the real scans were taken
IDEAL = "ideal"  # the network that saw no effects
NO_NETWORK = "none: the rough pose"
STAGES, ERRORS = ("alone", "refined"), ("rotation_deg", "translation_mm")
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


def register_all(
    known: KnownScan,
    model: RayCasting,
    networks: Mapping[str, TrainedMatcher],
    *,
    starts: int,
    rng: np.random.Generator,
) -> list[dict[str, Any]]:
    """A row for each rough pose of one scan: what every network makes of it, and what none does."""
    points = known.points(model.part)
    scan = MeasuredScan(points, None, np.zeros(3))
    rough = pose_batch.stack(*(_start(known, model, rng) for _ in range(starts)))
    found = {
        name: match_poses(matcher, scan, rough, iterations=matcher.iterations)
        for name, matcher in networks.items()
    }
    rows: list[dict[str, Any]] = []
    for index in range(starts):
        rows.append({"scan": known.scan.name})
        for name, poses in (found | {NO_NETWORK: rough}).items():
            alone = pose_batch.select(poses, index)
            refined = refine(model, points, alone).part_from_camera
            rows[-1][name] = {"alone": known.errors(alone), "refined": known.errors(refined)}
    return rows


def _start(known: KnownScan, model: RayCasting, rng: np.random.Generator) -> RigidTransform:
    """A pose beside one of the right ones."""
    right = known.camera_from_part[rng.integers(len(known.camera_from_part))]
    pose, part = RigidTransform.from_matrix(right).inverse(), model.part
    deg, mm = rng.uniform(0, START_DEG), rng.uniform(0, START_SHARE) * part.radius
    return perturb(pose, part, deg=deg, mm=mm, rng=rng)


def summarize(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> dict[str, Any]:
    """How many are right and their share, and medians, by network and stage."""

    def of_stage(name: str, stage: str) -> dict[str, float]:
        found = [row[name][stage] for row in rows]
        medians = {error: float(np.median([one[error] for one in found])) for error in ERRORS}
        right = float(np.mean([one["right"] for one in found]))
        return {"registrations": len(rows), "right": right, **medians}

    return {name: {stage: of_stage(name, stage) for stage in STAGES} for name in names}


def table(report: dict[str, Any]) -> str:
    """Markdown: a row for each way to train, for all scans and for those of each part."""
    rows = []
    for part, summary in report["summary"].items():
        for name, stages in summary.items():
            cells = [name, part]
            for stage in (stages[key] for key in STAGES):
                right = round(stage["right"] * stage["registrations"])
                cells += [f"{right} of {stage['registrations']}"]
                cells += [f"{stage[error]:.2f}" for error in ERRORS]
            rows.append(cells)
    head = ["network trained on", "part", "by it: right", "deg", "mm", "refined: right", "deg"]
    return markdown.table([*head, "mm"], rows)


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
        model = measurement_model(config.make_part(), np.zeros(3))
        scans = [known for known in truth if known.cad == first.cad]
        rows[first.cad.stem] = []
        for number, known in enumerate(tqdm(scans, first.cad.stem, unit="scan")):
            rng = np.random.default_rng([settings.seed, _STARTS, number])
            found = register_all(known, model, networks, starts=settings.starts, rng=rng)
            rows[first.cad.stem] += found
    names = [IDEAL, settings.sensor, NO_NETWORK]
    together = [row for found in rows.values() for row in found]
    groups = {"all": together} | rows
    report |= {
        "summary": {part: summarize(found, names) for part, found in groups.items()},
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
