"""Where a scan or a casting deviates from the CAD model, and by how much."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize, to_rgb
from matplotlib.figure import Figure

from vanejax.cad import Part
from vanejax.localization.pose_result import PointStatus, PoseResult, Verification
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
OBLIQUE_YAW_DEG, OBLIQUE_PITCH_DEG = 48.0, 18.0
_PANEL_IN = 3.2
_MAX_DOTS = 100_000
# of the picture of a casting
_PIXELS = 900
_FIELD_DEG = 12.0  # from so far away a millimetre is nearly as long everywhere
_SIDES_DEG = {"from above": (30.0, 40.0), "from below": (-25.0, 220.0)}  # elevation, azimuth
_REACH_MM = 4.0  # no casting is off by half of it
_SAME_FACE = 0.9  # cosine: the CAD face under a point of the casting, not the one round an edge


def deviation_map(result: PoseResult, scan: MeasuredScan, part: Part) -> Figure:
    """Signed distance of the checked points to the CAD surface, from two sides.

    Args:
      result: with `Verification.deviation_mm`; points without a partner get a colour of their own.
      scan: what was registered.
      part: to what.
    """
    pictures = deviation_pictures(result, scan, Scene(part))
    limit = color_limit_mm(result.verification)
    mm_per_in = sum(picture.width_mm for picture in pictures) / (2 * _PANEL_IN)
    high = max(picture.width_mm * picture.height_per_width for picture in pictures) / mm_per_in
    figure = canvas.new_figure(canvas.WIDTH_IN, high + 0.6)
    # one scale for both
    panels = figure.subplots(1, 2, width_ratios=[picture.width_mm for picture in pictures])
    for axes, picture, title in zip(
        panels, pictures, ("from the sensor's side", "from further left and above"), strict=True
    ):
        show(axes, picture)
        canvas.name_panel(axes, title)
    scale = ScalarMappable(Normalize(-limit, limit), colormaps[canvas.DEVIATION_COLORMAP])
    label = "deviation from the CAD surface (mm)\n+ outside the material"
    canvas.add_color_bar(figure, panels, scale, label, fraction=0.025, extend="both")
    lost = np.count_nonzero(np.isnan(result.verification.deviation_mm))
    if lost:
        share = 100 * lost / len(result.verification.deviation_mm)
        canvas.name_colors(figure, {f"no partner on the part ({share:.1f} %)": canvas.NO_PARTNER})
    return figure


def residual_histogram(result: PoseResult) -> Figure:
    """How many checked points deviate by how much, by their status, with the noise beside.

    The curve is white noise of `Refinement.noise_mm` with as many points as there are inliers.
    Deviations are distances along the surface's normal; noise along the ray looks narrower there.
    """
    verification = result.verification
    finite = np.isfinite(verification.deviation_mm)
    deviation = verification.deviation_mm[finite]
    status = verification.status[finite]
    limit = float(np.fmax(1.6 * verification.tolerance_mm, color_limit_mm(verification)))
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


def color_limit_mm(verification: Verification) -> float:
    """Where the colours of deviations end: a round figure that 98 % of them stay below."""
    deviation = np.abs(verification.deviation_mm[np.isfinite(verification.deviation_mm)])
    wanted = float(np.percentile(deviation, 98)) if len(deviation) else 0.0
    wanted = max(wanted, 1e-3)
    power = 10.0 ** np.floor(np.log10(wanted))
    steps = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
    # a rounding error above a step is that step
    return float(power * next(step for step in steps if step * power >= wanted * (1 - 1e-9)))


def deviation_colors(deviation_mm: np.ndarray, limit_mm: float) -> np.ndarray:
    """Colours [n, 3], 0 to 1, of signed deviations [n] in mm; NaN has a colour of its own."""
    scale = Normalize(-limit_mm, limit_mm)
    colors = colormaps[canvas.DEVIATION_COLORMAP](scale(deviation_mm))[:, :3]
    colors[np.isnan(deviation_mm)] = to_rgb(canvas.NO_PARTNER)
    return colors


def deviation_pictures(result: PoseResult, scan: MeasuredScan, scene: Scene) -> tuple[Picture, ...]:
    """The two pictures of `deviation_map`: as the sensor sees it, and from further round."""
    verification = result.verification
    pose = result.part_from_camera
    some = _choice(len(verification.checked))
    points = pose.apply(scan.points[verification.checked[some]])
    colors = deviation_colors(verification.deviation_mm[some], color_limit_mm(verification))
    # how far below the surface a point is still drawn on it: what noise alone may do
    lift = verification.tolerance_mm if np.isfinite(verification.tolerance_mm) else 0.0
    pictures = []
    for yaw, pitch in ((0.0, 0.0), (OBLIQUE_YAW_DEG, OBLIQUE_PITCH_DEG)):
        reader = reader_rotation(scan, scene.part, pose, yaw_deg=yaw, pitch_deg=pitch)
        frame = scene.frame(reader, [points])
        pictures.append(scene.draw(reader, points, colors, frame=frame, lift_mm=lift))
    return tuple(pictures)


def overlay_pictures(
    scan: MeasuredScan, scene: Scene, *poses: RigidTransform, pixels: int = 600
) -> list[Picture]:
    """The scan on the CAD model at poses part_from_camera, from one side, that of the last pose.

    All pictures have the same size; ``pixels`` is their longer side.
    """
    reader = overlay_rotation(scan, scene.part, poses[-1])
    some = scan.points[_choice(len(scan.points))]
    clouds = [pose.apply(some) for pose in poses]
    frame = scene.frame(reader, clouds)
    color = np.tile(to_rgb(canvas.SCAN), (len(some), 1))
    return [
        scene.draw(reader, cloud, color, frame=frame, part_color=canvas.CAD, pixels=pixels)
        for cloud in clouds
    ]


def overlay_rotation(
    scan: MeasuredScan, part: Part, part_from_camera: RigidTransform
) -> np.ndarray:
    """reader_from_part [3, 3] of overlays: beside the sensor, where errors along its rays show."""
    return reader_rotation(scan, part, part_from_camera, yaw_deg=28.0, pitch_deg=14.0)


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
    distance = 1.05 * cast.radius / np.sin(np.radians(_FIELD_DEG) / 2)
    camera = Camera(
        width=_PIXELS, height=_PIXELS, fov_x_deg=_FIELD_DEG, fov_y_deg=_FIELD_DEG,
        near_mm=distance - 1.5 * cast.radius, far_mm=distance + 1.5 * cast.radius,
    )  # fmt: skip
    scanner, bare = Scanner(cast), Scanner(part)
    scans = []
    for elevation, azimuth in _SIDES_DEG.values():
        view = hemisphere_viewpoints(
            cast.center, distance_mm=distance, elevations_deg=[elevation], azimuths_deg=[azimuth]
        ).view(0)
        scans.append(scanner.scan(camera, view))
    offsets = [_offset_mm(scan, bare) for scan in scans]
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
    label = "offset from the CAD surface (mm), + outward"
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
