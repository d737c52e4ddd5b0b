"""A standard deviation that outliers do not change."""

from __future__ import annotations

import numpy as np

MAD_TO_SIGMA = 1.4826  # 1 / the 75 % quantile of the standard normal distribution


def robust_sigma(
    deviations: np.ndarray, *, axis: int | None = None, ignore_nan: bool = False
) -> np.ndarray:
    """1.4826 times the median of |deviation|: of normal ones the standard deviation about zero.

    Of any shape and unit; f64, over ``axis`` (default all), without NaN if ``ignore_nan``.
    """
    median = np.nanmedian if ignore_nan else np.median
    return MAD_TO_SIGMA * median(np.abs(deviations), axis=axis)
