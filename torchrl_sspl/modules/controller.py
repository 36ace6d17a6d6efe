r"""What runs on the robot: an agent with its memory, and the premise of its proof watched at every step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.devices import compiled
from torchrl_sspl.direction import direction_of, within
from torchrl_sspl.errors import ConfigError, DTypeError, NonFiniteError, ShapeError
from torchrl_sspl.modules.observer import completed, corrected, held


class Memory:
    r"""The observer's state for n episodes side by side: what is expected to be seen next. Source: none.

    Args:
        agent: gives K, and the set in which its corrections are held where the agent is proved to tolerate an error.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> memory = Memory(load("pendulum"))
        >>> latent, innovation, cut, seen = memory.correct(torch.zeros(2, 3))
        >>> memory.expect(latent + 0.1)
        >>> bool((memory.correct(torch.zeros(2, 3))[0] > 0).all())
        True
    """

    def __init__(self, agent: Any) -> None:
        self.agent = agent
        self.held_error = agent.held_error  # read once: it looks at K
        self.prior: Tensor | None = None
        self.begins: Tensor | None = None  # (n,) bool

    def forget(self, rows: Tensor | None = None) -> None:
        """Everything, or what belongs to some of the episodes."""
        if rows is None:
            self.prior = self.begins = None
        elif self.begins is not None and self.prior is not None:
            self.begins[rows] = True
            self.prior = self.prior.index_fill(0, rows, 0.0)  # where no picture comes, the episode before would act on

    def correct(self, seen: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Latents and innovations ``(n, p)`` for what is seen ``(n, p)``, where a correction was cut ``(n,)``, and what is seen
        with what no picture shows; nothing is remembered."""
        prior, begins = self.expected(len(seen))
        return correction(self.agent, self.held_error, seen, torch.where(begins[:, None], seen, prior))

    def expected(self, n: int) -> tuple[Tensor, Tensor]:
        """What is expected ``(n, p)``, zeros where nothing is, and which episodes begin ``(n,)``."""
        if self.begins is None or self.prior is None:
            self.prior = torch.zeros(n, self.agent.latent_dim, dtype=self.agent.gain.dtype, device=self.agent.gain.device)
            self.begins = torch.ones(n, dtype=torch.bool, device=self.agent.gain.device)
        return self.prior, self.begins

    def unseen(self, n: int) -> Tensor:
        """Latents ``(n, p)`` where nothing is seen: what was expected. Nothing is remembered."""
        return within(self.expected(n)[0], direction_of(self.agent.dynamics))  # predictions of predictions drift off a circle, bit by bit

    def expect(self, predicted: Tensor, rows: Tensor | None = None) -> None:
        """Predictions ``(n, p)`` for the next step, of all or of some of the episodes; one that is not finite is forgotten."""
        assert self.prior is not None
        assert self.begins is not None
        lost = ~predicted.isfinite().all(1)  # from there no correction leads back
        predicted = predicted.masked_fill(lost[:, None], 0.0)
        if rows is None:
            self.prior, self.begins = predicted, lost
        else:
            self.prior = self.prior.index_copy(0, rows, predicted[rows])
            self.begins = self.begins.index_copy(0, rows, lost[rows])


def correction(agent: Any, held_error: float, seen: Tensor, expected: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Latents and innovations ``(n, p)`` of an agent's observer for what is seen and what was expected ``(n, p)``, where the correction
    was cut ``(n,)``, and what is seen with what no picture shows. Source: none."""
    turns = direction_of(agent.dynamics)
    seen = completed(seen, expected, agent.gain)
    latent, innovation = corrected(expected, seen, agent.gain, turns)
    latent, cut = held(agent.barrier, expected, latent, held_error, turns)
    return latent, innovation, cut, seen


def meets_premise(agent: Any, barrier: Tensor, seen: Tensor, error: Tensor) -> Tensor:
    """Whether an agent's steps meet the premise of its proof, at level zero; see :func:`premise_met`. Source: none.

    Args:
        agent: gives the tolerated error, and whether corrections are held in the set.
        barrier, seen, error: as there.
    """
    return premise_met(barrier, seen, error, agent.tolerated_error, held=agent.held_error > 0.0)


def premise_met(barrier: Tensor, seen: Tensor, error: Tensor, tolerated: float, *, held: bool, level: float = 0.0) -> Tensor:
    """Whether steps meet the premise of the proof (Theorem F in ``docs/theory.md``), bool of the shape of what is given.

    Without held corrections the memory is proved to stay in the set, so that its barrier need not be asked.

    Args:
        barrier, seen: barrier values of the memory, and of what was seen by itself.
        error: length of the corrections, latent units.
        tolerated: error below which the set is proved to be kept, latent units; 0: nothing is proved.
        held: whether corrections are held in the set.
        level: of the set.

    Source: none.

    Example:
        >>> premise_met(torch.tensor([-0.1, 0.1]), torch.tensor([-0.1, -0.1]), torch.ones(2), 0.01, held=True)
        tensor([ True, False])
    """
    # A comparison with a number that is none is false.
    met = (seen <= level) & torch.tensor(tolerated > 0.0, device=seen.device)
    return met & ((barrier <= level) if held else (error <= tolerated))


@dataclass
class Step:
    """What a controller does with n observations, and what it knows about them."""

    action: Tensor  # (n, m), physical units
    barrier: Tensor  # (n,) B of the latent; at most zero means inside
    inside: Tensor  # (n,) bool
    innovation: Tensor  # (n,) distance of what is seen from what was expected, latent units
    error: Tensor  # (n,) of it, what entered the closed loop: distance of the latent from what was expected
    applies: Tensor  # (n,) bool, whether the premise of the proof has held at every step since the reset, under actions that keep it
    latent: Tensor  # (n, p)
    seen: Tensor  # (n, p) of the observation by itself


class Controller:
    r"""Runs an agent on n systems side by side, with a memory of its own; made by ``agent.controller(batch_size=n)``.

    .. math::
        \hat z_0 = E(o_0), \qquad \hat z_t = \operatorname{clamp}(p_t + K (E(o_t) - p_t)), \qquad
        p_{t+1} = d(\hat z_t, u_t), \qquad u_t = \pi(\hat z_t)

    A correction that would leave the set is cut to the error :math:`\delta` that the set is proved to tolerate
    (:func:`~torchrl_sspl.modules.observer.held`): :math:`B(\hat z_t) \le 0` is kept whatever is seen. What is seen has to agree:
    the premise of the proof (Theorem F in ``docs/theory.md``), watched at every step, is that the episode began in the set
    and that every observation by itself lies in it, :math:`B(E(o_t)) \le 0`. Where K = I nothing is cut, and no correction may
    be above :math:`\delta`. Numbers that are not finite meet no premise, and from actions on that are neither the agent's own nor
    checked by a filter (:meth:`took`) nothing is proved. What is proved is read when a controller is made.
    Source: none.

    Args:
        agent: frozen agent; ``agent.tolerated_error`` is :math:`\delta`, zero where nothing is proved.
        batch_size: n.
        compile: compute a step as one graph (``torch.compile``): 1.4 to 2 times as fast, once the first one has taken its half
            minute. Needs a C++ compiler. Numbers are rounded in another order.

    Raises:
        ConfigError: if n is not a positive integer.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> out = load("pendulum").controller(batch_size=2).step(torch.zeros(2, 6, 64, 64, dtype=torch.uint8))
        >>> out.action.shape, out.inside.shape
        (torch.Size([2, 1]), torch.Size([2]))
    """

    def __init__(self, agent: Any, batch_size: int = 1, *, compile: bool = False) -> None:
        if not isinstance(batch_size, int) or batch_size < 1:
            raise ConfigError(f"expected batch_size >= 1, received {batch_size!r}")
        self.agent, self.batch_size = agent, batch_size
        self._memory = Memory(agent)
        self._proved = agent.tolerated_error  # as numbers, which a graph does not compute anew
        self._look = compiled(self.looked) if compile else self.looked
        self._applies = torch.ones(batch_size, dtype=torch.bool, device=agent.gain.device)
        self._last: tuple[Tensor, Tensor] | None = None  # latent, and the action that was told

    @property
    def begins(self) -> Tensor:
        """``(n,)`` bool, of which systems nothing was seen yet."""
        begins = self._memory.begins
        return torch.ones_like(self._applies) if begins is None else begins.clone()

    def reset(self, rows: Tensor | None = None) -> None:
        """Begin new episodes: all n, or those of some rows (indices or a mask)."""
        try:
            index = None if rows is None else torch.arange(self.batch_size, device=self._applies.device)[rows]
        except IndexError as error:
            raise ShapeError(f"expected rows of {self.batch_size} systems, as indices or as a mask ({self.batch_size},), received {rows}") from error
        self._memory.forget(index)
        self._applies[slice(None) if index is None else index] = True
        if rows is None:
            self._last = None

    @torch.no_grad()
    def step(self, pixels: Tensor | None) -> Step:
        """Actions for pixels ``(n, 6, H, W)`` uint8, frames t-1 and t; a ShapeError for another number of them, or for one without a batch.

        Without pixels (``None``) the memory goes on with what it expects, and the premise is not met; what would have been seen,
        and its distances, are NaN.
        """
        memory, n = self._memory, self.batch_size
        if pixels is None:
            latent, nothing = memory.unseen(n), torch.full((n, self.agent.latent_dim), math.nan, device=self._applies.device)
            return self.remember(*self._judged(latent, nothing, nothing), rows=(~self.begins).nonzero()[:, 0])
        if not isinstance(pixels, Tensor):
            raise DTypeError(f"expected pixels as a tensor of dtype torch.uint8, received {type(pixels).__name__}; torch.as_tensor(pixels) makes one of numpy")
        if pixels.ndim != 4 or len(pixels) != n:
            raise ShapeError(f"expected pixels of {n} systems, ({n}, 6, H, W), received {tuple(pixels.shape)}; make a controller for them")
        return self.remember(*self._look(pixels.to(self._applies.device), *self.expected()))

    def expected(self) -> tuple[Tensor, Tensor]:
        """The latents that are expected ``(n, p)``, and of which systems nothing was seen yet ``(n,)``."""
        return self._memory.expected(self.batch_size)

    def looked(self, pixels: Tensor, prior: Tensor, begins: Tensor) -> tuple[Step, Tensor]:
        """The step after a look at pixels, and what is expected next ``(n, p)``; nothing is remembered, so that it can be compiled."""
        seen = self.agent.encode(pixels)
        latent, innovation, _, seen = correction(self.agent, self._memory.held_error, seen, torch.where(begins[:, None], seen, prior))
        return self._judged(latent, innovation, seen)

    def remember(self, step: Step, predicted: Tensor, rows: Tensor | None = None) -> Step:
        """The step that was looked at, from now on the last one, with what is known of all steps since the reset."""
        self._applies = self._applies & step.applies
        step.applies = self._applies.clone()  # the caller's, whom a reset of some rows does not reach
        self._memory.expect(predicted, rows)
        self._last = step.latent, step.action.clone()  # a caller may clip it in place
        return step

    def _judged(self, latent: Tensor, innovation: Tensor, seen: Tensor) -> tuple[Step, Tensor]:
        """The step at latents, of which ``applies`` is whether it meets the premise by itself, and what is expected next."""
        agent = self.agent
        action = agent.policy(latent)
        barrier, of_seen = agent.barrier(torch.stack([latent, seen]))[..., 0]
        error = (latent - (seen - innovation)).norm(dim=-1)
        met = premise_met(barrier, of_seen, error, self._proved, held=self._memory.held_error > 0.0)
        step = Step(action, barrier, barrier <= 0.0, innovation.norm(dim=-1), error, met, latent, seen)
        return step, agent.dynamics(latent, action)

    @torch.no_grad()
    def took(self, action: Tensor, predicted: Tensor | None = None) -> Tensor:
        """Say what was really done after a step, ``(n, m)`` physical units, where it was not the action that was told; returns ``(n,)`` bool,
        whether the proof still applies.

        It does to actions that were told, and to those of a filter with the proved margin; others end it until the next reset.

        Args:
            action: what was done.
            predicted: ``(n, p)``, what a safety filter with the proved margin has found to follow (``Protected.predicted``); None: it is
                computed.

        Raises:
            ConfigError: before the first step since a reset.
            ShapeError: for actions or latents of another shape.
            NonFiniteError: for NaN or infinity among them.
        """
        if self._last is None:
            raise ConfigError("expected a step before took(), received none since the reset")
        latent, told = self._last
        if action.shape != told.shape:
            raise ShapeError(f"expected actions {tuple(told.shape)}, received {tuple(action.shape)}")
        if predicted is not None and predicted.shape != latent.shape:
            raise ShapeError(f"expected latents {tuple(latent.shape)} after the actions, received {tuple(predicted.shape)}")
        if not all(bool(given.isfinite().all()) for given in (action, predicted) if given is not None):
            raise NonFiniteError("expected finite actions, and what follows them, received NaN or infinity; the memory stays as it was")
        begins = self.begins
        if predicted is None:
            predicted = self.agent.dynamics(latent, action)
            self._applies = self._applies & ((action == told).all(1) | begins)
        self._memory.expect(predicted, (~begins).nonzero()[:, 0])
        return self._applies.clone()


__all__ = ["Controller", "Memory", "Step", "correction", "meets_premise", "premise_met"]
