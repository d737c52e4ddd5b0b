"""Scans: the virtual scanner, metrics over density, bad conditions and clutter, real scans."""

from __future__ import annotations

import functools

import numpy as np

from experiments.pages.reproduction.claim import (
    Claim,
    Finding,
    Report,
    Topic,
    Verdict,
    claim,
    digits,
    met_if,
    over_floor,
)
from experiments.runner.required_accuracy import NEED_DEG, NEED_MM
from experiments.studies.density.report import STEADY, TO_TELL
from experiments.studies.real_scans import study as real_scans
from experiments.studies.robustness import study as robustness
from experiments.studies.robustness.report import networks, share_within_need, values
from vanejax.scanner.camera import Camera, hemisphere_viewpoints

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


SCANNER = Topic("Virtual scans: Table 2, Algorithm 1, Figs 4 to 6", (_views, _camera, _quickly))

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


DENSITY = Topic("Metrics and density: Figs 1 and 2", (_rmse_falls, _ffmde_is_free))

# ---- bad conditions


def _series(report: Report, name: str) -> Report:
    return next(series for series in report["series"] if series["name"] == name)


def _mean(report: Report, *, series: str, metric: str) -> Finding:
    """The last network's mean over a series after refinement, against the paper's."""
    chosen, network = _series(report, series), networks(report)[-1]
    refined = [values(step, network, "refined", metric) for step in chosen["steps"]]
    truth = [[row["truth"][metric] for row in step["rows"]] for step in chosen["steps"]]
    return over_floor(
        float(np.concatenate(refined).mean()),
        float(np.concatenate(truth).mean()),
        chosen["paper"][metric],
        "the spacing of the CAD points and the camera's noise",
    )


def _paper_mean(report: Report, *, series: str, metric: str) -> str:
    return f"{_series(report, series)['paper'][metric]:.4f} mm"


def _within_need(report: Report, *, series: str) -> Finding:
    steps, network = _series(report, series)["steps"], networks(report)[-1]
    refined, alone = (
        [share_within_need(step, network, stage) for step in steps]
        for stage in ("refined", "alone")
    )
    rotation, translation = (
        max(float(values(step, network, "refined", key).max()) for step in steps)
        for key in ("rotation_deg", "translation_mm")
    )
    holes = max(np.mean([row["hole_share"] for row in step["rows"]]) for step in steps)
    return Finding(
        f"at most {digits(rotation)} deg and {digits(translation)} mm off",
        met_if(min(refined) == 1),
        f"{np.mean(refined):.0%} of the virtual scans are within {NEED_DEG:g} deg and "
        f"{NEED_MM:g} mm after refinement by ray casting, {np.mean(alone):.0%} before it; up "
        f"to {holes:.0%} of the pixels are lost.",
    )


_MEANS = (
    ("a", "distance", "ffmde_abs_mm", "FFMDE"),
    ("b", "distance", "rmse_mm", "RMSE"),
    ("c", "angle", "ffmde_abs_mm", "FFMDE"),
    ("d", "angle", "rmse_mm", "RMSE"),
)
_STEADY = (
    ("a, b", "distance", "all distances", "small fluctuations"),
    ("c, d", "angle", "all angles", "small fluctuations"),
    ("e", "light", "strong light", "no large deviation, by eye"),
)
SENSING = Topic(
    "Distance, angle, strong light: Figs 10 and 11",
    [
        Claim(
            f"mean {words} over the {series}s",
            functools.partial(_paper_mean, series=series, metric=metric),
            functools.partial(_mean, series=series, metric=metric),
            ("robustness",),
            f"Fig. 11 ({letter})",
        )
        for letter, series, metric, words in _MEANS
    ]
    + [
        Claim(
            f"the pose stays right over {words}",
            paper,
            functools.partial(_within_need, series=series),
            ("robustness",),
            f"Fig. 11 ({letters})",
        )
        for letters, series, words, paper in _STEADY
    ],
)

# ---- clutter, castings, random cameras


@claim(
    "scans from anywhere between 300 and 500 mm by random cameras: right",
    f"{robustness.LEAST_RIGHT:.0%}, no wrong one accepted",
    "robustness",
)
def _random_cameras(robustness_record: Report) -> Finding:
    report = robustness_record["random"]
    if not report:
        return Finding("–", Verdict.UNKNOWN, "The study was run without random scans.")
    return Finding(
        f"{report['right']:.1%} of {report['scans']:,}, {report['accepted_wrong']} wrong accepted",
        met_if(report["right"] >= robustness.LEAST_RIGHT and not report["accepted_wrong"]),
        f"Mean {digits(report['rotation_deg']['mean'])} deg and "
        f"{digits(report['translation_mm']['mean'])} mm, {digits(report['seconds']['median'])} s "
        "each (median).",
    )


CLUTTER = Topic("Clutter, castings, noise, random scans", (_random_cameras,))

# ---- real scans


@claim(
    "real depth-camera scans, no training, no guess: right",
    "all, no wrong one accepted",
    "real_scans",
)
def _real(report: Report) -> Finding:
    return Finding(
        f"{report['right']} of {report['scans']}, {report['accepted_wrong']} wrong accepted",
        met_if(report["right"] == report["scans"] and not report["accepted_wrong"]),
        f"Right is within {real_scans.RIGHT_DEG:g} deg and {real_scans.RIGHT_MM:g} mm, of a truth "
        f"good to about 1 deg and 2 mm; {report['accepted']} accepted.",
    )


@claim(
    "virtual scans by the fitted sensor are as near to real ones as these are to each other",
    lambda report: f"{report['real']['distance_of_halves']:.2f}, as two halves of the real scans",
    "sensor_fit",
)
def _likeness(report: Report) -> Finding:
    ideal, fitted = (report["virtual"][name]["distance_held_out"] for name in ("ideal", "all"))
    return Finding(
        f"{fitted:.2f}, an ideal camera {ideal:.2f}",
        met_if(fitted <= report["real"]["distance_of_halves"], partly=fitted < ideal),
        f"Mean logarithmic distance of {len(report['real']['statistics'])} statistics, on scans "
        "that the sensor was not fitted to.",
    )


REAL_SCANS = Topic("Real scans", (_real, _likeness))
