"""Training, evaluation and certification of agents; each name is loaded when it is first used."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what readers of the source, type checkers among them, need to know
    from torchrl_sspl.trainers.certify import certify_on_episodes, verify_run
    from torchrl_sspl.trainers.config import TrainingConfig, make_config
    from torchrl_sspl.trainers.encoding import encode_transitions
    from torchrl_sspl.trainers.episodes import evaluate_episodes
    from torchrl_sspl.trainers.evaluation import evaluate, rollout
    from torchrl_sspl.trainers.experiment import Experiment, run_experiment
    from torchrl_sspl.trainers.latents import LatentTraining
    from torchrl_sspl.trainers.paper import PaperTraining
    from torchrl_sspl.trainers.pipeline import SafePolicyTraining
    from torchrl_sspl.trainers.run import train
    from torchrl_sspl.trainers.torchrl_trainer import SSPLTrainer

_NAMES = {
    "SSPLTrainer": "torchrl_trainer",
    "SafePolicyTraining": "pipeline",
    "PaperTraining": "paper",
    "TrainingConfig": "config",
    "make_config": "config",
    "train": "run",
    "evaluate": "evaluation",
    "rollout": "evaluation",
    "certify_on_episodes": "certify",
    "verify_run": "certify",
    "LatentTraining": "latents",
    "encode_transitions": "encoding",
    "Experiment": "experiment",
    "run_experiment": "experiment",
    "evaluate_episodes": "episodes",
}
__all__ = [
    "Experiment",
    "LatentTraining",
    "PaperTraining",
    "SSPLTrainer",
    "SafePolicyTraining",
    "TrainingConfig",
    "certify_on_episodes",
    "encode_transitions",
    "evaluate",
    "evaluate_episodes",
    "make_config",
    "rollout",
    "run_experiment",
    "train",
    "verify_run",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(importlib.import_module(f"torchrl_sspl.trainers.{_NAMES[name]}"), name)
    raise AttributeError(f"module 'torchrl_sspl.trainers' has no attribute '{name}'; it has {', '.join(sorted(__all__))}")


def __dir__() -> list[str]:
    return sorted(__all__)
