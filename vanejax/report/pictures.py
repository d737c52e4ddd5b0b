"""Pictures inside the page: images without words, whose captions are the page's own text."""

from __future__ import annotations

import base64
import io
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.image import imsave

from vanejax.plotting.canvas import DEVIATION_COLORMAP, FAINT, FAR_ABOVE, FAR_BELOW, GRID, INK
from vanejax.plotting.scene import Picture, scale_bar_mm

_ON_DARK = {INK: "#e6e8eb", FAINT: "#8a8f98", GRID: "#33383f"}


class Image(NamedTuple):
    """A PNG for the page.

    Attributes:
      uri: as a data URI.
      width, height: pixels.
      bar_mm: a round length.
      bar_percent: how long it is, of the image's width.
    """

    uri: str
    width: int
    height: int
    bar_mm: float
    bar_percent: float


def image(picture: Picture) -> Image:
    """A rendered picture, transparent where nothing is."""
    data = io.BytesIO()
    height, width = picture.image.shape[:2]
    pixels = np.round(255 * np.clip(picture.image, 0, 1)).astype(np.uint8)
    # without metadata: matplotlib's holds an address
    options = {"compress_level": 4}  # twice as fast as the default, and a tenth larger
    imsave(data, pixels, format="png", metadata={"Software": None}, pil_kwargs=options)
    bar = scale_bar_mm(picture.width_mm)
    return Image(_png_uri(data.getvalue()), width, height, bar, 100 * bar / picture.width_mm)


def figure_uris(figure: Figure) -> tuple[str, str]:
    """A figure on nothing, with ink for a light and for a dark page; its colours are changed."""
    light = _figure_uri(figure)
    figure.set_layout_engine("none")  # the places stay as the first drawing found them
    for artist in figure.findobj():
        for name in ("color", "edgecolor", "markeredgecolor"):
            value = _value(artist, name)
            if value in _ON_DARK:
                getattr(artist, f"set_{name}")(_ON_DARK[value])
    for axes in figure.axes:
        axes.tick_params(colors=_ON_DARK[INK])
    return light, _figure_uri(figure)


def color_bar() -> str:
    """The colours of deviations from low to high, as a CSS gradient; 3 % at each end are beyond."""
    colors = map(to_hex, colormaps[DEVIATION_COLORMAP](np.linspace(0, 1, 17)))
    places = np.linspace(3, 97, 17)
    between = ", ".join(f"{color} {place:g}%" for color, place in zip(colors, places, strict=True))
    ends = f"{FAR_BELOW} 3%, {between}, {FAR_ABOVE} 97%"
    return f"linear-gradient(to right, {ends})"


def _figure_uri(figure: Figure) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=160, transparent=True, metadata={"Software": None})
    return _png_uri(data.getvalue())


def _value(artist: object, name: str) -> str | None:
    """An artist's colour as #rrggbb; None if it has no single one of that name."""
    get = getattr(artist, f"get_{name}", None)
    if get is None or isinstance(artist, Figure):
        return None
    try:
        return to_hex(get())
    except (TypeError, ValueError):
        return None


def _png_uri(data: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(data).decode("ascii")
