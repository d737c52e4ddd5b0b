"""RPM-Net in PyTorch, computed as its published code does: what vanejax is as fast as, or faster.

Written anew after Yew and Lee, *RPM-Net* (CVPR 2020), with the structure and the names of the
weights of their code: the features of both clouds anew in each iteration, neighbours by a sort of
all indices, each pair of a batch with a reference of its own. Needs ``pip install vanejax[peers]``.

Clouds are [B, N, 6]: coordinates and unit normals.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import torch
from torch import nn
from torch.nn import functional

_EPSILON = 1e-5


def square_distance(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """[B, N, M] squared distances of a [B, N, C] and b [B, M, C]."""
    product = -2 * torch.matmul(a, b.transpose(1, 2))
    return product + (a**2).sum(-1)[:, :, None] + (b**2).sum(-1)[:, None, :]


def ball_query(xyz: torch.Tensor, radius: float, num_neighbors: int) -> torch.Tensor:
    """[B, N, K] the first other points by index within the radius, filled up by the point."""
    batch, count, _ = xyz.shape
    itself = torch.arange(count)
    index = itself.repeat(batch, count, 1)
    index[:, itself, itself] = count
    index[square_distance(xyz, xyz) > radius**2] = count
    index = index.sort(dim=-1)[0][:, :, :num_neighbors]
    return torch.where(index == count, itself[None, :, None], index)


def gather(values: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Values [B, N, C] at indices [B, N, K]: [B, N, K, C]."""
    return values[torch.arange(len(values))[:, None, None], index]


def angle(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Angles [...] between vectors [..., 3], radians."""
    a, b = torch.broadcast_tensors(a, b)
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))


def stack(
    widths: Sequence[int], layer: Callable[..., nn.Module], groups: int, *, bare_end: bool
) -> nn.Sequential:
    """Layers with group normalisation and ReLU; a bare end has neither."""
    modules: list[nn.Module] = []
    for place, (before, after) in enumerate(itertools.pairwise(widths)):
        modules.append(layer(before, after))
        if not (bare_end and place == len(widths) - 2):
            modules += [nn.GroupNorm(groups, after), nn.ReLU()]
    return nn.Sequential(*modules)


def convolution(kind: type[nn.Module]) -> Callable[[int, int], nn.Module]:
    """A dense layer on every point, as the published code writes it."""
    return lambda before, after: kind(before, after, 1)


class FeatureNet(nn.Module):
    """Features [B, N, 96] of clouds."""

    def __init__(self, radius: float, num_neighbors: int) -> None:
        super().__init__()
        self.radius, self.num_neighbors = radius, num_neighbors
        self.prepool = stack((10, 96, 96, 192), convolution(nn.Conv2d), 8, bare_end=False)
        self.postpool = stack((192, 192, 96, 96), convolution(nn.Conv1d), 8, bare_end=True)

    def forward(self, cloud: torch.Tensor) -> torch.Tensor:
        """From clouds [B, N, 6]."""
        xyz, normals = cloud.split(3, dim=-1)
        index = ball_query(xyz, self.radius, self.num_neighbors)
        offsets = gather(xyz, index) - xyz[:, :, None]
        theirs, mine = gather(normals, index), normals[:, :, None]
        pairs = [angle(mine, offsets), angle(theirs, offsets), angle(mine, theirs)]
        ppf = torch.stack([*pairs, offsets.norm(dim=-1)], dim=-1)
        x = torch.cat([xyz[:, :, None].expand_as(offsets), offsets, ppf], dim=-1)
        x = self.prepool(x.permute(0, 3, 2, 1)).max(dim=2)[0]
        x = self.postpool(x).transpose(1, 2)
        return x / x.norm(dim=-1, keepdim=True)


class ParameterNet(nn.Module):
    """Annealing parameters beta [B] and alpha [B] of two clouds."""

    def __init__(self) -> None:
        super().__init__()
        narrow = stack((4, 64, 64, 64, 128), convolution(nn.Conv1d), 8, bare_end=False)
        wide = stack((128, 1024), convolution(nn.Conv1d), 16, bare_end=False)
        self.prepool = nn.Sequential(*narrow, *wide)
        self.postpool = stack((1024, 512, 256, 2), nn.Linear, 16, bare_end=True)

    def forward(
        self, source: torch.Tensor, target: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """From coordinates [B, N, 3] and [B, M, 3]."""
        both = [
            functional.pad(xyz, (0, 1), value=flag) for flag, xyz in enumerate((source, target))
        ]
        x = self.prepool(torch.cat(both, dim=1).transpose(1, 2)).max(dim=2)[0]
        beta, alpha = functional.softplus(self.postpool(x)).unbind(1)
        return beta, alpha


def log_sinkhorn(affinity: torch.Tensor, iterations: int) -> torch.Tensor:
    """Log assignments [B, N, M] with a slack row and column that are never normalised."""
    x = functional.pad(affinity, (0, 1, 0, 1))
    for _ in range(iterations):
        rows = x[:, :-1] - torch.logsumexp(x[:, :-1], dim=2, keepdim=True)
        x = torch.cat([rows, x[:, -1:]], dim=1)
        columns = x[:, :, :-1] - torch.logsumexp(x[:, :, :-1], dim=1, keepdim=True)
        x = torch.cat([columns, x[:, :, -1:]], dim=2)
    return x[:, :-1, :-1]


def weighted_procrustes(
    source: torch.Tensor, target: torch.Tensor, weights: torch.Tensor
) -> torch.Tensor:
    """Motions [B, 3, 4] of source [B, N, 3] onto target [B, N, 3] under weights [B, N]."""
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


def move(motion: torch.Tensor, cloud: torch.Tensor) -> torch.Tensor:
    """Clouds [B, N, 6] under motions [B, 3, 4]."""
    xyz, normals = cloud.split(3, dim=-1)
    turn = motion[:, :, :3].transpose(1, 2)
    return torch.cat([xyz @ turn + motion[:, None, :, 3], normals @ turn], dim=-1)


class TorchRpmNet(nn.Module):
    """RPM-Net on batches of pairs; `load_state_dict` takes the published weights by name."""

    def __init__(
        self, *, num_neighbors: int = 32, radius: float = 0.3, sinkhorn_iterations: int = 5
    ) -> None:
        super().__init__()
        self.sinkhorn_iterations = sinkhorn_iterations
        self.weights_net = ParameterNet()
        self.feat_extractor = FeatureNet(radius, num_neighbors)

    def forward(
        self, source: torch.Tensor, target: torch.Tensor, iterations: int
    ) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        """Motions [B, 3, 4] and assignments [B, N, M] after each iteration, from the identity."""
        motions, assignments = [], []
        moved = source
        for _ in range(iterations):
            beta, alpha = self.weights_net(moved[..., :3], target[..., :3])
            features = self.feat_extractor(moved), self.feat_extractor(target)
            excess = square_distance(*features) - alpha[:, None, None]
            affinity = -beta[:, None, None] * excess
            assignment = log_sinkhorn(affinity, self.sinkhorn_iterations).exp()
            weights = assignment.sum(2)
            partners = assignment @ target[..., :3] / (weights[..., None] + _EPSILON)
            motions.append(weighted_procrustes(source[..., :3], partners, weights))
            assignments.append(assignment)
            moved = move(motions[-1].detach(), source)
        return motions, assignments


def loss(
    model: TorchRpmNet,
    source: torch.Tensor,
    target: torch.Tensor,
    truth: torch.Tensor,
    iterations: int,
) -> torch.Tensor:
    """The published loss: distance of the moved source, 0.01 of the slack, halved backwards."""
    wanted = move(truth, source)[..., :3]
    total = torch.zeros(())
    for place, (motion, assignment) in enumerate(
        zip(*model(source, target, iterations), strict=True)
    ):
        value = functional.l1_loss(move(motion, source)[..., :3], wanted)
        for axis in (1, 2):
            value = value + 0.01 * (1 - assignment.sum(axis)).mean()
        total = total + 0.5 ** (iterations - 1 - place) * value
    return total


def make_train_step(
    model: TorchRpmNet, *, iterations: int, learning_rate: float = 1e-4
) -> Callable[[torch.Tensor, torch.Tensor, torch.Tensor], float]:
    """A step of Adam on source [B, N, 6], target [B, M, 6] and truth [B, 3, 4]; gives the loss."""
    optimizer = torch.optim.Adam(model.parameters(), lr=learning_rate)

    def step(source: torch.Tensor, target: torch.Tensor, truth: torch.Tensor) -> float:
        optimizer.zero_grad()
        value = loss(model, source, target, truth, iterations)
        value.backward()
        optimizer.step()
        return value.item()

    return step
