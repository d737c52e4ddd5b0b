"""How a part differs from its CAD model, estimated along with its pose.

A casting has stock, has shrunk, is bent; a sensor has a scale and smooth errors of its own. Least
squares takes much of that for a motion. Here the scan's deviations are averaged over patches of
smooth surface, away from edges, and `random_fields` says what of them is a motion, what a term of
the part or of the sensor, and how sure the pose still is.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from vanejax.errors import InputError
from vanejax.localization.fine_registration import robust_gauss_newton, subset
from vanejax.localization.noise import LEAST_COSINE, fit_noise
from vanejax.localization.pose_batch import select, stack
from vanejax.localization.pose_result import FormDeviation, Refinement
from vanejax.localization.random_fields import Average, Patches, Prior, average_models
from vanejax.localization.residuals import MeasurementModel, RayCasting, Residuals, moved
from vanejax.localization.sensor_calibration import Calibration
from vanejax.rigid import RigidTransform

POINTS = 20_000
PATCHES = 160
SURFACE_POINTS = 200
LEAST_PATCHES, LEAST_POINTS = 20, 3  # points of each patch
CONVERGED = 0.25  # standard deviations of the pose: outliers come and go by less
BY_CHANCE = 17.0  # of six squared deviations, one sum in a hundred is larger
# mm, and of the part's radius: what is farther off is not on the part
MOST_DEVIATION_MM, MOST_DEVIATION = 2.0, 0.03
# patches keep this far from edges, and 1.5 times as far as the surface is off
MARGINS_MM = (0.3, 1.2)
SAME_FACE_DEG = 25.0
SAME_NORMAL = 0.75  # squared cosine
FLATTEST = 0.1  # cosine of incidence
NEAR = 4.0  # standard deviations within a patch
MOST_STEP_DEG, MOST_STEP = 2.0, 0.03  # an iteration turns and moves by no more (of the radius)
STOCK_ITERATIONS = 2  # the face under the stock is not quite where the ray through it ends
# other starts, and how large a field must be to try them
STOCK_GUESSES_MM, CLEAR_MM = (0.7,), 0.25
ROUGH = 0.2  # of the part's radius: a field over no more is not smooth
LIKELY = 0.5  # a term more probable than this is taken to be there
# how many times more than elsewhere all points may know in a direction than those on smooth faces:
# what is beyond comes from edges, and of a casting they are that far off
MOST_BY_EDGES, EDGE_MM = 30.0, 0.4
BEYOND_MM = 3.0
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


@dataclasses.dataclass(frozen=True, eq=False)
class _State:
    """A pose of the scan divided by 1 + scale, and what the scan differs by.

    ``terms`` [3], see `random_fields.TERMS`; ``errors`` [C] of the calibration, in standard
    deviations.
    """

    pose: RigidTransform
    terms: np.ndarray
    errors: np.ndarray

    @property
    def factor(self) -> float:
        return 1 + self.terms[1]

    @property
    def differences(self) -> np.ndarray:
        """[3 + C], terms and errors."""
        return np.concatenate([self.terms, self.errors])


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
    fit = _Fit(model, sample, calibration)
    with threadpool_limits(1):  # the matrices are small: threads would wait for each other
        estimate = fit.converge(fit.start(refinement.part_from_camera), prior)
        # least squares may have locked onto a few faces of a casting with much stock
        for stock_mm in () if prior.stock_mm == 0 else STOCK_GUESSES_MM:
            if estimate is None or _is_clear(*estimate[1:]):
                break
            other = fit.converge(fit.start(refinement.part_from_camera, stock_mm), prior)
            if other is not None and _is_clear(*other[1:]):
                estimate = other
    if estimate is None:
        return dataclasses.replace(refinement, form=FormDeviation(is_told=False))
    if max_allowance_mm:
        stock = estimate[0].terms[0]
        if not 0 <= stock <= max_allowance_mm:  # then it is at the bound
            prior = dataclasses.replace(prior, stock_mm=float(np.clip(stock, 0, max_allowance_mm)))
            with threadpool_limits(1):
                estimate = fit.converge(estimate[0], prior) or estimate
    result = _result(model, refinement, *estimate, calibrated=calibration is not None)
    beyond = fit.beyond_edges(estimate[0], refinement.noise_mm, len(points))
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


class _Fit:
    """The estimation of one scan of one part."""

    def __init__(
        self, model: MeasurementModel, points: np.ndarray, calibration: Calibration | None
    ) -> None:
        self.model, self.points = model, points
        # [C, n, 3] mm
        self.moves = np.zeros((0, *points.shape))
        if calibration is not None:
            self.moves = calibration.displacements(points)

    def start(self, pose: RigidTransform, stock_mm: float = 0.0) -> _State:
        """A pose near one for a part with that much stock."""
        terms = np.array([stock_mm, 0.0, 0.0])
        for _ in range(2 if stock_mm else 0):
            model, points = as_designed(self.model, self.points, pose, terms)
            poses, _ = robust_gauss_newton(model, stack(pose), points[::5], iterations=8)
            pose = select(poses, 0)
        return _State(pose, terms, np.zeros(len(self.moves)))

    def _measured(self, state: _State) -> np.ndarray:
        """[n, 3] mm, camera frame: the points without the errors of the calibration."""
        return self.points - np.einsum("c,cni->ni", state.errors, self.moves)

    def converge(self, state: _State, prior: Prior) -> tuple[_State, Average, bool] | None:
        """From a state to that at which the average over all models stays; None: too few patches.

        Also whether it stayed.
        """
        quick = self._as_designed_already(state, prior)
        if quick is not None:
            return state, quick, True
        margin, average, converged = MARGINS_MM[1], None, False
        # far from the solution a rich model explains points of another face
        for kinds, most in ((("form",), 3), (prior.kinds[:-1], 5), (prior.kinds, 4)):
            stage = dataclasses.replace(prior, kinds=kinds)
            for _ in range(most):
                patches, size = self._patches(state, margin)
                if patches is None:
                    return None if average is None else (state, average, False)
                average = average_models(patches, state.differences, stage)
                state = _step(self.model, state, average.mean)
                # nearer to the edges there may be small faces that say more
                before, margin = margin, float(np.clip(1.5 * size, *MARGINS_MM))
                converged = _squared(average) < 6 * CONVERGED**2 and margin > 0.7 * before
                if converged:
                    break
        return state, average, converged

    def _as_designed_already(self, state: _State, prior: Prior) -> Average | None:
        """The average at a state where there is nothing to estimate; else None."""
        patches, size = self._patches(state, MARGINS_MM[0])
        if patches is None or 1.5 * size > MARGINS_MM[1] / 2:
            return None
        average = average_models(patches, state.differences, prior)
        some = average.term_probability.max() > LIKELY or average.field_probability > LIKELY
        return None if some or _squared(average) > BY_CHANCE else average

    def beyond_edges(self, state: _State, noise_mm: float, count: int) -> float:
        """Share of the points beside the part, by more than their spacing and noise let them be.

        By no more than `BEYOND_MM` either: what is farther off is clutter. ``count`` is of the
        whole scan. Stock on one side shows here, where all that is seen of the faces looks moved.
        """
        model, points = as_designed(self.model, self._measured(state), state.pose, state.terms)
        residuals = model.residuals(stack(state.pose), points)
        near = cKDTree(points).query(points[::10], k=2)[0][:, 1]
        spacing_mm = np.median(near) * np.sqrt(len(points) / count)
        off_mm = residuals.deviation_mm[0][~residuals.hit[0]]
        beyond = (off_mm > max(spacing_mm / 2, 5 * noise_mm)) & (off_mm < BEYOND_MM)
        return float(np.count_nonzero(beyond) / len(points))

    def _patches(self, state: _State, margin_mm: float) -> tuple[Patches | None, float]:
        """Means over patches of smooth surface, and how far off the surface most of the points are.

        None where there are too few.
        """
        pose = stack(state.pose)
        model, points = as_designed(self.model, self._measured(state), state.pose, state.terms)
        part = model.part
        residuals = model.residuals(pose, points)
        deviation, normals = residuals.deviation_mm[0], residuals.jacobian[0][:, 3:]
        cosine = np.maximum(residuals.cosine[0], LEAST_COSINE)
        used = residuals.hit[0] & (cosine > FLATTEST)
        used &= np.abs(deviation) < max(MOST_DEVIATION_MM, MOST_DEVIATION * part.radius)
        used &= _smooth(model, points, pose, margin_mm)
        # `as_designed` may have moved a point along the normal of another face than it ends at
        shift = (self._measured(state) / state.factor - points) @ pose.rotation[0].T
        squared = np.sum(shift**2, axis=1)
        along = np.sum(normals * shift, axis=1)
        used &= (along**2 >= SAME_NORMAL * squared) & ((squared > 0) | (state.terms[0] == 0))
        if np.count_nonzero(used) < LEAST_PATCHES * LEAST_POINTS:
            return None, 0.0
        columns = self._columns(model, points, pose, residuals)[used]
        positions = pose.apply(points[None])[0] - part.center - deviation[:, None] * normals
        positions, normals = positions[used], normals[used]
        deviation, cosine = deviation[used], cosine[used]
        patch = _labels(positions, normals, part.radius)
        count = np.bincount(patch)
        rest = deviation - _medians(deviation, patch)[patch]
        many = count[patch] >= 2 * LEAST_POINTS
        if np.count_nonzero(many) < LEAST_PATCHES:
            many[:] = True
        noise = fit_noise(
            Residuals(
                rest[None, many],
                columns[None, many, :6],
                cosine[None, many],
                np.ones((1, np.count_nonzero(many)), bool),
            )
        )
        sigma = noise.sigma_mm(cosine) * cosine
        near = np.abs(rest) < np.maximum(NEAR * sigma, 1e-3)
        weight = np.where(near, 1 / sigma**2, 0.0)
        kept = np.bincount(patch, near) >= LEAST_POINTS
        if np.count_nonzero(kept) < LEAST_PATCHES:
            return None, 0.0
        total = np.bincount(patch, weight)

        def means(values: np.ndarray) -> np.ndarray:
            sums = [np.bincount(patch, weight * column) for column in values.T]
            return (np.stack(sums, axis=1) / np.maximum(total, 1e-30)[:, None])[kept]

        patches = Patches(
            deviation_mm=means(deviation[:, None])[:, 0],
            weight=total[kept],
            columns=means(columns),
            positions=means(positions),
            normals=means(normals),
            cosine=means(cosine[:, None])[:, 0],
        )
        return patches, float(np.percentile(np.abs(deviation + state.terms[0]), 90))

    def _columns(
        self, model: MeasurementModel, points: np.ndarray, pose: RigidTransform, at: Residuals
    ) -> np.ndarray:
        """[n, 9 + C], see `Patches.columns`."""
        jacobian = at.jacobian[0]
        normals = jacobian[:, 3:]
        in_camera = normals @ pose.rotation[0]
        place = pose.apply(points[None])[0] - model.part.center
        scale = np.sum(normals * place, axis=1)
        focal = np.sum(in_camera * across_sight(model, points), axis=1)
        errors = np.einsum("ni,cni->nc", in_camera, self.moves)
        return np.column_stack([jacobian, np.ones(len(points)), scale, focal, errors])


def as_designed(
    model: MeasurementModel, points: np.ndarray, part_from_camera: RigidTransform, terms: np.ndarray
) -> tuple[MeasurementModel, np.ndarray]:
    """The model and the points [n, 3] mm as if the part had no stock and everything its true size.

    Args:
      model: of the scan as it is.
      points: of the scan as it is.
      part_from_camera: of the scan divided by 1 + scale.
      terms: [3].
    """
    stock, scale, focal = terms
    if scale:
        points = points / (1 + scale)
        if isinstance(model, RayCasting):
            model = dataclasses.replace(model, sensor_origin=model.sensor_origin / (1 + scale))
    if stock or focal:
        # not from the deviations: where the surface is curved, a ray meets the CAD model elsewhere
        # than under the stock that it ends at
        scanned, sideways = points, across_sight(model, points)
        shift = np.zeros_like(points)
        for _ in range(STOCK_ITERATIONS):
            residuals = model.residuals(stack(part_from_camera), points)
            normals = residuals.jacobian[0][:, 3:] @ part_from_camera.rotation
            offset = stock + focal * np.sum(normals * sideways, axis=1)
            shift = np.where(residuals.hit[0][:, None], offset[:, None] * normals, shift)
            points = scanned - shift
    return model, points


def across_sight(model: MeasurementModel, points: np.ndarray) -> np.ndarray:
    """[n, 3] mm: how points move across the optical axis where the focal length is off by one.

    The axis is the z axis that the sensor looks along, or the direction to the scan's middle where
    it looks along none; all is zero where the sensor's place is not known.
    """
    if not isinstance(model, RayCasting):
        return np.zeros_like(points)
    sight = points - model.sensor_origin
    axis = sight.mean(axis=0)
    if abs(axis[2]) > np.hypot(axis[0], axis[1]):
        axis = np.array([0.0, 0.0, 1.0])
    axis = axis / np.linalg.norm(axis)
    return sight - np.outer(sight @ axis, axis)


def scaled_pose(
    part_from_camera: RigidTransform, center: np.ndarray, factor: float
) -> RigidTransform:
    """The pose in a camera frame whose lengths are ``factor`` times as large; centre [3] mm."""
    in_camera = part_from_camera.inverse().apply(center[None])[0] * factor
    rotation = part_from_camera.rotation
    return RigidTransform(rotation, center - rotation @ in_camera)


def _motion(first: RigidTransform, second: RigidTransform, center: np.ndarray) -> np.ndarray:
    """[6] rotation vector in rad and translation in mm about the centre, from one to the other."""
    between = second @ first.inverse()
    turn = Rotation.from_matrix(between.rotation).as_rotvec()
    return np.concatenate([turn, between.apply(center[None])[0] - center])


def _step(model: MeasurementModel, state: _State, mean: np.ndarray) -> _State:
    """The state after a step, no longer than `MOST_STEP`."""
    turn, shift = np.linalg.norm(mean[:3]), np.linalg.norm(mean[3:6])
    most = max(turn / np.radians(MOST_STEP_DEG), shift / (MOST_STEP * model.part.radius), 1.0)
    pose = select(moved(model.part, stack(state.pose), -mean[None, :6] / most), 0)
    terms = state.terms + mean[6:9] / most
    errors = state.errors + mean[9:] / most
    # a larger part stays where it is
    factor = state.factor / (1 + terms[1])
    return _State(scaled_pose(pose, model.part.center, factor), terms, errors)


def _smooth(
    model: MeasurementModel, points: np.ndarray, pose: RigidTransform, margin_mm: float
) -> np.ndarray:
    """[n] whether all surface around a point is of one smooth face, as far as the margin."""
    least = np.cos(np.radians(SAME_FACE_DEG))
    if not isinstance(model, RayCasting):
        return model.surface.is_smooth(pose.apply(points[None])[0], margin_mm, least)
    rays = points - model.sensor_origin
    forward = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
    across = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    across /= np.linalg.norm(across)
    sensor = pose.apply(np.asarray(model.sensor_origin, np.float64)[None, None])[0, 0]
    sensor = sensor - model.part.center

    def cast(aside: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        turned = (rays + aside) @ pose.rotation[0].T
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        hits = model.scanner.cast_unit(sensor[None, None], turned[None])
        return hits.face[0] >= 0, hits.normals[0], hits.distance_mm[0]

    smooth, normals, distance = cast(np.zeros(3))
    for angle in np.arange(6) * np.pi / 3:
        aside = np.cos(angle) * across + np.sin(angle) * np.cross(forward, across)
        hit, others, other = cast(margin_mm * aside)
        smooth &= hit & (np.sum(normals * others, axis=1) > least)
        smooth &= ~(
            np.abs(np.where(hit, other, 0) - np.where(smooth, distance, 0)) > 8 * margin_mm
        )  # as slanted as `FLATTEST`
    return smooth


def _labels(positions: np.ndarray, normals: np.ndarray, radius_mm: float) -> np.ndarray:
    """[n] i64, 0, 1, ...: cubes of one size, faces of six directions apart, some `PATCHES`."""
    axis = np.argmax(np.abs(normals), axis=1)
    facing = 2 * axis + (np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0)
    size = radius_mm / 8
    for _ in range(6):
        cells = np.column_stack([np.floor(positions / size).astype(np.int64), facing])
        patch = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
        count = int(patch.max()) + 1
        if count <= 1.2 * PATCHES:
            break
        size *= np.sqrt(count / PATCHES)
    return patch


def _medians(values: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """[M] the lower median of the values [n] in each patch."""
    order = np.lexsort((values, patch))
    count = np.bincount(patch)
    first = np.cumsum(count) - count
    return values[order][first + (count - 1) // 2]


def _result(
    model: MeasurementModel,
    refinement: Refinement,
    state: _State,
    average: Average,
    converged: bool,
    *,
    calibrated: bool,
) -> Refinement:
    """What the result says of the part's form, its pose and its covariance."""
    sigma = np.sqrt(np.maximum(np.diag(average.covariance)[6:], 0))
    present = average.term_probability > LIKELY
    stock, scale, focal = np.where(present, state.terms, 0.0)
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
    if stock:
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
