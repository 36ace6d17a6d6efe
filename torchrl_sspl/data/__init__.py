"""Labelled transitions, each frame stored once, and their collection through TorchRL."""

from __future__ import annotations

from torchrl_sspl.data.augmentation import Augmentation
from torchrl_sspl.data.collect import RandomActions, collect_random, collect_rollouts
from torchrl_sspl.data.labels import Labels
from torchrl_sspl.data.store import RegionSampler, TransitionStore
from torchrl_sspl.data.trees import stand_in

stand_in()  # before anybody makes a sampler that draws by priority

__all__ = ["Augmentation", "Labels", "RandomActions", "RegionSampler", "TransitionStore", "collect_random", "collect_rollouts"]
