"""What the terminal shows of a registration."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vanejax.localization.pose_result import FormDeviation, PoseResult, Verdict

_COLORS = {"accepted": "32", "ambiguous": "33", "rejected": "31"}
_WIDTH = 100


def verdict_line(verdict: Verdict, *, color: bool) -> str:
    """The verdict and its reason."""
    word = verdict.status.upper()
    if color:
        word = f"\x1b[1;{_COLORS[verdict.status]}m{word}\x1b[0m"
    return f"{word}: {verdict.reason}"


def summary(
    result: PoseResult, *, color: bool, seconds: Mapping[str, float], calibrated: bool = False
) -> str:
    """A compact page of text, the verdict first.

    Args:
      result: what to show.
      color: whether the terminal takes colours.
      seconds: of each stage, in order; the whole last.
      calibrated: whether sigma has what the camera's calibration leaves open.
    """
    from vanejax.machine.pose_file import pose_to_dict

    numbers = pose_to_dict(result.part_from_camera)["part_from_camera_as"]
    uncertainty, checks, refinement = result.uncertainty, result.verification, result.refinement
    ended = "converged" if refinement.converged else "NOT CONVERGED"
    lacking = "" if calibrated else "; without the camera's calibration"
    lines = [
        verdict_line(result.verdict, color=color),
        "",
        "part_from_camera (from the scan's frame to the CAD model's)",
        f"  translation  {_row(numbers['translation_mm'])} mm",
        f"  Euler XYZ    {_row(numbers['euler_xyz_deg'])} deg (fixed axes x, y, z)",
        f"sigma (of the part about its centre, along its x, y, z{lacking})",
        f"  translation  {_row(uncertainty.translation_sigma_mm)} mm, at most "
        f"{_number(uncertainty.weakest_translation_sigma_mm)} along "
        f"{_direction(uncertainty.weakest_translation_axis)}",
        f"  rotation     {_row(uncertainty.rotation_sigma_deg)} deg, at most "
        f"{_number(uncertainty.weakest_rotation_sigma_deg)} about "
        f"{_direction(uncertainty.weakest_rotation_axis)}",
        "checks",
        f"  on the part  {_share(checks.inlier_share)} of {len(checks.checked):,} points, "
        f"within {checks.tolerance_mm:.3g} mm",
        f"  violations   {_share(checks.violation_share)} (points behind the part's surface)",
        f"  unmeasured   {_share(checks.unmeasured_share)} of what the sensor should have seen",
        f"  noise        {_number(refinement.noise_mm)} mm; {refinement.method}, "
        f"{refinement.iterations} iterations, {ended}, "
        f"{refinement.num_inliers:,} of {refinement.num_points:,} points",
    ]
    if refinement.form is not None:
        lines.append(f"  form         {_form(refinement.form)}")
    if result.alternatives:
        lines.append("alternatives (from the pose above)")
    for number, other in enumerate(result.alternatives, 1):
        lines.append(
            f"  {number}. turned by {other.rotation_deg:.2f} deg, moved by "
            f"{other.translation_mm:.2f} mm: {_share(other.inlier_share)} on the part"
        )
    for note in result.notes:
        lines += textwrap.wrap(
            note, _WIDTH, initial_indent="note: ", subsequent_indent="      "
        ) or ["note:"]
    lines.append("time: " + ", ".join(f"{name} {value:.2f} s" for name, value in seconds.items()))
    return "\n".join(lines)


def _form(form: FormDeviation) -> str:
    """How the part differs from its CAD model, in one line."""
    from vanejax.localization.verdict import in_words

    if not form.is_told:
        return "unknown: too little smooth surface was measured"
    return "; ".join(in_words(form)) or "no difference from the CAD model shows"


def _row(values: Sequence[float]) -> str:
    return " ".join(f"{_number(value):>11}" for value in values)


def _number(value: float) -> str:
    if value == math.inf:
        return "free"
    return f"{value:.4f}" if math.isfinite(value) else "unknown"


def _direction(axis: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:+.2f}" for value in axis) + ")"


def _share(share: float) -> str:
    return f"{100 * share:.1f} %" if math.isfinite(share) else "unknown"
