"""The methods that this one is compared with, behind one interface, and what perfect perception would reach.

``python -m torchrl_sspl.baselines NAME env=pendulum`` fits, scores and prints one row; ``... table`` a whole table.
"""

from __future__ import annotations

from torchrl_sspl.baselines.base import BUDGETS, Budget, Guarded, Needs, OneStepFilter, SafetyMethod
from torchrl_sspl.baselines.data import Recording, record
from torchrl_sspl.baselines.registry import METHODS, make
from torchrl_sspl.baselines.scoring import ScoreConfig, score

__all__ = [
    "BUDGETS", "Budget", "Guarded", "METHODS", "Needs", "OneStepFilter", "Recording", "SafetyMethod", "ScoreConfig", "make",
    "record", "score",
]  # fmt: skip
