"""RMSE and FFMDE over the density of the points at a fixed pose error: the paper's Fig. 1.

python -m experiments.density [--views 0,52,116,168] [--draws 4]

Virtual scans of the guide vane lie on samples of its CAD surface, at the true pose and beside it.
First the number of CAD points is varied, then the scan's own: without noise, with the paper's on
both clouds, and with it on the scan alone, as a CAD model has none. A pose's error is the same at
every density. Results: a table, a verdict, density.json and density.png in ``--out``.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import textwrap
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from scipy.spatial import cKDTree
from tqdm import tqdm

from experiments.runner import study_command as study
from experiments.runner.vane_views import VaneViews, perturb
from experiments.studies.density.report import (
    CANCELLED,
    LEGEND,
    SETTLED,
    TOLD_SHARE,
    TOLD_STD,
    picture,
    table,
    verdict,
)
from experiments.studies.verdicts.report import area_under_roc
from vanejax.errors import InputError
from vanejax.matching.metrics import ffmde_abs, ffmde_signed, rmse
from vanejax.plotting.canvas import save_figure
from vanejax.training.pairs import PairSampling

CAD_POINTS = tuple(2**power for power in range(8, 18))
SCAN_POINTS = tuple(4**power for power in range(4, 9))
FIXED_CAD, FIXED_SCAN = 8192, 4096  # of the cloud that is not varied
ERRORS = ((0.0, 0.0), (0.25, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 4.0))  # deg, mm at the centre
NOISE = PairSampling().noise  # the paper's
METRICS = ("rmse_mm", "ffmde_abs_mm", "ffmde_signed_mm")


@dataclasses.dataclass(frozen=True, eq=False)
class Sweep:
    """One cloud's number of points varied: S sizes, all E of `ERRORS`, D draws.

    Attributes:
      varied: "CAD" or "scan".
      cad_noise, scan_noise: standard deviations, unit-sphere units.
      cad_points, scan_points: [S].
      values: of each of `METRICS` [S, E, D], mm.
    """

    varied: str
    cad_noise: float
    scan_noise: float
    cad_points: Sequence[int]
    scan_points: Sequence[int]
    values: dict[str, np.ndarray]

    @property
    def sizes(self) -> Sequence[int]:
        """Of the cloud that is varied."""
        return self.cad_points if self.varied == "CAD" else self.scan_points

    def score(self, metric: str) -> np.ndarray:
        """[S, E, D] what a user would compare: the size of the metric, mm."""
        return np.abs(self.values[metric])


def fit(scan: np.ndarray, tree: cKDTree, normals: np.ndarray) -> dict[str, float]:
    """`METRICS` in mm of scan points [N, 3] in the part's frame on the tree's with normals [M, 3].

    The neighbours are `vanejax.matching.metrics.nearest_offsets`, found by a tree for large clouds.
    """
    nearest = tree.query(scan, workers=-1)[1]
    metrics = _metrics((tree.data[nearest] - scan).astype(np.float32), normals[nearest])
    return {name: float(value) for name, value in metrics.items()}


@jax.jit
def _metrics(offsets: jax.Array, normals: jax.Array) -> dict[str, jax.Array]:
    every = np.ones(len(offsets), bool)
    return {
        "rmse_mm": rmse(offsets, every),
        "ffmde_abs_mm": ffmde_abs(offsets, normals, every),
        "ffmde_signed_mm": ffmde_signed(offsets, normals, every),
    }


def jittered(
    points: np.ndarray, noise: float, unit_mm: float, rng: np.random.Generator
) -> np.ndarray:
    """Points [N, 3] mm, each coordinate with the clipped normal noise of `vanejax.training.pairs`.

    ``noise`` is in unit-sphere units, ``unit_mm`` the length of one.
    """
    clip = PairSampling().noise_clip
    return points + unit_mm * np.clip(noise * rng.standard_normal(points.shape), -clip, clip)


def measure(
    views: VaneViews,
    which: Sequence[int],
    varied: str,
    sizes: Sequence[int],
    cad_noise: float,
    scan_noise: float,
    *,
    draws: int,
    seed: int,
) -> Sweep:
    """All draws of all ``which`` views at all sizes; a scan with fewer points is taken whole.

    Poses depend on view, draw and error only; each draw has its own points and noise (standard
    deviations in unit-sphere units).
    """
    part, shape = views.part, (len(sizes), len(ERRORS), len(which) * draws)
    values = {name: np.empty(shape) for name in METRICS}
    scans = {view: views.points(view) for view in which}
    counts = [s if varied == "CAD" else FIXED_CAD for s in sizes]
    fewest = min(map(len, scans.values()))
    taken = [min(s if varied == "scan" else FIXED_SCAN, fewest) for s in sizes]
    label = f"{varied} points, noise {cad_noise:g} and {scan_noise:g}"
    for d, (view, draw) in enumerate(tqdm(list(itertools.product(which, range(draws))), label)):
        rng = np.random.default_rng([seed, view, draw])
        truth = views.truth(view)
        poses = [perturb(truth, part, deg=deg, mm=mm, rng=rng) for deg, mm in ERRORS]
        for s, (num_cad, num_scan) in enumerate(zip(counts, taken, strict=True)):
            rng = np.random.default_rng([seed, view, draw, num_cad, num_scan])
            points, normals, _ = part.sample(num_cad, int(rng.integers(2**31)))
            tree = cKDTree(jittered(points, cad_noise, part.radius, rng))
            chosen = scans[view][rng.choice(len(scans[view]), num_scan, replace=False)]
            scan = jittered(chosen, scan_noise, part.radius, rng)
            for e, pose in enumerate(poses):
                for name, value in fit(pose.apply(scan), tree, normals.astype(np.float32)).items():
                    values[name][s, e, d] = value
    return Sweep(varied, cad_noise, scan_noise, counts, taken, values)


def share_distinguished(score: np.ndarray) -> np.ndarray:
    """[S, E] share of the draws that score above the true pose's mean by `TOLD_STD` or more.

    In standard deviations of the true pose's draws at the same size, of scores [S, E, D]. Not in
    those of the wrong poses, whose directions make them differ the more the larger the error is.
    """
    limit = score[:, 0].mean(axis=1) + TOLD_STD * score[:, 0].std(axis=1, ddof=1)
    return np.mean(score > limit[:, None, None], axis=2)


def first_of_rest(sizes: Sequence[int], good: np.ndarray) -> int | None:
    """The size from which on all are good [S]; None if the last is not."""
    bad = np.flatnonzero(~good)
    first = int(bad[-1]) + 1 if len(bad) else 0
    return None if first == len(good) else int(sizes[first])


def ranked_right(score: np.ndarray) -> list[float]:
    """[E] how often a wrong pose scores above the true one, each at any of the sizes; ties half.

    The area under the ROC curve of a threshold for a density nobody controls, scores [S, E, D].
    """
    return [area_under_roc(score[:, e].ravel(), score[:, 0].ravel()) for e in range(len(score[0]))]


def cancellation(sweep: Sweep) -> list[dict[str, float]]:
    """For each error: in how many draws of all sizes the signed FFMDE cancels, and the worst."""
    signed, size = (
        sweep.score(metric).swapaxes(0, 1).reshape(len(ERRORS), -1)
        for metric in ("ffmde_signed_mm", "ffmde_abs_mm")
    )
    ratio = signed / np.maximum(size, 1e-9)
    return [
        {
            "share": float(np.mean(ratio[e] < CANCELLED)),
            "worst_signed_mm": float(signed[e, worst]),
            "worst_abs_mm": float(size[e, worst]),
        }
        for e, worst in enumerate(np.argmin(ratio, axis=1))
    ]


def summarize(sweep: Sweep, area_mm2: float) -> dict[str, Any]:
    """A sweep for JSON: means and spreads of the scores, and what they say of each metric."""
    report: dict[str, Any] = {
        "varied": sweep.varied,
        "cad_noise": sweep.cad_noise,
        "scan_noise": sweep.scan_noise,
        "errors": [{"deg": deg, "mm": mm} for deg, mm in ERRORS],
        "cad_points": list(sweep.cad_points),
        "scan_points": list(sweep.scan_points),
        "cad_spacing_mm": [float(np.sqrt(area_mm2 / count)) for count in sweep.cad_points],
        "draws": sweep.values["rmse_mm"].shape[2],
        "cancellation": cancellation(sweep),
        "signed_mean_mm": sweep.values["ffmde_signed_mm"].mean(axis=2),
    }
    errors, sizes = range(len(ERRORS)), sweep.sizes
    for name in METRICS:
        score = sweep.score(name)
        mean, share = score.mean(axis=2), share_distinguished(score)
        settled = np.abs(mean - mean[-1:]) <= SETTLED * mean[-1:]
        settled[-1] = np.abs(mean[-1] - mean[-2]) <= SETTLED * mean[-1]  # or it always would be
        report[name] = {
            "mean": mean,
            "std": score.std(axis=2, ddof=1),
            # of the power law that the mean follows
            "slope": np.polyfit(np.log(sizes), np.log(np.maximum(mean, 1e-9)), 1)[0],
            "coarsest_over_finest": mean[0] / np.maximum(mean[-1], 1e-9),
            "settled_from": [first_of_rest(sizes, settled[:, e]) for e in errors],
            "told_share": share,
            "told_from": [first_of_rest(sizes, share[:, e] >= TOLD_SHARE) for e in errors],
            "ranked_right": ranked_right(score),
        }
    return report


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """The study: each cloud varied, without and with noise.

    Raises:
      InputError: fewer than two draws, whose spread is not known; a view that is not there.
    """
    views = VaneViews()
    which = views.select(settings.views)
    if len(which) * settings.draws < 2:
        raise InputError("a spread needs two draws: more views or --draws")
    report = study.header("RMSE and FFMDE over density", settings, views.part)
    area = float(views.part.triangles.areas().sum())
    sweeps = []
    for case in (
        ("CAD", CAD_POINTS, 0.0, 0.0),
        ("CAD", CAD_POINTS, NOISE, NOISE),
        ("CAD", CAD_POINTS, 0.0, NOISE),
        ("scan", SCAN_POINTS, 0.0, 0.0),
        ("scan", SCAN_POINTS, NOISE, NOISE),
    ):
        sweep = measure(views, which, *case, draws=settings.draws, seed=settings.seed)
        sweeps.append(summarize(sweep, area))
        print(table(sweeps[-1]), end="\n\n")
    words = verdict(sweeps)
    print(f"{LEGEND}\n\n{textwrap.fill(words, 100)}")
    report = study.save(settings.out, "density", report | {"sweeps": sweeps, "verdict": words})
    save_figure(picture(sweeps), settings.out / "density.png")
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("density", __doc__)
    parser.add_argument("--views", default="0,52,116,168", help="test (54), all (216), or numbers")
    parser.add_argument("--draws", type=study.count, default=4, help="of each view (4)")
    return parser
