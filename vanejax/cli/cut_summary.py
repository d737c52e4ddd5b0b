"""What the terminal shows of how well a cut is known, and of what the part's form does to it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np

    from vanejax.cad.part import Part
    from vanejax.localization.pose_result import FormDeviation
    from vanejax.machine.motion_covariance import MotionCovariance
    from vanejax.machine.pose_record import PoseRecord
    from vanejax.machine.tool_path import ToolPath
    from vanejax.rigid import RigidTransform


class Place(NamedTuple):
    """How well a point is known: 95 % bounds in its least certain direction, mm.

    Attributes:
      words: which point, with its verb.
      where: of several, the one that is known least.
      bound_mm: by all errors together.
      by_pose_mm: by the pose's error alone.
      by_camera_mm: by that of the camera's place alone; None where it is taken as exact.
    """

    words: str
    where: str
    bound_mm: float
    by_pose_mm: float
    by_camera_mm: float | None

    def __str__(self) -> str:
        return f"{self.words} known to {_mm(self.bound_mm)} (95 %){self.where}"


def places(
    covariance: MotionCovariance,
    camera: MotionCovariance | None,
    machine_from_part: RigidTransform,
    part: Part | None,
    path: ToolPath | None,
) -> list[Place]:
    """Of the part's centre, of its surface and of the tool tip; the last matters most.

    Args:
      covariance: of the pose, part frame, about the part's centre.
      camera: of the camera's place, machine frame; None where that is taken as exact.
      machine_from_part: the work frame.
      part: the part, if it is known.
      path: of the tool in the machine's frame, if there is one.
    """
    pose = covariance.moved(machine_from_part)
    found = [_worst("the part's centre is", pose.center[None], pose, camera, lambda _: "")]
    if part is not None:
        vertices = part.mesh.vertices
        points = machine_from_part.apply(vertices)

        def on_part(k: int) -> str:
            return f", worst at {_point(vertices[k])} in the part's frame"

        found.append(_worst("the part's surface is", points, pose, camera, on_part))
    if path is not None:

        def on_path(k: int) -> str:
            return f", worst at point {k + 1} {_point(path.points[k])}"

        found.append(_worst("the tool tip is", path.points, pose, camera, on_path))
    return found


def _worst(
    words: str,
    points: np.ndarray,
    pose: MotionCovariance,
    camera: MotionCovariance | None,
    where: Callable[[int], str],
) -> Place:
    """Of points [N, 3] mm in the machine's frame, the one that is known least."""
    both = pose if camera is None else pose.with_independent(camera)
    bounds = both.bounds_mm(points)
    worst = int(bounds.argmax())
    by_pose, by_camera = (
        None if error is None else float(error.bounds_mm(points[worst : worst + 1])[0])
        for error in (pose, camera)
    )
    return Place(words, where(worst), float(bounds[worst]), by_pose, by_camera)


def place_lines(found: Sequence[Place], record: PoseRecord, *, camera_is_exact: bool) -> list[str]:
    """How well each place is known, the last with what makes it so, and what does not count.

    ``camera_is_exact``: a place of the camera was given without its standard deviations.
    """
    lines = ["", "uncertainty"]
    lines += [f"  {place}" for place in found]
    last = found[-1]
    if last.by_camera_mm is not None:
        lines.append(
            f"    {_mm(last.by_pose_mm)} by the pose alone, {_mm(last.by_camera_mm)} by the "
            "camera's place alone"
        )
    if camera_is_exact:
        lines.append("  the camera's place in the machine is taken as exact (no --camera-sigma)")
    if record.calibration is None:
        lines.append(
            "  errors of the camera's own calibration do not count (register --calibration)"
        )
    return lines


def refusal(place: Place, most_mm: float, form: FormDeviation | None) -> str | None:
    """Why a place is not known well enough, and what helps; None where it is."""
    if place.bound_mm <= most_mm:
        return None
    if (place.by_camera_mm or 0) > place.by_pose_mm:
        help_ = "most of that is the camera's place: calibrate it better, or scan from nearer"
    elif form is not None and form.scale_error:
        help_ = "check the camera's scale on a gauge, and the unit"
    else:
        help_ = "scan more of the part, from other sides"
    return (
        f"{place.words} known to {place.bound_mm:.2g} mm only (95 %){place.where}, and at most "
        f"{most_mm:g} mm is allowed: {help_}; or allow more by --max-uncertainty-mm"
    )


def form_lines(form: FormDeviation, farthest_mm: float | None) -> list[str]:
    """What the part's difference from its CAD model does to a cut along the CAD model.

    ``farthest_mm`` is the part's farthest point from its centre, if that is known.
    """
    if not form.is_told:
        return []
    words = list(_form_words(form, farthest_mm)) or ["no difference from the CAD model shows"]
    return ["", "the part as scanned (+- 1 sigma)", *(f"  {line}" for line in words)]


def _form_words(form: FormDeviation, farthest_mm: float | None) -> Iterator[str]:
    if form.stock_mm:
        size = f"{abs(form.stock_mm):.3f} +- {form.stock_sigma_mm:.3f} mm"
        if form.stock_mm > 0:
            yield f"the casting has {size} of stock: the first cut is that much deeper"
        else:
            yield (
                f"the surface lies {size} inside the CAD model: the tool cuts that much less, or "
                "nothing"
            )
    if form.scale_error:
        yield _scale_words(form, farthest_mm)
    if form.focal_error:
        yield (
            f"the camera's focal length is off by {form.focal_error:+.2%} +- {form.focal_sigma:.2%}"
            ": the pose allows for it; calibrate the camera"
        )
    if form.field != "none":
        yield _field_words(form)


def _scale_words(form: FormDeviation, farthest_mm: float | None) -> str:
    word, deeper = ("larger", "deeper") if form.scale_error > 0 else ("smaller", "less deep")
    size = f"the scan is {abs(form.scale_error):.2%} +- {form.scale_sigma:.2%} {word} than the CAD"
    if farthest_mm is None:
        return f"{size} model: the part is, or the camera's scale is off"
    off, sigma = abs(form.scale_error) * farthest_mm, form.scale_sigma * farthest_mm
    return (
        f"{size} model: if the part is, and not the camera's scale off, cuts are up to {off:.2f} "
        f"+- {sigma:.2f} mm {deeper}, {farthest_mm:.0f} mm from its centre"
    )


def _field_words(form: FormDeviation) -> str:
    from vanejax.localization.pose_result import BOUND

    length = f" over {form.field_length_mm:.0f} mm" if form.field_length_mm else ""
    size = f"{form.field_mm:.2g} mm (1 sigma){length}"
    most = f"(95 %: {BOUND * form.field_mm:.2g} mm)"
    if form.field == "range":
        return (
            f"the sensor's range seems to vary by {size}; if it is the part's surface instead, the "
            f"depth of cut varies by as much {most}"
        )
    if form.field == "facing":
        return (
            f"faces that look in different directions are offset by {size} beyond the pose: the "
            f"depth of cut differs from face to face by as much {most}"
        )
    return (
        f"the surface is off its CAD model by {size} beyond the pose: the depth of cut varies by "
        f"as much {most}"
    )


def notes(record: PoseRecord) -> Iterator[str]:
    """What the file leaves open."""
    if record.covariance is None:
        yield "the pose file has no covariance: nothing is known of how far the pose may be off"
    form = record.form
    if form is None:
        yield "nothing is known of how the part differs from its CAD model"
    elif not form.is_told:
        yield (
            "too little smooth surface was measured to tell how the part differs from its CAD model"
        )
    elif not form.converged:
        yield (
            "the estimate of how the part differs from its CAD model did not converge: the figures "
            "may be too small"
        )


def _point(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{round(float(value), 1) + 0.0:.1f}" for value in point) + ")"


def _mm(length: float) -> str:
    return f"{length:.3f} mm" if length >= 5e-4 else "less than 0.001 mm"
