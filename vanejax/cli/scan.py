"""``vanejax scan``: virtual scans of a part from the hemisphere, with their poses."""

from __future__ import annotations

import argparse
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vanejax.cli import workpiece
from vanejax.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from vanejax.cad.part import Part
    from vanejax.scanner import Camera, Scan, Scanner, Viewpoints

LABELS = "labels.json"
FORMATS = ("ply", "npz", "xyz", "pcd")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what the command takes."""
    workpiece.add_arguments(parser)
    parser.add_argument(
        "--out", metavar="DIR", required=True, help="folder for the scans and labels.json"
    )
    parser.add_argument(
        "--views",
        default="216",
        help="how many of the 216 viewpoints, spread evenly (216); or which, such as 0,5,9; or "
        "test for the 54 that training never sees",
    )
    parser.add_argument(
        "--noise-mm",
        type=float,
        default=0.0,
        metavar="SIGMA",
        help="standard deviation of white noise along the ray, mm (0)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the noise (0)")
    parser.add_argument("--format", choices=FORMATS, default="ply", help="of the scans (ply)")
    parser.add_argument(
        "--distance-mm", type=float, default=400.0, help="from camera to the part's centre (400)"
    )
    parser.add_argument(
        "--resolution",
        type=float,
        default=1.0,
        help="share of the camera's 1280 x 1024 pixels per side (1)",
    )
    parser.add_argument(
        "--force", action="store_true", help="write into a folder that is not empty"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def run(arguments: argparse.Namespace) -> int:
    """Scans and writes; labels.json comes last, so a folder that has it is whole.

    Raises:
      InputError: an argument, the part or the folder cannot be used.
    """
    if not 0 <= arguments.noise_mm < math.inf:
        raise InputError(f"--noise-mm {arguments.noise_mm}: should be 0 or more, in mm")
    if arguments.seed < 0:
        raise InputError(f"--seed {arguments.seed}: should be 0 or more")
    folder = Path(arguments.out)
    _check_folder(folder, force=arguments.force)

    from vanejax.files import write_json
    from vanejax.scanner import Camera, Scanner, hemisphere_viewpoints

    part = workpiece.load_workpiece(arguments)
    camera = Camera().scaled(arguments.resolution)
    viewpoints = hemisphere_viewpoints(part.center, distance_mm=arguments.distance_mm)
    views = parse_views(arguments.views, viewpoints.is_test)
    _claim_folder(folder)
    rows = _write_scans(arguments, folder, Scanner(part), camera, viewpoints, views)
    write_json(folder / LABELS, _labels(arguments, part, camera) | {"views": rows}, allow_nan=False)
    count = sum(row["points"] for row in rows)
    print(f"{folder}: {len(views)} scans of {part.name}, {count:,} points, and {LABELS}")
    return 0


def parse_views(text: str, is_test: np.ndarray) -> list[int]:
    """Indices of viewpoints, in the order given.

    Args:
      text: a number of views, to be spread evenly; two or more indices with commas between (one
        index: with a comma behind it); or ``test``.
      is_test: [V] bool, `Viewpoints.is_test`.

    Raises:
      InputError: none of these, an index twice, or more views than there are.
    """
    total = len(is_test)
    if text == "test":
        return [index for index in range(total) if is_test[index]]
    try:
        numbers = [int(word) for word in text.removesuffix(",").split(",")]
    except ValueError:
        raise InputError(
            f"--views {text}: should be a number of views, indices such as 0,5,9, or test"
        ) from None
    if "," not in text:
        (count,) = numbers
        if not 1 <= count <= total:
            raise InputError(f"--views {count}: there are 1 to {total}; one index is 5, with comma")
        # both ends included, so that few views differ in elevation and in azimuth
        return [round(i * (total - 1) / max(1, count - 1)) for i in range(count)]
    wrong = [number for number in numbers if not 0 <= number < total]
    if wrong or len(set(numbers)) < len(numbers):
        fault = f"there is no {wrong[0]}" if wrong else "an index is there twice"
        raise InputError(f"--views {text}: {fault}; the views are 0 to {total - 1}")
    return numbers


def _write_scans(
    arguments: argparse.Namespace,
    folder: Path,
    scanner: Scanner,
    camera: Camera,
    viewpoints: Viewpoints,
    views: list[int],
) -> list[dict[str, Any]]:
    """Writes a file per view, on all cores; the rows of labels.json."""
    from tqdm import tqdm

    from vanejax.scans import save_points

    def write_view(view: int) -> dict[str, Any]:
        camera_from_part = viewpoints.view(view)
        try:
            scan = scanner.scan(camera, camera_from_part)
        except InputError as error:
            raise InputError(f"view {view}: {error}") from error
        points = _noisy(scan, arguments.noise_mm, seed=(arguments.seed, view))
        name = f"view_{view:03d}.{arguments.format}"
        save_points(folder / name, points, scan.normals)
        return {
            "file": name,
            "view": view,
            "elevation_deg": float(viewpoints.elevation_deg[view]),
            "azimuth_deg": float(viewpoints.azimuth_deg[view]),
            "points": len(points),
            "camera_from_part": camera_from_part.as_matrix().tolist(),
        }

    # an error, or Ctrl-C, leaves the generator of `map`, which cancels the views not yet begun
    with ThreadPoolExecutor() as pool:
        rows = pool.map(write_view, views)
        return list(tqdm(rows, "scanning", len(views), unit="view", disable=arguments.quiet))


def _noisy(scan: Scan, sigma_mm: float, *, seed: tuple[int, int]) -> np.ndarray:
    """Points [N, 3] f32, mm, moved along their rays; the same seed moves them the same."""
    import numpy as np

    if not sigma_mm:
        return scan.points
    noise = np.random.default_rng(seed).normal(scale=sigma_mm, size=len(scan.points))
    stretch = 1 + noise / scan.range_mm
    return (scan.points * stretch[:, None]).astype(np.float32)


def _labels(arguments: argparse.Namespace, part: Part, camera: Camera) -> dict[str, Any]:
    return {
        "format": "vanejax virtual scans",
        "version": 1,
        "units": "mm",
        "frames": {
            "camera": "of the scans: origin at the camera, x right, y up, looking along -z",
            "part": "of the CAD model",
            "camera_from_part": "4x4, row-major, on column vectors; mm",
        },
        "part": {
            "name": part.name,
            "sha256": part.sha256,
            "center_mm": part.center.tolist(),
            "radius_mm": part.radius,
        },
        "camera": camera.to_dict()
        | {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
        "distance_mm": arguments.distance_mm,
        "noise_along_ray_mm": arguments.noise_mm,
        "seed": arguments.seed,
    }


def _check_folder(folder: Path, *, force: bool) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: is a file; give a folder")
    if folder.is_dir() and any(folder.iterdir()) and not force:
        raise InputError(f"--out {folder}: is not empty; choose another folder, or --force")


def _claim_folder(folder: Path) -> None:
    """Makes the folder; labels of an earlier run go first, since they will no longer be true."""
    from vanejax.files import check_writable

    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / LABELS).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be used: {error.strerror}") from error
    check_writable(folder / LABELS)
