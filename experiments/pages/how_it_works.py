"""The pictures of docs/how_it_works.md: scanner, scene, casting, matching, fine registration."""

from __future__ import annotations

import jax
import numpy as np
from matplotlib.figure import Figure

from experiments.runner.evaluation_pictures import SURFACE_SAMPLES, shadow_picture
from vanejax import plotting
from vanejax.cad import InvestmentCasting, Part, as_cast, guide_vane
from vanejax.localization import PoseResult, register
from vanejax.plotting.canvas import (
    INK,
    PAPER,
    SERIES,
    WIDTH_IN,
    add_legend,
    new_figure,
    style_chart,
)
from vanejax.plotting.deviation import casting_map
from vanejax.plotting.matching import Matching, matching_lines
from vanejax.plotting.sensing import segments_picture
from vanejax.rigid import RigidTransform
from vanejax.scanner import (
    Camera,
    Clutter,
    Scanner,
    Viewpoints,
    clutter_scene,
    hemisphere_viewpoints,
    measure,
    preset,
)
from vanejax.scans import MeasuredScan, clean_scan, segment
from vanejax.training import TrainedMatcher, draw_pairs, find_weights, make_bank, make_scan_set
from vanejax.training.weight_file import PRETRAINED

SEED = 0
VIEW = 20  # of the 216: elevation 60, azimuth 200 deg, a test view
SHOWN = (0, 20, 85)  # views whose shadow is drawn


def viewpoints_picture(sphere: Viewpoints, printed: Viewpoints, center: np.ndarray) -> Figure:
    """Where the cameras stand, seen from above, and how far away the printed formula puts them."""
    figure = new_figure(WIDTH_IN, 3.5)
    above, away = figure.subplots(1, 2)
    place = sphere.position - center
    kinds = (
        ("training (162)", ~sphere.is_test, SERIES[0], "o"),
        ("test (54)", sphere.is_test, SERIES[1], "^"),
    )
    for name, which, color, marker in kinds:
        x, y = place[which, :2].T
        above.scatter(x, y, s=14, color=color, marker=marker, label=name, linewidths=0)
    above.set_aspect("equal")
    style_chart(above, title="cameras from above", xlabel="part's x (mm)", ylabel="part's y (mm)")
    above.scatter(0, 0, marker="+", color=INK, s=50, label="the part's centre")
    for elevation, line in ((60.0, "-"), (85.0, "--")):
        for name, views, color in (("sphere", sphere, INK), ("as printed", printed, PAPER)):
            row = views.elevation_deg == elevation
            distance = np.linalg.norm(views.position[row] - center, axis=1)
            label = f"{name}, elevation {elevation:g}°"
            away.plot(views.azimuth_deg[row], distance, line, color=color, label=label)
    title = "distance from the part's centre (Algorithm 1)"
    style_chart(away, title=title, xlabel="azimuth (deg)", ylabel="distance (mm)")
    away.set_xticks(range(0, 361, 90))
    for axes, columns in ((above, 3), (away, 2)):
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.15)}
        add_legend(axes, ncols=columns, columnspacing=1.0, **below)
    return figure


def registered(scanner: Scanner, part: Part, views: Viewpoints) -> tuple[PoseResult, MeasuredScan]:
    """One scan of the scanner's part by the paper's camera, registered to a CAD model."""
    rng = np.random.default_rng(SEED)
    measured = measure(scanner, preset("paper_camera"), views.view(VIEW), rng)
    scan = clean_scan(measured.points)
    return register(scan, part, seed=SEED), scan


def scene_picture(views: Viewpoints) -> Figure:
    """A table, clamps and chips around the part, and what the segmentation takes for the part."""
    part = guide_vane()
    rng = np.random.default_rng(SEED)
    scene = clutter_scene(part, Clutter(table=True, clamps=2, chips=12), rng)
    camera = Camera()
    scan = scene.scanner().scan(camera, views.view(VIEW))
    segments = segment(scan.points.astype(np.float64), part, sensor_origin=np.zeros(3), seed=SEED)
    return segments_picture(scan, camera, scene, segments)


def matching_picture(matcher: TrainedMatcher, part: Part, views: Viewpoints) -> Figure:
    """The soft assignment of a noisy test view by the untrained and by the trained network."""
    view = views.select(np.array([VIEW]))
    scans = make_scan_set(part, matcher.camera, view, voxel_mm=matcher.voxel_mm, progress=False)
    bank = make_bank(scans, num_reference=matcher.sampling.num_reference)
    pairs = draw_pairs(jax.random.key(SEED), bank, np.array([0]), matcher.sampling)
    source, truth = jax.tree.map(lambda leaf: leaf[0], (pairs.source, pairs.target_from_source))
    model, start = matcher.model, RigidTransform.identity()
    untrained = model.init(jax.random.key(SEED), source, pairs.target, start, 1)
    real = np.asarray(source.mask)
    place = part.radius * np.asarray(truth.apply(source.xyz))[real]
    target = part.radius * np.asarray(pairs.target.xyz)
    shown = {}
    for name, variables in (("untrained", untrained), ("trained", matcher.variables)):
        (match,) = model.apply(variables, source, pairs.target, start, 1)
        assignment = np.exp(np.asarray(match.log_assignment))[real]
        shown[f"{name}, first iteration"] = Matching(place, target, assignment)
    return matching_lines(shown)


def pictures() -> dict[str, Figure]:
    """By file name, all of them."""
    part = guide_vane()
    scanner = Scanner(part, surface_samples=SURFACE_SAMPLES)
    sphere = hemisphere_viewpoints(part.center)
    printed = hemisphere_viewpoints(part.center, formula="printed")
    result, scan = registered(scanner, part, sphere)
    cast, flatter = (
        as_cast(part, InvestmentCasting(waviness_mm=wave), np.random.default_rng(SEED))
        for wave in (0.15, 0.1)
    )
    of_cast, cast_scan = registered(Scanner(flatter), part, sphere)
    return {
        "how_viewpoints.png": viewpoints_picture(sphere, printed, part.center),
        "how_shadow.png": shadow_picture(scanner, Camera(), sphere, SHOWN)[0],
        "how_scene.png": scene_picture(sphere),
        "how_casting.png": casting_map(part, cast),
        "how_matching.png": matching_picture(find_weights(PRETRAINED, part), part, sphere),
        "how_deviation.png": plotting.deviation_map(result, scan, part),
        "how_form.png": plotting.deviation_map(of_cast, cast_scan, part),
        "how_residuals.png": plotting.residual_histogram(result),
    }
