"""Losses as TorchRL loss modules."""

from __future__ import annotations

from torchrl_sspl.objectives.action_value import ActionValueLoss
from torchrl_sspl.objectives.base import LatentBatch, LatentLoss
from torchrl_sspl.objectives.consistency import ConsistencyLoss
from torchrl_sspl.objectives.counterexample import CounterexampleLoss
from torchrl_sspl.objectives.deviation import ActionChangeLoss, PolicyDeviationLoss
from torchrl_sspl.objectives.lipschitz import LipschitzLoss
from torchrl_sspl.objectives.salad import SaLaDLoss
from torchrl_sspl.objectives.sspl import PRESETS, SSPLLoss
from torchrl_sspl.objectives.synthesis import SynthesisLoss
from torchrl_sspl.objectives.target import TargetLoss

__all__ = [
    "ActionChangeLoss",
    "ActionValueLoss",
    "PRESETS",
    "ConsistencyLoss",
    "CounterexampleLoss",
    "LatentBatch",
    "LatentLoss",
    "LipschitzLoss",
    "PolicyDeviationLoss",
    "SSPLLoss",
    "SaLaDLoss",
    "SynthesisLoss",
    "TargetLoss",
]
