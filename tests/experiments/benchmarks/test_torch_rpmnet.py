"""The PyTorch peer computes what RPM-Net does; vanejax is held to the published code elsewhere."""

from __future__ import annotations

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.benchmarks.flops import dense_flops, feature_flops, match_flops
from vanejax.matching import RpmNet
from vanejax.matching.se3 import exp_so3
from vanejax.matching.torch_weights import rpmnet_variables
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.training import Pair, RpmNetLoss

torch = pytest.importorskip("torch")

from experiments.benchmarks import torch_rpmnet  # noqa: E402
from experiments.benchmarks.torch_rpmnet import TorchRpmNet  # noqa: E402

N, M, K = 60, 70, 8


@pytest.fixture(scope="module")
def peer() -> TorchRpmNet:
    torch.manual_seed(0)
    model = TorchRpmNet(num_neighbors=K, radius=0.5)
    # the features of random weights lie close together: beta must tell them apart
    model.weights_net.postpool[6].bias.data = torch.tensor([300.0, -4.0])
    return model


@pytest.fixture(scope="module")
def variables(peer: TorchRpmNet) -> dict:
    return rpmnet_variables({k: v.numpy().copy() for k, v in peer.state_dict().items()})


@pytest.fixture(scope="module")
def clouds() -> tuple[np.ndarray, np.ndarray]:
    """Source [N, 6] and target [M, 6] of a bumpy sphere, one of them turned."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(N + M, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    points = normals * (0.6 + 0.1 * np.sin(5 * normals[:, :1]))
    turn = np.asarray(exp_so3(np.array([0.1, -0.2, 0.3])))
    source = np.concatenate([points[:N] @ turn.T + 0.1, normals[:N] @ turn.T], -1)
    target = np.concatenate([points[N:], normals[N:]], -1)
    return source.astype(np.float32), target.astype(np.float32)


def cloud(points: np.ndarray) -> PointCloud:
    return PointCloud.create(jnp.asarray(points[:, :3]), jnp.asarray(points[:, 3:]))


def test_it_finds_what_vanejax_finds(peer: TorchRpmNet, variables: dict, clouds) -> None:
    source, target = clouds
    with torch.no_grad():
        motions, assignments = peer(*(torch.tensor(c[None]) for c in clouds), 3)
    model = RpmNet(num_neighbors=K, radius=0.5)
    run = jax.jit(lambda *pair: model.apply(variables, *pair, RigidTransform.identity(), 3))
    matches = run(cloud(source), cloud(target))
    for motion, assignment, match in zip(motions, assignments, matches, strict=True):
        # f32 eps x 300 of beta x the condition of a few near-equal features
        found = match.target_from_source.as_matrix()[:3]
        np.testing.assert_allclose(motion[0], found, atol=1e-4)
        np.testing.assert_allclose(assignment[0], np.exp(match.log_assignment), atol=1e-3)
    assert np.ptp(assignments[0].numpy()) > 0.1  # or all assignments look alike


@pytest.mark.slow
def test_a_step_has_the_loss_and_gradient_of_vanejax(peer, variables, clouds) -> None:
    source, target = clouds
    truth = RigidTransform(exp_so3(np.float32([0.0, 0.1, 0.0])), np.float32([0.0, 0.0, 0.1]))
    matrix = np.asarray(truth.as_matrix())[:3]
    stepped = copy.deepcopy(peer)
    step = torch_rpmnet.make_train_step(stepped, 2)
    loss = step(*(torch.tensor(c[None]) for c in (source, target, matrix)))
    batch = jax.tree.map(lambda leaf: leaf[None], (cloud(source), truth))
    pairs = Pair(source=batch[0], target=cloud(target), target_from_source=batch[1])
    model = RpmNet(num_neighbors=K, radius=0.5)
    value_and_grad = jax.value_and_grad(lambda given: RpmNetLoss()(model, given, pairs)[0])
    expected, gradient = jax.jit(value_and_grad)(variables)
    np.testing.assert_allclose(loss, expected, rtol=1e-4)
    bias = stepped.weights_net.postpool[6].bias
    ours = gradient["params"]["annealing_net"]["postpool_2"]["bias"]
    np.testing.assert_allclose(bias.grad, ours, rtol=0.02)
    # Adam's first step is the learning rate against the gradient's sign
    moved = (bias - peer.weights_net.postpool[6].bias).detach()
    np.testing.assert_allclose(moved, -1e-4 * np.sign(ours), rtol=0.2)


def test_the_flops_are_those_that_pytorch_counts(peer: TorchRpmNet, clouds) -> None:
    from torch.utils.flop_counter import FlopCounterMode

    with FlopCounterMode(display=False) as counter, torch.no_grad():
        peer(*(torch.tensor(c[None]) for c in clouds), 2)
    model = RpmNet(num_neighbors=K)
    each = feature_flops(model, N) + feature_flops(model, M) + match_flops(model, N, M)
    # its ball query multiplies matrices too, and it moves the source and solves for the motion
    small = 2 * 2 * (3 * N**2 + 3 * M**2) + 2 * dense_flops(N, (3, 3, 3, 3))
    total = counter.get_total_flops()
    assert 2 * each <= total <= 2 * each + 1.1 * small
