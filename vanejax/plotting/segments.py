"""One picture of a segmentation: the label of each point of a scan, beside the true one."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from vanejax.errors import InputError
from vanejax.plotting import canvas
from vanejax.plotting.shading import shade
from vanejax.scanner import Camera, Scan
from vanejax.scanner.clutter import ClutterScene
from vanejax.scans import Segment, Segments

_COLORS = {Segment.PART: canvas.SCAN, Segment.TABLE: canvas.TABLE, Segment.OTHER: canvas.CLUTTER}
_NAMES = {Segment.PART: "part", Segment.TABLE: "table", Segment.OTHER: "clutter"}


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
    canvas.name_colors(figure, {_NAMES[s]: _COLORS[s] for s in present})
    return figure


def _colored(light: np.ndarray, scan: Scan, camera: Camera, label: np.ndarray) -> np.ndarray:
    """[H, W, 3]: the shaded image in the colours of the labels [N], white where nothing is."""
    image = np.ones((camera.height * camera.width, 3))
    grey = light.reshape(-1, 3)[scan.pixel].mean(axis=1, keepdims=True)
    colors = np.array([to_rgb(_COLORS[s]) for s in Segment])
    image[scan.pixel] = np.clip(grey / np.percentile(grey, 80), 0.25, 1.1) * colors[label]
    return np.clip(image, 0, 1).reshape(camera.height, camera.width, 3)
