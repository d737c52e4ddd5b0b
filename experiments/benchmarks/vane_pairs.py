"""Pairs of real scans of the guide vane for timing RPM-Net: 717 source and 1,024 target points."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp

from experiments.configs.vane import get_config
from experiments.runner.experiment import Experiment
from vanejax.cad import guide_vane
from vanejax.scanner import Camera, hemisphere_viewpoints
from vanejax.training import (
    ScanSet,
    TrainState,
    make_scan_set,
)
from vanejax.training.pairs import Pair, PairSampling, ScanBank, draw_pairs, make_bank

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
