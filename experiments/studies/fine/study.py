"""Fine registration against the Cramer-Rao bound, over views of the guide vane and noise levels.

python -m experiments.fine [--noise-mm 0.05,0.1,0.2,0.5,1] [--views test] [--basin]

Every view is scanned at full resolution with white noise along the rays and refined from a random
pose of given size beside the true one. ``--basin`` asks instead from how far away that works.
Results: a table, fine.json and fine.png (basin.json) in ``--out``.
"""

from __future__ import annotations

import argparse
import dataclasses
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
from experiments.runner.vane_views import VaneViews, magnitudes, perturb, pose_error, with_noise
from vanejax.localization.covariance import uncertainty
from vanejax.localization.fine_registration import refine
from vanejax.localization.pose_batch import stack
from vanejax.localization.residuals import RayCasting
from vanejax.plotting.canvas import (
    FAINT,
    INK,
    OURS,
    WIDTH_IN,
    add_legend,
    new_figure,
    save_figure,
    style_chart,
)
from vanejax.plotting.canvas import (
    PAPER as PAPER_COLOR,
)
from vanejax.rigid import RigidTransform

NOISE_MM = (0.05, 0.1, 0.2, 0.5, 1.0)
PAPER = {"rotation_deg": 0.142, "translation_mm": 0.692}
MOST_RMS_RATIO, MOST_VIEW_RATIO = 1.3, 4.0
BASIN_DEG, BASIN_MM, BASIN_NOISE_MM = (5.0, 10.0, 20.0, 30.0, 45.0), (5.0, 10.0, 20.0), 0.1
BASIN_STRIDE = 3  # of the views: 18 of the 54
ARRIVED_DEG, ARRIVED_MM = 0.05, 0.05


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """One refinement of one view.

    Attributes:
      view: its index.
      error: [6] rad and mm, see `experiments.runner.vane_views.pose_error`.
      bound: [6, 6] the Cramer-Rao bound on the covariance of `error`.
      covariance: [6, 6] what the refinement reports.
      noise_mm: what it estimates.
      converged, iterations, num_points: as it reports.
      seconds: wall time.
    """

    view: int
    error: np.ndarray
    bound: np.ndarray
    covariance: np.ndarray
    noise_mm: float
    converged: bool
    iterations: int
    num_points: int
    seconds: float

    @property
    def bound_magnitudes(self) -> tuple[float, float]:
        """The smallest possible rms error in deg and mm: roots of the bound's traces."""
        turn, shift = np.trace(self.bound[:3, :3]), np.trace(self.bound[3:, 3:])
        return float(np.degrees(np.sqrt(turn))), float(np.sqrt(shift))

    @property
    def squared(self) -> float:
        """The error's normalised square, e^T C^-1 e; chi-square of 6 if the covariance is right."""
        return float(self.error @ np.linalg.solve(self.covariance, self.error))


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


def refine_view(
    views: VaneViews,
    view: int,
    ideal: np.ndarray,
    *,
    noise_mm: float,
    start_deg: float,
    start_mm: float,
    seed: int,
) -> Fit:
    """Adds noise to the ideal points [N, 3] of a view and refines from beside the true pose."""
    rng = np.random.default_rng([seed, view, round(1e6 * noise_mm)])  # levels are independent
    part, truth = views.part, views.truth(view)
    start = perturb(truth, part, deg=start_deg, mm=start_mm, rng=rng)
    points = with_noise(ideal, noise_mm, rng)
    began = time.perf_counter()
    refinement = refine(views.model, points, start)
    seconds = time.perf_counter() - began
    return Fit(
        view=view,
        error=pose_error(refinement.part_from_camera, truth, part.center),
        bound=cramer_rao(views.model, ideal, truth, noise_mm),
        covariance=uncertainty(refinement, part.center).covariance,
        noise_mm=refinement.noise_mm,
        converged=refinement.converged,
        iterations=refinement.iterations,
        num_points=refinement.num_points,
        seconds=seconds,
    )


def summarize(fits: Sequence[Fit], noise_mm: float) -> dict[str, Any]:
    """One noise level: errors against the bound, and whether the covariance says the truth."""
    errors = np.array([magnitudes(fit.error) for fit in fits])
    bounds = np.array([fit.bound_magnitudes for fit in fits])
    squared = np.array([fit.squared for fit in fits])
    count = 6 * len(fits)
    report: dict[str, Any] = {"noise_mm": noise_mm, "views": len(fits)}
    for k, name in enumerate(PAPER):
        error, bound = (float(np.sqrt(np.mean(v[:, k] ** 2))) for v in (errors, bounds))
        report[name] = {
            "rms": error,
            "max": float(errors[:, k].max()),
            "bound": bound,
            "ratio": error / bound,
            "worst_view_ratio": float((errors[:, k] / bounds[:, k]).max()),
            "paper_mean": PAPER[name],
        }
    return report | {
        "anees": float(squared.mean() / 6),
        "anees_interval_95": [stats.chi2.ppf(q, count) / count for q in (0.025, 0.975)],
        "coverage_95": float(np.mean(squared < stats.chi2.ppf(0.95, 6))),
        "coverage_interval_95": [
            stats.binom.ppf(q, len(fits), 0.95) / len(fits) for q in (0.025, 0.975)
        ],
        "noise_estimate_ratio": float(np.mean([fit.noise_mm for fit in fits]) / noise_mm),
        "converged": float(np.mean([fit.converged for fit in fits])),
        "seconds": study.spread([fit.seconds for fit in fits]),
        "points": study.spread([fit.num_points for fit in fits]),
        "rows": [
            {
                "view": fit.view,
                "rotation_deg": error[0],
                "translation_mm": error[1],
                "rotation_bound_deg": bound[0],
                "translation_bound_mm": bound[1],
                "squared": fit.squared,
                "noise_mm": fit.noise_mm,
                "converged": fit.converged,
                "iterations": fit.iterations,
                "points": fit.num_points,
                "seconds": fit.seconds,
            }
            for fit, error, bound in zip(fits, errors, bounds, strict=True)
        ],
    }


def measure(views: VaneViews, settings: argparse.Namespace) -> list[dict[str, Any]]:
    """All noise levels on the chosen views; `summarize` of each."""
    fits: dict[float, list[Fit]] = {noise: [] for noise in settings.noise_mm}
    for view in tqdm(views.select(settings.views), "refining", unit="view"):
        ideal = views.points(view)
        for noise, of_noise in fits.items():
            fit = refine_view(
                views, view, ideal, noise_mm=noise, start_deg=settings.start_deg,
                start_mm=settings.start_mm, seed=settings.seed,
            )  # fmt: skip
            of_noise.append(fit)
    return [summarize(of_noise, noise) for noise, of_noise in fits.items()]


def basin(
    views: VaneViews, which: Sequence[int], seed: int, *, degrees: Sequence[float] = BASIN_DEG
) -> list[dict[str, Any]]:
    """For each size of the start: the share of the views that arrive within 0.05 deg, 0.05 mm."""
    sizes = list(itertools.product(degrees, BASIN_MM))
    arrived: dict[tuple[float, float], list[bool]] = {size: [] for size in sizes}
    for view in tqdm(which, "refining", unit="view"):
        ideal = views.points(view)
        for number, (deg, mm) in enumerate(sizes):
            fit = refine_view(
                views, view, ideal, noise_mm=BASIN_NOISE_MM, start_deg=deg, start_mm=mm,
                seed=seed + number,
            )  # fmt: skip
            turn, shift = magnitudes(fit.error)
            arrived[deg, mm].append(turn < ARRIVED_DEG and shift < ARRIVED_MM)
    return [
        {
            "start_deg": deg,
            "start_mm": mm,
            "views": len(of_size),
            "arrived": float(np.mean(of_size)),
        }
        for (deg, mm), of_size in arrived.items()
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
    figure = new_figure(WIDTH_IN, 2.8)
    panels = figure.subplots(1, 3)
    for axes, name, unit in zip(panels, PAPER, ("deg", "mm"), strict=False):
        style_chart(
            axes, title=f"{name.split('_')[0]} error", xlabel="noise along the ray (mm)",
            ylabel=f"error ({unit})",
        )  # fmt: skip
        each = [[row[name] for row in level["rows"]] for level in levels]
        for x, values in zip(noise, each, strict=True):
            axes.plot([x] * len(values), values, ".", color=FAINT, markersize=3, alpha=0.5)
        axes.plot(noise, [level[name]["bound"] for level in levels], color=INK, label="bound")
        axes.plot(
            noise, [level[name]["rms"] for level in levels], "o", color=OURS, markersize=4,
            label="ours, rms",
        )  # fmt: skip
        axes.axhline(PAPER[name], color=PAPER_COLOR, linestyle="--", label="paper, mean")
        _noise_axis(axes, noise)
        axes.set_yscale("log")
    style_chart(
        panels[2], title="truth in the 95 % ellipsoid", xlabel="noise along the ray (mm)",
        ylabel="share of the views",
    )  # fmt: skip
    low, high = levels[0]["coverage_interval_95"]
    panels[2].axhspan(low, high, color=FAINT, alpha=0.25, linewidth=0, label="95 % of chance")
    shares = [level["coverage_95"] for level in levels]
    panels[2].plot(noise, shares, "o-", color=OURS, markersize=4)
    _noise_axis(panels[2], noise)
    panels[2].set_ylim(0, 1.03)
    add_legend(panels[2], loc="lower left")
    add_legend(figure, loc="outside lower left", ncols=3)
    return figure


def _noise_axis(axes: Axes, noise_mm: Sequence[float]) -> None:
    """Logarithmic, with the levels themselves as ticks."""
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
    save_figure(picture(levels), settings.out / "fine.png")
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
