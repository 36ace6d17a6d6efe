"""Networks that several methods share: this library's own encoder, trained to tell the state or whatever else it is asked for."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from torchrl_sspl.baselines.data import Recording, pooled
from torchrl_sspl.envs.base import SafetyEnv, wrapped
from torchrl_sspl.envs.cmu_dubins import CMUDubinsEnv
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.envs.pendulum import PixelPendulumEnv
from torchrl_sspl.envs.two_discs import CMUTwoDiscsEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.modules import FrameEncoder, MomentEncoder, ShapeBearingEncoder, ShapeEncoder, ShapePlaceEncoder
from torchrl_sspl.seeds import spawn
from torchrl_sspl.trainers.phases import InnerLoop

_REACH = 0.9  # of the encoder's range (-1, 1) that states use


class Coordinates:
    r"""States as numbers in (-1, 1) that a network can tell, and back.

    .. math:: (\cos\theta, \sin\theta, \dot\theta / 3.5) \quad\text{and}\quad (x / 2, y / 2, \cos\theta, \sin\theta)

    times 0.9, for the pendulum and for the car with their own bounds. Raises ConfigError for another system. Source: none.

    Args:
        env: the system.

    Example:
        >>> at = Coordinates(PixelPendulumEnv())
        >>> at.state(at.features(torch.tensor([[0.5, -1.0]])))
        tensor([[ 0.5000, -1.0000]])
    """

    def __init__(self, env: SafetyEnv) -> None:
        if not isinstance(env, PixelPendulumEnv | DubinsEnv) or env.state_dim > 3:
            raise ConfigError(f"expected a pendulum or a Dubins car without a yaw lag, received {type(env).__name__}")
        self.pendulum = isinstance(env, PixelPendulumEnv)
        self.high = env.state_space.high  # type: ignore[attr-defined]
        self.size = 3 if self.pendulum else 4

    def features(self, state: Tensor) -> Tensor:
        """``(n, s) -> (n, size)``."""
        if self.pendulum:
            parts = [state[:, 0].cos(), state[:, 0].sin(), state[:, 1] / self.high[1]]
        else:
            parts = [state[:, 0] / self.high[0], state[:, 1] / self.high[1], state[:, 2].cos(), state[:, 2].sin()]
        return _REACH * torch.stack(parts, -1)

    def state(self, features: Tensor) -> Tensor:
        """``(n, size) -> (n, s)``."""
        f = features / _REACH
        if self.pendulum:
            return torch.stack([torch.atan2(f[:, 1], f[:, 0]), f[:, 2] * self.high[1]], -1)
        return torch.stack([f[:, 0] * self.high[0], f[:, 1] * self.high[1], torch.atan2(f[:, 3], f[:, 2])], -1)


def encoder_for(env: SafetyEnv, size: int, data: Recording, *, whole: bool = False) -> FrameEncoder:
    """An encoder for the system, on pictures of the recording's size, untrained: moments for cars, else convolutions.

    It is what this library recommends for the system, but for the pendulum, where that is ``ContrastEncoder`` on pictures of 64 x 64. Of CMU's
    car it tells where the disc lies, seen from the car, and not the whole state. Source: none.

    Args:
        env: the system.
        size: of what it gives.
        data: pictures from which an encoder of moments takes its background.
        whole: whether the state has to be told, place and heading.
    """
    side = data.frames.shape[-1]
    encoder: FrameEncoder
    if isinstance(env, CMUDubinsEnv):  # a car of one colour
        encoder = ShapeEncoder(max(size, 4), pool_to=side) if whole else ShapeBearingEncoder(ShapeBearingEncoder.seen_dim, pool_to=side)
    elif isinstance(env, DubinsEnv):
        encoder = MomentEncoder(max(size, 4), pool_to=side)
    elif isinstance(env, CMUTwoDiscsEnv):
        encoder = ShapePlaceEncoder(max(size, 4), pool_to=side)
    else:
        return FrameEncoder(size, pool_to=side)
    rows = torch.arange(len(data))[:: max(1, len(data) // 2000)]
    encoder.fit(data.frames[rows, 1])  # type: ignore[operator]
    return encoder


def train(
    seed: int, steps: int, networks: dict[nn.Module, float], loss: Callable[[Tensor], dict[str, Tensor]], n: int, batch: int = 128
) -> InnerLoop:
    """Trains networks on batches of n rows with this library's optimiser loop: Adam, one cycle of the learning rate.

    Args:
        seed: of the batches.
        steps: of the optimiser.
        networks: with the largest learning rate of each.
        loss: rows ``(batch,)`` -> terms; those named ``loss*`` are added up.
        n: number of rows.
        batch: rows per step.

    Returns the loop, with the last loss. Source: none.

    Example:
        >>> line, x = nn.Linear(1, 1), torch.linspace(-1, 1, 50)[:, None]
        >>> loop = train(0, 300, {line: 0.05}, lambda rows: {"loss": (line(x[rows]) - 2 * x[rows]).square().mean()}, 50)
        >>> loop.loss < 0.01
        True
    """
    loop = InnerLoop(spawn(seed, "training"))
    loop(steps, networks, lambda: loss(loop.pick(n, batch)))
    return loop


class Perception(nn.Module):
    r"""Tells the state from two pictures; learnt from pictures that come with their state.

    .. math:: L = \mathbb{E}\, \lVert E(o) - c(x) \rVert^2, \qquad
        W = \arg\min_W \sum \lVert W^\top (E(o), \phi(f_{t-1}), \phi(f_t), 1) - c(x) \rVert^2

    with the :class:`Coordinates` c and the features :math:`\phi` of single frames. What is told is read out by W, in closed form: on the car it is 20 times
    as exact as E(o) alone. Source: supervised regression.

    Args:
        env: the system.
        data: what it learns from; the true states are used.
        steps: of the optimiser.
        seed: of the batches.
    """

    readout: Tensor

    def __init__(self, env: SafetyEnv, data: Recording, steps: int, seed: int) -> None:
        super().__init__()
        self.at, self.wrap = Coordinates(env), env.wrap
        self.encoder = encoder_for(env, self.at.size, data, whole=True)
        target = self.at.features(data.state)

        def loss(rows: Tensor) -> dict[str, Tensor]:
            told = self.encoder(data.frames[rows, :2].flatten(1, 2))
            return {"loss": (told - target[rows]).square().mean()}

        self.loop = train(seed, steps, {self.encoder: 3e-3}, loss, len(data))
        self.eval()
        found = torch.linalg.lstsq(torch.cat([self._features(part) for part in data.pixels.split(500)]), target.double(), driver="gelsd")
        self.register_buffer("readout", found.solution)

    @torch.no_grad()
    def _features(self, pixels: Tensor) -> Tensor:
        """What the encoder gives, the features of both frames, and one: ``(n, k)`` float64 of pooled observations."""
        seen = self.encoder.frames(pixels.unflatten(1, (2, -1)))
        return torch.cat([self.encoder.head(seen[:, 0], seen[:, 1]), seen.flatten(1), torch.ones(len(seen), 1)], 1).double()

    def forward(self, pixels: Tensor) -> Tensor:
        """States ``(n, s)`` of observations ``(n, 6, H, W)`` uint8."""
        return self.at.state((self._features(pooled(pixels, self.encoder.pool_to[0])) @ self.readout).float())


def perception_error(told: Tensor, state: Tensor, env: SafetyEnv) -> dict[str, float]:
    """Median and 99 % quantile of the error of each state coordinate, its own units. Source: none.

    Example:
        >>> round(perception_error(torch.tensor([[0.1, 0.0]]), torch.zeros(1, 2), PixelPendulumEnv())["x0_q50"], 3)
        0.1
    """
    off = told - state
    turn = getattr(env.state_space, "period", torch.zeros(env.state_dim))
    off = torch.where(turn > 0, wrapped(off), off).abs()
    return {f"x{k}_q{int(100 * q)}": float(off[:, k].quantile(q)) for k in range(off.shape[1]) for q in (0.5, 0.99)}


def fresh_error(perceive: Callable[[Tensor], Tensor], env: SafetyEnv, n: int = 1000) -> dict[str, float]:
    """The same of what a method perceives on n fresh pictures of states drawn uniformly, pixels ``(n, 6, H, W)`` -> states. Source: none.

    Example:
        >>> fresh_error(lambda pixels: torch.zeros(len(pixels), 2), PixelPendulumEnv(), n=50)["x0_q50"] > 0.5
        True
    """
    state = env.sample_states(n, torch.Generator().manual_seed(0))
    told = [perceive(env.observe(part)) for part in state.split(250)]
    return perception_error(torch.cat(told), state, env)


__all__ = ["Coordinates", "Perception", "encoder_for", "fresh_error", "perception_error", "train"]
