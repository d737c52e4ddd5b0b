"""Every method keeps the contract of `vanejax.matching.contract.Register`, on one grid of clouds.

The classical methods must also find the pose. Networks come with random weights here: what they
promise for any weights is tested, what training gives is the matter of their own tests.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vanejax.cad.parametric_vane import guide_vane
from vanejax.matching.baselines.dcp import Dcp, dcp
from vanejax.matching.baselines.fgr import fgr
from vanejax.matching.baselines.icp import icp
from vanejax.matching.baselines.pcrnet import PcrNet, pcrnet
from vanejax.matching.baselines.pointnetlk import PointNetLK, pointnetlk
from vanejax.matching.baselines.sac_ia import sac_ia
from vanejax.matching.contract import Register, Registration, chain
from vanejax.matching.fast_rpmnet import rpmnet
from vanejax.matching.metrics import rotation_error_deg
from vanejax.matching.rpmnet import RpmNet
from vanejax.matching.se3 import exp_se3
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform

NUM_SOURCE, NUM_TARGET, PADDING = 160, 320, 32
IDENTITY = RigidTransform.identity()
KEY = jax.random.key(0)


@functools.cache
def clouds() -> tuple[PointCloud, PointCloud]:
    """Points of the guide vane in unit-sphere units: half of the target's are the source's too.

    Both have as many rows, so that they can change places without another compilation.
    """
    part = guide_vane()
    points, normals, _ = part.sample(NUM_TARGET, seed=0)
    xyz = jnp.asarray((points - part.center) / part.radius, jnp.float32)
    target = PointCloud.create(xyz, jnp.asarray(normals, jnp.float32))
    # the half that a camera above would rather see: a source as partial as a scan
    rows = np.argsort(-points @ np.array([0.2, 0.3, 1.0]))[:NUM_SOURCE]
    source = jax.tree.map(lambda leaf: leaf[rows], target)
    return padded(source, NUM_TARGET - NUM_SOURCE, 0.0), target


def padded(cloud: PointCloud, count: int, value: float) -> PointCloud:
    """More masked rows behind a cloud's, which hold this value."""
    rows = jnp.full((count, 3), value)
    return PointCloud(
        xyz=jnp.concatenate([cloud.xyz, rows]),
        normals=jnp.concatenate([cloud.normals, rows]),
        mask=jnp.concatenate([cloud.mask, jnp.zeros(count, bool)]),
    )


@dataclasses.dataclass(frozen=True)
class Case:
    """A method, and what it promises.

    Attributes:
      make: gives it.
      reach_deg: it finds the pose from a start that is off by this; None for untrained networks.
      drawn: whether its answer depends on the key, and on how rows are counted.
    """

    make: Callable[[], Register]
    reach_deg: float | None = None
    drawn: bool = False


def network(model, factory, **settings) -> Callable[[], Register]:
    def make() -> Register:
        source, target = clouds()
        variables = jax.jit(model.init, static_argnums=4)(KEY, source, target, IDENTITY, 1)
        return factory(model, variables, **settings)

    return make


def coarse() -> Register:
    return sac_ia(feature_radius=0.5, max_distance=0.1, num_hypotheses=4000)


CASES = {
    "ICP, points": Case(lambda: icp(metric="point_to_point", max_distance=0.5), 8.0),
    "ICP, planes": Case(lambda: icp(metric="point_to_plane", max_distance=0.5), 8.0),
    "ICP, robust": Case(
        lambda: icp(
            metric="point_to_plane", max_distance=0.5, kernel="huber", kernel_width=0.1, trim=0.9
        ),
        8.0,
    ),
    "SAC-IA": Case(coarse, 45.0, drawn=True),
    "SAC-IA + ICP": Case(lambda: chain(coarse(), icp(max_distance=0.1)), 45.0, drawn=True),
    "FGR": Case(lambda: fgr(feature_radius=0.5, max_distance=0.05), 45.0, drawn=True),
    "RPM-Net": Case(
        network(RpmNet(num_neighbors=8, radius=0.4, feature_width=16), rpmnet, iterations=2)
    ),
    "DCP": Case(network(Dcp(width=32, num_neighbors=8, heads=2, hidden=32), dcp)),
    "PointNetLK": Case(network(PointNetLK(), pointnetlk, iterations=3)),
    "PCRNet": Case(network(PcrNet(head=(64, 32)), pcrnet, iterations=3)),
}
ACCURATE = [name for name, case in CASES.items() if case.reach_deg is not None]


@functools.cache
def registering(name: str) -> Callable[..., Registration]:
    return jax.jit(CASES[name].make())


def perturbation(deg: float, shift: float, seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    axis, direction = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    twist = np.concatenate([np.radians(deg) * axis, shift * direction])
    return exp_se3(jnp.asarray(twist, jnp.float32))


def assert_near(found: RigidTransform, truth: RigidTransform, *, deg: float, shift: float) -> None:
    assert rotation_error_deg(found, truth) < deg
    assert jnp.linalg.norm(found.translation - truth.translation) < shift


def assert_well_formed(result: Registration) -> None:
    """Shapes and dtypes, a proper rotation, and figures in their ranges."""
    pose = result.target_from_source
    assert pose.rotation.shape == (3, 3)
    assert pose.translation.shape == (3,)
    assert pose.rotation.dtype == pose.translation.dtype == jnp.float32
    turned = np.asarray(pose.rotation, np.float64)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=2e-5)  # f32 eps x some products
    assert np.linalg.det(turned) > 0
    assert np.isfinite(pose.translation).all()
    assert result.converged.shape == result.iterations.shape == ()
    assert result.converged.dtype == bool
    assert result.iterations.dtype == jnp.int32
    assert 0 <= result.overlap <= 1 + 1e-6
    assert result.rmse >= 0


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("seed", [0, 1])
def test_perturbed(name: str, seed: int) -> None:
    """A known motion is undone, as far as the method reaches."""
    source, target = clouds()
    reach = CASES[name].reach_deg
    truth = perturbation(reach or 20.0, 0.05, seed)
    result = registering(name)(source.transform(truth.inverse()), target, IDENTITY, KEY)
    assert_well_formed(result)
    if reach is not None:
        assert result.converged
        assert_near(result.target_from_source, truth, deg=1.0, shift=0.02)
        assert result.overlap > 0.5


@pytest.mark.parametrize("name", CASES)
def test_swapped(name: str) -> None:
    """The clouds' roles exchanged: the inverse motion."""
    _, target = clouds()
    reach = CASES[name].reach_deg
    truth = perturbation(0.5 * (reach or 20.0), 0.03, 2)
    # both halves, so that each finds itself in the other
    moved = target.transform(truth)
    result = registering(name)(moved, target, IDENTITY, KEY)
    assert_well_formed(result)
    if reach is not None:
        again = registering(name)(target, moved, IDENTITY, KEY)
        assert_near(result.target_from_source, truth.inverse(), deg=0.5, shift=0.01)
        assert_near(again.target_from_source, truth, deg=0.5, shift=0.01)


@pytest.mark.parametrize("name", ACCURATE)
def test_shifted(name: str) -> None:
    """Both clouds far from the origin, as in a machine's frame: the motion is conjugated."""
    source, target = clouds()
    truth = perturbation(0.5 * CASES[name].reach_deg, 0.05, 3)
    far = RigidTransform(jnp.eye(3), jnp.array([30.0, -20.0, 10.0]))
    moved = source.transform(truth.inverse()).transform(far)
    result = registering(name)(moved, target.transform(far), IDENTITY, KEY)
    found = far.inverse() @ result.target_from_source @ far
    assert rotation_error_deg(found, truth) < 1.0
    # 36 units away a thousandth of a degree moves the origin by 6e-4; f32 itself by 1e-5
    at = source.transform(truth.inverse()).xyz
    np.testing.assert_allclose(found.apply(at), truth.apply(at), atol=0.03)


@pytest.mark.parametrize("name", CASES)
def test_the_guess_is_part_of_the_answer(name: str) -> None:
    """Starting at a guess is starting from the source moved there: the answer is the total."""
    source, target = clouds()
    case = CASES[name]
    truth, guess = perturbation(20.0, 0.05, 4), perturbation(16.0, 0.03, 4)
    displaced = source.transform(truth.inverse())
    result = registering(name)(displaced, target, guess, KEY)
    if case.drawn:  # features need no guess, and rounding may choose another sample
        assert_near(result.target_from_source, truth, deg=1.0, shift=0.02)
        return
    moved = registering(name)(displaced.transform(guess), target, IDENTITY, KEY)
    total = moved.target_from_source @ guess
    # rounding of the moved points, through the iterations; the graph of DCP may change by a pair
    assert_near(result.target_from_source, total, deg=0.1, shift=2e-3)
    if case.reach_deg is not None:
        assert_near(result.target_from_source, truth, deg=1.0, shift=0.02)


@pytest.mark.parametrize("name", CASES)
def test_padding_is_irrelevant(name: str) -> None:
    """Masked rows, whatever they hold, change nothing."""
    source, target = clouds()
    case = CASES[name]
    truth = perturbation(0.5 * (case.reach_deg or 20.0), 0.05, 5)
    source = source.transform(truth.inverse())

    register = registering(name)
    result = register(padded(source, PADDING, 7.0), padded(target, PADDING, -3.0), IDENTITY, KEY)
    other = register(padded(source, PADDING, 0.0), padded(target, PADDING, 0.5), IDENTITY, KEY)
    # what padding holds does not count, draws or no draws
    for one, two in zip(jax.tree.leaves(result), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-5)
    if case.drawn:
        assert_near(result.target_from_source, truth, deg=1.0, shift=0.02)
    else:
        plain = register(source, target, IDENTITY, KEY)
        assert_near(
            result.target_from_source, plain.target_from_source, deg=0.05, shift=1e-3
        )  # sums in another order


# what random weights see in far points says nothing, and features find their like anywhere
NEAR_ONLY = [name for name in ACCURATE if not CASES[name].drawn]
NO_OVERLAP = [(name, what) for name in CASES for what in ("no source", "no target", "nothing")]
NO_OVERLAP += [(name, "far away") for name in NEAR_ONLY]


@pytest.mark.parametrize(("name", "what"), NO_OVERLAP)
def test_without_overlap_nothing_is_claimed(name: str, what: str) -> None:
    source, target = clouds()
    if what == "far away":
        source = source.replace(xyz=source.xyz + 100.0)
    if what in ("no source", "nothing"):
        source = source.replace(mask=jnp.zeros_like(source.mask))
    if what in ("no target", "nothing"):
        target = target.replace(mask=jnp.zeros_like(target.mask))
    result = registering(name)(source, target, IDENTITY, KEY)
    assert not result.converged
    assert np.isfinite(result.target_from_source.as_matrix()).all()


@pytest.mark.parametrize("name", CASES)
def test_a_batch_is_its_pairs(name: str) -> None:
    """A vmap gives what single calls give, and the same key gives the same."""
    source, target = clouds()
    case = CASES[name]
    poses = [perturbation(0.5 * (case.reach_deg or 20.0), 0.03, seed) for seed in (6, 7)]
    sources = [source.transform(pose.inverse()) for pose in poses]
    keys = jax.random.split(KEY)
    register = registering(name)
    singly = [register(one, target, IDENTITY, key) for one, key in zip(sources, keys, strict=True)]
    again = register(sources[0], target, IDENTITY, keys[0])
    for one, two in zip(jax.tree.leaves(singly[0]), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, two)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *sources)
    batched = jax.jit(jax.vmap(register, in_axes=(0, None, None, 0)))(both, target, IDENTITY, keys)
    for row, one in enumerate(singly):
        found = jax.tree.map(lambda leaf, row=row: leaf[row], batched.target_from_source)
        # sums in another order, through the iterations
        assert_near(found, one.target_from_source, deg=0.1, shift=2e-3)
