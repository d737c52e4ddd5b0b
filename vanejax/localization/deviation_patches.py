"""What a scan deviates from the CAD model by, as means over patches of smooth surface.

Under a pose, and without what is known already of the stock, the scale, the focal length and the
errors of the sensor's calibration. `random_fields` says what the means tell.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vanejax.localization.noise import LEAST_COSINE, fit_noise
from vanejax.localization.pose_batch import stack
from vanejax.localization.random_fields import Patches
from vanejax.localization.residuals import MeasurementModel, RayCasting, Residuals
from vanejax.localization.sensor_calibration import Calibration
from vanejax.rigid import RigidTransform

PATCHES = 160
LEAST_PATCHES, LEAST_POINTS = 20, 3  # points of each patch
# mm, and of the part's radius: what is farther off is not on the part
MOST_DEVIATION_MM, MOST_DEVIATION = 2.0, 0.03
SAME_FACE_DEG = 25.0
SAME_NORMAL = 0.75  # squared cosine
FLATTEST = 0.1  # cosine of incidence
NEAR = 4.0  # standard deviations within a patch
STOCK_ITERATIONS = 2  # the face under the stock is not quite where the ray through it ends


@dataclasses.dataclass(frozen=True, eq=False)
class State:
    """A pose of the scan divided by 1 + scale, and what the scan differs by.

    Attributes:
      pose: part_from_camera.
      terms: [3], see `random_fields.TERMS`.
      errors: [C] of the calibration, in standard deviations.
    """

    pose: RigidTransform
    terms: np.ndarray
    errors: np.ndarray

    @property
    def factor(self) -> float:
        """Of all lengths of the scan."""
        return 1 + self.terms[1]

    @property
    def differences(self) -> np.ndarray:
        """[3 + C], terms and errors."""
        return np.concatenate([self.terms, self.errors])


class ScanDeviations:
    """The deviations of one scan of one part.

    Args:
      model: predicts points.
      points: [n, 3] f64, mm, camera frame.
      calibration: what the sensor's leaves open.
    """

    def __init__(
        self, model: MeasurementModel, points: np.ndarray, calibration: Calibration | None
    ) -> None:
        self.model, self.points = model, points
        # [C, n, 3] mm
        self.moves = np.zeros((0, *points.shape))
        if calibration is not None:
            self.moves = calibration.displacements(points)

    def measured(self, state: State) -> np.ndarray:
        """[n, 3] mm, camera frame: the points without the errors of the calibration."""
        return self.points - np.einsum("c,cni->ni", state.errors, self.moves)

    def as_designed(self, state: State) -> tuple[MeasurementModel, np.ndarray]:
        """The model and the points [n, 3] mm without all that is known of the differences."""
        return as_designed(self.model, self.measured(state), state.pose, state.terms)

    def patches(self, state: State, margin_mm: float) -> tuple[Patches | None, float]:
        """Means over patches of smooth surface, and how far off the surface most of the points are.

        None where there are too few.
        """
        pose = stack(state.pose)
        model, points = self.as_designed(state)
        part = model.part
        residuals = model.residuals(pose, points)
        deviation, normals = residuals.deviation_mm[0], residuals.jacobian[0][:, 3:]
        cosine = np.maximum(residuals.cosine[0], LEAST_COSINE)
        used = residuals.hit[0] & (cosine > FLATTEST)
        used &= np.abs(deviation) < max(MOST_DEVIATION_MM, MOST_DEVIATION * part.radius)
        used &= _smooth(model, points, pose, margin_mm)
        # `as_designed` may have moved a point along the normal of another face than it ends at
        shift = (self.measured(state) / state.factor - points) @ pose.rotation[0].T
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
