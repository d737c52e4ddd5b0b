"""``vanejax export``: a training run becomes one file for ``vanejax register --weights``."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what the command takes."""
    parser.add_argument("workdir", metavar="WORKDIR", help="work folder of experiments.train")
    parser.add_argument("--out", metavar="FILE", help="what to write; by default WORKDIR/model.npz")
    parser.add_argument(
        "--checkpoint",
        choices=("best", "last"),
        default="best",
        help="the smallest error on the validation pairs (default), or the newest",
    )


def run(arguments: argparse.Namespace) -> int:
    """Writes the file and says what is in it.

    Raises:
      InputError: no training run, or the file cannot be written.
    """
    from vanejax.files import check_writable

    out = Path(arguments.out or Path(arguments.workdir) / "model.npz")
    if arguments.out is not None:
        check_writable(out)

    from vanejax.training.export import export_workdir

    # orbax tells of every file, and leaves tasks behind where a checkpoint does not fit
    for name, level in (("absl", logging.ERROR), ("asyncio", logging.CRITICAL)):
        logging.getLogger(name).setLevel(level)
    matcher = export_workdir(arguments.workdir, out, checkpoint=arguments.checkpoint)
    print(
        f"{out}: RPM-Net for {matcher.part_name} (sha256 {matcher.part_sha256[:12]}), "
        f"step {matcher.trained['step']}, {out.stat().st_size / 1e6:.1f} MB"
    )
    return 0
