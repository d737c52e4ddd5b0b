"""Fine registration against the Cramer-Rao bound, over views of the guide vane and noise levels.

python -m experiments.fine [--noise-mm 0.05,0.1,0.2,0.5,1] [--views test] [--basin]

Every view is scanned at full resolution with white noise along the rays and refined from a random
pose of given size beside the true one. ``--basin`` asks instead from how far away that works.
Results: a table, fine.json and fine.png (basin.json) in ``--out``.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from scipy import stats
from tqdm import tqdm

from experiments.runner import study_command as study
from experiments.runner.vane_views import VaneViews, error_row, perturb, pose_error, with_noise
from vanejax.localization import RayCasting, refine
from vanejax.localization.covariance import uncertainty
from vanejax.localization.pose_batch import stack
from vanejax.plotting import canvas
from vanejax.rigid import RigidTransform

NOISE_MM = (0.05, 0.1, 0.2, 0.5, 1.0)
PAPER = {"rotation_deg": 0.142, "translation_mm": 0.692}
MOST_RMS_RATIO, MOST_VIEW_RATIO = 1.3, 4.0
BASIN_DEG, BASIN_MM, BASIN_NOISE_MM = (5.0, 10.0, 20.0, 30.0, 45.0), (5.0, 10.0, 20.0), 0.1
BASIN_STRIDE = 3  # of the views: 18 of the 54
ARRIVED_DEG, ARRIVED_MM = 0.05, 0.05


def cramer_rao(
    model: RayCasting, points: np.ndarray, truth: RigidTransform, noise_mm: float
) -> np.ndarray:
    """[6, 6] the least covariance that any unbiased estimate of the pose can have.

    The inverse of ``J^T J / noise^2`` with the derivatives J of the ranges of all rays that hit, at
    the true pose; points [N, 3] are free of noise.
    """
    ideal = model.residuals(stack(truth), points)
    rows = ideal.jacobian[0][ideal.hit[0]] / ideal.cosine[0][ideal.hit[0], None]
    return np.linalg.inv(rows.T @ rows) * noise_mm**2


def against_bound(error: np.ndarray, bound: np.ndarray, covariance: np.ndarray) -> dict[str, float]:
    """An error [6], as `pose_error` has it, beside what was possible and what was reported.

    Args:
      error: rad, then mm.
      bound: [6, 6], of `cramer_rao`; the roots of its traces are the least possible rms errors.
      covariance: [6, 6], reported; ``squared`` is e^T C^-1 e, chi-square of 6 if it is right.
    """
    return {
        **error_row(error),
        "rotation_bound_deg": float(np.degrees(np.sqrt(np.trace(bound[:3, :3])))),
        "translation_bound_mm": float(np.sqrt(np.trace(bound[3:, 3:]))),
        "squared": float(error @ np.linalg.solve(covariance, error)),
    }


def refine_view(
    views: VaneViews,
    view: int,
    ideal: np.ndarray,
    *,
    noise_mm: float,
    start: tuple[float, float],
    seed: int,
) -> dict[str, Any]:
    """A row: noise is added to a view's ideal points [N, 3], which are then refined.

    ``start`` is how far from the true pose that begins: degrees and mm.
    """
    rng = np.random.default_rng([seed, view, round(1e6 * noise_mm)])  # levels are independent
    part, truth = views.part, views.truth(view)
    beside = perturb(truth, part, deg=start[0], mm=start[1], rng=rng)
    points = with_noise(ideal, noise_mm, rng)
    began = time.perf_counter()
    found = refine(views.model, points, beside)
    seconds = time.perf_counter() - began
    error = pose_error(found.part_from_camera, truth, part.center)
    bound = cramer_rao(views.model, ideal, truth, noise_mm)
    return {
        "view": view,
        **against_bound(error, bound, uncertainty(found, part.center).covariance),
        "noise_mm": found.noise_mm,
        "converged": found.converged,
        "iterations": found.iterations,
        "points": found.num_points,
        "seconds": seconds,
    }


def summarize(rows: Sequence[dict[str, Any]], noise_mm: float) -> dict[str, Any]:
    """One noise level: errors against the bound, and whether the covariance says the truth."""
    column = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    views, squared = len(rows), column["squared"]
    report: dict[str, Any] = {"noise_mm": noise_mm, "views": views}
    for name in PAPER:
        each, least = column[name], column["_bound_".join(name.split("_"))]
        error, bound = (float(np.sqrt(np.mean(values**2))) for values in (each, least))
        report[name] = {
            "rms": error,
            "max": float(each.max()),
            "bound": bound,
            "ratio": error / bound,
            "worst_view_ratio": float((each / least).max()),
            "paper_mean": PAPER[name],
        }
    tails = (0.025, 0.975)
    return report | {
        "anees": float(squared.mean() / 6),
        "anees_interval_95": [stats.chi2.ppf(q, 6 * views) / (6 * views) for q in tails],
        "coverage_95": float(np.mean(squared < stats.chi2.ppf(0.95, 6))),
        "coverage_interval_95": [stats.binom.ppf(q, views, 0.95) / views for q in tails],
        "noise_estimate_ratio": float(np.mean(column["noise_mm"]) / noise_mm),
        "converged": float(np.mean(column["converged"])),
        "seconds": study.spread([row["seconds"] for row in rows]),
        "points": study.spread([row["points"] for row in rows]),
        "rows": list(rows),
    }


def measure(views: VaneViews, settings: argparse.Namespace) -> list[dict[str, Any]]:
    """All noise levels on the chosen views; `summarize` of each."""
    rows: dict[float, list[dict[str, Any]]] = {noise: [] for noise in settings.noise_mm}
    start = (settings.start_deg, settings.start_mm)
    for view in tqdm(views.select(settings.views), "refining", unit="view"):
        ideal = views.points(view)
        for noise, of_noise in rows.items():
            of_noise.append(
                refine_view(views, view, ideal, noise_mm=noise, start=start, seed=settings.seed)
            )
    return [summarize(of_noise, noise) for noise, of_noise in rows.items()]


def basin(
    views: VaneViews, which: Sequence[int], seed: int, *, degrees: Sequence[float] = BASIN_DEG
) -> list[dict[str, Any]]:
    """For each size of the start: the share of the views that arrive within 0.05 deg, 0.05 mm."""
    starts = list(itertools.product(degrees, BASIN_MM))
    arrived: dict[tuple[float, float], list[bool]] = {start: [] for start in starts}
    for view in tqdm(which, "refining", unit="view"):
        ideal = views.points(view)
        for number, start in enumerate(starts):
            row = refine_view(
                views, view, ideal, noise_mm=BASIN_NOISE_MM, start=start, seed=seed + number
            )
            arrived[start].append(
                row["rotation_deg"] < ARRIVED_DEG and row["translation_mm"] < ARRIVED_MM
            )
    return [
        {"start_deg": deg, "start_mm": mm, "views": len(which), "arrived": float(np.mean(share))}
        for (deg, mm), share in arrived.items()
    ]


def table(levels: Sequence[dict[str, Any]]) -> str:
    """The noise levels as aligned text, and whether the goals are met."""
    lines = []
    for name, unit in (("rotation_deg", "deg"), ("translation_mm", "mm")):
        title = f"{name.split('_')[0]} error"
        lines.append(
            f"{title:<22}{f'rms ({unit})':>14}{'bound':>12}{'ratio':>8}{'worst view':>12}"
            f"{'paper, mean':>14}"
        )
        for level in levels:
            row = level[name]
            lines.append(
                f"  noise {level['noise_mm']:<6g} mm      {row['rms']:>14.5f}{row['bound']:>12.5f}"
                f"{row['ratio']:>8.2f}{row['worst_view_ratio']:>12.2f}{row['paper_mean']:>14.3f}"
            )
        lines.append("")
    lines.append(
        f"{'reported covariance':<22}{'ANEES':>8}{'95 % of it':>14}{'in ellipsoid':>14}"
        f"{'noise est.':>12}{'converged':>11}{'time (s)':>20}"
    )
    for level in levels:
        low, high = level["anees_interval_95"]
        time_s = level["seconds"]
        span = f"{time_s['median']:.2f} ({time_s['min']:.2f}-{time_s['max']:.2f})"
        lines.append(
            f"  noise {level['noise_mm']:<6g} mm      {level['anees']:>8.2f}"
            f"{f'{low:.2f}-{high:.2f}':>14}{level['coverage_95']:>14.1%}"
            f"{level['noise_estimate_ratio']:>12.3f}{level['converged']:>11.0%}{span:>20}"
        )
    points = levels[0]["points"]
    return "\n".join([*lines, "", f"{points['median']:,.0f} points (median)", _goals(levels)])


def _goals(levels: Sequence[dict[str, Any]]) -> str:
    rows = [level[name] for level in levels for name in PAPER]
    ratio, worst = (max(row[k] for row in rows) for k in ("ratio", "worst_view_ratio"))
    met = ratio <= MOST_RMS_RATIO and worst <= MOST_VIEW_RATIO
    return (
        f"{'met' if met else 'MISSED'}: rms at most {ratio:.2f} times the bound (goal "
        f"{MOST_RMS_RATIO}), a view at most {worst:.2f} times (goal {MOST_VIEW_RATIO:g})"
    )


def basin_table(rows: Sequence[dict[str, Any]]) -> str:
    """Shares that arrive over the start's size."""
    degrees = sorted({row["start_deg"] for row in rows})
    share = {(row["start_deg"], row["start_mm"]): row["arrived"] for row in rows}
    lines = [
        f"arrived within {ARRIVED_DEG} deg and {ARRIVED_MM} mm, {rows[0]['views']} views, "
        f"{BASIN_NOISE_MM} mm noise",
        f"{'start':>10}" + "".join(f"{f'{deg:g} deg':>9}" for deg in degrees),
    ]
    for mm in sorted({row["start_mm"] for row in rows}):
        lines.append(f"{f'{mm:g} mm':>10}" + "".join(f"{share[deg, mm]:>9.0%}" for deg in degrees))
    return "\n".join(lines)


def picture(levels: Sequence[dict[str, Any]]) -> Figure:
    """Errors over noise with the bound as a line, and how often the ellipsoid holds the truth."""
    noise = [level["noise_mm"] for level in levels]
    figure = canvas.new_figure(canvas.WIDTH_IN, 2.8)
    *errors, covered = figure.subplots(1, 3)
    for axes, (name, paper) in zip(errors, PAPER.items(), strict=True):
        kind, unit = name.split("_")
        each = [[row[name] for row in level["rows"]] for level in levels]
        for x, values in zip(noise, each, strict=True):
            axes.plot([x] * len(values), values, ".", color=canvas.FAINT, markersize=3, alpha=0.5)
        bound, rms = ([level[name][key] for level in levels] for key in ("bound", "rms"))
        axes.plot(noise, bound, color=canvas.INK, label="bound")
        axes.plot(noise, rms, "o", color=canvas.OURS, markersize=4, label="ours, rms")
        axes.axhline(paper, color=canvas.PAPER, linestyle="--", label="paper, mean")
        _over_noise(axes, noise, f"{kind} error", f"error ({unit})")
        axes.set_yscale("log")
    low, high = levels[0]["coverage_interval_95"]
    shares = [level["coverage_95"] for level in levels]
    covered.axhspan(low, high, color=canvas.FAINT, alpha=0.25, linewidth=0, label="95 % of chance")
    covered.plot(noise, shares, "o-", color=canvas.OURS, markersize=4)
    _over_noise(covered, noise, "truth in the 95 % ellipsoid", "share of the views")
    covered.set_ylim(0, 1.03)
    canvas.add_legend(covered, loc="lower left")
    canvas.add_legend(figure, loc="outside lower left", ncols=3)
    return figure


def _over_noise(axes: Axes, noise_mm: Sequence[float], title: str, ylabel: str) -> None:
    """Labels, and a logarithmic axis with the noise levels themselves as ticks."""
    canvas.style_chart(axes, title=title, xlabel="noise along the ray (mm)", ylabel=ylabel)
    axes.set_xscale("log")
    axes.set_xticks(noise_mm, [f"{level:g}" for level in noise_mm])
    axes.xaxis.set_minor_locator(NullLocator())


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """The study, or with ``settings.basin`` how far away a start may be."""
    views = VaneViews()
    method = "ray casting, Gauss-Newton from beside the true pose"
    report = study.header(method, settings, views.part)
    if settings.basin:
        rows = basin(views, views.select(settings.views)[::BASIN_STRIDE], settings.seed)
        report = study.save(settings.out, "basin", report | {"basin": rows})
        print(basin_table(rows))
        return report
    levels = measure(views, settings)
    report = study.save(settings.out, "fine", report | {"levels": levels})
    canvas.save_figure(picture(levels), settings.out / "fine.png")
    print(table(levels))
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("fine", __doc__)
    parser.add_argument("--noise-mm", type=study.positive_numbers, default=NOISE_MM)
    parser.add_argument("--views", default="test", help="test (54), all (216), or numbers: 0,4,8")
    parser.add_argument("--start-deg", type=float, default=5.0, help="how far the start is turned")
    parser.add_argument("--start-mm", type=float, default=5.0, help="how far it is moved")
    parser.add_argument("--basin", action="store_true", help="vary the start, not the noise")
    return parser
