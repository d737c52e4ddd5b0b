"""An animation of a registration for notebooks: a scan that moves onto the CAD model."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.animation import FuncAnimation
from scipy.spatial.transform import Rotation, Slerp

from vanejax.errors import InputError
from vanejax.plotting.canvas import CAD, SCAN, name_colors, name_panel, new_figure
from vanejax.plotting.clouds import draw_dots, height_per_width, limits, overlay_dots
from vanejax.rigid import RigidTransform

_WIDTH_IN, _DPI = 3.2, 80
_FRAME_MS = 200
# matplotlib's buttons are letters of a font that a browser would fetch
_BUTTONS = {
    "minus": "-", "fast-backward": "«", "step-backward": "‹", "play fa-flip-horizontal": "◀",
    "pause": "||", "play": "▶", "step-forward": "›", "fast-forward": "»", "plus": "+",
}  # fmt: skip


def registration_film(
    points: np.ndarray,
    poses: Sequence[RigidTransform],
    names: Sequence[str],
    reference: np.ndarray,
    *,
    frames_per_pose: int = 4,
) -> str:
    """HTML of an animation with buttons and a slider: `IPython.display.HTML` shows it.

    Between two poses the cloud turns about one axis and its centre goes straight. The HTML holds
    every picture and asks for nothing from the network.

    Args:
      points: [N, 3] mm, source frame.
      poses: target_from_source, mm, at least two: before, and after every iteration.
      names: of the poses, one each.
      reference: [M, 3] mm, target frame.
      frames_per_pose: from each pose to the next.

    Raises:
      InputError: no points, fewer than two poses, another number of names, or a pose that is not
        finite.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1:] != (3,) or not len(points):
        raise InputError(f"points have shape {points.shape}; they should be [N, 3], N at least 1")
    if len(poses) < 2 or len(poses) != len(names):
        raise InputError(
            f"{len(poses)} poses with {len(names)} names; a film needs two or more, a name for each"
        )
    if not all(np.isfinite(np.asarray(pose.as_matrix())).all() for pose in poses):
        raise InputError("a pose is not finite: this registration failed")
    clouds = [pose.apply(points) for pose in between(poses, points.mean(axis=0), frames_per_pose)]
    limit = limits([*clouds, reference])
    figure = new_figure(_WIDTH_IN, _WIDTH_IN * height_per_width(limit) + 0.8)
    figure.set_dpi(_DPI)
    axes = figure.subplots()
    name_colors(figure, {"scan": SCAN, "CAD": CAD})

    def draw(frame: int) -> list:
        axes.clear()
        draw_dots(axes, overlay_dots(clouds[frame], reference, 2.0), limit)
        name_panel(axes, names[frame // frames_per_pose])
        return []

    with rc_context({"animation.embed_limit": 50.0}):
        film = FuncAnimation(figure, draw, frames=len(clouds), interval=_FRAME_MS)
        page = film.to_jshtml(default_mode="once")
    page = re.sub(r"<link[^>]*>", "", page)
    return re.sub(r'<i class="fa fa-([\w -]+)"></i>', lambda m: _BUTTONS.get(m[1], m[1]), page)


def between(
    poses: Sequence[RigidTransform], center: np.ndarray, frames: int
) -> list[RigidTransform]:
    """``frames`` poses, f64, from each to the next, and the last; ``center`` [3] goes straight."""
    rotations = np.stack([np.asarray(pose.rotation, np.float64) for pose in poses])
    places = np.stack([np.asarray(pose.translation, np.float64) for pose in poses])
    places += rotations @ center
    whole = np.arange(len(poses), dtype=np.float64)
    times = np.arange((len(poses) - 1) * frames + 1) / frames
    turned = Slerp(whole, Rotation.from_matrix(rotations))(times).as_matrix()
    path = np.stack([np.interp(times, whole, places[:, axis]) for axis in range(3)], axis=1)
    return [RigidTransform(r, p - r @ center) for r, p in zip(turned, path, strict=True)]
