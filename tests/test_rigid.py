"""SE(3): group laws, the exponential, and the best motion between two point sets."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from vanejax.matching.procrustes import nearest_rotation, weighted_procrustes
from vanejax.matching.se3 import exp_se3, exp_so3, hat, rotation_angle
from vanejax.rigid import RigidTransform

BATCHES = [(), (1,), (3, 1, 2)]
ROUNDING = 1e-12  # f64 eps x coordinates up to 100 x a dozen operations

exp_se3, exp_so3 = map(jax.jit, (exp_se3, exp_so3))
rotation_angle = jax.jit(rotation_angle)
angle_gradient = jax.jit(jax.grad(lambda omega: rotation_angle(exp_so3(omega))))
procrustes = jax.jit(weighted_procrustes)


@pytest.fixture(autouse=True)
def _double_precision():
    with jax.enable_x64(True):
        yield


def random_motion(seed: int, batch: tuple[int, ...] = (), xp=np) -> RigidTransform:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(int(np.prod(batch, dtype=int)), rng=rng).as_matrix()
    translation = rng.normal(size=(*batch, 3), scale=30)
    return RigidTransform(xp.asarray(rotation.reshape(*batch, 3, 3)), xp.asarray(translation))


def assert_same(a: RigidTransform, b: RigidTransform, atol: float = ROUNDING) -> None:
    np.testing.assert_allclose(a.as_matrix(), b.as_matrix(), atol=atol)


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
@pytest.mark.parametrize("batch", BATCHES)
def test_motions_are_a_group_that_acts_on_points(batch, xp):
    a_from_b, b_from_c, c_from_d = (random_motion(seed, batch, xp) for seed in range(3))
    identity = RigidTransform.identity(batch, np.float64)
    points = xp.asarray(np.random.default_rng(3).normal(size=(*batch, 7, 3), scale=30))

    assert a_from_b.as_matrix().shape == (*batch, 4, 4)
    assert_same((a_from_b @ b_from_c) @ c_from_d, a_from_b @ (b_from_c @ c_from_d))
    assert_same(a_from_b @ identity, a_from_b)
    assert_same(identity @ a_from_b, a_from_b)
    assert_same(a_from_b @ a_from_b.inverse(), identity)
    assert_same(a_from_b.inverse() @ a_from_b, identity)
    assert_same((a_from_b @ b_from_c).inverse(), b_from_c.inverse() @ a_from_b.inverse())
    assert_same(RigidTransform.from_matrix(a_from_b.as_matrix()), a_from_b, atol=0)
    assert_same(RigidTransform.from_matrix(a_from_b.as_matrix()[..., :3, :]), a_from_b, atol=0)

    moved = (a_from_b @ b_from_c).apply(points)
    np.testing.assert_allclose(moved, a_from_b.apply(b_from_c.apply(points)), atol=ROUNDING)
    turned = a_from_b.apply(points) - a_from_b.apply(xp.zeros_like(points))
    np.testing.assert_allclose(a_from_b.rotate(points), turned, atol=ROUNDING)
    homogeneous = xp.concatenate([points, xp.ones_like(points[..., :1])], -1)
    by_matrix = np.einsum("...ij,...nj->...ni", a_from_b.as_matrix(), homogeneous)[..., :3]
    np.testing.assert_allclose(a_from_b.apply(points), by_matrix, atol=ROUNDING)
    assert isinstance(moved, np.ndarray) == (xp is np)  # the host stays on the host
    assert moved.dtype == np.float64


@pytest.mark.parametrize("batch", BATCHES)
def test_free_functions_take_any_batch(batch):
    rng = np.random.default_rng(0)
    twist = jnp.asarray(rng.normal(size=(*batch, 6)))
    motion = exp_se3(twist)
    np.testing.assert_allclose(exp_so3(twist[..., :3]), motion.rotation, atol=ROUNDING)
    cross = np.cross(twist[..., :3], twist[..., 3:])
    product = np.einsum("...ij,...j->...i", hat(twist[..., :3]), twist[..., 3:])
    np.testing.assert_allclose(product, cross, atol=ROUNDING)
    source = jnp.asarray(rng.normal(size=(*batch, 5, 3)))
    found = procrustes(source, motion.apply(source), jnp.ones((*batch, 5)))
    assert_same(found, motion)
    angles = np.linalg.norm(twist[..., :3], axis=-1)
    np.testing.assert_allclose(rotation_angle(found.rotation), angles, atol=ROUNDING)


near_zero = st.floats(-12, -1).map(lambda exponent: 10.0**exponent)
near_pi = st.floats(-12, -1).map(lambda exponent: np.pi - 10.0**exponent)
angles_up_to_pi = st.one_of(st.just(0.0), near_zero, st.floats(0.0, 3.14), near_pi)
directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)


@settings(max_examples=60, deadline=None)
@given(direction=directions, angle=angles_up_to_pi, seed=st.integers(0, 9))
def test_exponential_and_angle(direction, angle, seed):
    omega = angle * np.array(direction) / np.linalg.norm(direction)
    twist = np.concatenate([omega, np.random.default_rng(seed).normal(size=3)])
    with jax.enable_x64(True):
        motion = exp_se3(twist)
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = hat(omega), twist[3:]
        # f64 eps x 1000 where the Taylor series end (0.01 rad), and expm's own rounding
        np.testing.assert_allclose(motion.as_matrix(), scipy.linalg.expm(generator), atol=1e-12)
        np.testing.assert_allclose(rotation_angle(motion.rotation), angle, atol=1e-12)


@pytest.mark.parametrize("angle", [1e-6, 1e-3, 9.9e-3, 1.01e-2, 0.03, 0.3, 3.0])
def test_single_precision_keeps_its_digits(angle):
    """Between Taylor and closed form too, where 1 - cos t would cancel."""
    twist = np.array([0.6 * angle, 0, -0.8 * angle, 1, 2, -3])
    exact = exp_se3(twist)
    found = exp_se3(twist.astype(np.float32))
    assert found.rotation.dtype == jnp.float32
    assert_same(found, exact, atol=1e-6)  # f32 eps x 3 x 3 operations


@pytest.mark.parametrize("degrees", [1e-4, 1e-3, 0.02, 1.0, 179.99])
def test_rotation_angle_in_single_precision(degrees):
    axis = np.array([2, -1, 2]) / 3
    rotation = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix().astype(np.float32)
    found = rotation_angle(jnp.asarray(rotation))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(np.degrees(float(found)), degrees, rtol=1e-5)  # f32 eps x 100


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.009, 0.011, 1.0, 3.1])
def test_gradients_of_the_exponential(angle):
    """At zero, and beside both ends of the series."""
    twist = angle * np.array([0.6, 0, -0.8, 0, 0, 0]) + [0, 0, 0, 1, 2, -3]
    check_grads(exp_se3, (twist,), order=1, modes=["fwd", "rev"], atol=1e-7, rtol=1e-7, eps=1e-5)


@pytest.mark.parametrize("angle", [1e-9, 0.01, 1.0, 3.1])
def test_gradient_of_the_angle_is_the_axis(angle):
    axis = np.array([0.6, 0, -0.8])
    gradient = angle_gradient(angle * axis)
    np.testing.assert_allclose(gradient, axis, atol=1e-9)  # f64 eps / sin(3.1) x the series' end


def test_gradient_of_the_angle_at_identity_is_finite():
    gradient = jax.grad(rotation_angle)(jnp.eye(3))
    assert np.isfinite(gradient).all()


def kabsch(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> RigidTransform:
    """Weighted least squares by scipy."""
    a = np.average(source, axis=0, weights=weights)
    b = np.average(target, axis=0, weights=weights)
    rotation, _ = Rotation.align_vectors(target - b, source - a, weights=weights)
    return RigidTransform(rotation.as_matrix(), b - rotation.as_matrix() @ a)


OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)])
POINTS = np.random.default_rng(0).normal(size=(6, 3)) * (1.0, 0.7, 0.3)
NOISE = 0.1 * np.random.default_rng(1).normal(size=(6, 3))
PLANE = POINTS * (1, 1, 0)
MIRROR = np.diag([1.0, 1.0, -1.0])
WELL_POSED = {
    "generic": (POINTS, POINTS + NOISE),
    "equal singular values": (OCTAHEDRON, OCTAHEDRON),
    "two equal singular values": (OCTAHEDRON * (1, 1, 0.3), OCTAHEDRON * (1, 1, 0.3)),
    "planar": (PLANE, PLANE + NOISE * (1, 1, 0)),
    "flipped plane": (PLANE, (PLANE + NOISE) * (1, -1, 0)),
    "plane onto space": (PLANE, POINTS + NOISE),
    "reflection": (POINTS, POINTS @ MIRROR + NOISE),
}
ILL_POSED = {
    "collinear": (POINTS * (1, 0, 0), POINTS * (1, 0, 0) + NOISE * (1, 0, 0)),
    "coincident": (np.ones((6, 3)), np.zeros((6, 3))),
    "reflected octahedron": (OCTAHEDRON, -OCTAHEDRON),
    "reflection with two equal values": (OCTAHEDRON * (1, 0.5, 0.5), -OCTAHEDRON * (1, 0.5, 0.5)),
}


@pytest.mark.parametrize("name", WELL_POSED)
def test_procrustes_is_the_least_squares_motion_and_its_gradient(name):
    source, target = WELL_POSED[name]
    motion = random_motion(5)
    target = motion.apply(target)
    weights = np.array([1.0, 1, 1, 1, 1, 1])
    if name in ("generic", "reflection", "planar"):
        weights = np.array([0.3, 2.0, 1.0, 0.1, 0.7, 1.3])
    found = procrustes(source, target, weights)
    assert_same(found, kabsch(source, target, weights), atol=1e-10)  # ROUNDING over the gap of 0.1
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1, atol=ROUNDING)
    check_grads(procrustes, (source, target, weights), order=1, modes=["fwd", "rev"])


@pytest.mark.filterwarnings("ignore:Optimal rotation is not uniquely")  # that is the point
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", ILL_POSED)
def test_procrustes_stays_finite_where_the_answer_is_not_unique(name, dtype):
    source, target = (points.astype(dtype) for points in ILL_POSED[name])
    weights = np.ones(6, dtype)

    @jax.jit
    def both(source, target, weights):
        found, pull = jax.vjp(weighted_procrustes, source, target, weights)
        return found, pull(jax.tree.map(jnp.ones_like, found))

    found, gradients = both(source, target, weights)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((found, gradients)))
    eps = 20 * np.finfo(dtype).eps  # a product of three rotations
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=eps)
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1, atol=eps)
    # whichever rotation it is, it must be one of the best: scipy's residual is reached
    oracle = kabsch(source.astype(float), target.astype(float), weights.astype(float))

    def cost(motion):
        return np.sum((np.asarray(motion.apply(source), float) - target) ** 2)

    assert cost(jax.tree.map(np.asarray, found)) <= cost(oracle) + 100 * eps


def test_procrustes_without_weight_is_the_identity():
    weights = np.zeros(6)
    assert_same(procrustes(POINTS, POINTS + NOISE, weights), RigidTransform.identity(), atol=0)
    pull = jax.vjp(procrustes, POINTS, POINTS + NOISE, weights)[1]
    gradients = pull(random_motion(0, xp=jnp))
    assert all(np.isfinite(gradient).all() for gradient in gradients)


def test_a_pair_of_no_weight_is_not_there():
    target = random_motion(5).apply(POINTS) + NOISE
    junk = np.full((2, 3), 1e6)
    padded = (np.concatenate([POINTS, junk]), np.concatenate([target, -junk]))
    weights = np.array([1.0] * 6 + [0.0] * 2)
    # 0 x 1e6 is exactly 0: only the sums' order may differ
    assert_same(procrustes(*padded, weights), procrustes(POINTS, target, weights[:6]))
    pull = jax.vjp(procrustes, *padded, weights)[1]
    gradients = pull(jax.tree.map(jnp.ones_like, procrustes(*padded, weights)))
    for gradient in gradients[:2]:
        assert np.abs(gradient[:6]).max() > 0
        np.testing.assert_array_equal(gradient[6:], 0)


@pytest.mark.parametrize("determinant", [1, -1])
def test_nearest_rotation_maximises_the_trace(determinant):
    rng = np.random.default_rng(determinant + 1)
    matrix = rng.normal(size=(3, 3))
    matrix[0] *= determinant * np.sign(np.linalg.det(matrix))
    best = nearest_rotation(jnp.asarray(matrix))
    others = Rotation.random(2000, rng=rng).as_matrix()
    traces = np.einsum("nij,ij->n", others, matrix)
    assert np.trace(best.T @ matrix) >= traces.max()
    s = np.linalg.svd(matrix, compute_uv=False)
    expected = s[0] + s[1] + determinant * s[2]
    np.testing.assert_allclose(np.trace(best.T @ matrix), expected, atol=ROUNDING)
    np.testing.assert_allclose(best.T @ best, np.eye(3), atol=ROUNDING)
    check_grads(jax.jit(nearest_rotation), (jnp.asarray(matrix),), order=1, modes=["fwd", "rev"])


def test_a_motion_is_immutable_and_can_be_copied_with_changes():
    motion = random_motion(0)
    with pytest.raises(AttributeError):
        motion.translation = np.zeros(3)
    with pytest.raises(AttributeError):
        motion.shift = np.zeros(3)
    at_origin = motion.replace(translation=np.zeros(3))
    np.testing.assert_array_equal(at_origin.rotation, motion.rotation)
    np.testing.assert_array_equal(at_origin.translation, 0)
    assert motion.translation.any()


def test_a_motion_is_a_pytree_of_its_two_arrays():
    batch = random_motion(0, (4,), jnp)
    paths = [jax.tree_util.keystr(place) for place, _ in jax.tree.leaves_with_path(batch)]
    assert paths == [".rotation", ".translation"]
    alone = jax.jit(jax.vmap(lambda motion: motion.inverse()))(batch)
    assert isinstance(alone, RigidTransform)
    assert_same(alone, batch.inverse())


def test_a_product_with_a_motion_of_jax_is_one_of_jax_at_full_precision():
    host, device = random_motion(0), random_motion(1, xp=jnp)
    for motion in (host @ device, device @ host):
        assert isinstance(motion.rotation, jax.Array)
    text = str(jax.make_jaxpr(lambda a, b: a @ b)(host, device))
    assert text.count("precision=(Precision.HIGHEST, Precision.HIGHEST)") == text.count(
        "dot_general"
    )
