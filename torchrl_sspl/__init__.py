"""Safe policies from pixels with barrier certificates that are checked, for TorchRL.

The names below are loaded when they are first used, so that ``import torchrl_sspl`` stays light.

Example:
    >>> import torchrl_sspl as sspl
    >>> sspl.envs.PendulumEnv(batch_size=[4], seed=0).reset()["pixels"].shape
    torch.Size([4, 6, 64, 64])
"""

from __future__ import annotations

import importlib
from typing import Any

import gymnasium

__version__ = "0.1.0"

# A name and a path: nothing of the simulator is loaded before the environment is made.
if "SSPL/QuadrupedObstacle-v0" not in gymnasium.registry:
    gymnasium.register(
        id="SSPL/QuadrupedObstacle-v0", entry_point="torchrl_sspl.envs.quadruped.env:QuadrupedEnv", max_episode_steps=80
    )

_SUBPACKAGES = (
    "baselines", "certification", "configs", "data", "envs", "errors", "evaluation", "experiments", "functional", "lipschitz", "modules",
    "objectives",
    "runtime", "sets", "trainers", "viability", "viz",
)  # fmt: skip
_NAMES = {
    "Agent": "modules.agent",
    "load": "modules.agent",
    "SaLaD": "modules",
    "SandwichBarrier": "lipschitz",
    "SSPLLoss": "objectives",
    "SaLaDLoss": "objectives",
    "SynthesisLoss": "objectives",
    "PolicyDeviationLoss": "objectives",
    "ActionChangeLoss": "objectives",
    "LipschitzLoss": "objectives",
    "TargetLoss": "objectives",
    "ActionValueLoss": "objectives",
    "ConsistencyLoss": "objectives",
    "SSPLTrainer": "trainers",
    "run_experiment": "experiments.run",
    "viability_kernel": "viability",
    "recoverable_set": "viability",
    "evaluate": "evaluation.known",
    "certify": "evaluation.certify",
    "Certificate": "certification.certificate",
    "SafetyFilter": "runtime",
    "SafetyVectorWrapper": "runtime",
    "SafetyWrapper": "runtime",
    "Monitor": "runtime",
    "calibrate": "runtime",
}

__all__ = ["__version__", *_NAMES, *_SUBPACKAGES]


def __getattr__(name: str) -> Any:
    if name in _SUBPACKAGES:
        return importlib.import_module(f"torchrl_sspl.{name}")
    if name in _NAMES:
        return getattr(importlib.import_module(f"torchrl_sspl.{_NAMES[name]}"), name)
    raise AttributeError(f"module 'torchrl_sspl' has no attribute '{name}'; it has {', '.join(sorted(__all__))}")


def __dir__() -> list[str]:
    return sorted(__all__)
