"""Lipschitz-bounded barriers, and proofs of their bounds on the deployed weights."""

from __future__ import annotations

from torchrl_sspl.lipschitz.exact import (
    LipschitzProof,
    layer_weights,
    lipschitz_lower,
    lipschitz_upper,
    prove_lipschitz,
    solve_multipliers,
)
from torchrl_sspl.lipschitz.lmi import LMIBarrier
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
    "solve_multipliers",
]
