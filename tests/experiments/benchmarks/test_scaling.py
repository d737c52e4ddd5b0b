"""How scaling is fitted and shown, on times that are made up."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.benchmarks.scaling import Series, exponent, scaling_table, summarize_scaling

SIZES = np.array([10.0, 100.0, 1e3, 1e4, 1e5])


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_the_exponent_of_a_power_is_found(power: float) -> None:
    assert exponent(SIZES, 3e-7 * SIZES**power) == pytest.approx(power, abs=1e-9)


def test_what_is_fixed_does_not_hide_growth() -> None:
    """A second of start, and a quadratic cost that prevails at the end."""
    assert exponent(SIZES, 1.0 + 1e-5 * SIZES**2) == pytest.approx(2.0, abs=0.03)


def test_one_size_has_no_exponent() -> None:
    assert exponent([10], [1.0]) is None
    rows = summarize_scaling([Series("one", "points", [10], [[1.0]])])
    assert rows[0]["exponent"] is None
    assert "grows" not in scaling_table(rows)


def test_medians_are_fitted() -> None:
    series = Series("a thing", "faces", [10, 100], [[1.0, 50.0, 0.9], [10.0, 9.0, 90.0]])
    (row,) = summarize_scaling([series])
    assert row["exponent"] == pytest.approx(1.0)
    assert row["points"][0] == {
        "size": 10,
        "seconds": {"median": 1.0, "min": 0.9, "max": 50.0},
        "repeats": 3,
    }
    lines = scaling_table([row]).splitlines()
    assert max(map(len, lines)) <= 100
    assert lines[1] == "a thing: grows as size^1.00"
    assert lines[3].split() == ["100", "faces", "10.000", "9.000", "-", "90.000"]
