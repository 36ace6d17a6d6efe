r"""What runs on the robot: an agent with its memory, and the premise of its proof watched at every step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.modules.observer import corrected


class Memory:
    r"""The observer's state for n episodes side by side: what is expected to be seen next. Source: none.

    Args:
        gain: K ``(p, p)``.

    Example:
        >>> memory = Memory(0.5 * torch.eye(1))
        >>> latent, _ = memory.correct(torch.zeros(2, 1))
        >>> memory.expect(latent + 1.0)
        >>> memory.correct(torch.zeros(2, 1))[0].tolist()
        [[0.5], [0.5]]
    """

    def __init__(self, gain: Tensor) -> None:
        self.gain = gain
        self.prior: Tensor | None = None
        self.begins: Tensor | None = None  # (n,) bool

    def forget(self, rows: Tensor | None = None) -> None:
        """Everything, or what belongs to some of the episodes."""
        if rows is None:
            self.prior = self.begins = None
        elif self.begins is not None:
            self.begins[rows] = True

    def correct(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Latents and innovations ``(n, p)`` for what is seen, ``(n, p)``; nothing is remembered."""
        if self.begins is None or self.prior is None:
            self.prior, self.begins = seen, torch.ones(len(seen), dtype=torch.bool, device=seen.device)
        return corrected(torch.where(self.begins[:, None], seen, self.prior), seen, self.gain)

    def expect(self, predicted: Tensor, rows: Tensor | None = None) -> None:
        """Predictions ``(n, p)`` for the next step, of all or of some of the episodes."""
        assert self.prior is not None
        assert self.begins is not None
        if rows is None:
            self.prior, self.begins = predicted, torch.zeros_like(self.begins)
        else:
            self.prior = self.prior.index_copy(0, rows, predicted[rows])
            self.begins = self.begins.index_fill(0, rows, False)


@dataclass
class Step:
    """What a controller does with n observations, and what it knows about them."""

    action: Tensor  # (n, m), physical units
    barrier: Tensor  # (n,) B of the latent; at most zero means inside
    inside: Tensor  # (n,) bool
    innovation: Tensor  # (n,) distance of what is seen from what was expected, latent units
    error: Tensor  # (n,) of it, what entered the closed loop: distance of the latent from what was expected
    applies: Tensor  # (n,) bool, whether the premise of the proof has held at every step since the reset
    latent: Tensor  # (n, p)


class Controller:
    r"""Runs an agent on n systems side by side, with a memory of its own; made by ``agent.controller(batch_size=n)``.

    .. math::
        \hat z_0 = E(o_0), \qquad \hat z_t = \operatorname{clamp}(p_t + K (E(o_t) - p_t)), \qquad
        p_{t+1} = d(\hat z_t, u_t), \qquad u_t = \pi(\hat z_t)

    The premise of the proof (Theorem F in ``docs/theory.md``) is watched from what is seen anyway: the episode began in the set, no
    correction :math:`|\hat z_t - p_t|` was above the tolerated error :math:`\delta`, and nothing that was seen looks
    like U, :math:`B(E(o_t)) \le 0`. Numbers that are not finite meet no premise. Source: none.

    Args:
        agent: frozen agent; ``agent.tolerated_error`` is :math:`\delta`, zero where nothing is proved.
        batch_size: n.

    Raises:
        ConfigError: if n is not a positive integer.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> out = load("pendulum").controller(batch_size=2).step(torch.zeros(2, 6, 64, 64, dtype=torch.uint8))
        >>> out.action.shape, out.inside.shape
        (torch.Size([2, 1]), torch.Size([2]))
    """

    def __init__(self, agent: Any, batch_size: int = 1) -> None:
        if not isinstance(batch_size, int) or batch_size < 1:
            raise ConfigError(f"expected batch_size >= 1, received {batch_size!r}")
        self.agent, self.batch_size = agent, batch_size
        self._memory = Memory(agent.gain)
        self._applies = torch.ones(batch_size, dtype=torch.bool, device=agent.gain.device)

    def reset(self, rows: Tensor | None = None) -> None:
        """Begin new episodes: all n, or those of some rows (indices or a mask)."""
        index = None if rows is None else torch.arange(self.batch_size, device=self._applies.device)[rows]
        self._memory.forget(index)
        self._applies[slice(None) if index is None else index] = True

    @torch.no_grad()
    def step(self, pixels: Tensor) -> Step:
        """Actions for pixels ``(n, 6, H, W)`` uint8, frames t-1 and t; a ShapeError for another number of them."""
        if len(pixels) != self.batch_size:
            raise ShapeError(f"expected pixels of {self.batch_size} systems, received {len(pixels)}; make a controller for them")
        agent, memory = self.agent, self._memory
        seen = agent.encode(pixels.to(agent.gain.device))
        latent, innovation = memory.correct(seen)
        expected = torch.where(memory.begins[:, None], seen, memory.prior)  # type: ignore[index, arg-type]
        action, barrier = agent.policy(latent), agent.barrier(latent)[:, 0]
        error = (latent - expected).norm(dim=-1)
        # A comparison with a number that is none is false.
        met = (error <= agent.tolerated_error) & (agent.barrier(seen)[:, 0] <= 0.0) & (barrier <= 0.0)
        if not agent.tolerated_error > 0.0:
            met = torch.zeros_like(met)
        self._applies = self._applies & met
        memory.expect(agent.dynamics(latent, action))
        return Step(action, barrier, barrier <= 0.0, innovation.norm(dim=-1), error, self._applies.clone(), latent)


__all__ = ["Controller", "Memory", "Step"]
