"""The pictures of the pages are what the records and the code give; a blank one fails."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image, ImageChops

from experiments import docs
from vanejax.plotting.canvas import WIDTH_IN

# drawn by long runs, by the program of a page, or from scans that are not here
FROM_RUNS = {"overview.png", "placement.png", "real_scans.png", "sensor_effects.png"}
OF_RECORDS = docs.record_pictures()
ALIKE = 0.15  # another machine's letters differ by 0.02, another picture by more than 0.5


def ink(image: Image.Image) -> np.ndarray:
    """Mean departure from white [40, 60, 3] of the cells of a picture."""
    cells = image.convert("RGB").resize((60, 40), Image.Resampling.BOX)
    return 1 - np.asarray(cells) / 255


def difference(drawn: Image.Image, shown: Image.Image) -> float:
    """How far two pictures differ in their cells' ink, as a share of the first one's."""
    wanted = ink(drawn)
    return float(np.linalg.norm(ink(shown) - wanted) / np.linalg.norm(wanted))


def pixels(figure: Figure) -> Image.Image:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=200)
    return Image.open(data)


@pytest.mark.parametrize("name", sorted(OF_RECORDS))
def test_a_committed_picture_is_its_records(name: str) -> None:
    figure = OF_RECORDS[name].draw()
    drawn, shown = pixels(figure), Image.open(docs.DOCS / name)
    assert difference(drawn, shown) < ALIKE
    assert abs(drawn.height / drawn.width - shown.height / shown.width) < 0.01
    # legible in print
    assert figure.get_figwidth() <= WIDTH_IN
    words = [text for text in figure.findobj(Text) if text.get_text().strip()]
    assert min(text.get_fontsize() for text in words) >= 7


def test_a_blank_a_shifted_and_another_picture_fail() -> None:
    names = sorted(OF_RECORDS)[:2]
    one, other = (Image.open(docs.DOCS / name).convert("RGB") for name in names)
    assert difference(one, one) == 0
    assert difference(one, Image.new("RGB", one.size, "white")) > 5 * ALIKE
    assert difference(one, ImageChops.offset(one, one.width // 20, 0)) > ALIKE
    assert difference(one, ImageChops.invert(one)) > ALIKE
    assert difference(one, other) > ALIKE


def test_every_picture_of_the_pages_is_tested() -> None:
    shown = {path.name for path in docs.DOCS.glob("*.png")}
    commanded = {name for name in shown if name.startswith("how_")}
    assert shown == OF_RECORDS.keys() | commanded | FROM_RUNS
    for name in FROM_RUNS:
        darkest = np.asarray(Image.open(docs.DOCS / name).convert("RGB")).min(axis=-1)
        assert 0.05 < np.mean(darkest < 0.9 * 255) < 0.9, name


@pytest.mark.slow
def test_the_command_draws_what_the_pages_show(tmp_path: Path) -> None:
    docs.draw(tmp_path)
    drawn = {path.name for path in tmp_path.iterdir()}
    assert drawn == {path.name for path in docs.DOCS.glob("*.png")} - FROM_RUNS
    for name in drawn:
        assert difference(Image.open(tmp_path / name), Image.open(docs.DOCS / name)) < ALIKE, name
