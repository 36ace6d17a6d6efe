"""Networks: per-frame encoder, latent dynamics, policy, and the SaLaD world model that holds them."""

from __future__ import annotations

from torchrl_sspl.modules.choosing import ChoosingPolicy
from torchrl_sspl.modules.contrast import ContrastEncoder
from torchrl_sspl.modules.moments import (
    BearingEncoder,
    MomentEncoder,
    TurnedBearingEncoder,
)
from torchrl_sspl.modules.networks import FrameEncoder, InverseDynamics, LatentDynamics, Policy, inward_clamp
from torchrl_sspl.modules.observer import LatentObserver, Predict
from torchrl_sspl.modules.salad import SaLaD, as_tensordict_module, make_rollout_policy
from torchrl_sspl.modules.shapes import ShapeBearingEncoder, ShapeEncoder, ShapePlaceEncoder

__all__ = [
    "BearingEncoder",
    "ChoosingPolicy",
    "ContrastEncoder",
    "FrameEncoder",
    "InverseDynamics",
    "LatentDynamics",
    "LatentObserver",
    "MomentEncoder",
    "Policy",
    "Predict",
    "SaLaD",
    "ShapeBearingEncoder",
    "ShapeEncoder",
    "ShapePlaceEncoder",
    "TurnedBearingEncoder",
    "as_tensordict_module",
    "inward_clamp",
    "make_rollout_policy",
]
