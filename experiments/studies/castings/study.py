"""A virtual casting line: how registration and its bounds stand what castings differ by.

python -m experiments.castings [--views 2] [--parts NAME,...] [--kinds NAME,...]

Every case is a single scan of a casting that has stock, is bent, shrunk or broken, by a camera that
may be off, or is of another part. `vanejax.register` seeks the part from no guess, with its default
options; beside it stands what fine registration alone, which takes the part for its CAD model, ends
at from nearly the true pose. An accepted pose is wrong if it is off by more than 0.5 deg or 1 mm,
or than three times its own standard deviation in the weakest direction. Results: a table,
castings.json (written after every case) and castings.png in ``--out``.
"""

from __future__ import annotations

import argparse
import functools
import time
from typing import Any

import numpy as np
from tqdm import tqdm

from experiments.runner import study_command as study
from experiments.runner.vane_views import magnitudes, perturb, pose_error
from experiments.studies.castings.casting_line import KINDS, PARTS, VANES, Case, make_case, sought
from experiments.studies.castings.report import picture, summarize, table
from experiments.studies.verdicts.challenge_parts import ChallengePart
from vanejax.errors import InputError
from vanejax.localization.covariance import uncertainty
from vanejax.localization.fine_registration import refine
from vanejax.localization.pose_result import BOUND, Uncertainty
from vanejax.localization.registration import register
from vanejax.localization.residuals import MeasurementModel, measurement_model
from vanejax.plotting.canvas import save_figure
from vanejax.rigid import RigidTransform
from vanejax.scans.measured_scan import MIN_POINTS, MeasuredScan

START_DEG, START_MM = 1.0, 1.0  # of fine registration alone, from the truth
LISTED_DEG, LISTED_MM = 1.5, 1.5  # competing poses are not refined


@functools.cache
def _model(name: str) -> MeasurementModel:
    return measurement_model(sought(name).part, np.zeros(3))


def nearest_error(
    challenge: ChallengePart, pose: RigidTransform, truth: RigidTransform
) -> np.ndarray:
    """[6] the error against the nearest right pose, as `Uncertainty` defines it."""
    part = challenge.part
    errors = [
        pose_error(pose, RigidTransform.from_matrix(symmetry) @ truth, part.center)
        for symmetry in challenge.symmetries
    ]
    ways = [part.radius * np.linalg.norm(e[:3]) + np.linalg.norm(e[3:]) for e in errors]
    return errors[int(np.argmin(ways))]


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
        "rotation_over_bound": rotation_deg / stated.rotation_bound_deg,
        "translation_over_bound": translation_mm / stated.translation_bound_mm,
    }


def attempt(case: Case, seed: int) -> dict[str, Any]:
    """One case: what was found, how far off, and what was said of it."""
    part = case.challenge.part
    scan = MeasuredScan(case.points, None, np.zeros(3), f"{case.part}, {case.kind}, {case.number}")
    began = time.perf_counter()
    result = register(scan, part, calibration=case.calibration, seed=seed)
    seconds = time.perf_counter() - began
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
        "after": None,
        "before": None,
        "listed": False,
    }
    if case.truth is None:
        return row
    rng = np.random.default_rng([seed, case.number])
    start = perturb(case.truth, part, deg=START_DEG, mm=START_MM, rng=rng)
    before = refine(_model(case.part), case.points, start, seed=seed)
    error = functools.partial(nearest_error, case.challenge, truth=case.truth)
    poses = (result.part_from_camera, *(a.part_from_camera for a in result.alternatives))
    off = [magnitudes(error(pose)) for pose in poses]
    return row | {
        "after": accuracy(error(poses[0]), result.uncertainty),
        "before": accuracy(error(before.part_from_camera), uncertainty(before, part.center)),
        "listed": any(deg < LISTED_DEG and mm < LISTED_MM for deg, mm in off),
    }


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """All cases, one after the other.

    Raises:
      InputError: a part or a kind that is none.
    """
    for what, names, known in (("part", settings.parts, PARTS), ("kind", settings.kinds, KINDS)):
        if unknown := [name for name in names if name not in known]:
            raise InputError(f"no {what} {', '.join(unknown)}; there are {', '.join(known)}")
    cases = [
        (part, kind, number)
        for number in range(settings.views)
        for kind in settings.kinds
        for part in settings.parts
        if part in VANES or kind != "crop"
    ]
    head = study.header("register, no guess, no training", settings)
    rows: list[dict[str, Any]] = []
    report: dict[str, Any] = {}
    for part, kind, number in tqdm(cases, "registering", unit="scan"):
        case = make_case(part, kind, number, settings.seed)
        if len(case.points) < 2 * MIN_POINTS:
            continue
        rows.append(attempt(case, settings.seed))
        # after every case: what there is counts if the command is stopped
        report = study.save(settings.out, "castings", head | summarize(rows))
    save_figure(picture(report), settings.out / "castings.png")
    print(table(report))
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("castings", __doc__)
    parser.add_argument("--views", type=study.count, default=2, help="per part and kind (2)")
    for name, known in (("parts", PARTS), ("kinds", KINDS)):
        parser.add_argument(
            f"--{name}", type=_names, default=list(known), help=f"of {', '.join(known)} (all)"
        )
    return parser


def _names(text: str) -> list[str]:
    return text.split(",")
