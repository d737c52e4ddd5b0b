"""What `experiments.density` found: a table, the paper's Fig. 1 with FFMDE beside it, a verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from vanejax.plotting.canvas import (
    GRID,
    INK,
    MARKERS,
    SERIES,
    WIDTH_IN,
    add_legend,
    new_figure,
    style_chart,
)

TITLES = {
    "rmse_mm": "RMSE",
    "ffmde_abs_mm": "absolute FFMDE",
    "ffmde_signed_mm": "|FFMDE as printed|",
}
TO_TELL = 2  # of the errors: 0.5 deg and 1 mm in the study
STEADY = 1.1  # largest change that still counts as none
SETTLED = 0.1  # relative, of the finest density's mean
TOLD_STD, TOLD_SHARE = 3.0, 0.9  # so many wrong poses this far above the true pose's mean
CANCELLED = 0.1  # |signed| below this share of the absolute FFMDE
LEGEND = f"""\
slope         exponent of the mean over the number of points
changes       mean at the fewest points over mean at the most
settled       number of points from which on the mean is within {SETTLED:.0%} of its last
told          from which on {TOLD_SHARE:.0%} of draws are {TOLD_STD:g} std above the true pose
any density   how often a wrong pose scores above the true one, each at any number of points"""


def table(sweep: dict[str, Any]) -> str:
    """One sweep of the report as aligned text: a row for each metric and pose error."""
    sizes = sweep["cad_points" if sweep["varied"] == "CAD" else "scan_points"]
    shown = sorted({s * (len(sizes) - 1) // 3 for s in range(4)})
    counts = "".join(f"{f'{sizes[s]:,}':>9}" for s in shown)
    lines = [
        f"{sweep['varied']} points varied, {_noise(sweep)}: mm, means of {sweep['draws']} draws",
        f"{'':<20}{'pose error':>15}{counts}{'slope':>8}{'changes':>9}{'settled':>10}"
        f"{'told':>9}{'any density':>13}",
    ]
    for name, title in TITLES.items():
        entry = sweep[name]
        for e, error in enumerate(sweep["errors"]):
            means = "".join(f"{entry['mean'][s][e]:>9.3f}" for s in shown)
            settled, told = (_cell(entry[k][e]) for k in ("settled_from", "told_from"))
            apart = f"{told:>9}{entry['ranked_right'][e]:>13.0%}" if e else ""
            lines.append(
                f"{'' if e else title:<20}{_pose(error):>15}{means}{entry['slope'][e]:>8.2f}"
                f"{entry['coarsest_over_finest'][e]:>8.1f}x{settled:>10}{apart}"
            )
    return "\n".join(lines)


def picture(sweeps: Sequence[dict[str, Any]]) -> Figure:
    """The metrics over the number of CAD points: a row for each noise, a line for each error."""
    rows = [sweep for sweep in sweeps if sweep["varied"] == "CAD"]
    figure = new_figure(WIDTH_IN, 1.9 * len(rows) + 0.5)
    panels = figure.subplots(len(rows), len(TITLES), sharex=True, sharey="col", squeeze=False)
    for line, sweep in zip(panels, rows, strict=True):
        for axes, (name, title) in zip(line, TITLES.items(), strict=True):
            style_chart(axes, title=f"{title}\n{_noise(sweep)}")
            mean, std = (np.array(sweep[name][key]) for key in ("mean", "std"))
            for e, error in enumerate(sweep["errors"]):
                color = (INK, *SERIES)[e]
                axes.plot(
                    sweep["cad_points"], mean[:, e], f"{MARKERS[e]}-", color=color, markersize=2.8,
                    linewidth=1.0, label=_pose(error),
                )  # fmt: skip
                # half of the mean at the lowest: a logarithm has no room for less than nothing
                low = np.maximum(mean[:, e] - std[:, e], 0.5 * mean[:, e])
                axes.fill_between(
                    sweep["cad_points"], low, mean[:, e] + std[:, e], color=color, alpha=0.12,
                    linewidth=0,
                )  # fmt: skip
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_formatter("{x:,g}")
                axis.set_minor_formatter(NullFormatter())
            axes.grid(axis="x", color=GRID, linewidth=0.6)
        line[0].set_ylabel("mm")
    for axes in panels[-1]:
        axes.set_xlabel("points of the CAD sample")
    add_legend(figure, loc="outside upper center", ncols=5, title="pose error:", title_fontsize=8)
    return figure


def verdict(sweeps: Sequence[dict[str, Any]]) -> str:
    """What the sweeps say of the paper's argument for FFMDE, in one paragraph."""
    cad = [sweep for sweep in sweeps if sweep["varied"] == "CAD"]
    sentences = [_of_cad(sweep) for sweep in cad]
    sentences += [_of_scan(sweep) for sweep in sweeps if sweep["varied"] == "scan"]
    return " ".join([*sentences, _conclusion(cad)])


def _of_cad(sweep: dict[str, Any]) -> str:
    """One noise: how the metrics change, what they tell, how often the sign cancels."""
    e = TO_TELL
    rmse, face, signed = (sweep[name] for name in TITLES)
    pose = _pose(sweep["errors"][e])
    falls = (
        f"{title} falls {entry['coarsest_over_finest'][0]:.1f} times (exponent "
        f"{entry['slope'][0]:.2f}) at the true pose, {entry['coarsest_over_finest'][e]:.1f} times "
        f"at {pose} and {_settles(entry['settled_from'][e])} there"
        for title, entry in (("RMSE", rmse), ("FFMDE", face))
    )
    wrong = sweep["cancellation"][1:]
    worst = min(range(len(wrong)), key=lambda k: wrong[k]["worst_signed_mm"])
    return (
        f"With more CAD points, {_noise(sweep)}, {'; '.join(falls)}. RMSE tells {pose} "
        f"{_from(rmse['told_from'][e])}, FFMDE {_from(face['told_from'][e])}; with the density "
        f"unknown they rank it rightly in {rmse['ranked_right'][e]:.0%} and "
        f"{face['ranked_right'][e]:.0%} of the cases, FFMDE as printed in "
        f"{signed['ranked_right'][e]:.0%}. As printed it cancels below {CANCELLED:.0%} of the "
        f"absolute value in {np.mean([row['share'] for row in wrong]):.0%} of the wrong poses, at "
        f"{_pose(sweep['errors'][worst + 1])} down to {wrong[worst]['worst_signed_mm']:.4f} mm "
        f"where the absolute value is {wrong[worst]['worst_abs_mm']:.3f} mm."
    )


def _of_scan(sweep: dict[str, Any]) -> str:
    changes = [c for name in list(TITLES)[:2] for c in sweep[name]["coarsest_over_finest"]]
    most = max(max(c, 1 / max(c, 1e-9)) for c in changes)
    return (
        f"The scan's own number of points, {_noise(sweep)}, changes the two by a factor of at most "
        f"{most:.2f}: {'it does not matter' if most < STEADY else 'it matters too'}."
    )


def _conclusion(cad: Sequence[dict[str, Any]]) -> str:
    """The parts of the paper's argument, each where it holds."""
    e = TO_TELL

    def cases(holds: Callable[[dict[str, Any], dict[str, Any]], bool]) -> str:
        where = [_noise(sweep) for sweep in cad if holds(sweep["rmse_mm"], sweep["ffmde_abs_mm"])]
        if len(where) == len(cad):
            return "in every case"
        return f"only {' and '.join(where)}" if where else "in no case"

    ranks = cases(lambda rmse, face: face["ranked_right"][e] > rmse["ranked_right"][e])
    steadier = cases(
        lambda rmse, face: face["coarsest_over_finest"][e] < rmse["coarsest_over_finest"][e]
    )
    settled = cases(lambda _, face: face["settled_from"][e] is not None)
    steady = cases(lambda _, face: face["coarsest_over_finest"][e] < STEADY)
    return (
        f"So at a fixed error of {_pose(cad[0]['errors'][e])}, FFMDE ranks poses better than RMSE "
        f"over unequal densities {ranks}; it changes less than RMSE {steadier}; it settles at some "
        f"density {settled}; it is free of density {steady}."
    )


def _noise(sweep: dict[str, Any]) -> str:
    if not sweep["scan_noise"]:
        return "without noise"
    return f"noise {sweep['scan_noise']:g} on {'both clouds' if sweep['cad_noise'] else 'the scan'}"


def _pose(error: dict[str, float]) -> str:
    return f"{error['deg']:g} deg, {error['mm']:g} mm" if error["deg"] else "true pose"


def _cell(count: int | None) -> str:
    return "never" if count is None else f"{count:,}"


def _from(count: int | None) -> str:
    return "at no density" if count is None else f"from {count:,} points on"


def _settles(count: int | None) -> str:
    return "does not settle" if count is None else f"settles from {count:,} points on"
