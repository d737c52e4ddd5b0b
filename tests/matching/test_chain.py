"""Two methods in turn: the second starts where the first ended."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from vanejax.matching.contract import Register, Registration, chain
from vanejax.matching.se3 import exp_se3
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

CLOUD = PointCloud.create(jnp.zeros((4, 3)), jnp.zeros((4, 3)))


def step(twist: list[float], iterations: int, seen: list) -> Register:
    """A method that adds a known motion to its start, and keeps what it was given."""

    def register(source, target, init, key) -> Registration:
        seen.append((init, key))
        return Registration(
            target_from_source=exp_se3(jnp.asarray(twist)) @ init,
            converged=jnp.asarray(iterations > 1),
            iterations=jnp.asarray(iterations, jnp.int32),
            rmse=jnp.asarray(0.1 * iterations),
            overlap=jnp.asarray(1.0 / iterations),
        )

    return register


def test_the_second_starts_where_the_first_ended() -> None:
    first, second, seen = [0.1, 0.2, 0.0, 1.0, 0.0, 0.0], [0.0, 0.3, 0.0, 0.0, 2.0, 0.0], []
    register = chain(step(first, 1, seen), step(second, 5, seen))
    init = exp_se3(jnp.array([0.0, 0.0, 0.5, 0.0, 0.0, 3.0]))
    found = register(CLOUD, CLOUD, init, jax.random.key(0))
    total: RigidTransform = exp_se3(jnp.asarray(second)) @ exp_se3(jnp.asarray(first)) @ init
    np.testing.assert_allclose(
        found.target_from_source.as_matrix(), total.as_matrix(), atol=1e-6
    )  # f32 eps x 10
    assert found.iterations == 6
    assert found.converged
    np.testing.assert_allclose((found.rmse, found.overlap), (0.5, 0.2), rtol=1e-6)
    keys = [jax.random.key_data(key).tolist() for _, key in seen]
    assert keys[0] != keys[1]  # no key is spent twice
    assert jax.random.key_data(jax.random.key(0)).tolist() not in keys
