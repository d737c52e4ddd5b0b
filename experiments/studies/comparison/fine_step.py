"""Fine registration after any method: the same noisy points, cast as rays at the CAD model."""

from __future__ import annotations

import time

import jax
import numpy as np

from experiments.runner.registrations import Results, measure
from vanejax.cad import Part
from vanejax.localization import measurement_model, refine
from vanejax.rigid import RigidTransform
from vanejax.training import ScanSet


class FineStep:
    """Refines what a method found in the views of ``scans``, [V], of ``part``."""

    def __init__(self, part: Part, scans: ScanSet) -> None:
        self._part, self._scans = part, scans
        self._model = measurement_model(part, np.zeros(3))

    def __call__(self, results: Results) -> Results:
        """The same registrations, refined: nothing is added to the points that the method had.

        A view whose pose is not finite stays as it is. ``time_s`` is that of the fine step alone.
        """
        rows = [self._view(results, view) for view in range(len(self._scans))]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)

    def _view(self, results: Results, view: int) -> Results:
        row: Results = jax.tree.map(lambda leaf: np.asarray(leaf[view]), results)
        estimate, truth = row.registration.target_from_source, row.pairs.target_from_source
        if not np.isfinite(estimate.as_matrix()).all():
            return row.replace(time_s=np.float64(np.nan))
        # The source was drawn in the part's frame and moved away: taken back, it lies in the camera
        # frame of its view, noise and all, and the method's answer is a pose of that frame.
        part_from_camera = self._scans.viewpoints.view(view).inverse()
        part_from_source, camera_from_source = self._in_mm(estimate), self._in_mm(truth)
        camera_from_source = part_from_camera.inverse() @ camera_from_source
        points = row.pairs.source.xyz[row.pairs.source.mask].astype(np.float64)
        points = camera_from_source.apply(self._scans.radius_mm * points)
        start = time.perf_counter()
        refined = refine(self._model, points, part_from_source @ camera_from_source.inverse())
        seconds = time.perf_counter() - start
        pose = self._in_units(refined.part_from_camera @ camera_from_source)
        measured = jax.device_get(measure(row.pairs, pose, self._scans.radius_mm))
        registration = row.registration.replace(
            target_from_source=pose, converged=np.asarray(refined.converged)
        )
        return Results(row.pairs, registration, *measured, time_s=np.float64(seconds))

    def _in_mm(self, target_from_source: RigidTransform) -> RigidTransform:
        """part_from_source of clouds in mm, f64: the unit sphere's centre is the part's."""
        shift = self._scans.radius_mm * np.asarray(target_from_source.translation, np.float64)
        rotation = np.linalg.svd(np.asarray(target_from_source.rotation, np.float64))
        return RigidTransform(rotation.U @ rotation.Vh, shift + self._scans.center)

    def _in_units(self, part_from_source: RigidTransform) -> RigidTransform:
        """The inverse of `_in_mm`, f32."""
        shift = (part_from_source.translation - self._scans.center) / self._scans.radius_mm
        return RigidTransform(
            np.asarray(part_from_source.rotation, np.float32), np.asarray(shift, np.float32)
        )
