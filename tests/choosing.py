"""A road with an obstacle that has to be passed on either side: whatever is continuous runs into it."""

from __future__ import annotations

from typing import Any

import torch
from plain import linear
from torch import Tensor, nn

from torchrl_sspl.lipschitz import lipschitz_upper
from torchrl_sspl.modules import ChoosingPolicy, LatentDynamics, Policy

LEFT_OR_RIGHT = [[-2.0], [2.0]]


def with_net(module: nn.Module, *layers: nn.Module) -> nn.Module:
    module.net = nn.Sequential(*layers)
    return module.eval()


def road_barrier() -> nn.Sequential:
    """B(x, y) = min(0.3 - |y|, x - 0.5) = (x - 0.5) - relu(|y| - 0.3 + x - 0.5)."""
    first = linear([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0]], [0.0, 0.0, 2.0])
    second = linear([[1.0, 1.0, 1.0], [0.0, 0.0, 1.0]], [-2.8, 0.0])
    return nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), linear([[-1.0, 1.0]], [-2.5]))


def road_dynamics() -> LatentDynamics:
    """x+ = x + 0.2, y+ = y + 0.3 u, clamped; |u| <= 2."""
    pushes = linear([[0.0, 0.0, 0.6], [0.0, 0.0, -0.6]])
    return with_net(LatentDynamics(2, 1, (1,), 2.0), pushes, nn.ReLU(), linear([[0.0, 0.0], [1.0, -1.0]], [0.2, 0.0]))


def steering(gain: float = 5.0, offset: float = 0.0) -> Policy:
    """u = 2 clamp(gain y + offset)."""
    return with_net(Policy(2, 1, (1,), 2.0), linear([[0.0, gain]], [offset]))


def road(actions: Any = LEFT_OR_RIGHT, margin: float = 0.1, policy: nn.Module | None = None) -> dict[str, Any]:
    """Arguments of ``closed_loop``: where its own action is not accepted, the table leads to B <= -0.3."""
    barrier, dynamics = road_barrier(), road_dynamics()
    chooses = ChoosingPolicy(policy or steering(), actions, margin).bind(dynamics, barrier)
    bound = float(lipschitz_upper(barrier)) * 1.001
    return {"barrier": barrier, "dynamics": dynamics, "policy": chooses, "latent_dim": 2, "lipschitz_bound": bound}


def chosen_by_hand(policy: ChoosingPolicy, latent: Tensor) -> Tensor:
    """The definition, one latent and one action at a time; latents ``(n, p)``."""
    dynamics, barrier = policy.loop
    rows = []
    for z in latent:
        own = policy.policy(z)
        best, least = own, float(barrier(dynamics(z, own)))
        if least > -float(policy.margin):
            least = float("inf")
            for action in policy.actions:
                value = float(barrier(dynamics(z, action)))
                if value < least:
                    best, least = action, value
        rows.append(best)
    return torch.stack(rows)
