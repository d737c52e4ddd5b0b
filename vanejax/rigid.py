"""A rigid motion between two frames.

Frames live in names: ``part_from_camera.apply(points_camera)`` gives points in the part's frame,
and ``a_from_b @ b_from_c`` is ``a_from_c``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from vanejax.errors import InputError

MATRIX_TOLERANCE = 1e-3  # of a rotation's entries: a matrix typed by hand has three decimals

Array = Any  # of numpy, float64 on the host, or of JAX, which is not imported here


class RigidTransform(NamedTuple):
    """A rotation followed by a translation: ``x_a = rotation @ x_b + translation``.

    A named tuple is immutable, and a pytree without JAX being told: the command line starts half a
    second earlier where nobody needs JAX.

    Attributes:
      rotation: [..., 3, 3] f32 or f64, orthonormal with determinant +1.
      translation: [..., 3] same dtype, in the unit of the points it is applied to.
    """

    rotation: Array
    translation: Array

    @classmethod
    def identity(cls, batch: tuple[int, ...] = (), dtype: Any = np.float32) -> RigidTransform:
        """The motion that moves nothing, as numpy arrays with leading shape ``batch``."""
        rotation = np.broadcast_to(np.eye(3, dtype=dtype), (*batch, 3, 3))
        return cls(rotation=rotation, translation=np.zeros((*batch, 3), dtype))

    @classmethod
    def from_matrix(cls, matrix: Array) -> RigidTransform:
        """From [..., 3, 4] or homogeneous [..., 4, 4] matrices."""
        return cls(rotation=matrix[..., :3, :3], translation=matrix[..., :3, 3])

    def as_matrix(self) -> Array:
        """Homogeneous [..., 4, 4] matrices."""
        xp = self.rotation.__array_namespace__()
        top = xp.concatenate([self.rotation, self.translation[..., None]], axis=-1)
        bottom = xp.broadcast_to(xp.asarray([0, 0, 0, 1], top.dtype), (*top.shape[:-2], 1, 4))
        return xp.concatenate([top, bottom], axis=-2)

    def replace(self, **changes: Array) -> RigidTransform:
        """The same with another ``rotation`` or ``translation``."""
        return self._replace(**changes)

    def apply(self, points: Array) -> Array:
        """Moves points [..., N, 3]."""
        return self.rotate(points) + self.translation[..., None, :]

    def rotate(self, vectors: Array) -> Array:
        """Turns directions [..., N, 3], for example normals."""
        return _matmul(vectors, self.rotation.swapaxes(-1, -2))

    def inverse(self) -> RigidTransform:
        """``a_from_b.inverse()`` is ``b_from_a``."""
        rotation = self.rotation.swapaxes(-1, -2)
        translation = -_matmul(rotation, self.translation[..., None])[..., 0]
        return RigidTransform(rotation=rotation, translation=translation)

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        """Composition: ``a_from_b @ b_from_c`` is ``a_from_c``."""
        turned = _matmul(self.rotation, other.translation[..., None])[..., 0]
        return RigidTransform(
            rotation=_matmul(self.rotation, other.rotation),
            translation=turned + self.translation,
        )


def rigid_from_matrix(matrix: np.ndarray, *, where: str) -> RigidTransform:
    """The rigid motion that a 4x4 matrix is meant to be.

    Args:
      matrix: [4, 4] f64; translation in mm.
      where: what the message of an error starts with.

    Returns:
      Its translation, and the rotation nearest to its own: at most `MATRIX_TOLERANCE` away.

    Raises:
      InputError: not finite, or not a rigid motion; says what it is instead.
    """
    if not np.isfinite(matrix).all():
        raise InputError(f"{where}: the matrix holds a value that is not finite")
    rotation = matrix[:3, :3]
    if not np.allclose(matrix[3], [0, 0, 0, 1], rtol=0, atol=1e-9):
        transposed = np.allclose(matrix[:, 3], [0, 0, 0, 1], rtol=0, atol=1e-9)
        hint = "; it looks column-major: transpose it" if transposed else ""
        raise InputError(f"{where}: the last row is {matrix[3].tolist()}, not 0, 0, 0, 1{hint}")
    # before any product: entries of 1e200 would overflow it
    if (largest := np.abs(rotation).max()) > 1e6:
        raise InputError(f"{where}: no rotation: it has an entry of size {largest:.3g}, at most 1")
    gram = rotation.T @ rotation
    error = np.abs(gram - np.eye(3)).max()
    if error > MATRIX_TOLERANCE:
        scale = np.sqrt(np.trace(gram) / 3)
        even = scale > 0 and np.abs(gram / scale**2 - np.eye(3)).max() <= MATRIX_TOLERANCE
        hint = f"it scales by {scale:.4g}" if even else "its axes are not unit and square"
        raise InputError(
            f"{where}: no rotation: {hint} (R^T R differs from 1 by {error:.2g}, "
            f"more than {MATRIX_TOLERANCE:g})"
        )
    if np.linalg.det(rotation) < 0:
        raise InputError(
            f"{where}: no rotation but a mirror image (determinant -1); "
            "one axis has the wrong sign, or the frame is left-handed"
        )
    u, _, vt = np.linalg.svd(rotation)
    return RigidTransform(rotation=u @ vt, translation=matrix[:3, 3].copy())


def _matmul(a: Array, b: Array) -> Array:
    """Matrix product at full precision: TF32 on a GPU would cost 1e-3 of a coordinate."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a @ b
    xp = (b if isinstance(a, np.ndarray) else a).__array_namespace__()  # that of JAX
    return xp.matmul(a, b, precision="highest")
