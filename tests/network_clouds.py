"""Clouds with padding for tests of networks, poses, and gradients of poses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from quick_jit import quick_jit
from scipy.spatial.transform import Rotation

from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

START = jax.tree.map(jnp.asarray, RigidTransform.identity())


def scattered(values: np.ndarray, rows: int, junk: float | np.ndarray) -> tuple:
    """Values [N, C] scattered among padding of ``junk``: [rows, C], and the mask [rows]."""
    place = np.sort(np.random.default_rng(rows).permutation(rows)[: len(values)])
    full = np.full((rows, values.shape[1]), junk, values.dtype)
    full[place] = values
    return full, np.isin(np.arange(rows), place)


def bumpy_sphere(source: int, target: int, bump: float = 0.1) -> tuple[np.ndarray, ...]:
    """Two views: source xyz and normals [N, 3], turned and moved, and the target's [M, 3]; f64."""
    normals = np.random.default_rng(0).normal(size=(source + target, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    xyz = normals * (0.6 + bump * np.sin(5 * normals[:, :1]))
    turn = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    moved = xyz[:source] @ turn.T + [0.1, 0, -0.1]
    return moved, normals[:source] @ turn.T, xyz[source:], normals[source:]


def cloud(xyz: np.ndarray, rows: int | None = None, junk: float = 30.0) -> PointCloud:
    """A cloud for networks that look at no normals, its padding scattered among the points."""
    xyz, mask = scattered(xyz, len(xyz) if rows is None else rows, junk)
    return PointCloud(xyz=xyz, normals=xyz, mask=mask)


def pose(seed: int, size: float = 1.0) -> RigidTransform:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(size * rng.normal(size=3)).as_matrix()
    return RigidTransform(np.float32(turn), np.float32(rng.normal(size=3, scale=0.3)))


def pose_gradient(poses):
    """Gradients of ``poses(variables, source, target)`` for the variables and both clouds' xyz."""

    @quick_jit
    def gradient(variables, *clouds):
        def total(variables, *places):
            moved = (c.replace(xyz=xyz) for c, xyz in zip(clouds, places, strict=True))
            return jnp.sum(poses(variables, *moved).as_matrix() ** 3)

        return jax.grad(total, (0, 1, 2))(variables, *(c.xyz for c in clouds))

    return gradient


def assert_reached_but_no_padding(slopes, clouds, *, every: bool = False) -> None:
    """Slopes are exactly zero at padding; some real point, or every one, has another."""
    for slope, points in zip(slopes, clouds, strict=True):
        np.testing.assert_array_equal(slope[~points.mask], 0)
        largest = np.abs(slope[points.mask]).max(axis=1)
        assert (largest.min() if every else largest.max()) > 0


def assert_same(found, expected, atol: float) -> None:
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=atol)
