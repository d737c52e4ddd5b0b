"""Clutter (table, clamps, chips) taken out of a scan, and what its rays still say about a pose."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from vanejax.cad.part import Part
from vanejax.errors import InputError
from vanejax.localization.fine_registration import subset
from vanejax.localization.pose_batch import stack
from vanejax.localization.pose_result import PoseResult, Verdict
from vanejax.localization.residuals import MeasurementModel
from vanejax.localization.verdict import Limits
from vanejax.scans.measured_scan import MIN_POINTS, MeasuredScan
from vanejax.scans.segmentation import Segment, Segments, is_larger, segment

WHEN = ("auto", "off", "on")
MOST_CLUTTER = 0.33  # of the points: with more of it the whole scan is tried second
MOST_TABLE = 0.5  # of the points: with more of it the whole scan is not tried
LEAST_CLUTTER = 0.02  # of the points: less makes no difference
CHECKED_POINTS = 100_000


def segmentations(
    scan: MeasuredScan, part: Part, when: str, *, seed: int = 0
) -> Iterator[Segments | None]:
    """Segmentations in which to seek the part, likeliest first; None for the whole scan.

    Args:
      scan: that may show more than the part.
      part: what is sought in it.
      when: ``"off"``: only the whole scan; ``"on"``: only without clutter, if there is any;
        ``"auto"``: without clutter first where that is more than a third, else second.
      seed: of the segmentation.

    Raises:
      InputError: ``when`` is none of these.
    """
    if when not in WHEN:
        raise InputError(f"segment must be one of {', '.join(WHEN)}, got {when!r}")
    whole_first = when == "off" or (when == "auto" and not is_larger(scan.points, part))
    if whole_first:
        yield None
    if when == "off":
        return
    segments = segment(scan.points, part, sensor_origin=scan.sensor_origin, seed=seed)
    kept = segments.count(Segment.PART)
    if when == "auto" and not whole_first and kept > (1 - MOST_CLUTTER) * len(scan.points):
        whole_first = True
        yield None
    differs = MIN_POINTS <= kept < (1 - LEAST_CLUTTER) * len(scan.points)
    if differs:
        yield segments
    # with so much of a table in it no pose of the whole scan can be accepted
    hopeless = differs and segments.count(Segment.TABLE) > MOST_TABLE * len(scan.points)
    if not whole_first and not hopeless and (when == "auto" or not differs):
        yield None


def without_clutter(scan: MeasuredScan, segments: Segments) -> MeasuredScan:
    """The part's points alone, and a note that says what was taken away."""
    kept = segments.part
    table, other = segments.count(Segment.TABLE), segments.count(Segment.OTHER)
    note = (
        f"of {len(kept):,} points {table:,} were taken away as a table and {other:,} as other "
        "things; what touches the part may have stayed"
    )
    return dataclasses.replace(
        scan,
        points=scan.points[kept],
        normals=None if scan.normals is None else scan.normals[kept],
        notes=(*scan.notes, note),
    )


def with_clutter(
    result: PoseResult,
    scan: MeasuredScan,
    segments: Segments,
    model: MeasurementModel,
    *,
    limits: Limits | None = None,
    seed: int = 0,
) -> PoseResult:
    """The result for the part's points, from `without_clutter`, as one for the whole scan.

    Its indices become those of the scan. The rays to the clutter are free as well: a pose with the
    part in the way of too many of them is rejected.

    Args:
      result: for the part's points alone.
      scan: the whole one.
      segments: of it.
      model: predicts points of the whole scan.
      limits: of the verdict.
      seed: of the subset of the clutter that is checked.
    """
    kept = np.flatnonzero(segments.part)
    verification = dataclasses.replace(
        result.verification, checked=kept[result.verification.checked]
    )
    result = dataclasses.replace(result, verification=verification)
    if result.sensor_origin is None or result.verdict.status == "rejected":
        return result
    clutter = np.flatnonzero(~segments.part)
    checked = clutter[subset(clutter, CHECKED_POINTS, seed + 5)]
    residuals = model.residuals(stack(result.part_from_camera), scan.points[checked])
    behind = np.mean(residuals.hit & (residuals.deviation_mm < -verification.tolerance_mm))
    share = float(behind) * len(clutter) / len(kept)
    if share <= (limits or Limits()).most_violation_share:
        return result
    reason = (
        f"a table or other things, {share:.0%} as many points as there are on the part, would have "
        "been seen through its material"
    )
    return dataclasses.replace(result, verdict=Verdict("rejected", reason))
