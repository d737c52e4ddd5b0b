"""What a sensor and a segmentation made of a scan, pixel by pixel."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, SymLogNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from vanejax.errors import InputError
from vanejax.plotting import canvas
from vanejax.plotting.shading import crop_size, draw_part, shade
from vanejax.scanner import Camera, Measurement, Reason, Scan
from vanejax.scanner.clutter import ClutterScene
from vanejax.scans import Segment, Segments

REASON_COLORS = {
    Reason.SHADOWED: canvas.INK,
    Reason.GRAZING: "#882255",
    Reason.SATURATED: "#e3c800",
    Reason.DARK: "#6b8e00",
    Reason.LOST: "#a9adb4",
    Reason.OUT_OF_RANGE: "#0072b2",
}
_SEGMENTS = {
    Segment.PART: ("part", canvas.SCAN),
    Segment.TABLE: ("table", canvas.TABLE),
    Segment.OTHER: ("clutter", canvas.CLUTTER),
}
_LINEAR_MM = 0.01  # colours are linear up to here, logarithmic beyond


def measurements_picture(measurements: Mapping[str, Measurement]) -> Figure:
    """A panel for each measurement by its title: what the camera's image shows of the part.

    Measured pixels are coloured by how far their points stand off the true surface, outward, on one
    scale from -1 to 1 mm that shows hundredths and whole millimetres; the others by the reason why
    they are not measured. Both figures stand in the titles.
    """
    columns = min(4, len(measurements))
    lines = -(-len(measurements) // columns)
    first = next(iter(measurements.values()))
    wide, high = crop_size(first.ideal, first.sensor.camera)
    width = (canvas.WIDTH_IN - 0.8) / columns
    figure = canvas.new_figure(width * columns + 0.8, (width * high / wide + 0.35) * lines + 0.3)
    panels = figure.subplots(lines, columns, squeeze=False)
    scale = SymLogNorm(_LINEAR_MM, vmin=-1.0, vmax=1.0)
    for axes in panels.flat:
        axes.set_axis_off()
    for axes, (title, measurement) in zip(panels.flat, measurements.items(), strict=False):
        camera, image = measurement.sensor.camera, error_image(measurement, scale)
        draw_part(axes, measurement.ideal, camera, image)
        canvas.name_panel(axes, f"{title}\n{_figures(measurement)}", loc="left")
    label = "distance from the true surface (mm), + outward"
    colors = ScalarMappable(scale, canvas.DEVIATION_COLORMAP)
    bar = canvas.add_color_bar(figure, panels, colors, label, shrink=0.7, aspect=35)
    bar.ax.yaxis.set_major_formatter("{x:g}")
    seen = {Reason(reason) for m in measurements.values() for reason in np.unique(m.reason)}
    handles = [
        Patch(color=color, label=reason.name.lower().replace("_", " "))
        for reason, color in REASON_COLORS.items()
        if reason in seen
    ]
    words = {"title": "not measured", "title_fontsize": canvas.LABEL_PT}
    if handles and panels.size > len(measurements):  # in the panel that is left
        canvas.add_legend(panels.flat[-1], handles, loc="center", **words)
    elif handles:
        place = {"loc": "outside lower center", "ncols": len(handles)}
        canvas.add_legend(figure, handles, **place, **words)
    return figure


def _figures(measurement: Measurement) -> str:
    """Share of the pixels that are lost, and how far off the others are; what is zero is left."""
    rms_mm = float(np.sqrt(np.mean(off_surface_mm(measurement) ** 2)))
    lost = f"{measurement.hole_share:.1%} lost" if measurement.hole_share else ""
    rms = f"rms {rms_mm:.2g} mm" if rms_mm > 1e-4 else ""  # less is rounding
    return ", ".join(filter(None, (lost, rms))) or "no error"


def error_image(measurement: Measurement, scale: Normalize) -> np.ndarray:
    """[H, W, 3] the whole image in colours; white where there is nothing to see."""
    reason = measurement.organised()["reason"]
    image = np.ones((*reason.shape, 3))
    measured = reason == Reason.MEASURED
    colors = colormaps[canvas.DEVIATION_COLORMAP](scale(off_surface_mm(measurement)))
    image[measured] = colors[:, :3]
    for why, color in REASON_COLORS.items():
        image[reason == why] = to_rgb(color)
    return image


def off_surface_mm(measurement: Measurement) -> np.ndarray:
    """[n] f64, how far each point stands off the face that it was measured on, outward."""
    moved = measurement.points.astype(np.float64) - measurement.ideal.points[measurement.kept]
    return np.einsum("ni,ni->n", moved, measurement.normals)


def segments_picture(scan: Scan, camera: Camera, scene: ClutterScene, segments: Segments) -> Figure:
    """A scene as the camera sees it, coloured twice: by the segmentation, and by the truth.

    Args:
      scan: of the whole scene, N pixels.
      camera: that made it.
      scene: that was scanned: it knows whose each face is.
      segments: of the scan's points, noisy or not, in their order.

    Raises:
      InputError: segments of another number of points.
    """
    if len(segments.label) != len(scan.points):
        raise InputError(
            f"the scan has {len(scan.points):,} points, the segmentation {len(segments.label):,}"
        )
    owner = scene.owner(scan.face)
    kinds = [Segment.PART] + [
        Segment.TABLE if item.kind == "table" else Segment.OTHER for item in scene.objects
    ]
    truth = np.array(kinds, np.uint8)[owner]
    light = shade(scan, camera)
    aspect = camera.fx / camera.fy
    figure = canvas.new_figure(
        canvas.WIDTH_IN, canvas.WIDTH_IN / 2 * aspect * camera.height / camera.width + 0.6
    )
    wrong = float(np.mean(segments.label != truth))
    for axes, label, title in zip(
        figure.subplots(1, 2),
        (segments.label, truth),
        (f"segmentation ({wrong:.1%} of the points wrong)", "truth"),
        strict=True,
    ):
        image = _colored(light, scan, camera, label)
        axes.imshow(image, aspect=aspect, interpolation="antialiased")
        axes.set_axis_off()
        canvas.name_panel(axes, title)
    present = [s for s in Segment if np.any(truth == s) or np.any(segments.label == s)]
    canvas.name_colors(figure, dict(_SEGMENTS[s] for s in present))
    return figure


def _colored(light: np.ndarray, scan: Scan, camera: Camera, label: np.ndarray) -> np.ndarray:
    """[H, W, 3]: the shaded image in the colours of the labels [N], white where nothing is."""
    image = np.ones((camera.height * camera.width, 3))
    grey = light.reshape(-1, 3)[scan.pixel].mean(axis=1, keepdims=True)
    colors = np.array([to_rgb(_SEGMENTS[s][1]) for s in Segment])
    image[scan.pixel] = np.clip(grey / np.percentile(grey, 80), 0.25, 1.1) * colors[label]
    return np.clip(image, 0, 1).reshape(camera.height, camera.width, 3)
