"""Lipschitz-bounded barriers, and proofs of their bounds on the deployed weights."""

from __future__ import annotations

from torchrl_sspl.lipschitz.bounds import lipschitz_lower, lipschitz_upper
from torchrl_sspl.lipschitz.exact import LipschitzProof, prove_lipschitz
from torchrl_sspl.lipschitz.lmi import LMIBarrier
from torchrl_sspl.lipschitz.multipliers import solve_multipliers
from torchrl_sspl.lipschitz.network import layer_weights, slope_interval
from torchrl_sspl.lipschitz.sandwich import SandwichBarrier, cayley

__all__ = [
    "LMIBarrier",
    "LipschitzProof",
    "SandwichBarrier",
    "cayley",
    "layer_weights",
    "lipschitz_lower",
    "lipschitz_upper",
    "prove_lipschitz",
    "slope_interval",
    "solve_multipliers",
]
