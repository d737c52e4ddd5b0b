"""The pictures of an evaluation: which figures of `vanejax.plotting` it draws, and of what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from experiments.runner.evaluation_report import hardest_views
from experiments.runner.registrations import Results
from vanejax import plotting
from vanejax.cad import Part
from vanejax.scanner import Camera, Scan, Scanner, Viewpoints, hemisphere_viewpoints
from vanejax.training import ScanSet

PORTRAIT_PIXELS = 2.0  # times the camera's per side: the picture is printed larger than a scan
SURFACE_SAMPLES = 100_000  # so dense that hidden surface looks as solid as seen one
PORTRAIT_DISTANCE = 6.0  # times the part's radius: the near plane must not cut it


def draw(
    results: Results,
    scans: ScanSet,
    part: Part,
    camera: Camera,
    log: Sequence[Mapping[str, float]],
    folder: Path,
) -> None:
    """Errors, the hardest views and what they see (Fig. 5), and, with a log, its curves."""
    errors, views, hardest = results.errors, scans.viewpoints, hardest_views(scans)
    scanner = Scanner(part, surface_samples=SURFACE_SAMPLES)
    shadows, seen = shadow_picture(scanner, camera, views, hardest)
    fine = camera.scaled(PORTRAIT_PIXELS)
    shown = overlay(results, scans, hardest[0])
    figures = {
        "overlays": plotting.registration_overlays(
            [overlay(results, scans, view) for view in hardest]
        ),
        "error_map": plotting.error_map(
            views.elevation_deg, views.azimuth_deg, errors.rotation_deg, errors.translation_mm
        ),
        "axis_errors": plotting.axis_errors(
            {
                "registration": plotting.AxisErrors(
                    rotation_deg=errors.rotation_axes_deg,
                    translation_mm=errors.translation_axes_mm,
                )
            }
        ),
        "view_and_shadow": shadows,
        "overview": plotting.overview_picture(portrait(scanner, fine), fine, seen[0], shown),
    }
    if log:
        figures["training_curves"] = plotting.training_curves(log)
    for name, figure in figures.items():
        plotting.save_figure(figure, folder / f"{name}.png")


def portrait(scanner: Scanner, camera: Camera) -> Scan:
    """The part as the reader of an overview sees it."""
    part = scanner.part
    eye = hemisphere_viewpoints(
        part.center,
        distance_mm=max(PORTRAIT_DISTANCE * part.radius, camera.near_mm + 1.1 * part.radius),
        elevations_deg=(plotting.READER_ELEVATION_DEG,),
        azimuths_deg=(plotting.READER_AZIMUTH_DEG,),
    )
    return scanner.scan(camera, eye.view(0))


def shadow_picture(
    scanner: Scanner, camera: Camera, views: Viewpoints, shown: Sequence[int]
) -> tuple[Figure, list[Scan]]:
    """What some views see and what the part hides from them, the paper's Fig. 5; their scans."""
    scans = [scanner.scan(camera, views.view(view), hidden=True) for view in shown]
    names = [
        plotting.view_name(views.elevation_deg[view], views.azimuth_deg[view]) for view in shown
    ]
    return plotting.view_and_shadow(scans, names), scans


def overlay(results: Results, scans: ScanSet, view: int) -> plotting.Overlay:
    """One registration as the figures want it: real points only, in mm."""
    source, target = results.pairs.source, results.pairs.target
    points = source.xyz[view][source.mask[view]]
    moved, true = (
        points @ pose.rotation[view].T + pose.translation[view]
        for pose in (results.registration.target_from_source, results.pairs.target_from_source)
    )
    return plotting.Overlay(
        source=scans.radius_mm * points,
        moved=scans.radius_mm * moved,
        true=scans.radius_mm * true,
        reference=scans.radius_mm * target.xyz[view][target.mask[view]],
        elevation_deg=scans.viewpoints.elevation_deg[view],
        azimuth_deg=scans.viewpoints.azimuth_deg[view],
        visible_fraction=scans.visible_fraction[view],
        rotation_error_deg=float(results.errors.rotation_deg[view]),
        translation_error_mm=float(results.errors.translation_mm[view]),
    )
