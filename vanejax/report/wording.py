"""Numbers, shares and directions as a person reads them."""

from __future__ import annotations

import math

import numpy as np

_AXES = "xyz"
# within this angle a direction is called by the axis's name
_NEARLY_DEG = 12.0


def significant(value: float, digits: int = 2) -> str:
    """A figure of so many significant digits, without exponent from 1e-6 on; words if undefined."""
    if not math.isfinite(value):
        return "undetermined"
    if 0 < abs(value) < 1e-6:
        return "below 0.000001"
    # rounded first: 9.96 is 10, not 10.0
    rounded = float(f"{value:.{digits - 1}e}")
    exponent = math.floor(math.log10(abs(rounded))) if rounded else 0
    return f"{rounded:,.{max(0, digits - 1 - exponent)}f}".replace("-", "−")


def degrees(value: float, digits: int = 2) -> str:
    """An angle with its sign of degree."""
    return f"{significant(value, digits)}°" if math.isfinite(value) else significant(value)


def millimetres(value: float, digits: int = 2) -> str:
    """A length with its unit."""
    return f"{significant(value, digits)} mm" if math.isfinite(value) else significant(value)


def plus_minus(value: float, sigma: float) -> str:
    """A figure and its standard deviation, both as precise as that is known: 0.503 ± 0.003."""
    if not (math.isfinite(value) and math.isfinite(sigma)):
        return significant(value)
    if sigma <= 0:
        return significant(value, 3)
    exponent = math.floor(math.log10(sigma))
    # 0.0014 and 0.0006 are both more than 0.001 says
    places = max(0, (sigma < 1.95 * 10**exponent) - exponent)
    return f"{fixed(value, places)} ± {fixed(sigma, places)}"


def percent(share: float) -> str:
    """A share of 1 as a percentage; a little is not nothing, and nearly all is not all."""
    if not math.isfinite(share):
        return "unknown"
    if 0 < share < 5e-4:
        return "< 0.1 %"
    if 1 - 5e-4 < share < 1:
        return "> 99.9 %"
    return f"{100 * share:.1f} %"


def fixed(value: float, digits: int = 4) -> str:
    """A coordinate: a true minus sign, and no minus before zero."""
    text = f"{value:.{digits}f}"
    if float(text) == 0:
        text = text.lstrip("-")
    return text.replace("-", "−")


def direction(axis: np.ndarray) -> str:
    """A line's direction [3], part frame, in words; which of its two ends is meant does not count.

    ``the part's x axis``, ``between the part's x and z axes (0.71, 0.00, 0.70)``.
    """
    axis = np.asarray(axis, np.float64)
    length = float(np.linalg.norm(axis))
    if not math.isfinite(length) or length == 0:
        return "no single direction"
    largest, second, least = np.argsort(-np.abs(axis), kind="stable")
    axis = axis / length * (1.0 if axis[largest] > 0 else -1.0)
    numbers = "(" + ", ".join(fixed(float(v), 2) for v in axis) + ")"
    if abs(axis[largest]) > math.cos(math.radians(_NEARLY_DEG)):
        return f"the part's {_AXES[largest]} axis"
    if abs(axis[least]) < math.sin(math.radians(_NEARLY_DEG)):
        signs = {largest: "", second: "−" if axis[second] < 0 else ""}
        one, other = (signs[i] + _AXES[i] for i in (largest, second))
        return f"the direction {numbers}, between the part's {one} and {other} axes"
    return f"the direction {numbers} of the part's frame"
