"""Pictures of soft assignments: which CAD points a network assigns to the points of a scan."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.spatial.distance import cdist

from vanejax.errors import InputError
from vanejax.plotting import canvas
from vanejax.plotting.clouds import draw_dots, flattened, height_per_width, limits, overlay_dots

_GAP = 1.12  # of the width of what is drawn: how far the scan is moved aside


@dataclasses.dataclass(frozen=True, eq=False)
class Matching:
    """One soft assignment to look at; clouds in mm, target frame.

    Attributes:
      source: [N, 3] where its points truly lie.
      target: [M, 3].
      assignment: [N, M], 0 to 1, rows sum to at most 1; a row of zeros is no point.
    """

    source: np.ndarray
    target: np.ndarray
    assignment: np.ndarray

    def near(self, within_mm: float) -> np.ndarray:
        """[N, M] bool: the target's points that lie so near to where a source point truly is."""
        return cdist(self.source, self.target) <= within_mm

    def right_share(self, within_mm: float) -> float:
        """Share of all weight that goes to points within ``within_mm`` of the true place.

        ``sum_ij P_ij [|x_i - y_j| <= r] / sum_ij P_ij``; NaN where nothing has a weight.
        """
        total = float(self.assignment.sum())
        right = float(self.assignment.sum(where=self.near(within_mm)))
        return right / total if total > 0 else float("nan")


def matching_lines(
    matchings: Mapping[str, Matching],
    *,
    within_mm: float = 10.0,
    points: int = 60,
    partners: int = 6,
) -> Figure:
    """Soft assignments as lines from the scan, moved aside, to the assigned CAD points.

    The scan is drawn in its true pose, only shifted to the left: right matches are parallel lines.
    Of some points the strongest partners are drawn. Opacity is the square root of the weight, the
    strongest of all panels opaque: weights of an untrained network, thousandths, stay visible.
    Dark lines end within ``within_mm`` of the true place, vermilion ones do not.

    Args:
      matchings: by title, such as before and after training; one panel each.
      within_mm: how far from its true place a partner may lie and still be right.
      points: of the scan, spread evenly over its rows.
      partners: of each point.

    Raises:
      InputError: nothing to draw, shapes that do not fit together, or a weight that is not one.
    """
    if not matchings:
        raise InputError("matching_lines needs at least one matching")
    if not (within_mm > 0 and points > 0 and partners > 0):
        raise InputError("within_mm, points and partners of matching_lines should be positive")
    for title, matching in matchings.items():
        _check(title, matching)
    apart = {title: _moved_aside(matching) for title, matching in matchings.items()}
    limit = limits([c for t, m in matchings.items() for c in (apart[t], m.target)])
    limit[0, 1] += 0.06 * (limit[1, 0] - limit[0, 0])  # no scale bar here
    lines = {title: _strongest(matching, points, partners) for title, matching in matchings.items()}
    opaque = max([weight.max() for _, _, weight in lines.values() if len(weight)], default=1.0)
    width = canvas.WIDTH_IN / max(2, len(matchings))
    figure = canvas.new_figure(width * len(matchings), width * height_per_width(limit) + 1.3)
    for axes, (title, matching) in zip(
        figure.subplots(1, len(matchings), squeeze=False)[0], matchings.items(), strict=True
    ):
        draw_dots(axes, overlay_dots(apart[title], matching.target, 0.5 * width), limit)
        row, column, weight = lines[title]
        right = matching.near(within_mm)[row, column]
        ends = np.stack([apart[title][row], matching.target[column]], axis=1)
        _draw_lines(axes, ends, right, np.sqrt(weight / opaque))
        share = matching.right_share(within_mm)
        quality = f"{100 * share:.0f} % of the weight within {within_mm:g} mm"
        canvas.name_panel(
            axes,
            f"{title}\n{quality if np.isfinite(share) else 'nothing is matched'}\n"
            f"strongest weight {weight.max(initial=0.0):.2g}",
        )
    entries = [
        Line2D([], [], marker="o", linestyle="", color=canvas.SCAN, label="scan, moved aside"),
        Line2D([], [], marker="o", linestyle="", color=canvas.CAD, label="CAD"),
        Line2D([], [], color=canvas.RIGHT, label="right match"),
        Line2D([], [], color=canvas.WRONG, label="wrong match"),
    ]
    canvas.add_legend(
        figure, entries, loc="outside lower center", ncols=4 if len(matchings) > 1 else 2
    )
    return figure


def _moved_aside(matching: Matching) -> np.ndarray:
    """The source [N, 3], shifted to the reader's left of the target."""
    both = np.concatenate([matching.source, matching.target])
    across = flattened(both)[:, 0]
    # rows of reader_from_part are the reader's axes in the part's frame
    right = flattened(np.eye(3))[:, 0]
    return matching.source - _GAP * float(np.ptp(across)) * right


def _strongest(
    matching: Matching, points: int, partners: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and weights [L] of the strongest partners of some points, weak ones first."""
    rows = np.flatnonzero(matching.assignment.sum(axis=1) > 0)
    chosen = np.unique(np.linspace(0, len(rows) - 1, min(points, len(rows))).astype(int))
    rows = rows[chosen]
    columns = np.argsort(-matching.assignment[rows], axis=1, kind="stable")[:, :partners]
    row, column = np.repeat(rows, columns.shape[1]), columns.ravel()
    weight = matching.assignment[row, column]
    order = np.argsort(weight, kind="stable")
    return row[order], column[order], weight[order]


def _draw_lines(axes: Axes, ends: np.ndarray, right: np.ndarray, opacity: np.ndarray) -> None:
    """Lines between ends [L, 2, 3] into axes, below the dots; ``right`` [L], ``opacity`` [L]."""
    colors = np.where(right[:, None], to_rgb(canvas.RIGHT), to_rgb(canvas.WRONG))
    flat = flattened(ends.reshape(-1, 3))[:, :2].reshape(-1, 2, 2)
    axes.add_collection(
        LineCollection(
            flat, colors=np.concatenate([colors, opacity[:, None]], axis=1), linewidths=0.6,
            zorder=1,
        )
    )  # fmt: skip


def _check(title: str, matching: Matching) -> None:
    """Refuses what cannot be drawn."""
    shape = (len(matching.source), len(matching.target))
    clouds = {"source": matching.source, "target": matching.target}
    for name, cloud in clouds.items():
        if np.ndim(cloud) != 2 or np.shape(cloud)[1] != 3 or not np.isfinite(cloud).all():
            raise InputError(f"{title}: {name} {np.shape(cloud)} should be finite and [N, 3], mm")
    if matching.assignment.shape != shape:
        raise InputError(
            f"{title}: the assignment is {matching.assignment.shape}, the clouds have {shape} "
            "points: row per source point, column per target point"
        )
    if not (matching.assignment >= 0).all():
        raise InputError(f"{title}: an assignment is not negative; exponentiate a log assignment")
