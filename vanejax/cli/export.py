"""``vanejax export``: a training run becomes one file for ``vanejax register --weights``."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what the command takes."""
    parser.add_argument(
        "workdir",
        metavar="WORKDIR",
        help="work folder of experiments.train; or a PyTorch checkpoint of a published RPM-Net or "
        "PointNetLK (.pth, .pt, .t7), to convert it once; needs the extra vanejax[torch]",
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        help="what to write: safetensors, or .npz by that suffix; by default "
        "WORKDIR/model.safetensors, and for a checkpoint its name with .safetensors",
    )
    parser.add_argument(
        "--checkpoint",
        choices=("best", "last"),
        default="best",
        help="the smallest error on the validation pairs (default), or the newest",
    )


def run(arguments: argparse.Namespace) -> int:
    """Writes the file and says what is in it.

    Raises:
      InputError: no training run, no such checkpoint, or the file cannot be written.
    """
    from vanejax.errors import InputError
    from vanejax.files import check_writable

    given = Path(arguments.workdir)
    is_file = given.is_file()
    default = given.with_suffix(".safetensors") if is_file else given / "model.safetensors"
    out = Path(arguments.out or default)
    if is_file and out == given:
        raise InputError(f"{given}: would be overwritten; say with --out what to write")
    if arguments.out is not None:
        check_writable(out)

    if is_file:
        from vanejax.matching.torch_weights import convert_state_dict

        network, arrays = convert_state_dict(given, out)
        count = sum(array.size for array in arrays.values())
        print(f"{out}: {network}, {len(arrays)} arrays of {count:,} numbers in all")
        return 0

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
