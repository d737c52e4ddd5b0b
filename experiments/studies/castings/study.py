"""A virtual casting line: how registration and its bounds stand what castings differ by.

python -m experiments.castings [--views 6] [--parts NAME,...] [--kinds NAME,...] [--jobs N]

Every case is a single scan of a casting that has stock, is bent, shrunk or broken, by a camera that
may be off, or is of another part. `vanejax.register` seeks the part from no guess, with its default
options; beside it stands what fine registration alone, which takes the part for its CAD model, ends
at from nearly the true pose. An accepted pose is wrong if it is off by more than 0.5 deg or 1 mm,
or by more than its covariance allows: 27 of 10,000 true Gaussian errors are that far off. Results:
a table, castings.json (written after every case) and castings.png in ``--out``. The same command
goes on where it was stopped, if the source is that of a commit and has not changed.
"""

from __future__ import annotations

import argparse
import functools
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from experiments.runner import study_command as study
from experiments.runner.evaluation_report import plain
from experiments.runner.machine import cores
from experiments.runner.vane_views import magnitudes, perturb, pose_error
from experiments.studies.castings.casting_line import (
    KINDS,
    PARTS,
    VANES,
    WHITE_MM,
    Case,
    make_case,
    sought,
)
from experiments.studies.castings.report import (
    LISTED_DEG,
    LISTED_MM,
    MOST_SIGMAS,
    picture,
    summarize,
    table,
)
from experiments.studies.fine.study import cramer_rao
from experiments.studies.verdicts.challenge_parts import ChallengePart
from vanejax.errors import InputError
from vanejax.files import read_json
from vanejax.localization.covariance import uncertainty
from vanejax.localization.fine_registration import refine
from vanejax.localization.pose_result import BOUND, Uncertainty
from vanejax.localization.registration import register
from vanejax.localization.residuals import MeasurementModel, measurement_model
from vanejax.plotting.canvas import save_figure
from vanejax.rigid import RigidTransform
from vanejax.scans.measured_scan import MIN_POINTS, MeasuredScan

START_DEG, START_MM = 1.0, 1.0  # of fine registration alone, from the truth
# from the pose a whole number of pitches off, where the other faces of the segment do not fit
PITCH_DEG, PITCH_MM = 2.5, 3.0
SAMPLES = 100_000  # of errors by chance
SAME_SOURCE = ("seed", "commit", "versions")  # of a record that the study goes on from


class CaseName(NamedTuple):
    """Which case: what it is drawn from, along with the seed."""

    part: str
    kind: str
    number: int


@functools.cache
def _model(name: str) -> MeasurementModel:
    return measurement_model(sought(name).part, np.zeros(3))


def nearest_truth(
    challenge: ChallengePart, pose: RigidTransform, truth: RigidTransform
) -> RigidTransform:
    """Of the right poses of a part, that which a pose is nearest to."""
    part = challenge.part
    right = [RigidTransform.from_matrix(symmetry) @ truth for symmetry in challenge.symmetries]
    errors = [pose_error(pose, each, part.center) for each in right]
    ways = [part.radius * np.linalg.norm(e[:3]) + np.linalg.norm(e[3:]) for e in errors]
    return right[int(np.argmin(ways))]


def nearest_error(
    challenge: ChallengePart, pose: RigidTransform, truth: RigidTransform
) -> np.ndarray:
    """[6] the error against the nearest right pose, as `Uncertainty` defines it."""
    return pose_error(pose, nearest_truth(challenge, pose, truth), challenge.part.center)


def is_a_pitch_off(challenge: ChallengePart, pose: RigidTransform, truth: RigidTransform) -> bool:
    """Whether the pose of a vane segment is right but for one or more pitches of the ring."""
    errors = [
        magnitudes(
            pose_error(pose, RigidTransform.from_matrix(turn) @ truth, challenge.part.center)
        )
        for turn in challenge.also_tried
    ]
    return any(deg < PITCH_DEG and mm < PITCH_MM for deg, mm in errors)


def accuracy(error: np.ndarray, stated: Uncertainty) -> dict[str, float]:
    """How far off a pose is, and how that compares with what is said of it; error [6].

    ``squared`` is the squared error over the covariance, over 6: 1 on average. ``covered`` is the
    share of the six axes whose 95 % bounds hold.
    """
    rotation_deg, translation_mm = magnitudes(error)
    within = np.abs(error) <= BOUND * np.sqrt(np.diag(stated.covariance))
    return {
        "rotation_deg": rotation_deg,
        "translation_mm": translation_mm,
        "squared": float(error @ np.linalg.solve(stated.covariance, error)) / 6,
        "covered": float(np.mean(within)),
        "over_sigma": max(
            rotation_deg / stated.weakest_rotation_sigma_deg,
            translation_mm / stated.weakest_translation_sigma_mm,
        ),
        "rotation_over_bound": rotation_deg / stated.rotation_bound_deg,
        "translation_over_bound": translation_mm / stated.translation_bound_mm,
    }


def beyond_by_chance(stated: Uncertainty) -> float:
    """How probable it is that Gaussian errors with this covariance exceed `MOST_SIGMAS`.

    In magnitude, of the rotation's or the translation's standard deviation in the weakest
    direction; from `SAMPLES` of them.
    """
    normal = np.random.default_rng(0).standard_normal((SAMPLES, 6))
    errors = normal @ np.linalg.cholesky(stated.covariance).T
    rotation = np.linalg.norm(errors[:, :3], axis=1)
    translation = np.linalg.norm(errors[:, 3:], axis=1)
    beyond = rotation > MOST_SIGMAS * np.radians(stated.weakest_rotation_sigma_deg)
    beyond |= translation > MOST_SIGMAS * stated.weakest_translation_sigma_mm
    return float(np.mean(beyond))


def times_cramer_rao(case: Case, pose: RigidTransform) -> float:
    """Root mean square of the error over the Cramer-Rao bound of all points: 1 is the least.

    Of a part that is its CAD model, in a scan with white noise of `WHITE_MM`.
    """
    truth = nearest_truth(case.challenge, pose, case.truth)
    error = pose_error(pose, truth, case.challenge.part.center)
    # noise along the rays leaves the rays, and so the bound, as they are
    bound = cramer_rao(_model(case.part), case.points, truth, WHITE_MM)
    return float(np.sqrt(error @ np.linalg.solve(bound, error) / 6))


def attempt(case: Case, seed: int) -> dict[str, Any]:
    """One case: what was found, how far off, and what was said of it."""
    part = case.challenge.part
    scan = MeasuredScan(case.points, None, np.zeros(3), f"{case.part}, {case.kind}, {case.number}")
    began, cpu_began = time.perf_counter(), time.process_time()
    result = register(scan, part, calibration=case.calibration, seed=seed)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - cpu_began
    form = result.refinement.form
    row = {
        "part": case.part,
        "kind": case.kind,
        "number": case.number,
        "points": len(case.points),
        "verdict": result.verdict.status,
        "reason": result.verdict.reason,
        "stock_mm": {"true": case.stock_mm, "found": form and form.stock_mm},
        "scale_error": {"true": case.scale_error, "found": form and form.scale_error},
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "after": None,
        "before": None,
        "listed": False,
        "pitch_off": False,
    }
    if case.truth is None:
        return row
    rng = np.random.default_rng([seed, case.number])
    start = perturb(case.truth, part, deg=START_DEG, mm=START_MM, rng=rng)
    before = refine(_model(case.part), case.points, start, seed=seed)
    error = functools.partial(nearest_error, case.challenge, truth=case.truth)
    poses = (result.part_from_camera, *(a.part_from_camera for a in result.alternatives))
    off = [magnitudes(error(pose)) for pose in poses]
    after = accuracy(error(poses[0]), result.uncertainty)
    after["beyond_by_chance"] = beyond_by_chance(result.uncertainty)
    if case.kind == "equal":
        after["times_cramer_rao"] = times_cramer_rao(case, poses[0])
    return row | {
        "after": after,
        "before": accuracy(error(before.part_from_camera), uncertainty(before, part.center)),
        "listed": any(deg < LISTED_DEG and mm < LISTED_MM for deg, mm in off),
        "pitch_off": is_a_pitch_off(case.challenge, poses[0], case.truth),
    }


def case_names(views: int, parts: Sequence[str], kinds: Sequence[str]) -> list[CaseName]:
    """The cases of a study, first those of the first view of each kind and part."""
    return [
        CaseName(part, kind, view * KINDS[kind].per_view + number)
        for view in range(views)
        for kind in kinds
        for number in range(KINDS[kind].per_view)
        for part in parts
        if part in VANES or kind != "crop"
    ]


def attempted(name: CaseName, seed: int) -> dict[str, Any] | None:
    """The row of a case as a record holds it; None where the scan has too few points."""
    case = make_case(*name, seed)
    if len(case.points) < 2 * MIN_POINTS:
        return None
    return plain(attempt(case, seed), study.DIGITS)


def kept_rows(path: Path, head: Mapping[str, Any]) -> dict[CaseName, dict[str, Any]]:
    """Rows of a record, if there is one of the same seed and of the same unchanged source."""
    if not path.exists():
        return {}
    record = read_json(path)
    if str(head["commit"] or "+").endswith("+"):
        return {}
    if any(record.get(name) != head[name] for name in SAME_SOURCE):
        return {}
    rows = record.get("rows", [])
    return {CaseName(row["part"], row["kind"], row["number"]): row for row in rows}


def _start_worker() -> None:
    """One thread for linear algebra; stops with the study, which alone answers to Ctrl-C."""
    threadpool_limits(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """All cases, in ``jobs`` processes.

    Raises:
      InputError: a part or a kind that is none; or ``--out`` cannot be read or written.
    """
    for what, names, known in (("part", settings.parts, PARTS), ("kind", settings.kinds, KINDS)):
        if unknown := [name for name in names if name not in known]:
            raise InputError(f"no {what} {', '.join(unknown)}; there are {', '.join(known)}")
    names = case_names(settings.views, settings.parts, settings.kinds)
    head = study.header("register, no guess, no training", settings)
    del head["config"]["jobs"]  # no result depends on it
    kept = kept_rows(settings.out / "castings.json", head)
    rows = {name: kept[name] for name in names if name in kept}

    def save() -> dict[str, Any]:
        in_order = [rows[name] for name in names if name in rows]
        return study.save(settings.out, "castings", head | summarize(in_order))

    pool = ProcessPoolExecutor(
        settings.jobs, multiprocessing.get_context("spawn"), initializer=_start_worker
    )
    try:
        waiting = {
            pool.submit(attempted, name, settings.seed): name for name in names if name not in rows
        }
        done = tqdm(
            as_completed(waiting), "registering", len(names), initial=len(rows), unit="scan"
        )
        for future in done:
            if (row := future.result()) is not None:
                rows[waiting[future]] = row
                save()  # what there is counts if the command is stopped
    finally:
        pool.shutdown(cancel_futures=True)
    report = save()
    save_figure(picture(report), settings.out / "castings.png")
    print(table(report))
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("castings", __doc__)
    parser.add_argument(
        "--views",
        type=study.count,
        default=6,
        help=f"per part and kind (6); {KINDS['crop'].per_view} times as many are cropped",
    )
    parser.add_argument(
        "--jobs", type=study.count, default=cores(), help="processes (one for each core)"
    )
    for name, known in (("parts", PARTS), ("kinds", KINDS)):
        parser.add_argument(
            f"--{name}", type=_names, default=list(known), help=f"of {', '.join(known)} (all)"
        )
    return parser


def _names(text: str) -> list[str]:
    return text.split(",")
