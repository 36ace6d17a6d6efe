"""Batched TorchRL environments with labelled regions and pixel observations."""

from __future__ import annotations

from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.envs.cmu_dubins import CMUDubinsEnv
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.envs.gymnasium import GymnasiumPixels
from torchrl_sspl.envs.pendulum import PendulumEnv as PendulumEnv  # not in __all__: TorchRL has one too
from torchrl_sspl.envs.pendulum import PixelPendulumEnv
from torchrl_sspl.envs.rendering import GymnasiumRenderer, PendulumRenderer
from torchrl_sspl.envs.system import Opening, Requirement, System
from torchrl_sspl.envs.two_discs import CMUTwoDiscsEnv

__all__ = [
    "CMUDubinsEnv", "CMUTwoDiscsEnv", "DubinsEnv", "GymnasiumPixels", "GymnasiumRenderer", "Opening", "PendulumRenderer", "PixelPendulumEnv",
    "Requirement", "SafetyEnv", "System",
]  # fmt: skip
