"""Where a scan or a casting deviates from the CAD model, and by how much."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize, to_rgb
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from vanejax.cad import Part
from vanejax.localization.assessment import without_form_deviation
from vanejax.localization.pose_batch import stack
from vanejax.localization.pose_result import FormDeviation, PointStatus, PoseResult, Verification
from vanejax.localization.residuals import MeasurementModel, RayCasting, measurement_model
from vanejax.localization.verdict import in_words
from vanejax.plotting import canvas
from vanejax.plotting.scene import Picture, Scene, reader_rotation, show
from vanejax.plotting.shading import crop_size, draw_part, shade
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, Scan, Scanner, hemisphere_viewpoints
from vanejax.scans import MeasuredScan

STATUS_COLORS = {
    PointStatus.INLIER: canvas.SCAN,
    PointStatus.BEFORE: "#cc79a7",
    PointStatus.BEHIND: "#8c2d04",
    PointStatus.BESIDE: canvas.NO_PARTNER,
}
# the second look on the same scan: far enough round to see what the first one foreshortens
_OBLIQUE_DEG = {"yaw_deg": 48.0, "pitch_deg": 18.0}
_LIFT = 0.005  # of the part's radius: little enough to hide behind the thinnest wall
UNMEASURED = canvas.FAINT  # of the part: darker than the grey of no deviation
_PANEL_IN = 3.2
_TITLE_CHARACTERS = 105
_MAX_DOTS = 100_000
# of the picture of a casting
_PIXELS = 900
_FIELD_DEG = 12.0  # from so far away a millimetre is nearly as long everywhere
_SIDES_DEG = {"from above": (30.0, 40.0), "from below": (-25.0, 220.0)}  # elevation, azimuth
_REACH_MM = 4.0  # no casting is off by half of it
_FACING = 0.5  # of the part's radius: as far apart count points that face at right angles
_SAME_FACE = 0.9  # cosine: the CAD face under a point of the casting, not the one round an edge


class DeviationMaps(NamedTuple):
    """Pictures of a scan's deviations from the CAD surface, drawn on that surface.

    Attributes:
      titles: of the maps: one, or two where the part has stock or another size: as measured, and
        without these.
      sides: from where they are seen.
      pictures: of each side a picture for each map.
      limit_mm: where the colours of all of them end.
      below_share, above_share: of the checked points, those beyond the colours in the last map:
        noise, what is near an edge, and what no difference that was found explains.
      lost_share: of the checked points, those without a partner on the part.
    """

    titles: tuple[str, ...]
    sides: tuple[str, ...]
    pictures: tuple[tuple[Picture, ...], ...]
    limit_mm: float
    below_share: float
    above_share: float
    lost_share: float


def deviation_map(result: PoseResult, scan: MeasuredScan, part: Part) -> Figure:
    """Signed distance of the checked points to the CAD surface, from two sides.

    Where the part has stock, or the scan another size, a second map shows what is left without
    them, beside the first in the same colours; the title names what was found.

    Args:
      result: with `Verification.deviation_mm`; points without a partner get a colour of their own.
      scan: what was registered.
      part: to what.
    """
    maps = deviation_maps(result, scan, Scene(part))
    if len(maps.titles) == 1:
        rows, titles = [[picture for (picture,) in maps.pictures]], maps.sides
    else:
        rows = maps.pictures
        titles = [f"{title}\n{side}" for side in maps.sides for title in maps.titles]
    # one scale for all
    widths = np.max([[picture.width_mm for picture in row] for row in rows], axis=0)
    heights = [max(picture.width_mm * picture.height_per_width for picture in row) for row in rows]
    mm_per_in = sum(widths) / (2 * _PANEL_IN)
    figure = canvas.new_figure(canvas.WIDTH_IN, sum(heights) / mm_per_in + 0.4 + 0.3 * len(rows))
    panels = figure.subplots(
        len(rows), 2, squeeze=False, width_ratios=widths, height_ratios=heights
    )
    pictures = [picture for row in rows for picture in row]
    for axes, picture, title in zip(panels.flat, pictures, titles, strict=True):
        show(axes, picture)
        canvas.name_panel(axes, title)
    found = "; ".join(in_words(result.refinement.form)).replace("+-", "±")
    if found:
        words = "\n".join(textwrap.wrap(found, _TITLE_CHARACTERS))
        figure.suptitle(words, fontsize=canvas.TITLE_PT, color=canvas.INK)
    scale = ScalarMappable(Normalize(-maps.limit_mm, maps.limit_mm), deviation_colormap())
    label = "deviation from the CAD surface (mm)\n+ outside the material"
    bar = canvas.add_color_bar(figure, panels, scale, label, fraction=0.025, extend="both")
    bar.set_ticks(maps.limit_mm * np.linspace(-1, 1, 5))
    canvas.name_colors(figure, _legend(maps), columns=2 if len(maps.titles) > 1 else None)
    return figure


def _legend(maps: DeviationMaps) -> dict[str, str]:
    """What the colours beside those of the bar mean; shares are of the last map."""
    where = " in the right map" if len(maps.titles) > 1 else ""
    shares = {
        f"> {maps.limit_mm:g} mm below": (maps.below_share, canvas.FAR_BELOW),
        f"> {maps.limit_mm:g} mm outside": (maps.above_share, canvas.FAR_ABOVE),
        "no partner": (maps.lost_share, canvas.NO_PARTNER),
    }
    named = {
        f"{name}: {'< 0.1' if share < 5e-4 else f'{100 * share:.1f}'} %{where}": color
        for name, (share, color) in shares.items()
        if share
    }
    return named | {"not measured": UNMEASURED}


def residual_histogram(result: PoseResult) -> Figure:
    """How many checked points deviate by how much, by their status, with the noise beside.

    The curve is white noise of `Refinement.noise_mm` with as many points as there are inliers.
    Deviations are distances along the surface's normal; noise along the ray looks narrower there.
    """
    verification = result.verification
    finite = np.isfinite(verification.deviation_mm)
    deviation = verification.deviation_mm[finite]
    status = verification.status[finite]
    limit = float(np.fmax(1.6 * verification.tolerance_mm, _round_limit_mm(deviation, 98)))
    edges = np.linspace(-limit, limit, 97)
    figure = canvas.new_figure(5.0, 2.9)
    axes = figure.subplots()
    canvas.style_chart(axes, xlabel="deviation from the CAD surface (mm)", ylabel="points")
    shown = [s for s in PointStatus if (status == s).any()]
    if shown:
        axes.hist(
            [deviation[status == s] for s in shown], edges, stacked=True, histtype="stepfilled",
            color=[STATUS_COLORS[s] for s in shown], label=[s.name.lower() for s in shown],
        )  # fmt: skip
    noise = result.refinement.noise_mm
    inliers = np.count_nonzero(status == PointStatus.INLIER)
    if np.isfinite(noise) and noise > 0 and inliers:
        x = np.linspace(-limit, limit, 401)
        density = np.exp(-0.5 * (x / noise) ** 2) / (noise * np.sqrt(2 * np.pi))
        axes.plot(
            x, inliers * (edges[1] - edges[0]) * density, color=canvas.INK, linewidth=1.4,
            label=f"noise, σ = {noise:.3g} mm",
        )  # fmt: skip
    if np.isfinite(verification.tolerance_mm):
        for sign, label in ((-1, "tolerance"), (1, "_nolegend_")):
            edge = sign * verification.tolerance_mm
            axes.axvline(edge, color=canvas.INK, linewidth=1, linestyle=(0, (4, 3)), label=label)
    beyond = np.count_nonzero(np.abs(deviation) > limit)
    if beyond:
        words = f"{beyond:,} points lie beyond ±{limit:.3g} mm"
        canvas.name_panel(axes, words, loc="right")
    axes.set_xlim(-limit, limit)
    entries = dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    order = dict.fromkeys([*(s.name.lower() for s in shown), *entries])
    canvas.add_legend(
        figure, [entries[name] for name in order], loc="outside upper center", ncols=6,
        handlelength=1.4, columnspacing=1.2,
    )  # fmt: skip
    return figure


def overlay_before_after(result: PoseResult, scan: MeasuredScan, part: Part) -> Figure:
    """The scan on the CAD model at the first guess and at the result.

    Args:
      result: `PoseResult.before` and `PoseResult.part_from_camera` are drawn.
      scan: of more than 100,000 points a random choice is drawn.
      part: to what it was registered.
    """
    pictures = overlay_pictures(scan, Scene(part), result.before, result.part_from_camera)
    figure = canvas.new_figure(
        canvas.WIDTH_IN, canvas.WIDTH_IN / 2 * pictures[0].height_per_width + 0.6
    )
    for axes, picture, title in zip(
        figure.subplots(1, 2), pictures, ("before", "after"), strict=True
    ):
        show(axes, picture)
        canvas.name_panel(axes, title, fontweight="bold")
    canvas.name_colors(figure, {"scan": canvas.SCAN, "CAD": canvas.CAD})
    return figure


def color_limit_mm(verification: Verification, measured_mm: np.ndarray | None = None) -> float:
    """Where the colours of deviations end: a round figure that 99 % of the inliers are not beyond.

    Where there is no inlier, 98 % of all points.

    Args:
      verification: of n points.
      measured_mm: [n], the same points' deviations with all that the part differs by; 98 % of the
        inliers' are not beyond the limit either.
    """
    finite = np.isfinite(verification.deviation_mm)
    inlier = finite & (verification.status == PointStatus.INLIER)
    if not inlier.any():
        return _round_limit_mm(verification.deviation_mm, 98)
    limit = _round_limit_mm(verification.deviation_mm[inlier], 99)
    return limit if measured_mm is None else max(limit, _round_limit_mm(measured_mm[inlier], 98))


def _round_limit_mm(deviation_mm: np.ndarray, percent: float) -> float:
    """A round figure that so many of the deviations stay below."""
    deviation = np.abs(deviation_mm[np.isfinite(deviation_mm)])
    wanted = float(np.percentile(deviation, percent)) if len(deviation) else 0.0
    wanted = max(wanted, 1e-3)
    power = 10.0 ** np.floor(np.log10(wanted))
    steps = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
    # a rounding error above a step is that step
    return float(power * next(step for step in steps if step * power >= wanted * (1 - 1e-9)))


def deviation_colormap() -> Colormap:
    """The colours of deviations, with those beyond its ends and of what has no partner."""
    return colormaps[canvas.DEVIATION_COLORMAP].with_extremes(
        under=canvas.FAR_BELOW, over=canvas.FAR_ABOVE, bad=canvas.NO_PARTNER
    )


def deviation_colors(deviation_mm: np.ndarray, limit_mm: float) -> np.ndarray:
    """Colours [n, 3], 0 to 1, of signed deviations [n] in mm; NaN has a colour of its own."""
    scale = Normalize(-limit_mm, limit_mm)
    return deviation_colormap()(scale(np.ma.masked_invalid(deviation_mm)))[:, :3]


def deviation_maps(result: PoseResult, scan: MeasuredScan, scene: Scene) -> DeviationMaps:
    """The pictures of `deviation_map`: as the sensor sees it, and from further round."""
    clouds = _clouds(result, scan, scene.part)
    last = clouds[-1].deviation_mm
    limit = color_limit_mm(result.verification, clouds[0].deviation_mm)
    some = _choice(len(last))
    pose, oblique = result.part_from_camera, dict(_OBLIQUE_DEG)
    oblique["yaw_deg"] = scene.fuller_side(scan, pose, **oblique)
    pictures = []
    for turn in ({}, oblique):
        reader = reader_rotation(scan, scene.part, pose, **turn)
        frame = scene.frame(reader, [cloud.points[some] for cloud in clouds])
        look = {"frame": frame, "part_color": UNMEASURED, "lift_mm": _LIFT * scene.part.radius}
        row = [
            scene.draw(
                reader,
                cloud.points[some],
                deviation_colors(cloud.deviation_mm[some], limit),
                **look,
            )
            for cloud in clouds
        ]
        pictures.append(tuple(row))
    side = "left" if oblique["yaw_deg"] > 0 else "right"
    front = "measured" if scan.sensor_origin is None else "sensor's"
    count = max(len(last), 1)
    return DeviationMaps(
        tuple(cloud.title for cloud in clouds),
        (f"from the {front} side", f"from further {side} and above"),
        tuple(pictures),
        limit,
        below_share=float(np.count_nonzero(last < -limit) / count),
        above_share=float(np.count_nonzero(last > limit) / count),
        lost_share=float(np.count_nonzero(np.isnan(last)) / count),
    )


class _Cloud(NamedTuple):
    """Points [n, 3] mm, part frame, on the CAD surface, and their deviations [n] mm or NaN."""

    title: str
    points: np.ndarray
    deviation_mm: np.ndarray


def _clouds(result: PoseResult, scan: MeasuredScan, part: Part) -> list[_Cloud]:
    """The checked points as measured and, where that differs, without stock and size."""
    verification, form = result.verification, result.refinement.form
    model = measurement_model(part, result.sensor_origin)
    points, pose = scan.points[verification.checked], result.part_from_camera
    names = form_terms(form)
    place, _, _ = _on_surface(*without_form_deviation(model, points, pose, form))
    title = f"without {' and '.join(names)}" if names else "as measured"
    left = _Cloud(title, place, verification.deviation_mm)
    if not names:
        return [left]
    place, deviation, hit = _on_surface(model, points, pose)
    known = hit | (np.abs(deviation) <= verification.tolerance_mm)
    return [_Cloud("as measured", place, np.where(known, deviation, np.nan)), left]


def form_terms(form: FormDeviation | None) -> tuple[str, ...]:
    """What of a form can be taken out of a scan, in words."""
    if form is None:
        return ()
    terms = {
        "stock": form.stock_mm,
        "the difference of size": form.scale_error,
        "the error of the focal length": form.focal_error,
    }
    return tuple(name for name, value in terms.items() if value)


def _on_surface(
    model: MeasurementModel, points: np.ndarray, pose: RigidTransform
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where on the CAD surface deviations of points [n, 3] mm are from, in the part's frame.

    Below the surface a point would be hidden by it. Also the deviations [n] mm and whether there is
    such a place [n]; a point without one stays where it is.
    """
    if not len(points):
        return points, np.zeros(0), np.zeros(0, bool)
    residuals = model.residuals(stack(pose), points)
    deviation, hit = residuals.deviation_mm[0], residuals.hit[0]
    if isinstance(model, RayCasting):
        away = pose.rotate(points - model.sensor_origin)
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        along = np.where(hit, deviation / np.maximum(residuals.cosine[0], 1e-6), 0.0)
    else:
        away, along = residuals.jacobian[0][:, 3:], np.where(hit, -deviation, 0.0)
    return pose.apply(points) + along[:, None] * away, deviation, hit


def overlay_pictures(
    scan: MeasuredScan, scene: Scene, *poses: RigidTransform, pixels: int = 600
) -> list[Picture]:
    """The scan on the CAD model at poses part_from_camera, from one side, that of the last pose.

    All pictures have the same size; ``pixels`` is their longer side.
    """
    reader = overlay_rotation(scan, scene, poses[-1])
    some = scan.points[_choice(len(scan.points))]
    clouds = [pose.apply(some) for pose in poses]
    frame = scene.frame(reader, clouds)
    color = np.tile(to_rgb(canvas.SCAN), (len(some), 1))
    return [
        scene.draw(reader, cloud, color, frame=frame, part_color=canvas.CAD, pixels=pixels)
        for cloud in clouds
    ]


def overlay_rotation(
    scan: MeasuredScan, scene: Scene, part_from_camera: RigidTransform
) -> np.ndarray:
    """reader_from_part [3, 3] of overlays: beside the sensor, where errors along its rays show."""
    yaw = scene.fuller_side(scan, part_from_camera, yaw_deg=28.0, pitch_deg=14.0)
    return reader_rotation(scan, scene.part, part_from_camera, yaw_deg=yaw, pitch_deg=14.0)


def _choice(count: int) -> np.ndarray | slice:
    """Which of so many points are drawn: all, or a random choice that has no pattern."""
    if count <= _MAX_DOTS:
        return slice(None)
    return np.random.default_rng(0).choice(count, _MAX_DOTS, replace=False)


def casting_map(part: Part, cast: Part) -> Figure:
    """The casting from two opposite sides, coloured by its offset from the CAD model.

    The offset is along the casting's normals, positive outward. Grey is where no CAD surface of
    about the same direction lies under the casting: beside edges, by the width of the stock.

    Args:
      part: the CAD model.
      cast: its casting, in the same frame, as from `vanejax.cad.investment_casting.as_cast`.
    """
    bare = Scanner(part)
    label = "offset from the CAD surface (mm), + outward"
    return _painted(cast, lambda scan: _offset_mm(scan, bare), label)


def stock_map(part: Part, points: np.ndarray, normals: np.ndarray, stock_mm: np.ndarray) -> Figure:
    """The finished part from two opposite sides, coloured by the stock that a blank has over it.

    Grey is where the stock is not known.

    Args:
      part: the finished part.
      points: [n, 3] mm, on its surface.
      normals: [n, 3], unit.
      stock_mm: [n], NaN where it is not known, as from `vanejax.machine.place`.
    """
    facing = _FACING * part.radius
    tree = cKDTree(np.hstack([points, facing * normals]))

    def stock(scan: Scan) -> np.ndarray:
        part_from_camera = scan.camera_from_part.inverse()
        seen = part_from_camera.apply(scan.points.astype(np.float64))
        turned = part_from_camera.rotate(scan.normals.astype(np.float64))
        return stock_mm[tree.query(np.hstack([seen, facing * turned]))[1]]

    return _painted(part, stock, "stock over the finished surface (mm)")


def _painted(solid: Part, values_mm: Callable[[Scan], np.ndarray], label: str) -> Figure:
    """A solid from two opposite sides, coloured by what a function says of a scan's points."""
    distance = 1.05 * solid.radius / np.sin(np.radians(_FIELD_DEG) / 2)
    camera = Camera(
        width=_PIXELS, height=_PIXELS, fov_x_deg=_FIELD_DEG, fov_y_deg=_FIELD_DEG,
        near_mm=distance - 1.5 * solid.radius, far_mm=distance + 1.5 * solid.radius,
    )  # fmt: skip
    scanner = Scanner(solid)
    scans = []
    for elevation, azimuth in _SIDES_DEG.values():
        view = hemisphere_viewpoints(
            solid.center, distance_mm=distance, elevations_deg=[elevation], azimuths_deg=[azimuth]
        ).view(0)
        scans.append(scanner.scan(camera, view))
    offsets = [values_mm(scan) for scan in scans]
    scale, colors = _offset_scale(np.concatenate(offsets))
    sizes = [crop_size(scan, camera) for scan in scans]
    widths = [wide / high for wide, high in sizes]
    figure = canvas.new_figure(canvas.WIDTH_IN, (canvas.WIDTH_IN - 0.9) / sum(widths) + 0.3)
    panels = figure.subplots(1, 2, width_ratios=widths)
    for axes, title, scan, offset in zip(panels, _SIDES_DEG, scans, offsets, strict=True):
        image = shade(scan, camera)
        light = image.reshape(-1, 3)[scan.pixel].mean(axis=1, keepdims=True)
        color = colors(scale(offset))[:, :3]
        color[np.isnan(offset)] = to_rgb(canvas.FAINT)
        # the surface's light keeps its shape readable
        bright = np.clip(light / np.percentile(light, 80), 0, 1)
        image.reshape(-1, 3)[scan.pixel] = color * (0.55 + 0.45 * bright)
        draw_part(axes, scan, camera, image)
        canvas.name_panel(axes, title)
    canvas.add_color_bar(
        figure, panels, ScalarMappable(scale, colors), label, fraction=0.025, extend="both"
    )
    return figure


def _offset_mm(scan: Scan, bare: Scanner) -> np.ndarray:
    """[N] mm from the CAD model to the points of a scan of the casting; NaN where there is none."""
    part_from_camera = scan.camera_from_part.inverse()
    points = part_from_camera.apply(scan.points.astype(np.float64))
    normals = part_from_camera.rotate(scan.normals.astype(np.float64))
    hits = bare.cast(points + _REACH_MM / 2 * normals, -normals)
    same = np.einsum("ni,ni->n", hits.normals, normals) > _SAME_FACE
    return np.where(same & (hits.distance_mm < _REACH_MM), hits.distance_mm - _REACH_MM / 2, np.nan)


def _offset_scale(offset: np.ndarray) -> tuple[Normalize, Colormap]:
    """Limits that 1 % of the offsets are beyond; about zero where they have both signs."""
    known = offset[np.isfinite(offset)]
    low, high = np.percentile(known, [0.5, 99.5]) if len(known) else (0.0, 0.0)
    low, high = low - 0.005, high + 0.005  # a uniform offset has a scale too
    if low < -0.01:
        limit = max(-low, high)
        return Normalize(-limit, limit), colormaps[canvas.DEVIATION_COLORMAP]
    return Normalize(low, high), colormaps[canvas.ERROR_COLORMAP]
