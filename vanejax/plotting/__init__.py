"""Every figure, once: functions take arrays and give a `matplotlib.figure.Figure`.

No pyplot and no global state: figures are plain values, drawn on an Agg canvas, also in threads
and without a display.
"""

from vanejax.plotting.canvas import save_figure
from vanejax.plotting.charts import AxisErrors, axis_errors, error_map, training_curves
from vanejax.plotting.clouds import (
    READER_AZIMUTH_DEG,
    READER_ELEVATION_DEG,
    Overlay,
    method_displacements,
    registration_overlays,
    view_and_shadow,
    view_name,
)
from vanejax.plotting.deviation import (
    deviation_map,
    overlay_before_after,
    residual_histogram,
    stock_map,
)
from vanejax.plotting.overview import overview_picture
from vanejax.plotting.shading import part_picture, shade

__all__ = [
    "READER_AZIMUTH_DEG",
    "READER_ELEVATION_DEG",
    "AxisErrors",
    "Overlay",
    "axis_errors",
    "deviation_map",
    "error_map",
    "method_displacements",
    "overlay_before_after",
    "overview_picture",
    "part_picture",
    "registration_overlays",
    "residual_histogram",
    "save_figure",
    "shade",
    "stock_map",
    "training_curves",
    "view_and_shadow",
    "view_name",
]
