r"""Neural CBF: barrier and controller learnt together on states, behind a network that tells the state from pictures.

Faithful to Harms, Kulkarni, Khedekar, Jacquet, Alexis, *Neural control barrier functions for safe navigation*, IROS 2024 (arXiv
2407.19907), as far as its abstract goes (the rest was not at hand): barrier and safe controller learnt jointly in simulation with known control-affine
dynamics, the barrier in the form of a state-dependent quadratic. Stand-ins: the simulator's own step in place of
a control-affine model, a camera in place of a range image, a supervised
state in place of their latent; hinges and weights are those of neural_clbf as remembered. On the car, where no equilibrium
exists, h is a plain network of the coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from torchrl_sspl.baselines.base import Budget, Needs, OneStepFilter
from torchrl_sspl.baselines.data import Recording
from torchrl_sspl.baselines.perception import Coordinates, Perception, fresh_error, train
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.modules.networks import mlp
from torchrl_sspl.sets import SAFE, UNSAFE


class QuadraticBarrier(nn.Module):
    r"""State-dependent quadratic :math:`h(x) = c - e^\top P(x) e` with :math:`P = L(x) L(x)^\top + \varepsilon I`, e the state over its bound.

    Source: Harms et al. 2024, abstract (inspired by the state-dependent Riccati equation).

    Example:
        >>> QuadraticBarrier(torch.ones(2))(torch.zeros(3, 2)).shape
        torch.Size([3])
    """

    def __init__(self, scale: Tensor) -> None:
        super().__init__()
        self.size, self.scale = len(scale), scale
        self.factor, self.level = mlp((self.size, 64, 64, self.size**2), nn.SiLU), nn.Parameter(torch.tensor(0.5))

    def forward(self, state: Tensor) -> Tensor:
        """``(n, s) -> (n,)``."""
        e = state / self.scale
        lower = self.factor(e).reshape(-1, self.size, self.size)
        return self.level - (lower.mT @ e[..., None])[..., 0].square().sum(-1) - 0.01 * e.square().sum(-1)


class PlainBarrier(nn.Module):
    """h as a network of the bounded coordinates of the state. Source: neural_clbf."""

    def __init__(self, at: Coordinates) -> None:
        super().__init__()
        self.at, self.net = at, mlp((at.size, 64, 64, 1), nn.SiLU)

    def forward(self, state: Tensor) -> Tensor:
        """``(n, s) -> (n,)``."""
        return self.net(self.at.features(state))[:, 0]


@dataclass
class NeuralCBFConfig:
    """Options of the neural barrier."""

    perception_steps: int = 2000  # of the encoder
    steps: int = 3000  # of barrier and controller
    rate: float = 1.0  # alpha of the condition, 1/s
    margin: float = 0.1  # gamma_1 of the hinges on S and U
    hinge: float = 100.0  # weight of the hinges beside the condition's 10: a door in U costs the mean over U little
    slack: float = 0.01  # gamma_2 of the condition, per step
    alpha: float = 0.95  # share of h that a step of the filter has to leave
    offset: float = 0.0  # added to -h, in claim and filter
    batch: int = 512


class NeuralCBF(OneStepFilter):
    r"""Neural CBF (Harms et al. 2024): barrier and controller on states, learnt with the exact model.

    .. math:: L = 100\,(\mathbb{E}_S [g_1 - h]_+ + \mathbb{E}_U [g_1 + h]_+) + 10\,\mathbb{E}_{h > 0} [g_2 - h(f(x, \pi)) + (1 - \alpha dt) h(x)]_+
        + 10^{-2} \mathbb{E} \lVert \pi / u_{max} \rVert^2

    Source: see the module.
    """

    name = "neural_cbf"
    Config: ClassVar[type | None] = NeuralCBFConfig
    space: ClassVar[dict[str, tuple[Any, ...]]] = {
        "perception_steps": (2000, 6000), "steps": (3000, 6000), "rate": (0.3, 1.0, 3.0), "alpha": (0.5, 0.8, 0.95), "offset": (0.0, 0.05, 0.1),
    }  # fmt: skip

    def fit(self, data: Recording, env: SafetyEnv, budget: Budget, seed: int) -> None:
        """State from pictures, then barrier and controller on states; see :meth:`SafetyMethod.fit`."""
        c = self.config
        self.env, self.alpha, self.offset = env, c.alpha, c.offset
        self.eyes = self.stage(("perception_steps",), lambda: Perception(env, data, c.perception_steps, seed))
        self.notes |= fresh_error(self.eyes, env)
        at = Coordinates(env)
        self.net: nn.Module = QuadraticBarrier(at.high.clone()) if at.pendulum else PlainBarrier(at)
        control = nn.Sequential(mlp((at.size, 48, 48, env.action_dim), nn.SiLU), nn.Tanh())
        groups = [(data.region == code).nonzero()[:, 0] for code in (SAFE, UNSAFE)]
        outside = (data.region != UNSAFE).nonzero()[:, 0]
        step = c.rate * env.dt  # type: ignore[attr-defined]

        def loss(rows: Tensor) -> dict[str, Tensor]:
            terms: dict[str, Tensor] = {}
            for name, group, sign in (("safe", groups[0], 1.0), ("unsafe", groups[1], -1.0)):
                h = sign * self.net(data.state[group[rows % len(group)]]) if len(group) else torch.zeros(1)
                terms[f"loss_{name}"] = c.hinge * (c.margin - h).clamp_min(0).mean()
            x = data.state[outside[rows % len(outside)]]
            share = control(at.features(x))
            after = env.wrap(env.dynamics(x, env.max_action * share))
            here = self.net(x)
            gone = ~env.state_space.contains(after) & (env.exit_region == SAFE)
            missing = (c.slack - self.net(after) + (1 - step) * here).clamp_min(0)
            asked = (here > 0) & ~gone
            terms["loss_kept"] = 10.0 * (missing * asked).sum() / asked.sum().clamp_min(1)
            terms["loss_effort"] = 0.01 * share.square().mean()
            return terms

        loop = train(seed + 1, c.steps, {self.net: 3e-3, control: 3e-3}, loss, len(data), c.batch)
        self.notes["loss"] = float(loop.loss or 0.0)
        self.needs = Needs(
            **data.labels(), states=len(data), dynamics="exact", claimed="invariance of {h >= 0}: the condition holds on samples"
        )

    def perceive(self, seen: Tensor) -> Tensor:
        """The state that the pictures tell."""
        return self.eyes(seen)

    @torch.no_grad()
    def h(self, state: Tensor) -> Tensor:
        """Minus the learned barrier."""
        return -self.net(state)

    def predict(self, state: Tensor, action: Tensor) -> Tensor:
        """One step of the known dynamics."""
        return self.env.wrap(self.env.dynamics(state, action))


__all__ = ["NeuralCBF", "PlainBarrier", "QuadraticBarrier"]
