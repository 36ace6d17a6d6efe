"""One way from configuration to report: train, evaluate, certify, report; names load when first used."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what readers of the source, type checkers among them, need to know
    from torchrl_sspl.experiments.run import Experiment, agent_phases, run_experiment

_NAMES = {"Experiment": "run", "agent_phases": "run", "run_experiment": "run"}
__all__ = ["Experiment", "agent_phases", "run_experiment"]


def __getattr__(name: str) -> Any:
    if name in _NAMES:
        return getattr(importlib.import_module(f"torchrl_sspl.experiments.{_NAMES[name]}"), name)
    raise AttributeError(f"module 'torchrl_sspl.experiments' has no attribute '{name}'; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return sorted(__all__)
