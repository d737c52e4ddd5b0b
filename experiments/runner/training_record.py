"""How long a run was trained, and whether more of it would have helped."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

VALIDATION = ("validation_rotation_error_deg", "validation_translation_error_mm")
FLAT = 0.1  # a curve is flat where the last quarter of the steps lowers the error by less


@dataclasses.dataclass(frozen=True)
class TrainingRecord:
    """What a run's folder knows of its training.

    Attributes:
      rows: of the log.
      seconds: of training, over all resumptions.
    """

    rows: Sequence[Mapping[str, float]]
    seconds: float

    def summary(self, wanted_steps: int) -> dict[str, Any]:
        """For a report on a run that should have had ``wanted_steps``.

        Returns:
          ``steps``, ``wanted_steps``, ``ended_by`` ("steps", or "budget" where fewer were done),
          ``hours``, ``fall_in_last_quarter`` (of the validation's rotation error: its mean over the
          last quarter of the steps against that over the third; NaN where too few were validated),
          ``flat``, and the validation ``curve``.
        """
        curve = [row for row in self.rows if all(name in row for name in VALIDATION)]
        steps = int(self.rows[-1]["step"]) if self.rows else 0

        def mean_error(first: float, last: float) -> float:
            errors = [
                row[VALIDATION[0]] for row in curve if first * steps < row["step"] <= last * steps
            ]
            return float(np.mean(errors)) if errors else float("nan")

        fall = 1.0 - mean_error(0.75, 1.0) / mean_error(0.5, 0.75)
        return {
            "steps": steps,
            "wanted_steps": wanted_steps,
            "ended_by": "budget" if steps < wanted_steps else "steps",
            "hours": self.seconds / 3600,
            "fall_in_last_quarter": fall,
            "flat": bool(fall < FLAT),
            "curve": [
                {"step": row["step"]} | {name: row[name] for name in VALIDATION} for row in curve
            ],
        }
