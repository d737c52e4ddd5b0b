"""One scan, one CAD model, one pose to trust: search, challenge, fine registration, verdict."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from vanejax.cad.part import Part, load_part
from vanejax.cad.surface import Surface
from vanejax.errors import InputError
from vanejax.localization.clutter_removal import attempts, with_others, without_others
from vanejax.localization.covariance import uncertainty
from vanejax.localization.edge_rounding import check_window, refine_sharpened
from vanejax.localization.fine_registration import (
    check_allowance,
    descend,
    refine,
    subset,
    without_stock,
)
from vanejax.localization.pose_result import Alternative, PoseResult
from vanejax.localization.pose_search import (
    Candidates,
    challenge,
    concatenate,
    distances,
    distinct,
    is_same,
    noise_level,
    search,
    select,
    settle,
    starts,
)
from vanejax.localization.residuals import MeasurementModel, RayCasting, SurfaceMatching
from vanejax.localization.verdict import Limits, Rival, judge
from vanejax.localization.verification import View, evidence, verify
from vanejax.rigid import RigidTransform
from vanejax.scanner.sensor import Sensor, preset
from vanejax.scanner.virtual_scanner import Scanner
from vanejax.scans.measured_scan import MeasuredScan, clean_scan
from vanejax.scans.scan_file import load_scan

if TYPE_CHECKING:
    from vanejax.training.weight_file import TrainedMatcher

RIVALS = 8  # poses beside the best that are followed to their end and compared with it
RIVAL_POINTS = 8_000
VERIFIED_POINTS = 100_000
# of the part's radius: a casting is no truer to its model than the first, and what is farther off
# than the second is not on the part
LEAST_TOLERANCE, MOST_TOLERANCE = 0.001, 0.12
REACH = 0.3  # of the part's radius: how far a surface partner is sought where no ray is known
# one search more with twice the starts where the first finds no well supported pose
STARTS = (400, 800)
# a guess is good to this; a pose farther away that fits as well is no reason to doubt it
GUESS_DEG, GUESS_SHIFT = 30.0, 0.3
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
    max_allowance_mm: float = 0.0,
    sensor: Sensor | str | None = None,
    seed: int = 0,
) -> PoseResult:
    """Finds where a part is in a scan, how sure that is, and whether to trust it.

    Without a guess the pose is searched among all rotations: by a trained RPM-Net where
    ``weights`` are given, else, and where that is not accepted, by ray casting. What is found is
    challenged by the poses at which the part may look alike, refined on all points, verified, and
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
        `vanejax.scans.segmentation`: "off", "on", or "auto", which does so where the scan is not
        sound as it is, or has more than a third of other things. What touches the part may stay.
      max_allowance_mm: for a casting with stock all over that its CAD model lacks: how much at
        most. It is then estimated with the pose, see
        `vanejax.localization.fine_registration.refine`.
      sensor: a stereo camera, or a name of `vanejax.scanner.sensor.PRESETS`, whose matching window
        rounds
        edges off: that is then taken out, see `vanejax.localization.edge_rounding`. Not with an
          allowance.
      seed: of all random subsets: same seed, same result.

    Raises:
      InputError: a file or a value that makes no sense; a part that the weights do not know.
    """
    check_allowance(max_allowance_mm)
    if isinstance(sensor, str):
        sensor = preset(sensor)
    if sensor is not None and max_allowance_mm:
        raise InputError("a sensor's window and a casting's stock are not taken out together")
    seconds: dict[str, float] = {}
    with _timed(seconds, "read"):
        if not isinstance(part, Part):
            part = load_part(part, units=units_cad, must_be_closed=False)
        if isinstance(weights, str | os.PathLike):
            from vanejax.training.pretrained import find_weights

            weights = find_weights(weights, part)
        elif weights is not None:
            weights.check_part(part)
        init = None if init is None else _checked(init)
        if isinstance(scan, np.ndarray):
            scan = clean_scan(scan, sensor_origin=sensor_origin)
        elif not isinstance(scan, MeasuredScan):
            scan = load_scan(
                scan, units=units_scan, part_extent_mm=part.extent_mm, sensor_origin=sensor_origin
            )
        if sensor is not None:
            check_window(sensor, scan)
    asked = _Asked(part, init, weights, limits or Limits(), max_allowance_mm, sensor, seed, seconds)
    results = []
    for segments in attempts(scan, part, segment, seed=seed):
        if segments is None:
            result = _located(scan, asked)
        else:
            result = _located(without_others(scan, segments), asked)
            model = _model(scan, part)
            result = with_others(result, scan, segments, model, limits=asked.limits, seed=seed)
        if asked.is_sound(result):
            return result
        results.append(result)
    return max(results, key=lambda r: (STATUSES.index(r.verdict.status), r.verification.support))


@dataclasses.dataclass(frozen=True, eq=False)
class _Asked:
    """What `register` was asked, beside the scan, and the times it took so far."""

    part: Part
    init: RigidTransform | None
    weights: TrainedMatcher | None
    limits: Limits
    max_allowance_mm: float
    sensor: Sensor | None
    seed: int
    seconds: dict[str, float]

    def is_sound(self, result: PoseResult) -> bool:
        """Whether a pose explains the scan so well that nothing else need be tried."""
        return (
            result.verdict.status != "rejected"
            and result.verification.support >= self.limits.least_support
        )

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Adds the wall time of a stage to ``seconds``."""
        with _timed(self.seconds, name):
            yield


def _located(scan: MeasuredScan, asked: _Asked) -> PoseResult:
    """The pose of the part in a scan, also where the sensor's place turns out to be assumed."""
    result = _locate(scan, asked, STARTS)
    if scan.origin_is_assumed and not asked.is_sound(result):
        # perhaps the cloud was moved after it was taken: then the rays are wrong, not the pose
        merged = dataclasses.replace(
            scan,
            sensor_origin=None,
            notes=(
                *scan.notes,
                "seen from the scan's origin the part does not fit, from anywhere it does: the "
                "sensor's place is taken as unknown",
            ),
        )
        other = _locate(merged, dataclasses.replace(asked, weights=None), STARTS[:1])
        if other.verdict.status == "accepted":
            return other
    return result


def _locate(scan: MeasuredScan, asked: _Asked, counts: tuple[int, ...]) -> PoseResult:
    """Tries sources of poses, cheapest first, until one is well supported."""
    with asked.timed("set up"):
        model = _model(scan, asked.part)
    results = []
    for found in _sources(model, scan, asked, counts):
        result = _finish(model, scan, found, asked)
        if asked.is_sound(result):
            return result
        results.append(result)
    return max(results, key=lambda result: result.verification.support)


def _model(scan: MeasuredScan, part: Part) -> MeasurementModel:
    """Rays where they are known, else the surface."""
    surface = Surface(part)
    if scan.sensor_origin is None:
        return SurfaceMatching(surface, reach_mm=REACH * part.radius)
    return RayCasting(Scanner(part), surface, scan.sensor_origin)


def _sources(
    model: MeasurementModel,
    scan: MeasuredScan,
    asked: _Asked,
    counts: tuple[int, ...],
) -> Iterator[Candidates]:
    """Candidates from the guess; else from RPM-Net; else from more and more rotations."""
    points, seed = scan.points, asked.seed
    init, weights = asked.init, asked.weights
    if weights is not None:  # it brings JAX, which takes a second that others need not wait
        from vanejax.localization.matched_poses import icosahedral_rotations, match_poses
    if init is not None:
        guesses = _batch(init)
        if weights is not None:
            with asked.timed("match"):
                matched = match_poses(
                    weights, scan, guesses, iterations=weights.iterations, seed=seed
                )
            guesses = concatenate(guesses, matched)
        with asked.timed("search"):
            found = settle(model, points, guesses, seed=seed)
        yield found
        return
    if weights is not None:
        with asked.timed("match"):
            some = points[subset(points, RIVAL_POINTS, seed)]
            guesses = starts(model, some, icosahedral_rotations())
            matched = match_poses(weights, scan, guesses, iterations=MATCH_ITERATIONS, seed=seed)
        with asked.timed("search"):
            found = search(model, points, extra=matched, count=0, seed=seed)
        yield found
    for attempt, count in enumerate(counts):
        with asked.timed("search"):
            found = search(model, points, count=count, seed=seed + attempt)
        yield found


def _finish(
    model: MeasurementModel,
    scan: MeasuredScan,
    found: Candidates,
    asked: _Asked,
) -> PoseResult:
    """Challenges, compares, refines, verifies and judges the best of the candidates."""
    part, points = asked.part, scan.points
    init, limits, seed = asked.init, asked.limits, asked.seed
    with asked.timed("challenge"):
        pool = challenge(model, points, found, seed=seed)
        some = points[subset(points, RIVAL_POINTS, seed + 2)]
        poses = followed(model, select(pool.part_from_camera, slice(0, 1 + RIVALS)), some)
        view = _view(scan, some)
        level = float(inlier_tolerance_mm(model, poses, some).min())
        total = evidence(model, poses, some, tolerance_mm=level, view=view).total
        if init is not None:  # the best of those near the guess is the one to judge
            turn, shift = distances(poses, init, part)
            total[(turn < GUESS_DEG) & (shift < GUESS_SHIFT * part.radius)] += 10
        order = np.argsort(-total, kind="stable")
        poses = select(poses, order[distinct(select(poses, order), part, len(order))])
    with asked.timed("refine"):
        refinement = refine(
            model,
            points,
            select(poses, 0),
            seed=seed,
            max_allowance_mm=asked.max_allowance_mm,
        )
        if asked.sensor is not None and isinstance(model, RayCasting):
            refinement = refine_sharpened(model, scan, refinement, asked.sensor, seed=seed)
        pose = refinement.part_from_camera
    with asked.timed("verify"):
        poses = concatenate(_batch(pose), select(poses, slice(1, None)))
        tolerance = float(inlier_tolerance_mm(model, _batch(pose), some)[0])
        said = evidence(model, poses, some, tolerance_mm=tolerance, view=view)
        checked = subset(points, VERIFIED_POINTS, seed + 3)
        bare, within = points, tolerance
        if refinement.allowance_mm:  # what is asked is whether the part is there under its stock
            bare = without_stock(model, points, pose, refinement.allowance_mm)
            within = float(inlier_tolerance_mm(model, _batch(pose), bare[checked])[0])
        verification = verify(
            model, pose, bare, checked, tolerance_mm=within, view=_view(scan, bare[checked])
        )
    sure = uncertainty(refinement, part.center)
    turn, shift = distances(poses, pose, part)
    rivals = [
        Rival(said.preference(0, k), float(turn[k]), float(shift[k]), select(poses, k))
        for k in np.flatnonzero(~is_same(turn, shift, part))
    ]
    notes = [*scan.notes, *part.notes]
    if refinement.allowance_sigma_mm:
        notes.append(
            "the stock is taken to be the same all over: what varies of it moves the pose by up to "
            "as much, which sigma does not know"
        )
    if init is not None:
        rivals = _near_guess(rivals, init, part, limits, notes)
    verdict = judge(refinement, verification, sure, rivals, radius_mm=part.radius, limits=limits)
    near = sorted(
        (r for r in rivals if r.preference < limits.least_preference), key=lambda r: r.preference
    )
    return PoseResult(
        part_from_camera=pose,
        verdict=verdict,
        refinement=refinement,
        uncertainty=sure,
        verification=verification,
        alternatives=tuple(_alternative(model, rival, some, tolerance) for rival in near)
        if verdict.status == "ambiguous"
        else (),
        before=found.pose(0) if init is None else init,
        sensor_origin=scan.sensor_origin,
        notes=tuple(notes),
        seconds=asked.seconds,
    )


def _near_guess(
    rivals: list[Rival], init: RigidTransform, part: Part, limits: Limits, notes: list[str]
) -> list[Rival]:
    """Without those that the guess rules out: far from it and no better than the pose near it."""
    kept = []
    for rival in rivals:
        turn, shift = distances(_batch(rival.part_from_camera), init, part)
        far = turn[0] > GUESS_DEG or shift[0] > GUESS_SHIFT * part.radius
        if far and rival.preference > -limits.least_preference:
            if rival.preference < limits.least_preference:
                notes.append(
                    f"a pose turned by {rival.rotation_deg:.1f} deg fits as well; the guess rules "
                    "it out"
                )
            continue
        kept.append(rival)
    return kept


def _alternative(
    model: MeasurementModel, rival: Rival, points: np.ndarray, tolerance_mm: float
) -> Alternative:
    """A rival as the result lists it."""
    deviation = model.residuals(
        _batch(rival.part_from_camera), points, precision="samples"
    ).deviation_mm
    return Alternative(
        part_from_camera=rival.part_from_camera,
        rotation_deg=rival.rotation_deg,
        translation_mm=rival.translation_mm,
        inlier_share=float(np.mean(np.abs(deviation) <= tolerance_mm)),
    )


def followed(model: MeasurementModel, poses: RigidTransform, points: np.ndarray) -> RigidTransform:
    """H poses [H, 3, 3] followed to where they explain the points [n, 3] best: to be compared."""
    return descend(
        model,
        poses,
        points,
        iterations=8,
        precision="samples",
        floor_mm=LEAST_TOLERANCE * model.part.radius,
        settled_deg=0.02,
    )[0]


def inlier_tolerance_mm(
    model: MeasurementModel, poses: RigidTransform, points: np.ndarray
) -> np.ndarray:
    """[H] largest deviation of an inlier, mm: three robust standard deviations, within bounds."""
    radius = model.part.radius
    level = 3 * noise_level(model, poses, points)
    return np.clip(level, LEAST_TOLERANCE * radius, MOST_TOLERANCE * radius)


def _view(scan: MeasuredScan, points: np.ndarray) -> View | None:
    return None if scan.sensor_origin is None else View(points, scan.sensor_origin)


def _batch(pose: RigidTransform) -> RigidTransform:
    return RigidTransform(pose.rotation[None], pose.translation[None])


def _checked(init: RigidTransform) -> RigidTransform:
    """The guess as float64, if it is one pose."""
    rotation = np.asarray(init.rotation, np.float64)
    translation = np.asarray(init.translation, np.float64)
    if rotation.shape != (3, 3) or translation.shape != (3,):
        raise InputError(f"init must be one pose, got rotations of shape {rotation.shape}")
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    if not (orthonormal and np.linalg.det(rotation) > 0 and np.isfinite(translation).all()):
        raise InputError(
            "init is no rigid motion: its rotation is not orthonormal and right-handed"
        )
    return RigidTransform(rotation, translation)


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Adds the wall time of a stage to ``seconds``."""
    start = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
