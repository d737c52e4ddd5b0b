"""The laws of `vanejax.matching.contract.Register`, and the methods that must keep them.

The classical methods must also find the pose. Networks come with random weights: what they promise
for any weights is asked here, what training gives is the matter of their own tests.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from quick_jit import quick_jit

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

NUM_SOURCE, NUM_TARGET, ROWS = 160, 320, 352  # all clouds have as many rows: one compilation
IDENTITY = RigidTransform.identity()
KEY = jax.random.key(0)


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

    @property
    def angle_deg(self) -> float:
        """Of the motion that a law undoes."""
        return self.reach_deg or 20.0

    def __call__(self, *pair_init_key) -> Registration:
        """The method, compiled once."""
        return _compiled(self)(*pair_init_key)


@functools.cache
def _compiled(case: Case) -> Callable[..., Registration]:
    return quick_jit(case.make())


@functools.cache
def clouds() -> tuple[PointCloud, PointCloud]:
    """Points of the guide vane in unit-sphere units: half of the target's are the source's too."""
    part = guide_vane()
    points, normals, _ = part.sample(NUM_TARGET, seed=0)
    xyz = jnp.asarray((points - part.center) / part.radius, jnp.float32)
    target = PointCloud.create(xyz, jnp.asarray(normals, jnp.float32))
    # the half that a camera above would rather see: a source as partial as a scan
    rows = np.argsort(-points @ np.array([0.2, 0.3, 1.0]))[:NUM_SOURCE]
    source = jax.tree.map(lambda leaf: leaf[rows], target)
    return padded(source, 0.0), padded(target, 0.0)


def padded(cloud: PointCloud, value: float) -> PointCloud:
    """The cloud in ROWS rows; padding holds this value."""
    real = cloud.mask.sum()
    rows = jnp.full((ROWS - real, 3), value)
    return PointCloud(
        xyz=jnp.concatenate([cloud.xyz[:real], rows]),
        normals=jnp.concatenate([cloud.normals[:real], rows]),
        mask=jnp.arange(ROWS) < real,
    )


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
    assert result.converged.shape == result.iterations.shape == ()
    assert result.converged.dtype == bool
    assert result.iterations.dtype == jnp.int32
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))
    assert 0 <= result.overlap <= 1 + 1e-6
    assert result.rmse >= 0


# ---- the laws


def a_known_motion_is_undone(case: Case) -> None:
    """As far as the method reaches."""
    source, target = clouds()
    for seed in (0, 1):
        truth = perturbation(case.angle_deg, 0.05, seed)
        result = case(source.transform(truth.inverse()), target, IDENTITY, KEY)
        assert_well_formed(result)
        if case.reach_deg is not None:
            assert result.converged
            assert_near(result.target_from_source, truth, deg=1.0, shift=0.02)
            assert result.overlap > 0.5


def swapped_clouds_give_the_inverse(case: Case) -> None:
    _, target = clouds()
    truth = perturbation(0.5 * case.angle_deg, 0.03, 2)
    moved = target.transform(truth)
    there, back = case(moved, target, IDENTITY, KEY), case(target, moved, IDENTITY, KEY)
    assert_well_formed(there)
    if case.reach_deg is not None:
        assert_near(there.target_from_source, truth.inverse(), deg=0.5, shift=0.01)
        assert_near(back.target_from_source, truth, deg=0.5, shift=0.01)


def clouds_far_from_the_origin_give_the_conjugate(case: Case) -> None:
    """As in a machine's frame; networks know the frame that they were trained in."""
    if case.reach_deg is None:
        return
    source, target = clouds()
    truth = perturbation(0.5 * case.angle_deg, 0.05, 3)
    far = RigidTransform(jnp.eye(3), jnp.array([30.0, -20.0, 10.0]))
    displaced = source.transform(truth.inverse())
    result = case(displaced.transform(far), target.transform(far), IDENTITY, KEY)
    found = far.inverse() @ result.target_from_source @ far
    assert rotation_error_deg(found, truth) < 1.0
    # 36 units away a thousandth of a degree moves the origin by 6e-4; f32 itself by 1e-5
    at = displaced.xyz[:NUM_SOURCE]
    np.testing.assert_allclose(found.apply(at), truth.apply(at), atol=0.03)


def the_guess_is_part_of_the_answer(case: Case) -> None:
    """Starting at a guess is starting from the source moved there: the answer is the total."""
    source, target = clouds()
    truth, guess = perturbation(20.0, 0.05, 4), perturbation(16.0, 0.03, 4)
    displaced = source.transform(truth.inverse())
    result = case(displaced, target, guess, KEY)
    if not case.drawn:  # features need no guess, and rounding may choose another sample
        moved = case(displaced.transform(guess), target, IDENTITY, KEY)
        total = moved.target_from_source @ guess
        # rounding of the moved points, through the iterations; DCP's graph may change by a pair
        assert_near(result.target_from_source, total, deg=0.1, shift=2e-3)
    if case.reach_deg is not None:
        assert_near(result.target_from_source, truth, deg=1.0, shift=0.02)


def padding_is_irrelevant(case: Case) -> None:
    """What masked rows hold, and where they stand."""
    source, target = clouds()
    truth = perturbation(0.5 * case.angle_deg, 0.05, 5)
    source = source.transform(truth.inverse())
    result = case(padded(source, 7.0), padded(target, -3.0), IDENTITY, KEY)
    other = case(padded(source, 0.0), padded(target, 0.5), IDENTITY, KEY)
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    if case.drawn:
        assert_near(result.target_from_source, truth, deg=1.0, shift=0.02)
    else:
        in_front = (
            jax.tree.map(lambda leaf: jnp.roll(leaf, 20, axis=0), cloud)
            for cloud in (source, target)
        )
        rolled = case(*in_front, IDENTITY, KEY).target_from_source
        # sums in another order
        assert_near(result.target_from_source, rolled, deg=0.05, shift=1e-3)


def without_overlap_nothing_is_claimed(case: Case) -> None:
    """Without points the pose is finite and not called converged; far away, too."""
    source, target = clouds()
    no_source, no_target = (c.replace(mask=jnp.zeros_like(c.mask)) for c in (source, target))
    pairs = [(no_source, target), (source, no_target), (no_source, no_target)]
    # what random weights see in far points says nothing, and features find their like anywhere
    if case.reach_deg is not None and not case.drawn:
        pairs.append((source.replace(xyz=source.xyz + 100.0), target))
    for pair in pairs:
        result = case(*pair, IDENTITY, KEY)
        assert not result.converged
        assert_well_formed(result)


def degenerate_clouds_give_a_pose(case: Case) -> None:
    """A point, coincident points, a line, a plane: whatever the pose is, it is finite."""
    up = np.float32([0, 0, 1])
    for axes in (0 * up, up[::-1], 1 - up):
        flat = (
            cloud.replace(xyz=cloud.xyz * axes[None], normals=0 * cloud.normals + up[None])
            for cloud in clouds()
        )
        assert_well_formed(case(*flat, perturbation(10.0, 0.1, 8), KEY))
    source, target = clouds()
    single = source.replace(mask=jnp.arange(ROWS) == 3)
    assert_well_formed(case(single, target, IDENTITY, KEY))


def a_batch_is_its_pairs(case: Case) -> None:
    """A vmap gives what single calls give, and the same key gives the same."""
    source, target = clouds()
    sources = [
        source.transform(perturbation(0.5 * case.angle_deg, 0.03, seed).inverse())
        for seed in (6, 7)
    ]
    keys = jax.random.split(KEY)
    singly = [case(a, target, IDENTITY, key) for a, key in zip(sources, keys, strict=True)]
    again = case(sources[0], target, IDENTITY, keys[0])
    jax.tree.map(np.testing.assert_array_equal, singly[0], again)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), *sources)
    batched = quick_jit(jax.vmap(case.make(), in_axes=(0, None, None, 0)))
    result = batched(both, target, IDENTITY, keys)
    for row, single in enumerate(singly):
        found = jax.tree.map(lambda leaf, row=row: leaf[row], result.target_from_source)
        # sums in another order, through the iterations
        assert_near(found, single.target_from_source, deg=0.1, shift=2e-3)


LAWS = (
    a_known_motion_is_undone,
    swapped_clouds_give_the_inverse,
    clouds_far_from_the_origin_give_the_conjugate,
    the_guess_is_part_of_the_answer,
    padding_is_irrelevant,
    without_overlap_nothing_is_claimed,
    degenerate_clouds_give_a_pose,
    a_batch_is_its_pairs,
)


# ---- the methods


def network(model, factory, **settings) -> Callable[[], Register]:
    """Makes a `Register` of a network with random weights."""

    def make() -> Register:
        source, target = clouds()
        variables = quick_jit(model.init, static_argnums=4)(KEY, source, target, IDENTITY, 1)
        return factory(model, variables, **settings)

    return make


def _sac_ia() -> Register:
    return sac_ia(feature_radius=0.5, max_distance=0.1, num_hypotheses=4000)


def _robust_icp() -> Register:
    return icp(
        metric="point_to_plane", max_distance=0.5, kernel="huber", kernel_width=0.1, trim=0.9
    )


CASES = {
    "ICP, points": Case(lambda: icp(metric="point_to_point", max_distance=0.5), 8.0),
    "ICP, planes": Case(lambda: icp(metric="point_to_plane", max_distance=0.5), 8.0),
    "ICP, robust": Case(_robust_icp, 8.0),
    "SAC-IA": Case(_sac_ia, 45.0, drawn=True),
    "SAC-IA + ICP": Case(lambda: chain(_sac_ia(), icp(max_distance=0.1)), 45.0, drawn=True),
    "FGR": Case(lambda: fgr(feature_radius=0.5, max_distance=0.05), 45.0, drawn=True),
    "RPM-Net": Case(
        network(RpmNet(num_neighbors=8, radius=0.4, feature_width=16), rpmnet, iterations=2)
    ),
    "DCP": Case(network(Dcp(width=32, num_neighbors=8, heads=2, hidden=32), dcp)),
    "PointNetLK": Case(network(PointNetLK(), pointnetlk, iterations=3)),
    "PCRNet": Case(network(PcrNet(head=(64, 32)), pcrnet, iterations=3)),
}
