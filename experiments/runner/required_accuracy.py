"""The accuracy that the paper's machining process asks of a pose."""

from __future__ import annotations

import numpy as np

NEED_DEG, NEED_MM = 0.5, 1.0


def within_need(rotation_deg: np.ndarray, translation_mm: np.ndarray) -> np.ndarray:
    """Whether pose errors of any one shape are below `NEED_DEG` and `NEED_MM`; NaN is not."""
    return (rotation_deg < NEED_DEG) & (translation_mm < NEED_MM)
