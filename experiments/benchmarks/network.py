"""Times of RPM-Net: a training step and a registration, with PyTorch and arithmetic.

What is timed are pairs of real scans of the guide vane: 717 source and 1,024 target points.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.flops import inference_flops, step_flops
from experiments.benchmarks.timing import Bench, Figure, peer
from experiments.configs.vane import get_config
from experiments.runner import machine
from experiments.runner.experiment import Experiment
from vanejax.cad import guide_vane
from vanejax.matching import fast_rpmnet
from vanejax.pointcloud import PointCloud
from vanejax.rigid import RigidTransform
from vanejax.scanner import Camera, hemisphere_viewpoints
from vanejax.training import (
    Pair,
    PairSampling,
    ScanSet,
    TrainState,
    draw_pairs,
    make_bank,
    make_scan_set,
)
from vanejax.training.pairs import ScanBank

TEST_ITERATIONS = 5
ELEVATIONS_DEG, AZIMUTHS_DEG = (70.0,), (10.0, 100.0, 190.0, 280.0)


@functools.cache
def vane_scans() -> ScanSet:
    """Four views at half the resolution, which leaves every voxel its point."""
    part = guide_vane()
    views = hemisphere_viewpoints(
        part.center, elevations_deg=ELEVATIONS_DEG, azimuths_deg=AZIMUTHS_DEG
    )
    return make_scan_set(part, Camera().scaled(0.5), views, progress=False)


@dataclasses.dataclass(frozen=True)
class VanePairs:
    """RPM-Net of the default recipe on pairs of fixed size."""

    sources: int = 717  # N, all rows real
    targets: int = 1024  # M
    neighbors: int = 32  # K
    batch: int = 4  # B

    @functools.cached_property
    def config(self) -> Experiment:
        """The default recipe with these sizes."""
        config = get_config()
        config.model.num_neighbors = self.neighbors
        config.training.batch_size = self.batch
        return config

    @functools.cached_property
    def bank(self) -> ScanBank:
        """The scans, from each of which N points are drawn."""
        bank = make_bank(vane_scans(), num_reference=self.targets)
        return bank.replace(source_sizes=jnp.full_like(bank.source_sizes, self.sources))

    @property
    def sampling(self) -> PairSampling:
        """The recipe's, for these sizes."""
        return PairSampling(num_reference=self.targets, num_source=self.sources)

    def pair(self, seed: int) -> Pair:
        """One pair with a reference of its own."""
        views = jnp.asarray([seed % len(AZIMUTHS_DEG)])
        pairs = draw_pairs(jax.random.key(seed), self.bank, views, self.sampling)
        first = jax.tree.map(lambda leaf: leaf[0], (pairs.source, pairs.target_from_source))
        return Pair(source=first[0], target=pairs.target, target_from_source=first[1])

    def state(self) -> TrainState:
        """Untrained."""
        return self.config.initial_state(self.bank, self.sampling)


def step(bench: Bench) -> Iterator[Figure]:
    """One step of training on a batch of four pairs."""
    pairs = VanePairs()
    iterations = pairs.config.loss.iterations
    flops = step_flops(
        pairs.config.make_network().model, pairs.sources, pairs.targets, iterations, pairs.batch
    )
    yield arithmetic(bench, "arithmetic of a step", flops)
    seconds, loss = bench.time(training(pairs))
    # last: its threads stay, and wait busily
    yield torch_step(bench, pairs)
    yield Figure(
        f"training step, batch {pairs.batch}",
        seconds,
        peers={"PyTorch, training step": 1.0},
        limits={"arithmetic of a step": 3.0},
        goal_s=1.0,
        note=f"{sizes(pairs)}, {iterations} iterations, loss {loss:.3f}",
    )


def inference(bench: Bench) -> Iterator[Figure]:
    """One registration, the reference's features given."""
    pairs = VanePairs()
    flops = inference_flops(
        pairs.config.make_network().model, pairs.sources, pairs.targets, TEST_ITERATIONS
    )
    yield arithmetic(bench, "arithmetic of an inference", flops)
    seconds, _ = bench.time(registering(pairs))
    # last: its threads stay, and wait busily
    yield torch_inference(bench, pairs)
    yield Figure(
        "inference, batch 1",
        seconds,
        peers={"PyTorch, inference": 1.0},
        limits={"arithmetic of an inference": None},
        goal_s=0.09,
        note=f"{sizes(pairs)}, {TEST_ITERATIONS} iterations, features of the reference given",
    )


def arithmetic(bench: Bench, name: str, flops: int) -> Figure:
    """The time of so many operations at the rate of a large matrix product, measured now."""
    rates = machine.flops_per_second(bench.repeats)
    size = machine.MATMUL_SIZE
    note = (
        f"{flops / 1e9:.1f} GFLOP at {np.median(rates) / 1e9:.0f} GFLOP/s, the rate of a "
        f"{size} x {size} f32 product"
    )
    return Figure(name, [flops / rate for rate in rates], note=note)


def sizes(pairs: VanePairs) -> str:
    """In words."""
    return f"{pairs.sources} x {pairs.targets} points, k = {pairs.neighbors}"


def training(pairs: VanePairs) -> Callable[[], float]:
    """Steps of one training run, each of which gives its loss."""
    train_step, state = pairs.config.train_step(pairs.sampling), pairs.state()

    def step() -> float:
        nonlocal state
        state, metrics = train_step(state, pairs.bank)
        return float(metrics["loss"])

    return step


def registering(pairs: VanePairs) -> Callable[[], RigidTransform]:
    """A registration of one pair, the reference's features computed before."""
    model, variables = pairs.config.make_network().model, pairs.state().variables
    pair = pairs.pair(0)
    features = jax.jit(fast_rpmnet.features, static_argnums=0)(model, variables, pair.target)

    @jax.jit
    def infer(
        variables: Any, source: PointCloud, target: PointCloud, features: jax.Array
    ) -> RigidTransform:
        match = fast_rpmnet.last_match(
            model,
            variables,
            source,
            target,
            RigidTransform.identity(),
            iterations=TEST_ITERATIONS,
            target_features=features,
        )
        return match.target_from_source

    return lambda: jax.block_until_ready(infer(variables, pair.source, pair.target, features))


@peer("PyTorch, training step")
def torch_step(bench: Bench, pairs: VanePairs) -> tuple[list[float], str]:
    """The published step: each pair with its own reference, the published loss."""
    import torch

    from experiments.benchmarks import torch_rpmnet

    model = torch_rpmnet.TorchRpmNet(num_neighbors=pairs.neighbors)
    batch = [pairs.pair(seed) for seed in range(pairs.batch)]
    tensors = [torch.tensor(np.stack(arrays)) for arrays in zip(*map(_arrays, batch), strict=True)]
    iterations = pairs.config.loss.iterations
    step = torch_rpmnet.make_train_step(model, iterations)
    seconds, loss = bench.time(lambda: step(*tensors))
    note = f"a reference for each pair, {torch.get_num_threads()} threads, loss {loss:.3f}"
    return seconds, note


@peer("PyTorch, inference")
def torch_inference(bench: Bench, pairs: VanePairs) -> tuple[list[float], str]:
    """The published registration: features of both clouds in each iteration."""
    import torch

    from experiments.benchmarks import torch_rpmnet

    model = torch_rpmnet.TorchRpmNet(num_neighbors=pairs.neighbors)
    source, target, _ = (torch.tensor(array[None]) for array in _arrays(pairs.pair(0)))
    with torch.no_grad():
        seconds, _ = bench.time(lambda: model(source, target, TEST_ITERATIONS))
    return seconds, f"{torch.get_num_threads()} threads"


def _arrays(pair: Pair) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source [N, 6], target [M, 6] and target_from_source [3, 4], as PyTorch's code takes them."""
    clouds = (np.concatenate([c.xyz, c.normals], -1) for c in (pair.source, pair.target))
    return *clouds, np.asarray(pair.target_from_source.as_matrix())[:3]
