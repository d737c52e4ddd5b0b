"""Virtual scans: the viewpoints, the camera, and how long they take."""

from __future__ import annotations

import numpy as np

from experiments.pages.reproduction.claim import Claim, Finding, Results, Verdict, digits, met_if
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.topic import Part, Picture, Topic, origin
from vanejax.scanner.camera import Camera, hemisphere_viewpoints

PAPER_VIEWS, PAPER_TEST_VIEWS = 216, 54  # Algorithm 1, section III.D
PAPER_FIELD_OF_VIEW_DEG = 41.9  # section III.B, eq. 3
PAPER_RESOLUTION = (1280, 1024)  # Table 2


def _views(_: Results) -> Finding:
    # what a training run scans: the same call as in `experiments.runner.vane_views`
    viewpoints = hemisphere_viewpoints(np.zeros(3))
    found = len(viewpoints), int(viewpoints.is_test.sum())
    same = found == (PAPER_VIEWS, PAPER_TEST_VIEWS)
    return Finding(
        f"{found[0]} views, {found[1]} for the test",
        met_if(same),
        "The same viewpoints and the same split"
        + (
            ", by the intended sphere, not by the printed formula." if same else " do not come out."
        ),
    )


def _camera(_: Results) -> Finding:
    camera = Camera()
    angle = abs(camera.fov_x_deg - PAPER_FIELD_OF_VIEW_DEG) < 0.1
    return Finding(
        f"{camera.width} x {camera.height}, {camera.fov_x_deg:.1f} x {camera.fov_y_deg:.1f} deg",
        met_if(angle and (camera.width, camera.height) == PAPER_RESOLUTION),
        "The paper's angle is that of the width, not of the diagonal as eq. 3 says; the height has "
        "its own.",
    )


def _quickly(results: Results) -> Finding:
    row = next(r for r in results["benchmark"]["rows"] if r["name"].startswith("scan, "))
    seconds = row["seconds"]["median"]
    peers = "; ".join(
        f"{entry['ratio']:.1f} times as fast as {entry['name']}"
        for entry in row["against"]
        if entry["kind"] == "peer" and entry["ratio"]
    )
    return Finding(
        f"{digits(seconds)} s for {PAPER_VIEWS} views",
        Verdict.INCOMPARABLE,
        f"The paper names no time; {peers or 'no other program was timed beside it'}.",
    )


def _scanner(results: Results, live: Live | None) -> list[Part]:
    parts: list[Part] = [
        "A hemisphere of viewpoints 400 mm around the part's centre, elevations 60 to 85 deg by 5, "
        "azimuths 0 to 350 deg by 10; a pixel is a ray that Embree casts at the CAD model, so what "
        "the part hides from the camera is not in the scan. Azimuths 0, 40, ... 320 deg are for "
        "the test.",
        Picture(
            "Six virtual scans of the guide vane in green with the self-occluded surface in red",
            "What the camera sees (green) and what the part hides from it (red), for the least "
            "visible test view of each elevation." + (" Drawn for this page." if live else ""),
            run="vane/view_and_shadow.png",
        ),
    ]
    if live is None:
        parts.append(
            Picture(
                "The guide vane, a virtual scan with its shadow, and a registration",
                "From CAD model to registration: the part, a scan (green) with what the part hides "
                "(red), and the same scan registered.",
                docs="overview.png",
            )
        )
    if "sensor_effects" in results:
        parts += [
            Picture(
                "Each effect of the virtual sensor alone on the guide vane",
                "Beyond the paper's z-buffer: each effect of the virtual structured-light camera.",
                docs="sensor_effects.png",
                run="sensor_effects/sensor_effects.png",
            ),
            origin(results, "sensor_effects"),
        ]
    return parts


SCANNER = Topic(
    "Virtual scans: Table 2, Algorithm 1, Figs 4 to 6",
    (
        Claim(
            "views of the virtual data set, and how many test it",
            f"{PAPER_VIEWS} views, {PAPER_TEST_VIEWS} for the test",
            (),
            _views,
            place="Algorithm 1, section III.D",
        ),
        Claim(
            "the virtual camera has the real one's resolution and field of view",
            f"{PAPER_RESOLUTION[0]} x {PAPER_RESOLUTION[1]}, {PAPER_FIELD_OF_VIEW_DEG:g} deg",
            (),
            _camera,
            place="Table 2, eq. 3",
        ),
        Claim(
            "a near-real data set is generated quickly",
            "no figure",
            ("benchmark",),
            _quickly,
            place="sections I and III",
        ),
    ),
    _scanner,
)
