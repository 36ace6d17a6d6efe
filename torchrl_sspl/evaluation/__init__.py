"""Measurements of whatever acts: closed loops, true kernels, episodes, full physics, certificates.

Each name is loaded when it is first used; ``certify``, the name of a module here, is ``torchrl_sspl.certify``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what readers of the source, type checkers among them, need to know
    from torchrl_sspl.evaluation.certify import certify_on_episodes, verify_run
    from torchrl_sspl.evaluation.controllers import AgentController, Controller, RandomController, as_controller
    from torchrl_sspl.evaluation.episodes import evaluate_episodes
    from torchrl_sspl.evaluation.known import evaluate
    from torchrl_sspl.evaluation.outcome import Outcome, write_metrics
    from torchrl_sspl.evaluation.physics import evaluate_physics
    from torchrl_sspl.evaluation.simulation import Episodes, simulate

_NAMES = {
    "AgentController": "controllers",
    "Controller": "controllers",
    "Episodes": "simulation",
    "Outcome": "outcome",
    "RandomController": "controllers",
    "as_controller": "controllers",
    "certify_on_episodes": "certify",
    "evaluate": "known",
    "evaluate_episodes": "episodes",
    "evaluate_physics": "physics",
    "simulate": "simulation",
    "verify_run": "certify",
    "write_metrics": "outcome",
}
__all__ = [
    "AgentController",
    "Controller",
    "Episodes",
    "Outcome",
    "RandomController",
    "as_controller",
    "certify_on_episodes",
    "evaluate",
    "evaluate_episodes",
    "evaluate_physics",
    "simulate",
    "verify_run",
    "write_metrics",
]


def __getattr__(name: str) -> Any:
    if name in _NAMES:
        return getattr(importlib.import_module(f"torchrl_sspl.evaluation.{_NAMES[name]}"), name)
    raise AttributeError(f"module 'torchrl_sspl.evaluation' has no attribute '{name}'; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return sorted(__all__)
