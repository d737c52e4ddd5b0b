"""Figures hold the data they were given, nothing is clipped, and files appear whole."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import trimesh
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text

from vanejax import plotting
from vanejax.cad import part_from_mesh
from vanejax.errors import InputError
from vanejax.plotting.canvas import CAD, SCAN
from vanejax.plotting.clouds import seen_and_hidden
from vanejax.plotting.matching import Matching, matching_lines
from vanejax.plotting.shading import crop
from vanejax.scanner import Camera, Scan, Scanner, hemisphere_viewpoints

CAMERA = Camera().scaled(0.1)
HALF_SIZES = np.array([40.0, 30.0, 20.0])


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    """Four views of a box with corners at plus and minus `HALF_SIZES` mm."""
    box = trimesh.creation.box(2 * HALF_SIZES)
    scanner = Scanner(part_from_mesh(box.vertices, box.faces, name="box"), surface_samples=2000)
    views = hemisphere_viewpoints(np.zeros(3), elevations_deg=(60, 85), azimuths_deg=(20, 200))
    return [scanner.scan(CAMERA, views.view(view), hidden=True) for view in range(4)]


def overlay(seed: int = 0) -> plotting.Overlay:
    rng = np.random.default_rng(seed)
    reference = rng.uniform(-50, 50, (60, 3))
    return plotting.Overlay(
        source=reference[:20] + np.array([30, -40, 10]),
        moved=reference[:20] + 0.5,
        true=reference[:20],
        reference=reference,
        elevation_deg=65.0,
        azimuth_deg=120.0,
        visible_fraction=0.374,
        rotation_error_deg=0.456,
        translation_error_mm=1.234,
    )


def views(elevations: int, azimuths: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Elevation and azimuth, azimuth in the inner loop, and two error values, each [V]."""
    elevation = np.repeat(60.0 + 5 * np.arange(elevations), azimuths)
    azimuth = np.tile(40.0 * np.arange(azimuths), elevations)
    return elevation, azimuth, 0.1 + np.arange(len(azimuth)), 2.0 + np.arange(len(azimuth))


def log(steps: int = 200) -> list[dict[str, float]]:
    training = [
        {
            "step": step,
            "loss": 3 / step,
            "rotation_error_deg": 40 / step,
            "translation_error_mm": 20 / step,
        }
        for step in range(10, 10 * steps, 10)
    ]
    validation = [
        {"step": step, "validation_rotation_error_deg": 1.5, "validation_translation_error_mm": 2}
        for step in range(250, 10 * steps, 250)
    ]
    return training + validation


def axis_errors(count: int, seed: int = 0) -> plotting.AxisErrors:
    rng = np.random.default_rng(seed)
    return plotting.AxisErrors(rng.uniform(0, 2, (count, 3)), rng.uniform(0, 3, (count, 3)))


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


# ---------------------------------------------------------------- every figure


def matchings(count: int) -> Figure:
    cloud = overlay().true
    return matching_lines(
        {f"after {number} steps": Matching(cloud, cloud, np.eye(20)) for number in range(count)}
    )


def every_figure(scans: list[Scan]) -> dict[str, Figure]:
    failed = dataclasses.replace(overlay(), moved=np.full((20, 3), np.nan))
    return {
        "overlays": plotting.registration_overlays([overlay(seed) for seed in range(6)]),
        "one overlay": plotting.registration_overlays([overlay()]),
        "failed": plotting.registration_overlays([overlay(), failed]),
        "methods": plotting.method_displacements({"ICP": overlay(), "FGR": failed}),
        "error map": plotting.error_map(*views(6, 9)),
        "full map": plotting.error_map(*views(6, 36)),
        "small map": plotting.error_map(*views(2, 3)),
        "one cell": plotting.error_map(*views(1, 1)),
        "axes": plotting.axis_errors({"RPM-Net": axis_errors(54)}),
        "few axes": plotting.axis_errors({"vane": axis_errors(6), "ModelNet40": axis_errors(6, 1)}),
        "training": plotting.training_curves(log()),
        "short training": plotting.training_curves(log(4)),
        "views": plotting.view_and_shadow(scans, [plotting.view_name(60, 20)] * 4),
        "part": plotting.part_picture(scans[0], CAMERA),
        "overview": plotting.overview_picture(scans[0], CAMERA, scans[1], overlay()),
        **{f"{count} matchings": matchings(count) for count in (1, 2, 3)},
    }


def test_nothing_is_clipped_and_no_titles_overlap(scans: list[Scan]) -> None:
    # here alone, not for the whole test: pytest then turns what others left behind into errors
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figures = every_figure(scans)
        for figure in figures.values():
            figure.draw_without_rendering()
    for name, figure in figures.items():
        page = figure.bbox
        words = [text for legend in figure.legends for text in legend.get_texts()]
        for axes in figure.axes:
            words += [axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label]
        titles = []
        for text in words:
            if not text.get_text().strip():
                continue
            box = text.get_window_extent()
            # half a pixel of rounding
            inside = box.x0 > -0.5 and box.y0 > -0.5
            inside &= box.x1 < page.x1 + 0.5 and box.y1 < page.y1 + 0.5
            assert inside, f"{name}: {text.get_text()!r} is clipped"
            titles.append((text.get_text(), box))
        for index, (text, box) in enumerate(titles):
            for other, other_box in titles[:index]:
                assert not box.overlaps(other_box), f"{name}: {text!r} overlaps {other!r}"


def test_figures_leave_no_trace_in_matplotlib(scans: list[Scan]) -> None:
    before = dict(matplotlib.rcParams)
    pyplot.close("all")
    for figure in every_figure(scans).values():
        assert type(figure.canvas) is FigureCanvasAgg
    assert pyplot.get_fignums() == []
    assert dict(matplotlib.rcParams) == before


# ---------------------------------------------------------------- files


def test_save_figure_leaves_whole_files(tmp_path: Path) -> None:
    path = tmp_path / "figure.png"
    path.write_text("an older picture")
    plotting.save_figure(plotting.error_map(*views(2, 3)), path, dpi=40)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["figure.pdf", "figure.png"]


def test_a_figure_that_cannot_be_drawn_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "figure.png"
    path.write_text("an older picture")
    figure = plotting.error_map(*views(2, 3))
    figure.axes[0].set_title("$\\unknown_command$")
    with pytest.raises(ValueError, match="unknown_command"):
        plotting.save_figure(figure, path)
    assert path.read_text() == "an older picture"
    assert [entry.name for entry in tmp_path.iterdir()] == ["figure.png"]


@pytest.mark.parametrize("name", ["figure.jpg", "figure", "missing/figure.png"])
def test_a_path_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="figure"):
        plotting.save_figure(plotting.error_map(*views(1, 2)), tmp_path / name)


# ---------------------------------------------------------------- clouds


def test_overlays_show_both_clouds_before_and_after() -> None:
    figure = plotting.registration_overlays([overlay()])
    before, after = figure.axes
    for axes in (before, after):
        dots = axes.collections[0]
        assert len(dots.get_offsets()) == 80
        colors = dots.get_facecolors()[:, :3]
        # depth only pales a colour: the largest channel tells blue from orange
        assert (np.argmax(colors, axis=1) == np.argmax(to_rgb(SCAN))).sum() == 20
        assert (np.argmax(colors, axis=1) == np.argmax(to_rgb(CAD))).sum() == 60
        assert axes.get_aspect() == 1
    assert before.get_title() == "elevation 65°\nazimuth 120°\n37 % visible"
    assert before.get_xlim() == after.get_xlim()
    assert before.get_ylim() == after.get_ylim()
    assert after.get_title() == "0.46°, 1.23 mm"


def test_overlays_are_seen_without_distortion() -> None:
    """The picture is an orthographic view: a sphere of radius 50 mm fills a disc of 50 mm."""
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    sphere = 50 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    figure = plotting.registration_overlays(
        [dataclasses.replace(overlay(), source=sphere[:5], moved=sphere[:5], reference=sphere)]
    )
    radius = np.linalg.norm(figure.axes[1].collections[0].get_offsets(), axis=1)
    assert radius.max() <= 50 + 1e-9
    assert radius.max() > 49.9  # 4000 points leave no gap of 3 deg at the rim


def test_near_points_are_drawn_over_far_ones() -> None:
    a, b = np.radians([plotting.READER_ELEVATION_DEG, plotting.READER_AZIMUTH_DEG])
    towards_reader = np.array([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)])
    near, far = 10 * towards_reader[None], -10 * towards_reader[None]
    for source, reference, top in ((near, far, SCAN), (far, near, CAD)):
        pair = dataclasses.replace(overlay(), source=source, moved=source, reference=reference)
        dots = plotting.registration_overlays([pair]).axes[1].collections[0]
        np.testing.assert_allclose(dots.get_facecolors()[-1, :3], to_rgb(top))


def test_methods_are_told_apart_by_how_far_each_leaves_the_points() -> None:
    near, far = overlay(), dataclasses.replace(overlay(), moved=overlay().true + 5.2)
    panels = plotting.method_displacements({"near": near, "far": far}).axes[:2]
    colors = [axes.collections[0].get_facecolors()[:, :3] for axes in panels]
    assert [axes.get_title().splitlines()[0] for axes in panels] == ["near", "far"]
    # 0.87 mm is green, 9 mm nearly the dark end of the scale: a quarter of the dots changes
    assert colors[0].mean() > colors[1].mean() + 0.03
    assert panels[0].get_xlim() == panels[1].get_xlim()


def test_a_failed_registration_says_so() -> None:
    lost = dataclasses.replace(overlay(), moved=np.full((20, 3), np.nan), rotation_error_deg=np.nan)
    after = plotting.registration_overlays([lost]).axes[1]
    assert after.get_title() == "no finite pose"
    assert len(after.collections[0].get_offsets()) == 60


def test_seen_and_hidden_points_lie_on_the_part(scans: list[Scan]) -> None:
    for scan in scans:
        for points in seen_and_hidden(scan, voxel_mm=2.0):
            assert len(points) > 100
            # float32 in the camera frame, 400 mm away: eps x 400 = 5e-5 mm
            np.testing.assert_allclose(np.max(np.abs(points) / HALF_SIZES, axis=1), 1, atol=1e-5)
    seen, hidden = seen_and_hidden(scans[0], voxel_mm=2.0)
    below = hidden[:, 2] < -19.99
    assert below.any()  # the camera is above: the bottom is hidden, and never seen
    assert not (np.abs(seen[:, 2] + 20) < 1e-3)[np.abs(seen[:, :2]).max(axis=1) < 29].any()


# ---------------------------------------------------------------- shaded pictures


def test_shading_covers_exactly_the_pixels_of_the_scan(scans: list[Scan]) -> None:
    image = plotting.shade(scans[0], CAMERA)
    assert image.shape == (CAMERA.height, CAMERA.width, 3)
    flat = image.reshape(-1, 3)
    outside = np.ones(len(flat), bool)
    outside[scans[0].pixel] = False
    assert (flat[outside] == 1).all()
    assert (flat[~outside] < 0.99).all()
    assert image.min() >= 0


def test_faces_of_other_slope_have_other_brightness(scans: list[Scan]) -> None:
    scan = scans[0]
    brightness = plotting.shade(scan, CAMERA).reshape(-1, 3)[scan.pixel].mean(axis=1)
    normals, face = np.unique(np.round(scan.normals, 3), axis=0, return_inverse=True)
    medians = [np.median(brightness[face.ravel() == index]) for index in range(len(normals))]
    assert len(medians) == 3  # an oblique view of a box
    # by eye, a step of 0.02 of full brightness is an edge
    assert min(np.diff(np.sort(medians))) > 0.02


def test_the_picture_is_cropped_to_the_part_with_true_proportions(scans: list[Scan]) -> None:
    rows, columns = crop(scans[0], CAMERA)
    row, column = np.divmod(scans[0].pixel, CAMERA.width)
    assert rows.start < row.min() <= row.max() < rows.stop
    assert columns.start < column.min() <= column.max() < columns.stop
    axes = plotting.part_picture(scans[0], CAMERA).axes[0]
    assert axes.get_aspect() == pytest.approx(CAMERA.fx / CAMERA.fy)


# ---------------------------------------------------------------- charts


def test_the_error_map_puts_values_where_they_belong() -> None:
    elevation, azimuth, rotation, translation = views(3, 4)
    order = np.random.default_rng(0).permutation(12)[:11]  # one view is missing
    figure = plotting.error_map(
        elevation[order], azimuth[order], rotation[order], translation[order]
    )
    for axes, values in zip(figure.axes[:2], (rotation, translation), strict=True):
        cells = axes.images[0].get_array()
        expected = values.reshape(3, 4)
        there = np.isin(np.arange(12), order).reshape(3, 4)
        assert (cells.mask == ~there).all()
        np.testing.assert_array_equal(cells.data[there], expected[there])
        assert [label.get_text() for label in axes.get_xticklabels()] == ["0", "40", "80", "120"]
        assert [label.get_text() for label in axes.get_yticklabels()] == ["60", "65", "70"]


def test_the_error_map_marks_failures_but_not_missing_views() -> None:
    elevation, azimuth, rotation, translation = views(2, 3)
    rotation[4] = np.nan
    shown = texts(plotting.error_map(elevation[1:], azimuth[1:], rotation[1:], translation[1:]))
    assert shown.count("failed") == 1
    assert sum("." in text for text in shown) >= 9  # 4 and 5 numbers


def test_axis_errors_draw_equations_8_to_11() -> None:
    errors = axis_errors(7)
    figure = plotting.axis_errors({"RPM-Net": errors})
    panels = np.array(figure.axes).reshape(2, 2)
    for (bars, lines), values in zip(
        panels, (errors.rotation_deg, errors.translation_mm), strict=True
    ):
        heights = [bar.get_height() for bar in bars.patches]
        np.testing.assert_allclose(heights, values.mean(axis=0), rtol=1e-6)  # f32
        np.testing.assert_allclose(lines.lines[0].get_ydata(), values.mean(axis=1), rtol=1e-6)
        np.testing.assert_array_equal(lines.lines[0].get_xdata(), np.arange(1, 8))


def test_axis_errors_leave_failed_views_out_and_show_them() -> None:
    errors = axis_errors(5)
    errors.rotation_deg[2, 1] = np.nan
    bars, lines = plotting.axis_errors({"RPM-Net": errors}).axes[:2]
    heights = [bar.get_height() for bar in bars.patches]
    finite = np.delete(errors.rotation_deg, 2, axis=0)
    np.testing.assert_allclose(heights, finite.mean(axis=0), rtol=1e-6)  # f32
    np.testing.assert_array_equal(lines.lines[1].get_xdata(), [3])


def test_training_curves_show_logged_values_and_validation() -> None:
    rows = [*log(), {"step": 5, "loss": float("nan")}, {"step": 6, "loss": 0.0}]
    loss, rotation, translation = plotting.training_curves(rows).axes
    steps = np.arange(10, 2000, 10)
    np.testing.assert_array_equal(loss.lines[0].get_xdata(), steps)  # no logarithm of 0 or NaN
    np.testing.assert_allclose(loss.lines[0].get_ydata(), 3 / steps)
    for axes in (rotation, translation):
        np.testing.assert_array_equal(axes.lines[2].get_xdata(), np.arange(250, 2000, 250))
        assert axes.get_yscale() == "log"
    assert len(loss.lines) == 2  # the log has no validation loss


def test_the_smooth_curve_of_an_exponential_is_itself() -> None:
    """A running geometric mean leaves straight lines on a log axis straight, but for the ends."""
    rows = [{"step": step, "loss": float(np.exp(-step / 50))} for step in range(1, 401)]
    smooth = plotting.training_curves(rows).axes[0].lines[1].get_ydata()
    expected = [row["loss"] for row in rows]
    np.testing.assert_allclose(smooth[5:-5], expected[5:-5], rtol=1e-9)  # f64 sums of 400


def test_what_cannot_be_drawn_is_refused(scans: list[Scan]) -> None:
    scan = scans[0]
    for words, draw in (
        (
            "hidden=True",
            lambda: seen_and_hidden(dataclasses.replace(scan, hidden=None), voxel_mm=1),
        ),
        ("at least one scan", lambda: plotting.view_and_shadow([], [])),
        ("at least one registration", lambda: plotting.registration_overlays([])),
        ("at least one registration", lambda: plotting.method_displacements({})),
        ("at least one series", lambda: plotting.axis_errors({})),
        ("at least one matching", lambda: matching_lines({})),
        ("another camera", lambda: plotting.shade(scan, CAMERA.scaled(0.3))),
        ("no loss", lambda: plotting.training_curves([])),
        ("no loss", lambda: plotting.training_curves([{"step": 1, "gradient_norm": 1.0}])),
    ):
        with pytest.raises(InputError, match=words):
            draw()
