"""From scans of a part to trained weights.

In: a `ScanSet` (virtual scans with labels) and a network. Out: a pure training step
``state, metrics = step(state, bank)``, checkpoints, and weight files for `register`.
"""

from vanejax.training.checkpoint import Checkpoints, restore_or
from vanejax.training.dataset import ScanSet, load_scan_set, make_scan_set
from vanejax.training.pairs import Pair, PairSampling, draw_pairs, make_bank
from vanejax.training.rpmnet_loss import RpmNetLoss
from vanejax.training.train_step import (
    OptimizerSettings,
    TrainState,
    init_state,
    make_optimizer,
    make_train_step,
)
from vanejax.training.weight_file import TrainedMatcher, find_weights, load_model, save_model

__all__ = [
    "Checkpoints",
    "OptimizerSettings",
    "Pair",
    "PairSampling",
    "RpmNetLoss",
    "ScanSet",
    "TrainState",
    "TrainedMatcher",
    "draw_pairs",
    "find_weights",
    "init_state",
    "load_model",
    "load_scan_set",
    "make_bank",
    "make_optimizer",
    "make_scan_set",
    "make_train_step",
    "restore_or",
    "save_model",
]
