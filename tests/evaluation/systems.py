"""Small systems and controllers, and an independent simulator, for the tests of evaluations."""

from __future__ import annotations

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from torch import nn

from torchrl_sspl.envs import DubinsEnv
from torchrl_sspl.envs.gymnasium import GymnasiumPixels
from torchrl_sspl.modules import LatentDynamics, MomentEncoder, Policy
from torchrl_sspl.modules.agent import Agent, mlp_barrier


class Lane(gymnasium.Env):
    """A point at 0..15 moves by the action; beyond 12 the episode ends."""

    render_mode = "rgb_array"
    observation_space = spaces.Box(0, 20, (1,), np.float64)
    action_space = spaces.Box(-3.0, 3.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = float(self.np_random.integers(1, (options or {}).get("below", 9)))
        return np.array([self.x]), {}

    def step(self, action):
        self.x = float(np.clip(self.x + float(action[0]), 0, 15))
        return np.array([self.x]), 0.0, self.x > 12, False, {}

    def render(self):
        picture = np.zeros((16, 16, 3), np.uint8)
        picture[:, round(self.x)] = 255
        return picture


def lane(batch_size=(4,), seed=0, make=Lane, **options) -> GymnasiumPixels:
    sets = {"safe": lambda state, info: state[0] < 3, "unsafe": lambda state, info: state[0] > 10}
    return GymnasiumPixels(make, batch_size=batch_size, seed=seed, image_size=16, **(sets | options))


class Where(nn.Module):
    """Latent (x, 0) / 16, read from the second frame."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(1))

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        x = pixels[..., 3, 0, :].float().argmax(-1, keepdim=True) / 16
        return torch.cat([self.scale * x, torch.zeros_like(x)], -1)


class Move(nn.Module):
    def forward(self, latent: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return latent + torch.cat([action, torch.zeros_like(action)], -1) / 16


class Push(nn.Module):
    def __init__(self, by: float) -> None:
        super().__init__()
        self.by = by

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        return torch.full_like(latent[..., :1], self.by)


def lane_agent(by: float, border: float = 9.4) -> Agent:
    """B = (x - border) / 16, and a policy that always moves by the same."""
    barrier = mlp_barrier(2, [])
    with torch.no_grad():
        barrier[0].weight.copy_(torch.tensor([[1.0, 0.0]]))
        barrier[0].bias.fill_(-border / 16)
    return Agent(Where(), Move(), barrier, Push(by), 2.0)


class World:
    """Stands in for the simulator: the Dubins car, with faults that a test asks for."""

    def __init__(self, **faults: int) -> None:
        self.model, self.faults, self.closed, self.seeds = DubinsEnv(batch_size=[1], image_size=64), faults, 0, []

    def _info(self):
        now = {name: self.steps >= step for name, step in self.faults.items()}
        left = not bool(self.model.state_space.contains(self.state[0]))
        info = {"pose": self.state[0].numpy(), "unsafe": bool(self.model.unsafe_set.contains(self.state[0])),
                "safe": bool(self.model.safe_set.contains(self.state[0])), "contact": False, "fallen": False, "left": left}  # fmt: skip
        return {**info, **now}

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        self.steps, self.state = 0, torch.tensor([options["pose"]])
        self.pixels = self.model.observe(self.state)[0].numpy()
        return self.pixels, self._info()

    def step(self, action):
        assert action.shape == (1,)
        before, self.steps = self.state, self.steps + 1
        self.state = self.model.wrap(self.model.dynamics(before, torch.as_tensor(action)[None]))
        info = self._info()
        return self.model.observe(self.state, before)[0].numpy(), 0.0, info["fallen"] or info["left"], False, info

    def close(self):
        self.closed += 1


def straight_ahead(barrier: float = -1.0) -> Agent:
    """An agent that never turns and calls everything safe (or nothing)."""
    policy, constant = Policy(4, 1, (4,), 2.0), nn.Sequential(nn.Linear(4, 1))
    for layer in (policy.net[-1], constant[0]):
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)
    nn.init.constant_(constant[0].bias, barrier)
    return Agent(MomentEncoder(4, 64), LatentDynamics(4, 1, (4,), 2.0), constant, policy, 1.5)


class Counter:
    """A controller with memory: its action is the number of observations since the reset; it keeps what it was told."""

    reads = "pixels"

    def __init__(self, n: int) -> None:
        self.n, self.resets = n, []

    def reset(self, rows=None):
        self.resets.append(None if rows is None else rows.tolist())
        if rows is None:
            self.seen = torch.zeros(self.n)
        else:
            self.seen[rows] = 0

    def step(self, observation, rows=None):
        from torchrl_sspl.evaluation.controllers import Decision

        chosen = torch.arange(self.n) if rows is None else rows
        assert len(observation) == len(chosen)
        self.seen[chosen] += 1
        return Decision(self.seen[chosen][:, None].clone())


class Predictor:
    """As policies of stable-baselines3: arrays in, arrays out, a state of its own behind them."""

    def __init__(self, by: float) -> None:
        self.by = by

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert isinstance(observation, np.ndarray)
        assert deterministic
        return np.full((len(observation), 1), self.by, np.float32), None
