"""How a cost grows with the size of its input: a series of times, and the exponent they follow."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.benchmarks.timing import shown
from experiments.runner import study_command as study

FITTED = 3  # the largest sizes: in small ones what is fixed prevails


@dataclasses.dataclass(frozen=True)
class Series:
    """One thing timed at several sizes.

    Attributes:
      name: of what is timed.
      unit: of the sizes, in the plural.
      sizes: ascending.
      seconds: of each repeat at each size.
    """

    name: str
    unit: str
    sizes: Sequence[float]
    seconds: Sequence[Sequence[float]]


def exponent(sizes: Sequence[float], seconds: Sequence[float]) -> float | None:
    """The slope of log time over log size at the largest sizes: 1 is linear, 2 quadratic.

    None for fewer than two sizes.
    """
    if len(sizes) < 2:
        return None
    x, y = (np.log(values[-FITTED:]) for values in (sizes, seconds))
    return float(np.polyfit(x, y, 1)[0])


def summarize_scaling(series: Sequence[Series]) -> list[dict[str, Any]]:
    """For JSON: each size with its times, and the exponent of the medians."""
    rows = []
    for one in series:
        points = [
            {"size": size, "seconds": study.spread(list(seconds)), "repeats": len(seconds)}
            for size, seconds in zip(one.sizes, one.seconds, strict=True)
        ]
        power = exponent(one.sizes, [point["seconds"]["median"] for point in points])
        rows.append({"name": one.name, "unit": one.unit, "points": points, "exponent": power})
    return rows


def scaling_table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as aligned text."""
    lines = [f"{'scaling':<46}{'median (s)':>11}{'min - max':>20}"]
    for row in rows:
        power = "" if row["exponent"] is None else f": grows as size^{row['exponent']:.2f}"
        lines.append(f"{row['name']}{power}")
        for point in row["points"]:
            median, least, most = (shown(point["seconds"][k]) for k in ("median", "min", "max"))
            size = f"{point['size']:,.0f} {row['unit']}"
            lines.append(f"{size:>46}{median:>11}{f'{least} - {most}':>20}")
    return "\n".join(lines)
