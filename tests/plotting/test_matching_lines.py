"""Lines of a soft assignment: they join the points they should, as strong as their weight."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from vanejax.errors import InputError
from vanejax.plotting.canvas import RIGHT, WRONG
from vanejax.plotting.matching import Matching, matching_lines


def matching(*, points: int = 20, seed: int = 0) -> Matching:
    """Source and target are the same points, some centimetres apart; each is its own partner."""
    cloud = np.random.default_rng(seed).uniform(-60, 60, (points, 3))
    return Matching(cloud, cloud, 0.5 * np.eye(points))


def lines(figure: Figure, panel: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Ends [L, 2, 2] and colours [L, 4] of a panel's lines."""
    (found,) = (c for c in figure.axes[panel].collections if isinstance(c, LineCollection))
    return np.stack(found.get_segments()), found.get_colors()


def titles(figure: Figure) -> list[str]:
    return [axes.get_title() for axes in figure.axes]


def test_right_matches_are_parallel_and_dark():
    ends, colors = lines(matching_lines({"right": matching()}, partners=1))
    assert len(ends) == 20
    along = ends[:, 1] - ends[:, 0]
    np.testing.assert_allclose(along, np.tile(along[0], (20, 1)), atol=1e-9)  # f64, about 200 mm
    assert along[0, 0] > 100  # to the right, beyond the width of the cloud
    assert abs(along[0, 1]) < 1e-9
    np.testing.assert_allclose(colors, np.tile((*to_rgb(RIGHT), 1.0), (20, 1)))


def test_wrong_matches_are_coloured_and_go_where_the_network_says():
    good = matching()
    shifted = dataclasses.replace(good, assignment=np.roll(good.assignment, 1, axis=1))
    figure = matching_lines({"right": good, "wrong": shifted}, partners=1, within_mm=1.0)
    right, wrong = lines(figure, 0)[0], lines(figure, 1)[0]
    np.testing.assert_allclose(wrong[:, 0], right[:, 0])
    np.testing.assert_allclose(wrong[:, 1], np.roll(right[:, 1], -1, axis=0))
    assert (lines(figure, 1)[1][:, :3] == to_rgb(WRONG)).all()
    assert "100 % of the weight within 1 mm" in titles(figure)[0]
    assert titles(figure)[1].splitlines()[1].startswith("0 % of the weight within 1 mm")


def test_opacity_is_the_root_of_the_weight_on_one_scale():
    strong, weak = matching(), matching()
    weak = dataclasses.replace(weak, assignment=weak.assignment * 0.04)
    figure = matching_lines({"strong": strong, "weak": weak}, partners=1)
    np.testing.assert_allclose(lines(figure, 0)[1][:, 3], 1.0)
    np.testing.assert_allclose(lines(figure, 1)[1][:, 3], 0.2)
    assert "strongest weight 0.02" in titles(figure)[1]


def test_the_strongest_partners_are_drawn_the_weakest_first():
    rng = np.random.default_rng(1)
    some = dataclasses.replace(matching(), assignment=rng.dirichlet(np.ones(20), 20))
    ends, colors = lines(matching_lines({"some": some}, points=5, partners=3))
    assert len(ends) == 15
    assert (np.diff(colors[:, 3]) >= 0).all()
    wanted = np.sort(np.sort(some.assignment[[0, 4, 9, 14, 19]], axis=1)[:, -3:].ravel())
    np.testing.assert_allclose(colors[:, 3], np.sqrt(wanted / wanted[-1]))


def test_the_share_of_right_weight_is_a_loop():
    rng = np.random.default_rng(2)
    some = Matching(
        rng.uniform(-9, 9, (7, 3)), rng.uniform(-9, 9, (11, 3)), rng.uniform(0, 0.1, (7, 11))
    )
    right = total = 0.0
    for i, x in enumerate(some.source):
        for j, y in enumerate(some.target):
            total += some.assignment[i, j]
            if np.linalg.norm(x - y) <= 6.0:
                right += some.assignment[i, j]
    assert 0.05 < right / total < 0.95
    assert some.right_share(6.0) == pytest.approx(right / total)


def test_nothing_matched_is_said():
    nothing = dataclasses.replace(matching(), assignment=np.zeros((20, 20)))
    figure = matching_lines({"nothing": nothing, "right": matching()})
    assert "nothing is matched" in titles(figure)[0]
    assert len(figure.axes[0].collections[-1].get_segments()) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"assignment": np.zeros((20, 19))}, r"odd: the assignment is \(20, 19\), .* \(20, 20\)"),
        ({"assignment": np.full((20, 20), -3.0)}, "odd: an assignment is not negative; exponen"),
        ({"assignment": np.full((20, 20), np.nan)}, "odd: an assignment is not negative"),
        ({"source": np.full((20, 3), np.inf)}, r"odd: source \(20, 3\) should be finite"),
        ({"target": np.zeros((20, 2))}, r"odd: target \(20, 2\) should be finite and \[N, 3\]"),
    ],
)
def test_what_cannot_be_drawn_is_refused(change, words):
    with pytest.raises(InputError, match=words):
        matching_lines({"odd": dataclasses.replace(matching(), **change)})


def test_no_lines_are_refused():
    with pytest.raises(InputError, match="positive"):
        matching_lines({"right": matching()}, within_mm=0.0)
