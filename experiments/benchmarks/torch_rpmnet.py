"""RPM-Net in PyTorch, computed as its published code does: the peer of the network's times.

Written anew after Yew and Lee, *RPM-Net* (CVPR 2020), with the structure and the weight names of
their code: the features of both clouds anew in each iteration, neighbours by a sort of all indices,
each pair of a batch with its own reference. Needs ``pip install vanejax[peers]``.

Clouds are [B, N, 6]: coordinates and unit normals. Motions are [B, 3, 4].
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

_EPSILON = 1e-5
SINKHORN_ITERATIONS, LEARNING_RATE = 5, 1e-4


def square_distance(a: Tensor, b: Tensor) -> Tensor:
    """[B, N, M] squared distances of a [B, N, C] and b [B, M, C]."""
    product = -2 * torch.matmul(a, b.transpose(1, 2))
    return product + (a**2).sum(-1)[:, :, None] + (b**2).sum(-1)[:, None, :]


def ball_query(xyz: Tensor, radius: float, num_neighbors: int) -> Tensor:
    """[B, N, K] the first other points by index within the radius, padded with the point itself."""
    batch, count, _ = xyz.shape
    itself = torch.arange(count)
    index = itself.repeat(batch, count, 1)
    index[:, itself, itself] = count
    index[square_distance(xyz, xyz) > radius**2] = count
    index = index.sort(dim=-1)[0][:, :, :num_neighbors]
    return torch.where(index == count, itself[None, :, None], index)


def angle(a: Tensor, b: Tensor) -> Tensor:
    """Angles [...] between vectors [..., 3], radians."""
    a, b = torch.broadcast_tensors(a, b)
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))


def stack(
    widths: Sequence[int], layer: type[nn.Module], groups: int, *, plain_end: bool
) -> nn.Sequential:
    """Dense layers with group normalisation and ReLU; a plain end has neither."""
    size = () if layer is nn.Linear else (1,)  # a convolution of one point is a dense layer
    modules: list[nn.Module] = []
    for place, (before, after) in enumerate(itertools.pairwise(widths)):
        modules.append(layer(before, after, *size))
        if not (plain_end and place == len(widths) - 2):
            modules += [nn.GroupNorm(groups, after), nn.ReLU()]
    return nn.Sequential(*modules)


class FeatureNet(nn.Module):
    """Features [B, N, 96] of clouds."""

    def __init__(self, radius: float, num_neighbors: int) -> None:
        super().__init__()
        self.radius, self.num_neighbors = radius, num_neighbors
        self.prepool = stack((10, 96, 96, 192), nn.Conv2d, 8, plain_end=False)
        self.postpool = stack((192, 192, 96, 96), nn.Conv1d, 8, plain_end=True)

    def forward(self, cloud: Tensor) -> Tensor:
        """From clouds [B, N, 6]."""
        xyz, normals = cloud.split(3, dim=-1)
        index = ball_query(xyz, self.radius, self.num_neighbors)
        batch = torch.arange(len(xyz))[:, None, None]
        offsets = xyz[batch, index] - xyz[:, :, None]
        theirs, mine = normals[batch, index], normals[:, :, None]
        pairs = [angle(mine, offsets), angle(theirs, offsets), angle(mine, theirs)]
        ppf = torch.stack([*pairs, offsets.norm(dim=-1)], dim=-1)
        x = torch.cat([xyz[:, :, None].expand_as(offsets), offsets, ppf], dim=-1)
        x = self.prepool(x.permute(0, 3, 2, 1)).max(dim=2)[0]
        x = self.postpool(x).transpose(1, 2)
        return x / x.norm(dim=-1, keepdim=True)


class ParameterNet(nn.Module):
    """Annealing parameters beta and alpha, [B, 2], of two clouds."""

    def __init__(self) -> None:
        super().__init__()
        narrow = stack((4, 64, 64, 64, 128), nn.Conv1d, 8, plain_end=False)
        wide = stack((128, 1024), nn.Conv1d, 16, plain_end=False)
        self.prepool = nn.Sequential(*narrow, *wide)
        self.postpool = stack((1024, 512, 256, 2), nn.Linear, 16, plain_end=True)

    def forward(self, source: Tensor, target: Tensor) -> Tensor:
        """From coordinates [B, N, 3] and [B, M, 3]."""
        both = [
            functional.pad(xyz, (0, 1), value=flag) for flag, xyz in enumerate((source, target))
        ]
        x = self.prepool(torch.cat(both, dim=1).transpose(1, 2)).max(dim=2)[0]
        return functional.softplus(self.postpool(x))


def log_sinkhorn(affinity: Tensor) -> Tensor:
    """Log assignments [B, N, M] with a slack row and column that are never normalised."""
    x = functional.pad(affinity, (0, 1, 0, 1))
    for _ in range(SINKHORN_ITERATIONS):
        rows = x[:, :-1] - torch.logsumexp(x[:, :-1], dim=2, keepdim=True)
        x = torch.cat([rows, x[:, -1:]], dim=1)
        columns = x[:, :, :-1] - torch.logsumexp(x[:, :, :-1], dim=1, keepdim=True)
        x = torch.cat([columns, x[:, :, -1:]], dim=2)
    return x[:, :-1, :-1]


def weighted_procrustes(source: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    """Motions of source [B, N, 3] onto target [B, N, 3] under weights [B, N]."""
    share = (weights / (weights.sum(1, keepdim=True) + _EPSILON))[..., None]
    source_mean = (share * source).sum(1, keepdim=True)
    target_mean = (share * target).sum(1, keepdim=True)
    covariance = (source - source_mean).transpose(1, 2) @ (share * (target - target_mean))
    u, _, v = torch.svd(covariance)
    mirrored = torch.cat([v[:, :, :2], -v[:, :, 2:]], dim=2)
    turn, other = v @ u.transpose(1, 2), mirrored @ u.transpose(1, 2)
    rotation = torch.where(torch.det(turn)[:, None, None] > 0, turn, other)
    translation = target_mean.transpose(1, 2) - rotation @ source_mean.transpose(1, 2)
    return torch.cat([rotation, translation], dim=2)


def move(motion: Tensor, cloud: Tensor) -> Tensor:
    """Clouds under motions."""
    xyz, normals = cloud.split(3, dim=-1)
    turn = motion[:, :, :3].transpose(1, 2)
    return torch.cat([xyz @ turn + motion[:, None, :, 3], normals @ turn], dim=-1)


class TorchRpmNet(nn.Module):
    """RPM-Net on batches of pairs; `load_state_dict` takes the published weights by name."""

    def __init__(self, *, num_neighbors: int = 32, radius: float = 0.3) -> None:
        super().__init__()
        self.weights_net = ParameterNet()
        self.feat_extractor = FeatureNet(radius, num_neighbors)

    def forward(
        self, source: Tensor, target: Tensor, iterations: int
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Motions and assignments [B, N, M] after each iteration, from the identity."""
        motions, assignments, moved = [], [], source
        for _ in range(iterations):
            parameters = self.weights_net(moved[..., :3], target[..., :3])
            beta, alpha = parameters[..., None, None].unbind(1)
            features = self.feat_extractor(moved), self.feat_extractor(target)
            affinity = -beta * (square_distance(*features) - alpha)
            assignment = log_sinkhorn(affinity).exp()
            weights = assignment.sum(2)
            partners = assignment @ target[..., :3] / (weights[..., None] + _EPSILON)
            motions.append(weighted_procrustes(source[..., :3], partners, weights))
            assignments.append(assignment)
            moved = move(motions[-1].detach(), source)
        return motions, assignments


def loss(
    model: TorchRpmNet, source: Tensor, target: Tensor, truth: Tensor, iterations: int
) -> Tensor:
    """The published loss: distance of the moved source, 0.01 of the slack, halved backwards."""
    expected = move(truth, source)[..., :3]
    total = torch.zeros(())
    for motion, assignment in zip(*model(source, target, iterations), strict=True):
        value = functional.l1_loss(move(motion, source)[..., :3], expected)
        value = value + sum(0.01 * (1 - assignment.sum(axis)).mean() for axis in (1, 2))
        total = 0.5 * total + value
    return total


def make_train_step(
    model: TorchRpmNet, iterations: int
) -> Callable[[Tensor, Tensor, Tensor], float]:
    """A step of Adam on source, target and true motion; gives the loss."""
    optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE)

    def step(source: Tensor, target: Tensor, truth: Tensor) -> float:
        optimizer.zero_grad()
        value = loss(model, source, target, truth, iterations)
        value.backward()
        optimizer.step()
        return value.item()

    return step
