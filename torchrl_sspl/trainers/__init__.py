"""Training on TorchRL's trainer: the joint loss on pictures, then phases on frozen latents; names load when first used."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what readers of the source, type checkers among them, need to know
    from torchrl_sspl.trainers.asking import choose_and_spread, infer_unsafe
    from torchrl_sspl.trainers.phases import Check, InnerLoop, Phase, Phases, Workspace
    from torchrl_sspl.trainers.selection import CheckRound, PlaceLevel
    from torchrl_sspl.trainers.source import Source, starts_of
    from torchrl_sspl.trainers.steady import KeepChanges, SteadyEncoder
    from torchrl_sspl.trainers.synthesis import (
        FineTune,
        FitDynamics,
        FitSets,
        Gather,
        Retry,
        Settle,
        SteerPolicy,
        TeachPolicy,
        Tighten,
        synthesis_phases,
    )
    from torchrl_sspl.trainers.trainer import SSPLTrainer

_NAMES = {
    **dict.fromkeys(("choose_and_spread", "infer_unsafe"), "asking"),
    **dict.fromkeys(("Check", "InnerLoop", "Phase", "Phases", "Workspace"), "phases"),
    **dict.fromkeys(("CheckRound", "PlaceLevel"), "selection"),
    **dict.fromkeys(("Source", "starts_of"), "source"),
    **dict.fromkeys(
        ("FineTune", "FitDynamics", "FitSets", "Gather", "Retry", "Settle", "SteerPolicy", "TeachPolicy", "Tighten", "synthesis_phases"),
        "synthesis",
    ),
    "SSPLTrainer": "trainer",
    **dict.fromkeys(("KeepChanges", "SteadyEncoder"), "steady"),
}
__all__ = [
    "Check", "CheckRound", "FineTune", "FitDynamics", "FitSets", "Gather", "InnerLoop", "KeepChanges", "Phase", "Phases", "PlaceLevel",
    "Retry", "SSPLTrainer", "Settle", "Source", "SteadyEncoder", "SteerPolicy", "TeachPolicy", "Tighten", "Workspace", "choose_and_spread", "infer_unsafe",
    "starts_of", "synthesis_phases",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(importlib.import_module(f"torchrl_sspl.trainers.{_NAMES[name]}"), name)
    raise AttributeError(f"module 'torchrl_sspl.trainers' has no attribute '{name}'; it has {', '.join(sorted(__all__))}")


def __dir__() -> list[str]:
    return sorted(__all__)
