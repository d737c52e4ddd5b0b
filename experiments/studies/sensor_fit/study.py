"""How alike virtual and real scans are, effect by effect, and a sensor fitted to the real ones.

python -m experiments.sensor_fit FOLDER [--out DIR] [--fit]

FOLDER is that of `experiments.real_scans`. Every real scan is compared with what the CAD model
predicts at its refined true pose; so are virtual scans of the same part in the same pose, by an
ideal camera, with one effect of `vanejax.scanner.sensor.consumer_depth` alone, with all and with
all but one. ``--fit`` searches the values of that preset on every other scan and prints them.
Results: a table, sensor_fit.json and real_scans.png in ``--out``.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import minimize

from experiments.runner import markdown
from experiments.runner import study_command as study
from experiments.studies.real_scans.study import load_truth
from experiments.studies.sensor_fit.sensor_statistics import (
    EDGE_PX,
    Compared,
    Grid,
    compared,
    distance,
    find_grid,
    residual_gap,
    statistics,
)
from vanejax.cad import load_part
from vanejax.localization import RayCasting, measurement_model
from vanejax.plotting import canvas
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Sensor, measurement
from vanejax.scanner.camera import field_of_view_deg
from vanejax.scanner.sensor import consumer_depth

EFFECTS: dict[str, tuple[str, ...]] = {
    "noise": ("noise_px",),
    "correlated": ("correlated_px",),
    "window": ("window_px", "edge_fattening_px"),
    "mixed": ("flying_pixel_rate",),
    "steps": ("depth_quantisation_mm",),
    "dropout": (
        "shadow",
        "max_incidence_deg",
        "incidence_spread_deg",
        "border_dropout_px",
        "dropout_rate",
    ),
}
START = {
    "noise_px": 0.01,
    "correlated_px": 0.06,
    "correlation_px": 10.0,
    "window_px": 2.0,
    "edge_fattening_px": 1.5,
    "border_dropout_px": 1.0,
    "flying_pixel_rate": 0.5,
    "jump_mm": 8.0,
    "dropout_rate": 0.015,
    "incidence_spread_deg": 8.0,
    "max_incidence_deg": 77.0,
}
"""Where the search begins: guessed from the pictures of the residuals."""
RECORDED_AS = {
    "edge_fattening_px": "adhesion_px",
    "border_dropout_px": "rim_px",
    "flying_pixel_rate": "mixed_share",
    "depth_quantisation_mm": "step_mm",
    "max_incidence_deg": "most_incidence_deg",
    "dropout_rate": "lost_share",
}
"""Names of the sensor's fields in results, which keep those of the first record."""
SHOWN = ("Separator_2", "Range_Hood_4")
"""In the picture: two that the preset was not fitted to."""


class RealScan(NamedTuple):
    """One scan, its part, and about where the part stood."""

    name: str  # the file's stem
    model: RayCasting  # rays from the origin of the scan's frame
    camera_from_part: RigidTransform  # one right answer; a symmetric part has more
    points: np.ndarray  # [N, 3] f64 mm, camera frame

    def compared(self, grid: Grid, points: np.ndarray | None = None) -> Compared:
        """The scan, or other ``points`` of the same part in the same pose, with the prediction."""
        points = self.points if points is None else points
        return compared(self.model, points, self.camera_from_part, grid)


def load(folder: Path) -> list[RealScan]:
    """The scans of a folder.

    Raises:
      InputError: as `load_truth`, or a file that cannot be read.
    """
    model = functools.cache(
        lambda cad, units: measurement_model(load_part(cad, units=units), np.zeros(3))
    )
    scans = []
    for known in load_truth(folder):
        of = model(known.cad, known.cad_units)
        pose = RigidTransform.from_matrix(known.camera_from_part[0])
        scans.append(RealScan(known.scan.stem, of, pose, known.points(of.part)))
    return scans


def fitted_camera(grid: Grid) -> Camera:
    """The depth camera with the pixels of the grid, the optical axis in its middle."""
    camera = consumer_depth().camera
    fov_x, fov_y = (field_of_view_deg(n, grid.focal_px) for n in (camera.width, camera.height))
    return dataclasses.replace(camera, fov_x_deg=fov_x, fov_y_deg=fov_y)


def measured_by(scans: Sequence[RealScan], sensor: Sensor, seed: int) -> list[Compared]:
    """The same parts in the same poses, scanned by a sensor and compared as the real ones are."""
    grid = Grid(sensor.camera.fx, 0.5, 0.5)  # the middle of an even number of pixels
    result = []
    for number, scan in enumerate(scans):
        rng = np.random.default_rng([seed, number])
        taken = measurement.measure(scan.model.scanner, sensor, scan.camera_from_part, rng)
        result.append(scan.compared(grid, taken.points.astype(np.float64)))
    return result


def without(full: Sensor, effect: str) -> Sensor:
    """A sensor less one of its effects."""
    return dataclasses.replace(full, **{name: getattr(Sensor(), name) for name in EFFECTS[effect]})


def with_values(sensor: Sensor, values: Mapping[str, float]) -> Sensor:
    """The sensor with other magnitudes, each held within what a sensor can have."""
    bounds = {
        "correlation_px": (1.0, 100.0),
        "flying_pixel_rate": (0.0, 1.0),
        "dropout_rate": (0.0, 1.0),
        "max_incidence_deg": (30.0, 90.0),
    }
    return dataclasses.replace(
        sensor,
        **{name: float(np.clip(v, *bounds.get(name, (0.0, 100.0)))) for name, v in values.items()},
    )


def fit(
    unlike: Callable[[Sensor], float], sensor: Sensor, start: Mapping[str, float], *, steps: int
) -> Sensor:
    """The values in place of ``start`` for which ``unlike`` is smallest, by Nelder and Mead.

    Over the values' logarithms, twice: the second search begins where the first ended, with a new
    simplex, as the first one's tends to collapse. ``unlike`` must use the same random numbers at
    every call, so that it is a function. At most ``steps`` calls in all.
    """
    names = list(start)

    def there(place: np.ndarray) -> Sensor:
        return with_values(sensor, dict(zip(names, np.exp(place), strict=True)))

    best = np.log(list(start.values()))
    sizes = np.diag([-0.06 if name == "max_incidence_deg" else 0.4 for name in names])
    for size in (sizes, -sizes):
        best = minimize(
            lambda place: unlike(there(place)),
            best,
            method="Nelder-Mead",
            options={
                "maxfev": steps // 2,
                "initial_simplex": np.vstack([best, best + size]),
                "adaptive": True,  # to the number of values: without it ten are too many
            },
        ).x
    return there(best)


def halves(items: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    """Every other one, and the rest: to fit, and to test the fit."""
    return list(items[0::2]), list(items[1::2])


def measure(
    scans: Sequence[RealScan], real: Sequence[Compared], full: Sensor, seed: int
) -> tuple[dict[str, Any], dict[str, list[Compared]]]:
    """Figures of the real scans and of virtual ones, how far apart they are, and the scans.

    Distances are to the real scans: of all, and of those half of them that were not fitted to.
    """
    sensors = {
        "ideal": full.only(),
        **{f"+ {effect}": full.only(*names) for effect, names in EFFECTS.items()},
        "all": full,
        **{f"all but {effect}": without(full, effect) for effect in EFFECTS},
    }
    made = {name: measured_by(scans, sensor, seed) for name, sensor in sensors.items()}
    of_all = statistics(real)
    fitted, held_out = halves(real)
    of_fitted, of_held_out = statistics(fitted), statistics(held_out)
    rows = {}
    for name, virtual in made.items():
        figures = statistics(virtual)
        rows[name] = {
            "statistics": figures,
            "distance": distance(of_all, figures),
            "distance_held_out": distance(of_held_out, statistics(halves(virtual)[1])),
            "residual_gap": residual_gap(real, virtual),
        }
    report = {
        "scans": [scan.name for scan in scans],
        "fitted_to": [scan.name for scan in halves(scans)[0]],
        "real": {
            "statistics": of_all,
            "distance_of_halves": distance(of_fitted, of_held_out),
            "residual_gap_of_halves": residual_gap(fitted, held_out),
        },
        "virtual": rows,
    }
    return report, {"real": list(real), **made}


def table(report: Mapping[str, Any]) -> str:
    """Figures of real and virtual scans side by side, as Markdown; then the distances."""
    virtual, real = report["virtual"], report["real"]
    shown = [name for name in virtual if not name.startswith("all but")]
    columns = [real["statistics"], *(virtual[name]["statistics"] for name in shown)]
    rows = [
        [figure, *(_cell(figure, column[figure]) for column in columns)]
        for figure in real["statistics"]
    ]
    for title, key, halves_key in (
        ("**distance, all scans**", "distance", "distance_of_halves"),
        ("**distance, scans not fitted to**", "distance_held_out", None),
        ("**Kolmogorov-Smirnov, residuals**", "residual_gap", "residual_gap_of_halves"),
    ):
        of_halves = f"(halves: {real[halves_key]:.2f})" if halves_key else ""
        rows.append([title, of_halves, *(f"{virtual[name][key]:.2f}" for name in shown)])
    left = ", ".join(
        f"{name.removeprefix('all but ')} {row['distance']:.2f}"
        for name, row in virtual.items()
        if name.startswith("all but")
    )
    text = markdown.table(["figure", "real", *shown], rows)
    return f"{text}\n\nThe distance with all effects but one: {left}."


def _cell(figure: str, value: float | None) -> str:
    if value is None or not np.isfinite(value):
        return "-"
    return f"{value:.1%}" if figure.endswith("(share)") else f"{value:.2f}"


def picture(scans: Sequence[RealScan], taken: Mapping[str, Sequence[Compared]]) -> Figure:
    """Two scans: residuals in the image, real and virtual, and how they are distributed."""
    columns = {"real": "real", "ideal": "ideal", "all": "consumer_depth"}
    names = [scan.name for scan in scans]
    chosen = [names.index(name) for name in SHOWN if name in names] or [0]
    figure = canvas.new_figure(canvas.WIDTH_IN, 2.2 * len(chosen))
    panels = figure.subplots(len(chosen), 4, squeeze=False, width_ratios=(1, 1, 1, 1.3))
    for row, number in zip(panels, chosen, strict=True):
        canvas.style_chart(
            row[3], title="away from edges", xlabel="residual (mm)", ylabel="share per mm"
        )
        for axes, (key, sensor) in zip(row, columns.items(), strict=False):
            scan, style = taken[key][number], canvas.SENSORS[sensor]
            image = axes.imshow(scan.residual_mm, cmap=canvas.DEVIATION_COLORMAP, vmin=-4, vmax=4)
            title = "real" if key == "real" else f"virtual,\n{sensor}"
            axes.set_title(title, color=canvas.INK, fontsize=canvas.LABEL_PT, loc="left")
            axes.set_axis_off()
            inner = scan.residual_mm[scan.edge_px > EDGE_PX]
            row[3].hist(
                inner[np.isfinite(inner)], bins=np.arange(-6, 6.1, 0.25), density=True,
                histtype="step", color=style.color, linestyle=style.line, label=sensor,
                linewidth=1.2,
            )  # fmt: skip
        row[0].text(
            -0.05, 0.5, names[number], transform=row[0].transAxes, rotation=90, ha="right",
            va="center", color=canvas.INK, fontsize=canvas.LABEL_PT,
        )  # fmt: skip
        canvas.add_color_bar(figure, row[2], image, "measured - predicted (mm)", shrink=0.9)
        row[3].set_yscale("log")
        row[3].set_ylim(1e-3, 60)
    canvas.add_legend(
        figure, row[3].get_legend_handles_labels()[0], loc="outside lower right", ncols=3
    )
    return figure


def main(settings: argparse.Namespace) -> dict[str, Any]:
    """The comparison, after a fit if that is wanted."""
    scans = load(settings.folder)
    grid = find_grid([scan.points for scan in scans])
    real = [scan.compared(grid) for scan in scans]
    full = dataclasses.replace(consumer_depth(), camera=fitted_camera(grid))
    if settings.fit:
        some, wanted = halves(scans)[0], statistics(halves(real)[0])

        def unlike(sensor: Sensor) -> float:
            taken = measured_by(some * 2, sensor, settings.seed)  # each twice, to average chance
            return distance(wanted, statistics(taken))

        full = fit(unlike, full, START, steps=settings.steps)
        print("\n".join(f"{name}={getattr(full, name):.3g}" for name in START))
    # other random numbers than the search had
    figures, taken = measure(scans, real, full, settings.seed + 1)
    values = {
        RECORDED_AS.get(name, name): getattr(full, name)
        for effect in EFFECTS.values()
        for name in effect
    }
    head = study.header("statistics of residuals at the refined true pose", settings)
    report = head | {
        "grid": dataclasses.asdict(grid),
        "sensor": values | {"correlation_px": full.correlation_px},
    }
    report = study.save(settings.out, "sensor_fit", report | figures)
    canvas.save_figure(picture(scans, taken), settings.out / "real_scans.png")
    print(table(report))
    return report


def make_parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = study.make_parser("sensor_fit", __doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="of experiments.real_scans")
    parser.add_argument("--fit", action="store_true", help="search the values first")
    parser.add_argument("--steps", type=study.count, default=600, help="of the search (600)")
    return parser
