"""Colours that appear together differ for every kind of colour vision and on a greyscale print."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from vanejax.plotting import canvas
from vanejax.plotting.deviation import STATUS_COLORS
from vanejax.plotting.sensing import REASON_COLORS
from vanejax.report.templates import source

# of linear RGB, for complete dichromats (Machado, Oliveira, Fernandes, 2009)
VISIONS = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "tritanopia": np.array(
        [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ]
    ),
}
AREAS = {  # filled side by side: must differ in lightness too
    "clouds": (canvas.SCAN, canvas.CAD),
    "view": (canvas.SCAN, canvas.HIDDEN),
    "segments": (canvas.SCAN, canvas.TABLE, canvas.CLUTTER),
    "matches": (canvas.RIGHT, canvas.WRONG, canvas.CAD),
    "verdicts": tuple(canvas.VERDICTS.values()),
    "statuses": tuple(STATUS_COLORS.values()),
    "deviations": (canvas.FAR_BELOW, "#3b4cc0", "#dddddd"),  # beyond, the end, none
    "deviations above": (canvas.FAR_ABOVE, "#b40426", "#dddddd"),
    "reasons": tuple(REASON_COLORS.values()),
}


def lab(color: str, vision: np.ndarray) -> np.ndarray:
    """CIE L*a*b* of a colour as seen."""
    rgb = np.array(to_rgb(color))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz_from_rgb = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    xyz = xyz_from_rgb @ np.clip(vision @ linear, 0, 1) / np.array([0.9505, 1.0, 1.089])
    x, y, z = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def least_distance(one: str, other: str) -> float:
    """The smallest difference (CIE76) over all kinds of colour vision; 2.3 is just noticeable."""
    return min(float(np.linalg.norm(lab(one, v) - lab(other, v))) for v in VISIONS.values())


def lightness_step(one: str, other: str) -> float:
    """How far apart a greyscale print puts them, of 100."""
    return float(abs(lab(one, np.eye(3))[0] - lab(other, np.eye(3))[0]))


@pytest.mark.parametrize("name", AREAS)
def test_areas_differ_for_every_eye_and_in_grey(name: str) -> None:
    for one, other in itertools.combinations(AREAS[name], 2):
        assert least_distance(one, other) > 15, (one, other)
        assert lightness_step(one, other) > 8, (one, other)


def test_green_on_red_would_fail() -> None:
    """The colours that figures had before: the test can tell."""
    assert lightness_step("#1b9e4b", "#d1342f") < 15
    assert least_distance("#7f9a2f", "#b8762f") < 15


@pytest.mark.parametrize("styles", [canvas.METHODS, canvas.SENSORS])
def test_lines_differ_by_colour_or_by_line_and_marker(styles: dict[str, canvas.Style]) -> None:
    assert len(set(styles.values())) == len(styles)
    for one, other in itertools.combinations(styles.values(), 2):
        if one.color == other.color:
            assert one.line != other.line
        else:
            assert least_distance(one.color, other.color) > 10, (one, other)
            # what a greyscale print makes alike
            assert lightness_step(one.color, other.color) > 8 or one[1:] != other[1:]


def test_series_differ_for_every_eye() -> None:
    assert len(set(canvas.MARKERS)) == len(canvas.SERIES)
    for one, other in [*itertools.combinations(canvas.SERIES, 2), (canvas.OURS, canvas.PAPER)]:
        assert least_distance(one, other) > 10, (one, other)


def test_the_report_has_the_same_colours() -> None:
    style = source("page.css")
    names = {"scan": canvas.SCAN, "cad": canvas.CAD, "hidden": canvas.HIDDEN}
    names |= {
        "lost": canvas.NO_PARTNER,
        "faint": canvas.FAINT,
        "accepted": canvas.VERDICTS["accepted"],
    }
    names |= {"far-below": canvas.FAR_BELOW, "far-above": canvas.FAR_ABOVE}
    for name, color in names.items():
        assert f"--{name}: {color};" in style
