"""What a sensor made of a scan: errors where it measured, reasons where it did not."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure

from vanejax.plotting.canvas import INK, new_figure
from vanejax.plotting.deviation import DEVIATION_COLORMAP
from vanejax.plotting.shading import crop
from vanejax.scanner.measurement import Measurement, Reason

REASON_COLORS = {
    Reason.SHADOWED: "#3b3f46",
    Reason.GRAZING: "#8a63c9",
    Reason.SATURATED: "#f2c230",
    Reason.DARK: "#2f9e8f",
    Reason.LOST: "#b7bcc4",
    Reason.OUT_OF_RANGE: "#e07a2f",
}
_PANEL_IN = 2.9  # wide


def measurements_picture(
    measurements: Mapping[str, Measurement], *, limit_mm: float = 0.15, columns: int = 4
) -> Figure:
    """A panel for each measurement by its title: what the camera's image shows of the part.

    Measured pixels are coloured by how far their points stand off the true surface, outward, from
    ``-limit_mm`` to ``limit_mm``; the others by the reason why they are not measured.
    """
    columns = min(columns, len(measurements))
    rows = math.ceil(len(measurements) / columns)
    first = next(iter(measurements.values()))
    down, across = crop(first.ideal, first.sensor.camera)
    camera = first.sensor.camera
    high = (down.stop - down.start) / camera.fy / ((across.stop - across.start) / camera.fx)
    figure = new_figure(_PANEL_IN * columns + 0.9, (_PANEL_IN * high + 0.35) * rows + 0.5)
    panels = figure.subplots(rows, columns, squeeze=False)
    scale = Normalize(-limit_mm, limit_mm)
    for axes in panels.flat:
        axes.set_axis_off()
    for axes, (title, measurement) in zip(panels.flat, measurements.items(), strict=False):
        _draw(axes, measurement, scale)
        axes.set_title(title, color=INK, fontsize=10, loc="left")
    bar = figure.colorbar(
        ScalarMappable(scale, DEVIATION_COLORMAP), ax=panels, shrink=0.6, pad=0.01, aspect=30
    )
    bar.set_label("off the true surface (mm)", color=INK, fontsize=9)
    seen = {Reason(reason) for m in measurements.values() for reason in np.unique(m.reason)}
    handles = [
        panels[0, 0].scatter(
            [], [], s=45, marker="s", color=color, label=reason.name.lower().replace("_", " ")
        )
        for reason, color in REASON_COLORS.items()
        if reason in seen
    ]
    if handles:
        figure.legend(
            handles=handles, loc="outside lower center", ncols=len(handles), frameon=False,
            fontsize=10, labelcolor=INK,
        )  # fmt: skip
    return figure


def error_image(measurement: Measurement, scale: Normalize) -> np.ndarray:
    """[H, W, 3] the whole image in colours; white where there is nothing to see."""
    reason = measurement.organised()["reason"]
    image = np.ones((*reason.shape, 3))
    measured = reason == Reason.MEASURED
    image[measured] = colormaps[DEVIATION_COLORMAP](scale(off_surface_mm(measurement)))[:, :3]
    for why, color in REASON_COLORS.items():
        image[reason == why] = to_rgb(color)
    return image


def off_surface_mm(measurement: Measurement) -> np.ndarray:
    """[n] f64, how far each point stands off the face that it was measured on, outward."""
    moved = measurement.points.astype(np.float64) - measurement.ideal.points[measurement.kept]
    return np.einsum("ni,ni->n", moved, measurement.normals)


def _draw(axes: Axes, measurement: Measurement, scale: Normalize) -> None:
    camera = measurement.sensor.camera
    rows, columns = crop(measurement.ideal, camera)
    axes.imshow(
        error_image(measurement, scale)[rows, columns],
        aspect=camera.fx / camera.fy,
        interpolation="antialiased",
    )
