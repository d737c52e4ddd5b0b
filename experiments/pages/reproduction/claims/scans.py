"""Scans: the virtual scanner, and metrics over density."""

from __future__ import annotations

import numpy as np

from experiments.pages.reproduction.claim import (
    Finding,
    Report,
    Topic,
    Verdict,
    claim,
    digits,
    met_if,
)
from experiments.studies.density.report import STEADY, TO_TELL
from vanejax.scanner import Camera, hemisphere_viewpoints

PAPER_VIEWS, PAPER_TEST_VIEWS = 216, 54  # Algorithm 1, section III.D
PAPER_FIELD_OF_VIEW_DEG = 41.9  # section III.B, eq. 3
PAPER_RESOLUTION = (1280, 1024)  # Table 2

# ---- virtual scans


@claim(
    "views of the virtual data set, and how many test it",
    f"{PAPER_VIEWS} views, {PAPER_TEST_VIEWS} for the test",
    place="Algorithm 1, section III.D",
)
def _views() -> Finding:
    # what a training run scans: the same call as in `experiments.runner.vane_views`
    viewpoints = hemisphere_viewpoints(np.zeros(3))
    counts = len(viewpoints), int(viewpoints.is_test.sum())
    return Finding(
        f"{counts[0]} views, {counts[1]} for the test",
        met_if(counts == (PAPER_VIEWS, PAPER_TEST_VIEWS)),
        "The viewpoints lie on the intended sphere, not where the printed formula puts them.",
    )


@claim(
    "the virtual camera has the real one's resolution and field of view",
    f"{PAPER_RESOLUTION[0]} x {PAPER_RESOLUTION[1]}, {PAPER_FIELD_OF_VIEW_DEG:g} deg",
    place="Table 2, eq. 3",
)
def _camera() -> Finding:
    camera = Camera()
    same_angle = abs(camera.fov_x_deg - PAPER_FIELD_OF_VIEW_DEG) < 0.1
    return Finding(
        f"{camera.width} x {camera.height}, {camera.fov_x_deg:.1f} x {camera.fov_y_deg:.1f} deg",
        met_if(same_angle and (camera.width, camera.height) == PAPER_RESOLUTION),
        "The paper's angle is that of the width, not of the diagonal as eq. 3 says; the height has "
        "its own.",
    )


@claim(
    "a near-real data set is generated quickly",
    "no figure",
    "benchmark",
    place="sections I and III",
)
def _quickly(benchmark: Report) -> Finding:
    row = next(r for r in benchmark["rows"] if r["name"].startswith("scan, "))
    peers = "; ".join(
        f"{entry['ratio']:.1f} times as fast as {entry['name']}"
        for entry in row["against"]
        if entry["kind"] == "peer" and entry["ratio"]
    )
    return Finding(
        f"{digits(row['seconds']['median'])} s for {PAPER_VIEWS} views",
        Verdict.INCOMPARABLE,
        f"The paper gives no time; {peers or 'no other program was timed in the same run'}.",
    )


# ---- metrics over density


def _changes(density: Report, metric: str) -> list[float]:
    sweeps = [sweep for sweep in density["sweeps"] if sweep["varied"] == "CAD"]
    return [sweep[metric]["coarsest_over_finest"][TO_TELL] for sweep in sweeps]


@claim(
    "RMSE falls with the density of the points at the same registration",
    "curve without figures",
    "density",
    place="Fig. 1",
)
def _rmse_falls(density: Report) -> Finding:
    changes = _changes(density, "rmse_mm")
    first = next(sweep for sweep in density["sweeps"] if sweep["varied"] == "CAD")
    error, sizes = first["errors"][TO_TELL], first["cad_points"]
    return Finding(
        f"falls {min(changes):.1f} to {max(changes):.1f} times",
        met_if(min(changes) > STEADY),
        f"At a fixed pose error of {error['deg']:g} deg and {error['mm']:g} mm, from "
        f"{sizes[0]:,} to {sizes[-1]:,} CAD points, with {len(changes)} kinds of noise.",
    )


@claim("FFMDE is free of the density of the points", "stated", "density", place="Fig. 2, eq. 2")
def _ffmde_is_free(density: Report) -> Finding:
    ffmde, rmse = (_changes(density, name) for name in ("ffmde_abs_mm", "rmse_mm"))
    steadier = sum(f < r for f, r in zip(ffmde, rmse, strict=True))
    free = max(ffmde) < STEADY
    return Finding(
        f"falls {min(ffmde):.1f} to {max(ffmde):.1f} times",
        met_if(free, partly=steadier == len(ffmde)),
        f"{'It is free of density' if free else 'It is not free of density'}, but changes less "
        f"than RMSE in {steadier} of {len(ffmde)} cases, at the same fixed pose error.",
    )


TOPICS = (
    Topic(
        "scanner", "Virtual scans: Table 2, Algorithm 1, Figs 4 to 6", (_views, _camera, _quickly)
    ),
    Topic("density", "Metrics and density: Figs 1 and 2", (_rmse_falls, _ffmde_is_free)),
)
