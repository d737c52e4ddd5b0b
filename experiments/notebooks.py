"""Runs the notebooks in kernels and stores them with their outputs, so that they can be read.

python -m experiments.notebooks [NAME ...]

Figures are stored as PNG pictures of at most 60 kB. An interactive view is stored as a picture of
itself, which a headless Chromium takes; whoever runs the notebook gets the view.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import html
import io
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path

import nbclient
import nbformat
from nbformat import NotebookNode
from PIL import Image, ImageChops

from experiments.runner import study_command
from vanejax.errors import InputError
from vanejax.files import write_text

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "notebooks"
MAX_PICTURE_BYTES = 60_000
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def source_hash(notebook: NotebookNode) -> str:
    """SHA-256 of the code: what the stored outputs are of."""
    code = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    return hashlib.sha256("\0".join(code).encode()).hexdigest()


def execute(notebook: NotebookNode, folder: Path, environment: Mapping[str, str] = {}) -> None:
    """Runs the cells in a kernel of their own, in ``folder``; raises CellExecutionError."""
    client = nbclient.NotebookClient(
        notebook,
        timeout=300,
        kernel_name="python3",
        record_timing=False,
        resources={"metadata": {"path": str(folder)}},
    )
    client.execute(env=os.environ | {"PYTHONPATH": str(ROOT)} | environment)


def texts(notebook: NotebookNode) -> list[str]:
    """What each code cell prints and returns as text, without its figures' digits."""
    printed = []
    for cell in notebook.cells:
        if cell.cell_type == "code":
            parts = [out.get("text") or out.data["text/plain"] for out in cell.outputs]
            text = re.sub(r"\n+", "\n", re.sub(r"0x[0-9a-f]+", "#", "\n".join(parts)))
            printed.append(re.sub(r"[-+]?\d[\d,.e+-]*", "#", re.sub(r" +", " ", text)))
    return printed


def freeze(notebook: NotebookNode) -> None:
    """Makes the outputs small enough to store, and notes of which code they are.

    Raises:
      InputError: there is no browser to take pictures of interactive views.
    """
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if page := data.pop("text/html", None):
                picture = photograph(page)
            elif "image/png" in data:
                picture = base64.b64decode(data["image/png"])
            else:
                continue
            data["image/png"] = base64.b64encode(small_png(picture)).decode()
            output["metadata"] = {}
    notebook.metadata["outputs_of"] = source_hash(notebook)


def photograph(page: str) -> bytes:
    """A PNG of an interactive view as a notebook shows it."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise InputError(f"pictures of interactive views need one of {', '.join(BROWSERS)}")
    framed = re.search(r'srcdoc="([^"]*)"', page)
    with tempfile.TemporaryDirectory() as folder:
        path, shot = Path(folder) / "view.html", Path(folder) / "view.png"
        path.write_text(html.unescape(framed[1]) if framed else page)
        flags = ["--headless", "--no-sandbox", "--hide-scrollbars", "--virtual-time-budget=5000"]
        flags += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # WebGL without a GPU
        place = [f"--screenshot={shot}", "--window-size=900,560", path.as_uri()]
        subprocess.run([browser, *flags, *place], check=True, capture_output=True)
        picture = Image.open(shot).convert("RGB")
    margins = ImageChops.difference(picture, Image.new("RGB", picture.size, "white"))
    buffer = io.BytesIO()
    picture.crop(margins.getbbox()).save(buffer, "PNG")
    return buffer.getvalue()


def small_png(picture: bytes) -> bytes:
    """The same picture in few colours, and smaller where that is not enough."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    for colors, width in ((256, 1000), (128, 900), (64, 800), (64, 640), (32, 640), (16, 560)):
        smaller = image.copy()
        smaller.thumbnail((width, width))
        buffer = io.BytesIO()
        smaller.quantize(colors, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
        if buffer.tell() <= MAX_PICTURE_BYTES:
            break
    return buffer.getvalue()


def make_parser() -> argparse.ArgumentParser:
    """The options of this command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="such as scanner (all)")
    return parser


def main(arguments: argparse.Namespace) -> int:
    """Runs and stores them."""
    paths = sorted(FOLDER.glob("*.ipynb"))
    if unknown := set(arguments.names) - {path.stem for path in paths}:
        raise InputError(f"no notebook {', '.join(unknown)} in {FOLDER}")
    for path in paths:
        if not arguments.names or path.stem in arguments.names:
            notebook = nbformat.read(path, as_version=4)
            with tempfile.TemporaryDirectory() as folder:
                execute(notebook, Path(folder))
            freeze(notebook)
            write_text(path, nbformat.writes(notebook) + "\n")
            print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1e3:.0f} kB")
    return 0


if __name__ == "__main__":
    study_command.run(main, make_parser())
