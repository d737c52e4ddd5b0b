"""How much arithmetic RPM-Net cannot do without: the physical limit of its speed.

A multiplication and an addition count as two. Counted are the matrix products; what is done once
per number (normalisation, ReLU, exponentials, point-pair features) is left out, so that the count
is a lower bound. It is that of the mathematics, not of the program: the reference's features once,
the source's in each iteration, nothing computed again.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from vanejax.matching import RpmNet

ANNEALING_POINTS = (4, 64, 64, 64, 128, 1024)  # widths of the net before its maximum
ANNEALING_CLOUD = (1024, 512, 256, 2)  # and behind it


def dense_flops(rows: int, widths: Sequence[int]) -> int:
    """Of a stack of dense layers on ``rows`` rows."""
    return 2 * rows * sum(a * b for a, b in itertools.pairwise(widths))


def feature_flops(model: RpmNet, points: int) -> int:
    """Of the features of one cloud, neighbours included."""
    width = model.feature_width
    around = dense_flops(points * model.num_neighbors, (10, width, width, 2 * width))
    return around + dense_flops(points, (2 * width, 2 * width, width, width))


def match_flops(model: RpmNet, sources: int, targets: int) -> int:
    """Of one iteration behind the features: annealing, distance matrix, soft correspondences."""
    annealing = dense_flops(sources + targets, ANNEALING_POINTS) + dense_flops(1, ANNEALING_CLOUD)
    return annealing + 2 * sources * targets * (model.feature_width + 3)


def neighbor_flops(points: int) -> int:
    """Of the squared distances of all points of a cloud: three differences, squares, sums."""
    return 8 * points**2


def inference_flops(model: RpmNet, sources: int, targets: int, iterations: int) -> int:
    """Of registering one pair, the reference's features given."""
    each = feature_flops(model, sources) + match_flops(model, sources, targets)
    return neighbor_flops(sources) + iterations * each


def step_flops(model: RpmNet, sources: int, targets: int, iterations: int, batch: int) -> int:
    """Of one training step on a batch that shares its reference.

    The gradient of a matrix product is two such products, so all counts three times; but no
    gradient is wanted of what the first layers are given.
    """
    rows = model.num_neighbors * (batch * iterations * sources + targets)
    pairs = batch * iterations
    first = dense_flops(rows, (10, model.feature_width))
    first += dense_flops(pairs * (sources + targets), ANNEALING_POINTS[:2])
    each = feature_flops(model, sources) + match_flops(model, sources, targets)
    forward = pairs * each + feature_flops(model, targets)
    neighbors = batch * neighbor_flops(sources) + neighbor_flops(targets)
    return 3 * forward - first + neighbors
