"""What an evaluation says in numbers: a dict for JSON and a table for the eye."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from experiments.runner.registrations import Results
from vanejax.matching.metrics import mean_per_axis, mean_per_view, summary
from vanejax.training import ScanSet

MEASURES = {
    "rotation_error_deg": "rotation error (deg)",
    "translation_error_mm": "translation error (mm)",
    "rmse_mm": "RMSE, eq. 1 (mm)",
    "ffmde_abs_mm": "FFMDE, absolute (mm)",
    "ffmde_signed_mm": "FFMDE, signed, eq. 2 (mm)",
    "time_s": "time (s)",
}


def hardest_views(scans: ScanSet) -> np.ndarray:
    """Indices of the least visible view of each elevation, in its order (paper, section III.D)."""
    elevation, fraction = scans.viewpoints.elevation_deg, scans.visible_fraction
    return np.array(
        [
            np.flatnonzero(elevation == level)[np.argmin(fraction[elevation == level])]
            for level in np.unique(elevation)
        ]
    )


def summarize(results: Results, scans: ScanSet) -> dict[str, Any]:
    """Figures over all views and over the hardest, and a row for each view.

    A view counts as not finite where its pose or any measure is; such views are left out of means
    and counted beside them.
    """
    errors, fit = results.errors, results.fit
    columns = {
        "rotation_error_deg": errors.rotation_deg,
        "translation_error_mm": errors.translation_mm,
        "rmse_mm": fit.rmse_mm,
        "ffmde_signed_mm": fit.ffmde_signed_mm,
        "ffmde_abs_mm": fit.ffmde_abs_mm,
        "time_s": results.time_s,
        "mre_deg": np.asarray(mean_per_view(errors.rotation_axes_deg)),
        "mte_mm": np.asarray(mean_per_view(errors.translation_axes_mm)),
    }
    finite = np.all([np.isfinite(column) for column in columns.values()], axis=0)
    hardest = hardest_views(scans)
    rows = [
        {
            "elevation_deg": scans.viewpoints.elevation_deg[view],
            "azimuth_deg": scans.viewpoints.azimuth_deg[view],
            "visible_fraction": scans.visible_fraction[view],
            "source_points": results.pairs.source.mask[view].sum(),
            "converged": results.registration.converged[view],
        }
        | {name: column[view] for name, column in columns.items()}
        | {
            "rotation_error_axes_deg": errors.rotation_axes_deg[view],
            "translation_error_axes_mm": errors.translation_axes_mm[view],
        }
        for view in range(len(scans))
    ]
    truth = results.fit_at_truth
    return {
        "views": len(scans),
        "non_finite_views": int(np.sum(~finite)),
        "summary": {name: summary(column) for name, column in columns.items()},
        "mre_per_axis_deg": mean_per_axis(errors.rotation_axes_deg[finite]),
        "mte_per_axis_mm": mean_per_axis(errors.translation_axes_mm[finite]),
        "at_true_pose": {
            "rmse_mm": summary(truth.rmse_mm),
            "ffmde_signed_mm": summary(truth.ffmde_signed_mm),
            "ffmde_abs_mm": summary(truth.ffmde_abs_mm),
        },
        "hardest": {
            "rows": hardest,
            "summary": {name: summary(column[hardest]) for name, column in columns.items()},
        },
        "rows": rows,
    }


def table(report: dict[str, Any]) -> str:
    """The report as aligned text."""
    lines = [f"{report['part']['name']}: {report['method']}"]
    for title, part in (
        (f"{report['views']} test views", report["summary"]),
        (f"{len(report['hardest']['rows'])} hardest views", report["hardest"]["summary"]),
    ):
        columns = ("mean", "median", "p95", "max")
        lines += ["", f"{title:<28}" + "".join(f"{column:>10}" for column in columns)]
        for name, label in MEASURES.items():
            values = "".join(_cell(part[name][column]) for column in columns)
            lines.append(f"  {label:<26}{values}")
    axes = [("MRE, eq. 8 (deg)", "mre_per_axis_deg"), ("MTE, eq. 9 (mm)", "mte_per_axis_mm")]
    lines += ["", f"{'mean error per axis':<28}{'x':>10}{'y':>10}{'z':>10}"]
    for label, name in axes:
        lines.append(f"  {label:<26}" + "".join(map(_cell, report[name])))
    floor = report["at_true_pose"]
    lines += [
        "",
        "At the true pose, density and noise of the points alone give a mean RMSE of "
        f"{_cell(floor['rmse_mm']['mean']).strip()} mm",
        f"and a mean absolute FFMDE of {_cell(floor['ffmde_abs_mm']['mean']).strip()} mm.",
    ]
    if report["non_finite_views"]:
        lines += [
            "",
            f"WARNING: {report['non_finite_views']} of {report['views']} views gave numbers that "
            "are not finite; the figures above leave them out.",
        ]
    return "\n".join(lines)


def _cell(value: float | None) -> str:
    return f"{'-':>10}" if value is None else f"{value:>10.4f}"


def plain(value: Any, digits: int = 17) -> Any:
    """What strict JSON can hold: no arrays, None where not finite, so many significant digits."""
    if isinstance(value, dict):
        return {name: plain(entry, digits) for name, entry in value.items()}
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return plain(np.asarray(value).tolist(), digits)
    if isinstance(value, list | tuple):
        return [plain(entry, digits) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if np.isfinite(value) else None
    return value
