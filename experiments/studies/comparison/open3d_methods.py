"""Open3D's registrations as methods of the common contract, on the host.

Each factory gives ``register(source, target, init, key) -> Registration`` with numpy leaves, so
that one table holds these and the library's own. They cannot be jitted or vmapped. Lengths are in
the clouds' unit. Needs ``pip install 'vanejax[peers]'``.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax
import numpy as np

from vanejax.errors import InputError, MissingExtra
from vanejax.matching.contract import Register, Registration
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

FEWEST = 3  # points of a cloud, below which no pose is determined

# from Open3D's two clouds and a start, 4 x 4, to Open3D's result
Align = Callable[[Any, Any, np.ndarray], Any]


def icp(
    *,
    metric: str = "point_to_point",
    max_iterations: int = 50,
    max_distance: float,
    kernel: str = "none",
    kernel_width: float | None = None,
    trim: float = 1.0,
) -> Register:
    """Open3D's ICP, with the settings of `vanejax.matching.baselines.icp.icp`.

    Raises:
      InputError: no Open3D, or what it cannot do: to trim, or a kernel without point_to_plane.
    """
    open3d = _open3d()
    method = open3d.pipelines.registration
    if metric not in ("point_to_point", "point_to_plane"):
        raise InputError(f"metric {metric!r} is unknown: point_to_point or point_to_plane")
    to_plane = metric == "point_to_plane"
    losses = {"huber": method.HuberLoss, "tukey": method.TukeyLoss}
    if kernel != "none" and (kernel not in losses or not to_plane or kernel_width is None):
        raise InputError(
            f"kernel {kernel!r} of width {kernel_width}: Open3D's ICP takes {', '.join(losses)} "
            "with a width, and with point_to_plane only"
        )
    if trim != 1:
        raise InputError(f"trim is {trim}: Open3D's ICP does not trim")
    if to_plane:
        loss = [] if kernel == "none" else [losses[kernel](kernel_width)]
        estimation = method.TransformationEstimationPointToPlane(*loss)
    else:
        estimation = method.TransformationEstimationPointToPoint(False)
    criteria = method.ICPConvergenceCriteria(max_iteration=max_iterations)

    def align(source: Any, target: Any, start: np.ndarray) -> Any:
        return method.registration_icp(source, target, max_distance, start, estimation, criteria)

    return _register(open3d, align, max_distance)


def ransac(
    *, feature_radius: float, max_distance: float, num_hypotheses: int = 100_000
) -> Register:
    """Open3D's RANSAC over FPFH matches, with settings of `vanejax.matching.baselines.sac_ia`.

    Raises:
      InputError: no Open3D.
    """
    open3d = _open3d()
    method = open3d.pipelines.registration

    def align(source: Any, target: Any, start: np.ndarray) -> Any:
        del start  # features need no guess
        return method.registration_ransac_based_on_feature_matching(
            source,
            target,
            *_features(open3d, (source, target), feature_radius),
            True,  # mutual matches only, where there are enough of them
            max_distance,
            method.TransformationEstimationPointToPoint(False),
            3,
            [
                method.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                method.CorrespondenceCheckerBasedOnDistance(max_distance),
            ],
            method.RANSACConvergenceCriteria(num_hypotheses, 0.999),
        )

    return _register(open3d, align, max_distance)


def fgr(
    *,
    feature_radius: float,
    max_distance: float,
    tuple_similarity: float = 0.95,
    num_tuples: int = 1000,
) -> Register:
    """Open3D's Fast Global Registration, with settings of `vanejax.matching.baselines.fgr.fgr`.

    Raises:
      InputError: no Open3D.
    """
    open3d = _open3d()
    method = open3d.pipelines.registration

    def align(source: Any, target: Any, start: np.ndarray) -> Any:
        del start  # features need no guess
        points = [np.asarray(cloud.points) for cloud in (source, target)]
        radius = max(np.linalg.norm(xyz - xyz.mean(axis=0), axis=-1).max() for xyz in points)
        option = method.FastGlobalRegistrationOption(
            division_factor=1.4,
            use_absolute_scale=False,
            decrease_mu=True,
            # Open3D compares it with the squared scale of the robust kernel
            maximum_correspondence_distance=(max_distance / max(radius, 1e-9)) ** 2,
            iteration_number=64,
            tuple_scale=tuple_similarity,
            maximum_tuple_count=num_tuples,
        )
        features = _features(open3d, (source, target), feature_radius)
        return method.registration_fgr_based_on_feature_matching(source, target, *features, option)

    return _register(open3d, align, max_distance)


def _open3d() -> ModuleType:
    try:
        import open3d
    except ImportError as error:
        raise MissingExtra(
            f"Open3D needs the extra peers: pip install 'vanejax[peers]' ({error})"
        ) from error
    return open3d


def _features(open3d: ModuleType, clouds: tuple[Any, Any], radius: float) -> list[Any]:
    search = open3d.geometry.KDTreeSearchParamRadius(radius)
    return [open3d.pipelines.registration.compute_fpfh_feature(cloud, search) for cloud in clouds]


def _cloud(open3d: ModuleType, cloud: PointCloud) -> Any:
    """The real rows as Open3D's cloud."""
    mask = np.asarray(cloud.mask)
    points = open3d.geometry.PointCloud()
    points.points = open3d.utility.Vector3dVector(np.asarray(cloud.xyz, np.float64)[mask])
    points.normals = open3d.utility.Vector3dVector(np.asarray(cloud.normals, np.float64)[mask])
    return points


def _register(open3d: ModuleType, align: Align, max_distance: float) -> Register:
    """The contract around ``align``; rmse and overlap are of partners within ``max_distance``."""

    def register(
        source: PointCloud, target: PointCloud, init: RigidTransform, key: jax.Array
    ) -> Registration:
        open3d.utility.random.seed(int(jax.random.bits(key)) >> 1)  # a C int
        clouds = [_cloud(open3d, cloud) for cloud in (source, target)]
        start = np.eye(4)
        start[:3] = np.concatenate([init.rotation, np.asarray(init.translation)[:, None]], 1)
        enough = min(len(cloud.points) for cloud in clouds) >= FEWEST
        # its warning of few mutual matches comes with every second pair
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            result = align(*clouds, start).transformation if enough else start
        # where nothing was found, RANSAC and FGR answer with the identity
        converged = enough and np.isfinite(result).all()
        if not converged:
            result = start
        fit = open3d.pipelines.registration.evaluate_registration(*clouds, max_distance, result)
        return Registration(
            target_from_source=RigidTransform.from_matrix(np.array(result, np.float32)),
            converged=np.bool_(converged and fit.fitness > 0),
            iterations=np.int32(0),  # Open3D does not say
            rmse=np.float32(fit.inlier_rmse),
            overlap=np.float32(fit.fitness),
        )

    return register
