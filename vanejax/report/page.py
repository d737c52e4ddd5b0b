"""The page: what `register` found, in the order in which an engineer asks for it."""

from __future__ import annotations

import contextlib
import datetime
import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from vanejax.cad import Part
from vanejax.errors import InputError
from vanejax.files import write_text
from vanejax.localization.pose_result import (
    FormDeviation,
    PointStatus,
    PoseResult,
    Uncertainty,
)
from vanejax.localization.verdict import Limits, in_words
from vanejax.machine.pose_file import pose_to_dict
from vanejax.plotting.deviation import (
    STATUS_COLORS,
    DeviationMaps,
    color_limit_mm,
    deviation_maps,
    form_terms,
    overlay_pictures,
    residual_histogram,
)
from vanejax.plotting.scene import Scene
from vanejax.report import templates
from vanejax.report.pictures import Image, figure_uris, image
from vanejax.report.viewer import viewer
from vanejax.report.wording import degrees, fixed, millimetres, percent, plus_minus
from vanejax.rigid import RigidTransform
from vanejax.scans import MeasuredScan

_PACKAGES = ("vanejax", "jax", "numpy", "scipy", "embreex", "trimesh")
_MOST_PICTURES = 6
_MEANING = {
    PointStatus.INLIER: ("On the part", "within what the noise explains"),
    PointStatus.BEFORE: ("Before it", "dust, a fixture, or a wrong pose"),
    PointStatus.BEHIND: (
        "Behind it",
        "the ray would have gone through material: a free-space violation",
    ),
    PointStatus.BESIDE: ("Beside it", "no partner on the part: surroundings, or a wrong pose"),
}
_FIELDS = {
    "form": "the surface waves along its normal",
    "displacement": "the part is bent or twisted",
    "range": "the sensor's range varies",
    "facing": "faces that look the same way are offset alike: stock on a few faces, or the like",
}
_ADVICE = {
    "accepted": "The scan confirms this pose.",
    "ambiguous": "More than one pose explains this scan. Do not machine before it is decided.",
    "rejected": "Do not use this pose.",
}


def write_report(
    path: str | os.PathLike[str],
    result: PoseResult,
    scan: MeasuredScan,
    part: Part,
    *,
    truth: RigidTransform | None = None,
    limits: Limits | None = None,
) -> None:
    """Writes what was found as one HTML file that needs no network and no other file.

    It opens in any browser of the last years, on a tablet and on paper too. The interactive view
    needs WebGL 2; without it the pictures remain. The page's policy forbids every request and
    every script but its own. It appears complete or not at all.

    Args:
      path: ending in .html or .htm.
      result: of `vanejax.register`.
      scan: what was registered; mm, its own frame.
      part: to what.
      truth: part_from_camera, where it is known, as for virtual scans: the error is stated too.
      limits: of the verdict, as they were given to `vanejax.register`.

    Raises:
      InputError: another suffix, a folder that cannot be written, or a result of another scan.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: a report is an HTML file; let its name end in .html")
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; make it first")
    checked = result.verification.checked
    if len(checked) and (checked.min() < 0 or checked.max() >= len(scan.points)):
        raise InputError(
            f"the result checks point {int(checked.max())}, but the scan {scan.name!r} has "
            f"{len(scan.points)}: it is another scan's result"
        )
    write_text(path, _html(result, scan, part, truth, limits or Limits()))


def _html(
    result: PoseResult,
    scan: MeasuredScan,
    part: Part,
    truth: RigidTransform | None,
    limits: Limits,
) -> str:
    """The page's text."""
    scene = Scene(part)
    before, after = overlay_pictures(scan, scene, result.before, result.part_from_camera)
    maps = deviation_maps(result, scan, scene)
    moved = _difference(result.before, result.part_from_camera, part.center)
    return templates.page(
        "page.html",
        result=result,
        scan=scan,
        part=part,
        advice=_advice(result),
        pose=_pose(result.part_from_camera),
        inverse=_pose(result.camera_from_part),
        shares=_shares(result),
        moved_deg=float(np.degrees(np.linalg.norm(moved[:3]))),
        moved_mm=float(np.linalg.norm(moved[3:])),
        before=image(before),
        after=image(after),
        form=result.refinement.form,
        differences=_differences(result.refinement.form),
        found="; ".join(in_words(result.refinement.form)).replace("+-", "±"),
        taken_out=" and ".join(form_terms(result.refinement.form)),
        needs=_needs(result.uncertainty, limits),
        maps=maps,
        deviations=_captioned(maps),
        limit_mm=color_limit_mm(result.verification),
        histogram=figure_uris(residual_histogram(result)),
        others=_others(result, scan, scene),
        truth=None if truth is None else _against_truth(result, truth),
        viewer=viewer(result, scan, part),
        total_seconds=sum(result.seconds.values()),
        slowest_seconds=max([*result.seconds.values(), 1e-9]),
        versions={name: importlib.metadata.version(name) for name in _PACKAGES},
        python=platform.python_version(),
        system=platform.platform(terse=True),
        written=datetime.datetime.now().astimezone().isoformat(sep=" ", timespec="seconds"),
    )


def _captioned(maps: DeviationMaps) -> list[tuple[str, Image]]:
    """The maps, each with what it shows: what is to be compared lies beside each other."""
    found = []
    for side, row in zip(maps.sides, maps.pictures, strict=True):
        for title, picture in zip(maps.titles, row, strict=True):
            words = side if len(maps.titles) == 1 else f"{title}, {side}"
            found.append((words[0].upper() + words[1:], image(picture)))
    return found


def _differences(form: FormDeviation | None) -> list[tuple[str, str, str]]:
    """How the part differs from its CAD model: of each difference its name, figure and meaning."""
    if form is None or not form.is_told:
        return []
    rows = [("Stock", "none found", "no uniform offset that the scan shows")]
    if form.stock_mm:
        value = f"{plus_minus(form.stock_mm, form.stock_sigma_mm)} mm"
        side = "outward" if form.stock_mm > 0 else "inward: too little material"
        rows = [("Stock", value, f"uniform offset of the surface, {side}")]
    if form.scale_error:
        value = plus_minus(100 * abs(form.scale_error), 100 * form.scale_sigma)
        word = "larger" if form.scale_error > 0 else "smaller"
        meaning = f"the part is {word}, or the camera's scale is off: one view does not tell"
        rows.append(("Size", f"{value} % {word}", meaning))
    else:
        rows.append(("Size", "as designed", "no difference that the scan shows"))
    if form.focal_error:
        value = plus_minus(100 * form.focal_error, 100 * form.focal_sigma)
        rows.append(("Focal length", f"{value} %", "the camera's calibration is off"))
    if form.field == "none":
        rows.append(
            ("Smooth deviation", "none found", "no wave, bend or twist that the scan shows")
        )
    else:
        length = f" over {form.field_length_mm:.0f} mm" if form.field_length_mm else ""
        value = f"{millimetres(form.field_mm)}{length}"
        rows.append(("Smooth deviation", value, f"σ; {_FIELDS[form.field]}"))
    if form.unexplained_share:
        share = percent(form.unexplained_share)
        meaning = "of the patches of the scan: missing or extra material, or other things"
        rows.append(("Not explained", share, meaning))
    if form.beyond_edges_share:
        share = percent(form.beyond_edges_share)
        why = "as stock or size make them"
        if not (form.stock_mm or form.scale_error):
            why = "stock on one side, or something that touches the part"
        rows.append(("Beyond the edges", share, f"of the points, by less than 3 mm: {why}"))
    return rows


def _needs(uncertainty: Uncertainty, limits: Limits) -> list[tuple[str, str, str, str]]:
    """Of the rotation and of the position: 95 % bound, what the job needs, and whether it is so."""
    rows = []
    for name, bound, least, words in (
        ("Rotation", uncertainty.rotation_bound_deg, limits.tolerance_deg, degrees),
        ("Position", uncertainty.translation_bound_mm, limits.tolerance_mm, millimetres),
    ):
        rows.append((name, words(bound), words(least), "yes" if bound <= least else "no"))
    return rows


def _advice(result: PoseResult) -> str:
    """What to do, in a sentence."""
    if result.verdict.status == "ambiguous" and not result.alternatives:
        return "The scan does not fix the pose well enough. Do not machine before it is decided."
    return _ADVICE[result.verdict.status]


def _pose(transform: RigidTransform) -> dict[str, Any]:
    """The transform in the forms that machines ask for, all of them text."""
    values = pose_to_dict(transform)
    numbers = values["part_from_camera_as"]
    matrix = [
        [fixed(v, 4 if column == 3 else 8) for column, v in enumerate(row)]
        for row in values["part_from_camera"][:3]
    ]
    return {
        "matrix": [*matrix, ["0", "0", "0", "1"]],
        "quaternion": [fixed(v, 8) for v in numbers["quaternion_wxyz"]],
        "euler": [fixed(v, 5) for v in numbers["euler_xyz_deg"]],
        "translation": [fixed(v, 4) for v in numbers["translation_mm"]],
        # only the sum or difference of the other two angles is defined there
        "locked": abs(abs(numbers["euler_xyz_deg"][1]) - 90) < 1e-4,
    }


def _difference(true: RigidTransform, found: RigidTransform, center: np.ndarray) -> np.ndarray:
    """The error [6] of `Uncertainty`, rad and mm: what takes ``found`` to ``true``."""
    error = true @ found.inverse()
    rotation = np.asarray(error.rotation, np.float64)
    turned = Rotation.from_matrix(rotation).as_rotvec()
    return np.concatenate([turned, error.translation + rotation @ center - center])


def _against_truth(result: PoseResult, truth: RigidTransform) -> dict[str, Any]:
    """The error, and its chi-square under the covariance: e^T C^-1 e, six degrees of freedom."""
    uncertainty: Uncertainty = result.uncertainty
    error = _difference(truth, result.part_from_camera, uncertainty.center)
    chi_square = float("nan")
    if uncertainty.free_axis is None:  # else the error may turn by any angle
        with contextlib.suppress(np.linalg.LinAlgError):
            chi_square = float(error @ np.linalg.solve(uncertainty.covariance, error))
    return {
        "rotation_deg": float(np.degrees(np.linalg.norm(error[:3]))),
        "translation_mm": float(np.linalg.norm(error[3:])),
        "axes_deg": [fixed(v, 5) for v in np.degrees(error[:3])],
        "axes_mm": [fixed(v, 5) for v in error[3:]],
        "chi_square": chi_square,
        "limit": float(chdtri(6, 0.05)),
    }


def _shares(result: PoseResult) -> list[dict[str, Any]]:
    """How many of the checked points have each status."""
    status = result.verification.status
    rows = []
    for value in PointStatus:
        name, meaning = _MEANING[value]
        count = int(np.count_nonzero(status == value))
        share = count / max(1, len(status))
        # the ray's side of a surface has a meaning only if there is a ray
        if value is PointStatus.BEHIND and np.isnan(result.verification.violation_share):
            share = float("nan")
        row = {"name": name, "meaning": meaning, "share": share, "count": count}
        rows.append(row | {"color": STATUS_COLORS[value]})
    return rows


def _others(result: PoseResult, scan: MeasuredScan, scene: Scene) -> list[dict[str, Any]]:
    """The alternatives; the first few with a picture, each from beside its own sensor."""
    rows = []
    for alternative in result.alternatives:
        found = alternative.part_from_camera
        picture = None
        if len(rows) < _MOST_PICTURES:
            (small,) = overlay_pictures(scan, scene, found, pixels=360)
            picture = image(small)
        rows.append({"alternative": alternative, "pose": _pose(found), "image": picture})
    return rows
