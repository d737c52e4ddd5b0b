"""How a part differs from its CAD model, estimated along with its pose.

A casting has stock, has shrunk, is bent; a sensor has a scale and smooth errors of its own. Least
squares takes much of that for a motion. Here the deviations of the scan, as `deviation_patches` has
them, are asked with `random_fields` what of them is a motion, what a term of the part or of the
sensor, and how sure the pose still is.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from vanejax.errors import InputError
from vanejax.localization.deviation_patches import ScanDeviations, State, scaled_pose
from vanejax.localization.fine_registration import robust_gauss_newton, subset
from vanejax.localization.pose_batch import select, stack
from vanejax.localization.pose_result import BEYOND_EDGES_MM, FormDeviation, Refinement
from vanejax.localization.random_fields import Average, Prior, average_models
from vanejax.localization.residuals import MeasurementModel, RayCasting, moved
from vanejax.localization.sensor_calibration import Calibration
from vanejax.rigid import RigidTransform

POINTS = 20_000
SURFACE_POINTS = 200
CONVERGED = 0.25  # standard deviations of the pose: outliers come and go by less
BY_CHANCE = 17.0  # of six squared deviations, one sum in a hundred is larger
# patches keep this far from edges, and 1.5 times as far as the surface is off
MARGINS_MM = (0.3, 1.2)
MOST_STEP_DEG, MOST_STEP = 2.0, 0.03  # an iteration turns and moves by no more (of the radius)
# other starts, and how large a field must be to try them
STOCK_GUESSES_MM, CLEAR_MM = (0.7,), 0.25
ROUGH = 0.2  # of the part's radius: a field over no more is not smooth
LIKELY = 0.5  # a term more probable than this is taken to be there
# how many times more than elsewhere all points may know in a direction than those on smooth faces:
# what is beyond comes from edges, and of a casting they are that far off
MOST_BY_EDGES, EDGE_MM = 30.0, 0.4
AT_CORNERS = 1.5  # times as far as a face, an edge of two of them is moved
# of the stock: how well the points under it are known where the surface is curved
STOCK_TRUENESS = 0.005
# of the field: it is taken to be small, and moves where a ray ends
FIELD_TRUENESS = 0.01
# of scale times distance: a scan does not tell a large part from a camera with a wrong scale, which
# would move the pose along the line of sight by that much; the bounds at 1.96 sigma hold for both
SCALE_SIGMA = 0.6


def check_lengths(max_allowance_mm: float | None, form_tolerance_mm: float | None) -> None:
    """Raises InputError for lengths that stock and tolerance cannot have."""
    if max_allowance_mm is not None and not 0 <= max_allowance_mm < np.inf:
        raise InputError(
            f"max_allowance_mm must be 0 mm or more and finite, got {max_allowance_mm!r}; "
            "1 mm is usual for an investment casting"
        )
    if form_tolerance_mm is not None and not 0 < form_tolerance_mm < np.inf:
        raise InputError(
            f"form_tolerance_mm must be more than 0 mm and finite, got {form_tolerance_mm!r}; "
            "0.3 mm is usual for an investment casting of 50 mm"
        )


def with_form_deviation(
    model: MeasurementModel,
    points: np.ndarray,
    refinement: Refinement,
    *,
    max_allowance_mm: float | None = None,
    form_tolerance_mm: float | None = None,
    calibration: Calibration | None = None,
    seed: int = 0,
) -> Refinement:
    """The refinement of a part that may differ from its CAD model.

    A part that is its CAD model keeps its pose. Else pose and covariance are those of the average
    over all models of the difference.

    Args:
      model: predicts points.
      points: [N, 3] f64, mm, camera frame.
      refinement: of these points, as if the part were its CAD model.
      max_allowance_mm: the stock is between 0 and this; None: it may be any; 0: there is none.
      form_tolerance_mm: the part's form is within this of its CAD model, in 95 of 100 places; None
        where only the scan tells.
      calibration: what the sensor's leaves open; of points in the camera's frame.
      seed: of the subset of points.
    """
    check_lengths(max_allowance_mm, form_tolerance_mm)
    rays = isinstance(model, RayCasting)
    prior = Prior(
        model.part.radius,
        model.surface.points[:SURFACE_POINTS] - model.part.center,
        ("form", "displacement", "range", "facing") if rays else ("form", "displacement", "facing"),
        stock_mm=0.0 if max_allowance_mm == 0 else None,
        form_tolerance_mm=form_tolerance_mm,
    )
    sample = points[subset(points, POINTS, seed + 6)]
    scan = ScanDeviations(model, sample, calibration)
    with threadpool_limits(1):  # the matrices are small: threads would wait for each other
        estimate = _converge(scan, _start(scan, refinement.part_from_camera), prior)
        # least squares may have locked onto a few faces of a casting with much stock
        for stock_mm in () if prior.stock_mm == 0 else STOCK_GUESSES_MM:
            if estimate is None or _is_clear(*estimate[1:]):
                break
            start = _start(scan, refinement.part_from_camera, stock_mm)
            other = _converge(scan, start, prior)
            if other is not None and _is_clear(*other[1:]):
                estimate = other
    if estimate is None:
        return dataclasses.replace(refinement, form=FormDeviation(is_told=False))
    if max_allowance_mm:
        stock = estimate[0].terms[0]
        if not 0 <= stock <= max_allowance_mm:  # then it is at the bound
            prior = dataclasses.replace(prior, stock_mm=float(np.clip(stock, 0, max_allowance_mm)))
            with threadpool_limits(1):
                estimate = _converge(scan, estimate[0], prior) or estimate
    result = _result(
        model, refinement, *estimate, stock_mm=prior.stock_mm, calibrated=calibration is not None
    )
    beyond = _beyond_edges(scan, estimate[0], result, len(points))
    return dataclasses.replace(
        result, form=dataclasses.replace(result.form, beyond_edges_share=beyond)
    )


def _is_clear(average: Average, converged: bool) -> bool:
    """Whether an estimate says what the part differs by, without a large rest."""
    return converged and average.field.kind != "facing" and average.amplitude_mm <= CLEAR_MM


def _squared(average: Average) -> float:
    """The squared motion over its covariance."""
    motion = average.mean[:6]
    return float(motion @ np.linalg.solve(average.covariance[:6, :6], motion))


def _start(scan: ScanDeviations, pose: RigidTransform, stock_mm: float = 0.0) -> State:
    """A pose near one for a part with that much stock."""
    state = State(pose, np.array([stock_mm, 0.0, 0.0]), np.zeros(len(scan.moves)))
    for _ in range(2 if stock_mm else 0):
        model, points = scan.as_designed(state)
        poses, _ = robust_gauss_newton(model, stack(state.pose), points[::5], iterations=8)
        state = dataclasses.replace(state, pose=select(poses, 0))
    return state


def _converge(
    scan: ScanDeviations, state: State, prior: Prior
) -> tuple[State, Average, bool] | None:
    """From a state to that at which the average over all models stays; None: too few patches.

    Also whether it stayed.
    """
    quick = _as_designed_already(scan, state, prior)
    if quick is not None:
        return state, quick, True
    margin, average, converged = MARGINS_MM[1], None, False
    # far from the solution a rich model explains points of another face
    for kinds, most in ((("form",), 3), (prior.kinds[:-1], 5), (prior.kinds, 4)):
        stage = dataclasses.replace(prior, kinds=kinds)
        for _ in range(most):
            patches, size = scan.patches(state, margin)
            if patches is None:
                return None if average is None else (state, average, False)
            average = average_models(patches, state.differences, stage)
            state = _step(scan.model, state, average.mean)
            # nearer to the edges there may be small faces that say more
            before, margin = margin, float(np.clip(1.5 * size, *MARGINS_MM))
            converged = _squared(average) < 6 * CONVERGED**2 and margin > 0.7 * before
            if converged:
                break
    return state, average, converged


def _as_designed_already(scan: ScanDeviations, state: State, prior: Prior) -> Average | None:
    """The average at a state where there is nothing to estimate; else None."""
    patches, size = scan.patches(state, MARGINS_MM[0])
    if patches is None or 1.5 * size > MARGINS_MM[1] / 2:
        return None
    average = average_models(patches, state.differences, prior)
    some = average.term_probability.max() > LIKELY or average.field_probability > LIKELY
    return None if some or _squared(average) > BY_CHANCE else average


def _beyond_edges(scan: ScanDeviations, state: State, result: Refinement, count: int) -> float:
    """Share of the points beside the part, by more than spacing, noise and form let them be.

    By no more than `BEYOND_EDGES_MM` either: what is farther off is clutter. ``count`` is of the
    whole scan. Stock on one side shows here, where all that is seen of the faces looks moved.
    """
    form = result.form
    model, points = scan.as_designed(state)
    residuals = model.residuals(stack(state.pose), points)
    near = cKDTree(points).query(points[::10], k=2)[0][:, 1]
    spacing_mm = np.median(near) * np.sqrt(len(points) / count)
    off_mm = residuals.deviation_mm[0][~residuals.hit[0]]
    least_mm = max(spacing_mm / 2, 5 * result.noise_mm)
    least_mm += AT_CORNERS * (abs(form.stock_mm) + 2 * form.field_mm)
    beyond = (off_mm > least_mm) & (off_mm < BEYOND_EDGES_MM)
    return float(np.count_nonzero(beyond) / len(points))


def _motion(first: RigidTransform, second: RigidTransform, center: np.ndarray) -> np.ndarray:
    """[6] rotation vector in rad and translation in mm about the centre, from one to the other."""
    between = second @ first.inverse()
    turn = Rotation.from_matrix(between.rotation).as_rotvec()
    return np.concatenate([turn, between.apply(center[None])[0] - center])


def _step(model: MeasurementModel, state: State, mean: np.ndarray) -> State:
    """The state after a step, no longer than `MOST_STEP`."""
    turn, shift = np.linalg.norm(mean[:3]), np.linalg.norm(mean[3:6])
    most = max(turn / np.radians(MOST_STEP_DEG), shift / (MOST_STEP * model.part.radius), 1.0)
    pose = select(moved(model.part, stack(state.pose), -mean[None, :6] / most), 0)
    terms = state.terms + mean[6:9] / most
    errors = state.errors + mean[9:] / most
    # a larger part stays where it is
    factor = state.factor / (1 + terms[1])
    return State(scaled_pose(pose, model.part.center, factor), terms, errors)


def _result(
    model: MeasurementModel,
    refinement: Refinement,
    state: State,
    average: Average,
    converged: bool,
    *,
    stock_mm: float | None,
    calibrated: bool,
) -> Refinement:
    """What the result says of the form, the pose and its covariance; stock where it is known."""
    sigma = np.sqrt(np.maximum(np.diag(average.covariance)[6:], 0))
    present = average.term_probability > LIKELY
    stock, scale, focal = np.where(present, state.terms, 0.0)
    if stock_mm is not None:
        stock = stock_mm
    field = average.field_probability > LIKELY
    form = FormDeviation(
        stock_mm=float(stock),
        stock_sigma_mm=float(sigma[0]) if present[0] else 0.0,
        scale_error=float(scale),
        scale_sigma=float(sigma[1]) if present[1] else 0.0,
        focal_error=float(focal),
        focal_sigma=float(sigma[2]) if present[2] else 0.0,
        field=average.field.kind if field else "none",
        field_mm=average.amplitude_mm if field else 0.0,
        field_length_mm=average.field.length * model.part.radius if field else 0.0,
        unexplained_share=float(np.mean(average.outliers)),
        converged=converged,
    )
    if form.is_as_designed and not calibrated:
        surfaces = np.linalg.inv(average.covariance[:6, :6])
        fixed_by = np.linalg.eigvals(np.linalg.solve(surfaces, refinement.information)).real
        if fixed_by.max() > MOST_BY_EDGES * np.sort(fixed_by)[1]:
            edges = np.repeat([EDGE_MM / model.part.radius, EDGE_MM], 3) ** 2
            edges = np.linalg.pinv(refinement.information, hermitian=True) + np.diag(edges)
            refinement = dataclasses.replace(
                refinement, information=surfaces + np.linalg.inv(edges)
            )
        return dataclasses.replace(refinement, form=form)
    pose = scaled_pose(state.pose, model.part.center, state.factor)
    covariance = average.covariance[:6, :6].copy()
    if stock and stock_mm is None:
        by_stock = average.covariance[:6, 6] / average.covariance[6, 6]
        covariance += (STOCK_TRUENESS * stock) ** 2 * np.outer(by_stock, by_stock)
    if form.field in ("form", "displacement"):
        sides = np.repeat([1 / model.part.radius, 1.0], 3)
        covariance += np.diag((FIELD_TRUENESS * form.field_mm * sides) ** 2)
    if scale and isinstance(model, RayCasting):
        in_camera = pose.inverse().apply(model.part.center[None])[0] - model.sensor_origin
        sight = SCALE_SIGMA * scale * (pose.rotation @ in_camera)
        covariance[3:, 3:] += np.outer(sight, sight)
    # so large a rest that is not smooth is no form: the pose of all points is as good
    rough = average.field.length <= ROUGH and form.field in ("form", "displacement", "range")
    if rough and form.field_mm > CLEAR_MM and not present.any():
        other = refinement.part_from_camera
        apart = _motion(pose, other, model.part.center)
        covariance += np.outer(apart, apart)
        pose = other
    return dataclasses.replace(
        refinement,
        part_from_camera=pose,
        converged=converged,
        information=np.linalg.inv(covariance),
        form=form,
    )
