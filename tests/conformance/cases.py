"""The losses under test, small: how each is built, its data, and which networks each term may move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn
from torchrl.objectives import LossModule

from torchrl_sspl.lipschitz import LMIBarrier, SandwichBarrier
from torchrl_sspl.modules import FrameEncoder, LatentDynamics, Policy
from torchrl_sspl.objectives import (
    ActionChangeLoss,
    ActionValueLoss,
    ConsistencyLoss,
    CounterexampleLoss,
    LipschitzLoss,
    PolicyDeviationLoss,
    SaLaDLoss,
    SSPLLoss,
    SynthesisLoss,
    TargetLoss,
)

ROWS = 12


def _mlp(inputs: int, outputs: int, *last: nn.Module) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 8), nn.Tanh(), nn.Linear(8, outputs), *last)


def networks(source: str) -> tuple[nn.Module | None, nn.Module, nn.Module, nn.Module]:
    """Encoder, dynamics, barrier and policy; ``source`` is what the batch holds."""
    torch.manual_seed(0)
    dynamics, policy = LatentDynamics(2, 1, (8,), action_scale=2.0), Policy(2, 1, (8,), action_scale=2.0)
    if source == "frames":
        return (
            FrameEncoder(2, pool_to=8, channels=(4,), features=4, hidden=8),
            dynamics,
            SandwichBarrier(2, (8,)),
            policy,
        )
    return (None if source == "latent" else _mlp(4, 2, nn.Tanh())), dynamics, _mlp(2, 1), policy


def batch(source: str, rows: int = ROWS) -> TensorDict:
    """A batch with all regions in it."""
    generator = torch.Generator().manual_seed(1)
    data = TensorDict(
        action=torch.randn(rows, 1, generator=generator),
        user_action=torch.randn(rows, 1, generator=generator),
        region=(torch.arange(rows) % 3)[:, None],
        next=TensorDict(batch_size=rows),
        batch_size=rows,
    )
    if source == "frames":
        data["frames"] = torch.randint(0, 256, (rows, 3, 3, 8, 8), dtype=torch.uint8, generator=generator)
        return data
    key, size = ("latent", 2) if source == "latent" else ("pixels", 4)
    data[key] = torch.randn(rows, size, generator=generator).tanh()
    data["next", key] = torch.randn(rows, size, generator=generator).tanh()
    if source == "latent":
        data["residual"] = 0.1 * torch.randn(rows, size, generator=generator)
        data["barrier_target"] = torch.randn(rows, 1, generator=generator)
        data["inside"] = data["barrier_target"] < 0
        data["action_target"] = torch.randn(rows, 1, generator=generator)
        data["action_weight"] = torch.rand(rows, 1, generator=generator)
        data["action_value"] = torch.randn(rows, 5, generator=generator)
    return data


@dataclass
class Case:
    """A loss under test.

    Attributes:
        name: identifier.
        loss: class of the loss.
        source: entry that the batch holds: ``"pixels"``, ``"frames"`` or ``"latent"``.
        reaches: networks that each term may move, and has to.
        takes: networks that the loss takes, in order.
        options: keyword arguments of the loss.
        pointwise: no term depends on which other rows are in the batch.
        rows: the terms belong to rows of the batch.
        unreached: ends of the names of parameters that the loss does not depend on.
    """

    name: str
    loss: type[LossModule]
    source: str
    reaches: dict[str, set[str]]
    takes: str
    options: dict[str, Any] = field(default_factory=dict)
    pointwise: bool = True
    rows: bool = True
    unreached: tuple[str, ...] = ()

    def nets(self) -> tuple[nn.Module | None, ...]:
        names = ("encoder", "dynamics", "barrier", "policy")
        found = dict(zip(names, networks(self.source), strict=True)) | {"lmi_barrier": LMIBarrier(2, (6,))}
        return tuple(found[name] for name in self.takes.split())

    def build(self, kind: Callable[..., LossModule] | None = None, **options: Any) -> LossModule:
        loss = (kind or self.loss)(*self.nets(), **{**self.options, **options})
        # The target updater is told apart in a check of its own.
        loss._has_update_associated = dict.fromkeys(loss._has_update_associated, True)
        return loss

    def data(self, rows: int = ROWS) -> TensorDict:
        return batch(self.source, rows)


SALAD = {
    "loss_safe": {"encoder", "barrier"},
    "loss_unsafe": {"encoder", "barrier"},
    "loss_consistency": {"encoder", "dynamics"},
}
EXTRAS = {
    "inverse_dynamics_coeff": 1.0,
    "variance_coeff": 1.0,
    "covariance_coeff": 1.0,
    "saturation_coeff": 1.0,
    "saturation_limit": 0.05,
    "worst_coeff": 0.5,
}
SALAD_EXTRA = SALAD | {
    "loss_inverse_dynamics": {"encoder", "inverse_dynamics"},
    "loss_variance": {"encoder"},
    "loss_covariance": {"encoder"},
    "loss_saturation": {"encoder"},
}
# Margins at which every hinge is active on the untrained networks.
WIDE = {"safety_margin": 3.0, "dynamics_margin": 3.0}
GROWTH = {
    "growth_coeff": 1.0,
    "growth_depth": 3.0,
    "off_manifold_coeff": 1.0,
    "descent_coeff": 1.0,
    "band": 5.0,
}
SYNTHESIS = {
    "loss_synthesis": {"barrier", "actor_network"},
    "loss_off_manifold": {"barrier", "actor_network"},
    "loss_descent": {"actor_network"},
}
ALL = {"encoder", "dynamics", "barrier", "actor_network"}

ALL_FOUR = "encoder dynamics barrier policy"

CASES = [
    Case("salad", SaLaDLoss, "pixels", SALAD, "encoder dynamics barrier", WIDE),
    Case(
        "salad-online",
        SaLaDLoss,
        "pixels",
        SALAD_EXTRA,
        "encoder dynamics barrier",
        WIDE | EXTRAS | {"consistency": "online"},
        False,
    ),
    Case("synthesis", SynthesisLoss, "pixels", SYNTHESIS, ALL_FOUR, WIDE | GROWTH | {"growth_coeff": 0.0}),
    Case(
        "synthesis-latent",
        SynthesisLoss,
        "latent",
        SYNTHESIS | {"loss_growth": {"barrier"}},
        ALL_FOUR,
        GROWTH | {"mode": "R1", "decay": 0.3, "dynamics_margin": 0.0},
    ),
    Case(
        "synthesis-paper",
        SynthesisLoss,
        "pixels",
        {"loss_synthesis": ALL},
        ALL_FOUR,
        WIDE | {"mode": "paper", "successor": "target", "detach": ()},
    ),
    Case(
        "deviation",
        PolicyDeviationLoss,
        "pixels",
        {"loss_policy_deviation": {"encoder", "actor_network"}},
        "encoder policy",
        {"user_policy": "data", "detach": ()},
    ),
    Case(
        "lipschitz",
        LipschitzLoss,
        "latent",
        {"loss_lipschitz": {"barrier"}},
        "lmi_barrier",
        rows=False,
        unreached=("bias",),
    ),
    Case(
        "sspl-paper",
        SSPLLoss,
        "frames",
        SALAD | {"loss_synthesis": ALL, "loss_policy_deviation": {"encoder", "actor_network"}},
        ALL_FOUR,
        WIDE | {"preset": "paper", "reduction": "mean"},
    ),
    Case(
        "sspl-sound",
        SSPLLoss,
        "frames",
        SALAD_EXTRA | SYNTHESIS,
        ALL_FOUR,
        WIDE | GROWTH | EXTRAS | {"preset": "sound", "growth_coeff": 0.0},
        False,
    ),
    Case(
        "target",
        TargetLoss,
        "latent",
        {
            "loss_target": {"barrier"},
            "loss_policy_target": {"actor_network"},
            "loss_safe": {"barrier"},
            "loss_unsafe": {"barrier"},
        },
        "barrier policy",
        {"safety_margin": 3.0, "safe_coeff": 1.0, "unsafe_coeff": 1.0, "action_scale": 2.0},
    ),
    Case(
        "action-value",
        ActionValueLoss,
        "latent",
        {"loss_action_value": {"actor_network"}},
        "policy",
        {"action_scale": 2.0},
    ),
    Case(
        "consistency",
        ConsistencyLoss,
        "latent",
        {"loss_consistency": {"dynamics"}},
        "dynamics",
        {"unsafe_weight": 0.3, "worst_fraction": 0.25},
    ),
    Case(
        "counterexample",
        CounterexampleLoss,
        "latent",
        {"loss_counterexample": {"barrier", "actor_network"}},
        "dynamics barrier policy",
        {"depth": 2.0, "worst_fraction": 0.25, "dynamics_margin": 1.0},
    ),
    Case(
        "counterexample-least",
        CounterexampleLoss,
        "latent",
        {"loss_counterexample": {"barrier", "actor_network"}},
        "dynamics barrier policy",
        {"mode": "least", "depth": 2.0, "worst_fraction": 0.25, "dynamics_margin": 1.0},
    ),
    Case(
        "action-change",
        ActionChangeLoss,
        "latent",
        {"loss_action_change": {"actor_network"}},
        "dynamics policy",
        {"action_scale": 0.5},
    ),
]
