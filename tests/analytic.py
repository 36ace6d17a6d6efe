"""A system on a line with an agent whose closed loop is known by hand, and both broken on purpose."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.modules import LatentDynamics, Policy
from torchrl_sspl.modules.agent import ENCODERS, Agent, mlp_barrier
from torchrl_sspl.sets import UNSAFE, Box

SIDE = 32


class Line(SafetyEnv):
    """x+ = 1.8 x + 0.3 u with |u| <= 2; S is [-0.3, 0.3], U what lies beyond 0.8, and a picture spells x in 16 bits.

    Args:
        law: states -> states, after a step, to break the system.
        shown: states -> states that the picture spells, to break the camera.
    """

    def __init__(
        self,
        law: Callable[[Tensor], Tensor] | None = None,
        shown: Callable[[Tensor], Tensor] | None = None,
        batch_size: Any = (1,),
        seed: int | None = None,
        initial: float = 1.0,
        gain: float = 1.8,
        horizon: int | None = None,
    ) -> None:
        self.law, self.shown, self.gain = law, shown, gain
        space = Box([-1.0], [1.0])
        super().__init__(
            state_dim=1, action_dim=1, max_action=2.0, safe_set=Box([-0.3], [0.3]), unsafe_set=space - Box([-0.8], [0.8]),
            state_space=space, initial_set=Box([-initial], [initial]), batch_size=batch_size, image_size=SIDE, seed=seed,
            horizon=horizon,
        )  # fmt: skip

    def dynamics(self, state: Tensor, action: Tensor) -> Tensor:
        moved = (self.gain * state + 0.3 * self.clamp_action(action)).clamp(-1.0, 1.0)
        return moved if self.law is None else self.law(moved)

    def wrap(self, state: Tensor) -> Tensor:
        return state

    def previous_state(self, state: Tensor) -> Tensor:
        return state

    def draw(self, state: Tensor) -> Tensor:
        seen = state if self.shown is None else self.shown(state)
        code = ((seen[:, 0].double() + 1) / 2 * 65535).round().long().clamp(0, 65535)
        frames = torch.zeros(len(state), 3, SIDE, SIDE, dtype=torch.uint8)
        frames[:, 0], frames[:, 1] = (code // 256)[:, None, None].byte(), (code % 256)[:, None, None].byte()
        return frames


class Reader(nn.Module):
    """Latent (x, 0), read from the second frame."""

    def __init__(self, latent_dim: int = 2, image_size: int = SIDE) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(1))

    def forward(self, pixels: Tensor) -> Tensor:
        corner = pixels[..., 3:, 0, 0].double()
        x = ((corner[..., :1] * 256 + corner[..., 1:2]) / 65535 * 2 - 1).float() * self.scale
        return torch.cat([x, torch.zeros_like(x)], -1)


ENCODERS["Reader"] = Reader
SIZES = {"latent_dim": 2, "action_dim": 1, "action_scale": 2.0, "hidden": [4]}


def line_agent(**description: Any) -> Agent:
    """z1+ = 1.8 z1 + 0.6 clamp(-2 z1), z2+ = z2 / 2, B = |z|_1 - 1/2: inside |z1| <= 1/2 it is z1+ = 0.6 z1."""
    eye = torch.eye(2)
    signs = torch.cat([eye, -eye])
    dynamics, policy, barrier = LatentDynamics(**SIZES), Policy(**SIZES), mlp_barrier(2, [4])
    values = {
        barrier: (signs, torch.zeros(4), torch.ones(1, 4), torch.tensor([-0.5])),
        dynamics.net: (
            torch.cat([signs, torch.tensor([[0.75], [0.0], [-0.75], [0.0]])], 1), torch.zeros(4),
            torch.tensor([[0.8, 0.0, -0.8, 0.0], [0.0, -0.5, 0.0, 0.5]]), torch.zeros(2),
        ),
        policy.net: (signs, torch.zeros(4), torch.tensor([[-2.0, 0.0, 2.0, 0.0]]), torch.zeros(1)),
    }  # fmt: skip
    for net, (w0, b0, w1, b1) in values.items():
        net.load_state_dict({"0.weight": w0, "0.bias": b0, "2.weight": w1, "2.bias": b1})
    networks = {
        "encoder": {"class": "Reader", "arguments": {"latent_dim": 2, "image_size": SIDE}},
        "dynamics": {"class": "LatentDynamics", "arguments": SIZES},
        "policy": {"class": "Policy", "arguments": SIZES},
        "barrier": {"latent_dim": 2, "hidden": [4]},
    }
    body = {"networks": networks, "config": {"seed": 3}, "seeds": [3, 20260101]} | copy.deepcopy(description)
    return Agent(Reader(), dynamics, barrier, policy, 1.5, body)


def is_unsafe(state: Tensor) -> Tensor:
    """Whether states ``(n, 1)`` lie in U."""
    return Line().region(state)[:, 0] == UNSAFE
