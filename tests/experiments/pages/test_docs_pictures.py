"""The pictures of docs/how_it_works.md: the command draws them all."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

from experiments import docs_pictures

DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.slow
def test_the_command_draws_what_the_pages_show(tmp_path: Path, monkeypatch) -> None:
    # what takes longest, and has tests of its own, is drawn once: by whoever records the pictures
    monkeypatch.setattr(docs_pictures, "matching_picture", _skipped)
    arguments = docs_pictures.make_parser().parse_args(["--out", str(tmp_path)])
    docs_pictures.main(arguments)
    drawn = {path.name for path in tmp_path.glob("*.png")}
    assert drawn == {path.name for path in DOCS.glob("how_*.png")}
    for name in drawn - {"how_matching.png"}:
        mine, shown = plt.imread(tmp_path / name), plt.imread(DOCS / name)
        # fonts of another machine move a letter; another picture differs in far more
        assert mine.shape == shown.shape
        assert np.mean(np.abs(mine - shown)) < 0.02, name


def _skipped(*_: object) -> Figure:
    return Figure()
