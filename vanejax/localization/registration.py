"""One scan, one CAD model, one pose: search, competing hypotheses, refinement, assessment."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from vanejax.cad.declared_symmetry import PartSymmetry, Symmetry
from vanejax.cad.part import Part, load_part
from vanejax.errors import InputError
from vanejax.localization import misfit
from vanejax.localization.assessment import (
    COMPARED_POINTS,
    Assessment,
    assess,
    choose,
    competing_hypotheses,
)
from vanejax.localization.clutter_removal import segmentations, with_clutter, without_clutter
from vanejax.localization.covariance import moved_to
from vanejax.localization.edge_rounding import check_window, refine_sharpened
from vanejax.localization.fine_registration import refine, subset
from vanejax.localization.form_deviation import check_lengths, with_form_deviation
from vanejax.localization.pose_batch import concatenate, select, stack
from vanejax.localization.pose_result import PoseResult, Refinement, Verdict
from vanejax.localization.pose_search import Candidates, converge, initial_poses, search
from vanejax.localization.residuals import MeasurementModel, RayCasting, measurement_model
from vanejax.localization.sensor_calibration import Calibration
from vanejax.localization.verdict import Limits
from vanejax.rigid import RigidTransform, rigid_from_matrix
from vanejax.scanner.sensor import Sensor, preset
from vanejax.scans import MeasuredScan, clean_scan, load_scan

if TYPE_CHECKING:
    from vanejax.training.weight_file import TrainedMatcher

# one search more with twice the rotations where the first finds no well supported pose
SEARCH_ROTATIONS = (400, 800)
STATUSES = ("rejected", "ambiguous", "accepted")  # better and better
MATCH_ITERATIONS = 1  # of RPM-Net from each of 60 rotations: ray casting does the rest


def register(
    scan: MeasuredScan | np.ndarray | str | os.PathLike[str],
    part: Part | str | os.PathLike[str],
    *,
    units_scan: str = "auto",
    units_cad: str = "mm",
    sensor_origin: str | np.ndarray = "auto",
    init: RigidTransform | None = None,
    weights: TrainedMatcher | str | os.PathLike[str] | None = None,
    limits: Limits | None = None,
    segment: str = "auto",
    max_allowance_mm: float | None = None,
    form_tolerance_mm: float | None = None,
    calibration: Calibration | Sensor | str | None = None,
    sensor: Sensor | str | None = None,
    symmetry: Symmetry | str = "none",
    seed: int = 0,
) -> PoseResult:
    """Finds the pose of a part in a scan, its covariance, and whether to trust it.

    Without a guess the pose is searched among all rotations: by a trained RPM-Net where
    ``weights`` are given, else, and where that is not accepted, by ray casting. The best pose
    competes with those at which the part may look alike, is refined on all points, verified, and
    judged.

    Args:
      scan: a file (PLY, PCD, XYZ, CSV, NPZ), points [N, 3] in mm, or a `MeasuredScan`.
      part: a CAD file or a `Part`; an open surface will do.
      units_scan: of a scan file: mm, cm, m, in, ...; "auto" takes mm, or m where only that fits.
      units_cad: of a CAD file.
      sensor_origin: [3] mm in the scan's frame; "auto" takes the scan's origin where that can be
        the sensor's place; "unknown" for merged or moved clouds: then nothing is known of rays, and
        fewer wrong poses can be told from right ones. Of no use with a `MeasuredScan`, which has
        its own.
      init: rough part_from_camera. Poses far from it that fit as well are then no ambiguity.
      weights: what `vanejax export` wrote for this part, or its path; "pretrained" for those
        that come with the package, for the built-in guide vane.
      limits: of the verdict.
      segment: whether table, clamps and chips are taken out of the scan first, see
        `vanejax.scans.segmentation`: "off", "on", or "auto", which does so where registration of
        the raw scan fails, or where more than a third of it is clutter. What touches the part may
        stay.
      max_allowance_mm: how much stock a casting may have at most, uniform. It is estimated with the
        pose, see `form_deviation`; None: there may be any; 0: there is none.
      form_tolerance_mm: the part's form is within this of its CAD model (95 %); None where only the
        scan tells.
      calibration: what the sensor's calibration leaves open, or a sensor with such errors, or the
        name of a preset; for a scan in the camera's frame. It then counts in the covariance.
      sensor: a stereo camera, or a name of `vanejax.scanner.sensor.PRESETS`, whose matching window
        rounds edges off: that is then taken out, see `edge_rounding`.
      symmetry: poses that are the same by it are one: `Symmetry`, or what its ``parse`` reads, such
        as "z:180". That one is reported which is nearest to ``init``, or without one the least
        turned from the camera's axes; where the CAD model is less symmetric, that which fits best.
      seed: of all random subsets: same seed, same result.

    Raises:
      InputError: a file or a value that makes no sense; a part that the weights do not know; a
        symmetry that the CAD model does not have.
    """
    if isinstance(symmetry, str):
        symmetry = Symmetry.parse(symmetry)
    check_lengths(max_allowance_mm, form_tolerance_mm)
    if isinstance(sensor, str):
        sensor = preset(sensor)
    if calibration is not None and not isinstance(calibration, Calibration):
        calibration = Calibration.of(calibration)
    seconds: dict[str, float] = {}
    with _timed(seconds, "read"):
        if not isinstance(part, Part):
            part = load_part(part, units=units_cad, must_be_closed=False)
        weights = _load_weights(weights, part)
        init = None if init is None else _check_guess(init)
        scan = _load_scan(scan, part, units_scan, sensor_origin)
        if sensor is not None:
            check_window(sensor, scan)
        if calibration is not None:
            calibration.check_frame(scan)
    form = {
        "max_allowance_mm": max_allowance_mm,
        "form_tolerance_mm": form_tolerance_mm,
        "calibration": calibration,
    }
    of_part = None
    if symmetry != Symmetry():
        with _timed(seconds, "symmetry"):
            of_part = symmetry.on(part)
    task = _Task(part, init, weights, limits or Limits(), form, sensor, of_part, seed, seconds)
    results = []
    for segments in segmentations(scan, part, segment, seed=seed):
        seen = scan if segments is None else without_clutter(scan, segments)
        result = _register_from_sensor(seen, task)
        if segments is not None:
            model = measurement_model(part, scan.sensor_origin)
            result = with_clutter(result, scan, segments, model, limits=task.limits, seed=seed)
        results.append((result, seen))
        if task.is_sound(result):
            break
    result, seen = max(results, key=lambda tried: task.rank(tried[0]))
    return _name_other_shape(result, scan, seen, task)


@dataclasses.dataclass(frozen=True, eq=False)
class _Task:
    """What `register` was asked for, beside the scan, and the wall time of its stages so far."""

    part: Part
    init: RigidTransform | None
    weights: TrainedMatcher | None
    limits: Limits
    form: dict[str, Any]
    sensor: Sensor | None
    symmetry: PartSymmetry | None
    seed: int
    seconds: dict[str, float]

    def without_hints(self) -> _Task:
        """The same, of a part of which no pose and no weights are known."""
        return dataclasses.replace(self, init=None, weights=None)

    def is_sound(self, result: PoseResult) -> bool:
        """Whether a pose explains the scan so well that nothing else need be tried."""
        if result.verdict.status == "rejected":
            return misfit.has_other_size(result, self.limits)
        return result.verification.support >= self.limits.least_support

    def rank(self, result: PoseResult) -> tuple[bool, int, float]:
        """The largest is the best result."""
        status = STATUSES.index(result.verdict.status)
        return self.is_sound(result), status, result.verification.support


def _name_other_shape(
    result: PoseResult, scan: MeasuredScan, seen: MeasuredScan, task: _Task
) -> PoseResult:
    """A result that is rejected where the scan fits another shape much better than the part.

    Args:
      result: of the part.
      scan: the whole one.
      seen: what of it the result is of.
      task: what `register` was asked for.
    """
    refused_by_rays = seen.sensor_origin is not None and result.sensor_origin is None
    if not refused_by_rays and not misfit.fits_badly(result, task.part, task.limits):
        return result
    for factor, shown, candidates in _other_shapes(result, scan, seen, task):
        scaled = misfit.times(shown, factor)
        model = measurement_model(task.part, scaled.sensor_origin)
        other = _localize(model, scaled, candidates, task.without_hints())
        if task.is_sound(other) and task.rank(other) > task.rank(result):
            verdict = Verdict("rejected", misfit.in_words(factor, other, result))
            return dataclasses.replace(result, verdict=verdict, alternatives=())
    return result


def _other_shapes(
    result: PoseResult, scan: MeasuredScan, seen: MeasuredScan, task: _Task
) -> Iterator[tuple[float, MeasuredScan, Candidates]]:
    """Factors of a scan at which it fits clearly better than the part, and poses of that."""
    with _timed(task.seconds, "other shapes"):
        model = measurement_model(task.part, seen.sensor_origin)
        own = misfit.support(model, result.part_from_camera, seen.points, seed=task.seed)
        if task.init is not None:  # the part may well be far from the guess
            elsewhere = search(model, seen.points, seed=task.seed).pose(0)
            own = max(own, misfit.support(model, elsewhere, seen.points, seed=task.seed))
        mirrored = misfit.mirror_image(model, seen, own, seed=task.seed)
    if mirrored is not None:
        yield misfit.MIRRORED, seen, mirrored
    # what was taken for a table may be the rest of a part in another unit
    for shown in (seen,) if seen is scan else (seen, scan):
        with _timed(task.seconds, "other shapes"):
            resized = misfit.other_size(model, shown, own, seed=task.seed)
        if resized is not None:
            factor, candidates = resized
            yield factor, shown, candidates


def _register_from_sensor(scan: MeasuredScan, task: _Task) -> PoseResult:
    """The pose of the part; where the assumed sensor origin rules out every pose, an ambiguous one.

    What the rays from the assumed origin refuse is never accepted without them.
    """
    result = _register_points(scan, task, SEARCH_ROTATIONS)
    if not scan.origin_is_assumed or result.verdict.status != "rejected":
        return result
    merged = dataclasses.replace(scan, sensor_origin=None)
    without_weights = dataclasses.replace(task, weights=None)
    other = _register_points(merged, without_weights, SEARCH_ROTATIONS[:1])
    noise_mm = other.verification.tolerance_mm / 3
    fits = noise_mm <= task.limits.doubtful_noise * task.part.radius
    if other.verdict.status == "rejected" or not fits:
        return result
    verdict = Verdict(
        "ambiguous",
        f"seen from the scan's origin the part fits nowhere ({result.verdict.reason}); were the "
        "sensor's place unknown, it would fit here. If the cloud was moved or merged, say so "
        "(--sensor-origin unknown); if not, the part is not like its CAD model, or another one",
    )
    return dataclasses.replace(other, verdict=verdict)


def _register_points(scan: MeasuredScan, task: _Task, rotations: tuple[int, ...]) -> PoseResult:
    """Tries searches, the cheapest first, until one gives a well supported pose."""
    with _timed(task.seconds, "set up"):
        model = measurement_model(task.part, scan.sensor_origin)
    results = []
    for candidates in _search(model, scan, task, rotations):
        result = _localize(model, scan, candidates, task)
        if task.is_sound(result):
            return result
        results.append(result)
    return max(results, key=lambda result: result.verification.support)


def _search(
    model: MeasurementModel, scan: MeasuredScan, task: _Task, rotations: tuple[int, ...]
) -> Iterator[Candidates]:
    """Candidates near the guess; else from RPM-Net; else from more and more rotations."""
    points, seed = scan.points, task.seed
    if task.init is not None:
        guesses = stack(task.init)
        if task.weights is not None:
            matched = _match(scan, guesses, task, task.weights.iterations)
            guesses = concatenate(guesses, matched)
        with _timed(task.seconds, "search"):
            candidates = converge(model, points, guesses, seed=seed, symmetry=task.symmetry)
        yield candidates
        return
    if task.weights is not None:
        from vanejax.localization.matched_poses import icosahedral_rotations

        sample = points[subset(points, COMPARED_POINTS, seed)]
        guesses = initial_poses(model, sample, icosahedral_rotations())
        matched = _match(scan, guesses, task, MATCH_ITERATIONS)
        with _timed(task.seconds, "search"):
            candidates = search(
                model, points, extra=matched, count=0, seed=seed, symmetry=task.symmetry
            )
        yield candidates
    for attempt, count in enumerate(rotations):
        with _timed(task.seconds, "search"):
            candidates = search(
                model, points, count=count, seed=seed + attempt, symmetry=task.symmetry
            )
        yield candidates


def _match(
    scan: MeasuredScan, guesses: RigidTransform, task: _Task, iterations: int
) -> RigidTransform:
    """What RPM-Net makes of the guesses."""
    # it brings JAX, which takes a second that others need not wait
    from vanejax.localization.matched_poses import match_poses

    with _timed(task.seconds, "match"):
        return match_poses(task.weights, scan, guesses, iterations=iterations, seed=task.seed)


def _localize(
    model: MeasurementModel, scan: MeasuredScan, candidates: Candidates, task: _Task
) -> PoseResult:
    """From candidates to a result: compete, choose, refine, verify and judge."""
    points, seed = scan.points, task.seed
    with _timed(task.seconds, "challenge"):
        hypotheses = competing_hypotheses(
            model, points, candidates, seed=seed, symmetry=task.symmetry
        )
        poses = choose(model, hypotheses, task.init, task.symmetry)
    with _timed(task.seconds, "refine"):
        refinement = _refine(model, scan, select(poses, 0), task)
    before = task.init
    if before is None:
        before = candidates.pose(0)
        if task.symmetry is not None:
            before = task.symmetry.canonical(before, refinement.part_from_camera)
    with _timed(task.seconds, "verify"):
        assessment = assess(
            model,
            points,
            refinement,
            select(poses, slice(1, None)),
            guess=task.init,
            limits=task.limits,
            seed=seed,
            symmetry=task.symmetry,
        )
    return PoseResult(
        part_from_camera=refinement.part_from_camera,
        verdict=assessment.verdict,
        refinement=refinement,
        uncertainty=assessment.uncertainty,
        verification=assessment.verification,
        alternatives=assessment.alternatives,
        before=before,
        sensor_origin=scan.sensor_origin,
        notes=(*scan.notes, *task.part.notes, *_notes(assessment, task)),
        seconds=task.seconds,
        symmetry=task.symmetry,
    )


def _refine(
    model: MeasurementModel, scan: MeasuredScan, pose: RigidTransform, task: _Task
) -> Refinement:
    """The pose on all points; without what a sensor's window rounds off, where it is given."""
    points = scan.points
    refinement = refine(model, points, pose, seed=task.seed)
    if task.sensor is not None and isinstance(model, RayCasting):
        refinement, points = refine_sharpened(model, scan, refinement, task.sensor, seed=task.seed)
    refinement = with_form_deviation(model, points, refinement, seed=task.seed, **task.form)
    if task.symmetry is None or not task.symmetry.is_exact:
        return refinement
    pose = task.symmetry.canonical(refinement.part_from_camera, task.init)
    return moved_to(refinement, pose, model.part.center)


def _notes(assessment: Assessment, task: _Task) -> Iterator[str]:
    """What was taken for one pose, and what only the guess decided."""
    if task.symmetry is not None:
        yield task.symmetry.in_words(guess=task.init is not None)
    turns = [f"{other.rotation_deg:.1f} deg" for other in assessment.ruled_out]
    if len(turns) == 1:
        yield f"a pose turned by {turns[0]} fits as well; the guess rules it out"
    elif turns:
        yield (
            f"{len(turns)} other poses fit as well, one turned by {turns[0]}; the guess rules them "
            "out"
        )


def _load_weights(
    weights: TrainedMatcher | str | os.PathLike[str] | None, part: Part
) -> TrainedMatcher | None:
    """The matcher, read where a file is named, if it was trained for the part."""
    if isinstance(weights, str | os.PathLike):
        from vanejax.training.weight_file import find_weights

        return find_weights(weights, part)
    if weights is not None:
        weights.check_part(part)
    return weights


def _load_scan(
    scan: MeasuredScan | np.ndarray | str | os.PathLike[str],
    part: Part,
    units: str,
    sensor_origin: str | np.ndarray,
) -> MeasuredScan:
    if isinstance(scan, MeasuredScan):
        return scan
    if isinstance(scan, np.ndarray):
        return clean_scan(scan, sensor_origin=sensor_origin)
    return load_scan(scan, units=units, part_extent_mm=part.extent_mm, sensor_origin=sensor_origin)


def _check_guess(init: RigidTransform) -> RigidTransform:
    """The guess as float64, if it is one pose."""
    rotation = np.asarray(init.rotation, np.float64)
    translation = np.asarray(init.translation, np.float64)
    if rotation.shape != (3, 3) or translation.shape != (3,):
        raise InputError(f"init must be one pose, got rotations of shape {rotation.shape}")
    pose = RigidTransform(rotation, translation)
    rigid_from_matrix(pose.as_matrix(), where="init")
    return pose


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Adds the wall time of a stage to ``seconds``."""
    start = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
