"""Measurements of whatever acts: closed loops, true kernels, episodes, full physics, certificates."""

from __future__ import annotations

from torchrl_sspl.evaluation.certify import certify_on_episodes, verify_run
from torchrl_sspl.evaluation.controllers import AgentController, Controller, RandomController, as_controller
from torchrl_sspl.evaluation.episodes import evaluate_episodes
from torchrl_sspl.evaluation.known import evaluate
from torchrl_sspl.evaluation.outcome import Outcome, write_metrics
from torchrl_sspl.evaluation.physics import evaluate_physics
from torchrl_sspl.evaluation.simulation import Episodes, simulate

#: Without ``certify``, the name of a module here: it is ``torchrl_sspl.certify``.
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
