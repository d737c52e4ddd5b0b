"""A standard deviation that outliers do not change."""

from __future__ import annotations

import numpy as np

MAD_TO_SIGMA = 1.4826  # 1 / the 75 % quantile of the standard normal distribution


def robust_sigma(
    deviations: np.ndarray, *, axis: int | None = None, ignore_nan: bool = False
) -> np.ndarray:
    """1.4826 times the median of |deviation|: of normal ones the standard deviation about zero.

    Args:
      deviations: of any shape and unit, from what they should be.
      axis: over which the median is taken; default all.
      ignore_nan: takes the median of those that are not NaN.

    Returns:
      f64, of the shape without ``axis``, in the deviations' unit.
    """
    median = np.nanmedian if ignore_nan else np.median
    return MAD_TO_SIGMA * median(np.abs(deviations), axis=axis)
