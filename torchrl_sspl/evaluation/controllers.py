"""Whatever acts: agents, other controllers with or without a barrier, plain functions, random actions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.evaluation.measurements import Draw
from torchrl_sspl.modules.agent import Agent, on_host
from torchrl_sspl.modules.controller import Memory, meets_premise

CHUNK = 1000  # frames drawn and encoded at a time
_NONE: Any = None


@dataclass
class Decision:
    """What a controller does with the observations of n episodes, and what it thinks of them; None where nothing."""

    action: Tensor = _NONE  # (n, m), physical units
    barrier: Tensor = _NONE  # (n,), at most zero means safe
    seen: Tensor = _NONE  # (n,) barrier of what is seen by itself, without memory
    latent: Tensor = _NONE  # (n, p)
    outside: Tensor = _NONE  # (n,) bool, whether what the encoder gives lies outside [-1, 1] or is no number
    innovation: Tensor = _NONE  # (n, p) what is seen, less what was expected
    cut: Tensor = _NONE  # (n,) bool, whether its correction was cut so that the set is not left
    predicted: Tensor = _NONE  # (n, p) the next latent that it expects
    predicted_barrier: Tensor = _NONE  # (n,) barrier of the latter

    def _map(self, function: Callable[[Tensor, str], Tensor]) -> Decision:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return Decision(**{k: function(v, k) for k, v in values.items() if v is not None})

    def rows(self, rows: Tensor | None) -> Decision:
        """Those of some of the episodes; of all, if None."""
        return self if rows is None else self._map(lambda value, _: value[rows])

    def put(self, rows: Tensor, others: Decision) -> Decision:
        """These decisions, in some rows replaced by others."""

        def merged(value: Tensor, name: str) -> Tensor:
            other = getattr(others, name)
            return value if other is None else value.index_copy(0, rows, other)

        return self._map(merged)


@runtime_checkable
class Controller(Protocol):
    """Anything that acts, with memory if it wants: what :func:`simulate` asks, episodes side by side.

    ``reads`` names what it sees: ``"pixels"`` (two stacked frames uint8 ``(k, 6, H, W)``), ``"state"`` (true states),
    or another key of the environment. An optional ``watch(observation, rows)``, with the arguments and the result of
    ``step``, is asked in place of it about observations that are not acted on: the last of an episode.
    """

    reads: str

    def reset(self, rows: Tensor | None = None) -> None:
        """Forget everything (new episodes, perhaps of another number), or what belongs to some of the n episodes."""

    def step(self, observation: Tensor, rows: Tensor | None = None) -> Decision:
        """Actions for k observations; ``rows (k,)`` says which of the n episodes they belong to, None: all."""
        ...


class Camera:
    """Observations of n systems, drawn when they are looked at, some frames at a time.

    Args:
        draw: states ``(n, s)`` -> frames uint8 ``(n, 3, H, W)``.
        state, before: states now and one step ago, ``(n, s)``.
    """

    def __init__(self, draw: Draw, state: Tensor, before: Tensor) -> None:
        self.draw, self.state, self.before, self.rows = draw, state, before, torch.arange(len(state))
        self._album: Tensor | None = None

    def move(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Turn to the next states of all, or of some of the n systems."""
        self.state, self.rows = state, torch.arange(len(state)) if rows is None else rows

    def __len__(self) -> int:
        return len(self.state)

    def newest(self) -> Iterator[Tensor]:
        """Frames of now."""
        return (self.draw(part) for part in self.state.split(CHUNK))

    def previous(self) -> Iterator[Tensor]:
        """Frames of one step before the first."""
        return (self.draw(part) for part in self.before.split(CHUNK))

    def pixels(self) -> Iterator[Tensor]:
        """Both frames stacked; each is drawn once, if they are asked for at every step."""
        seen = torch.cat(list(self.newest()))
        if self._album is None:
            self._album = torch.cat(list(self.previous()))
        before = self._album[self.rows]
        self._album[self.rows] = seen
        return (torch.cat(both, dim=-3) for both in zip(before.split(CHUNK), seen.split(CHUNK), strict=True))


class AgentController:
    """An agent in a closed loop, its latent observer with it; of a film of states every frame is encoded once, where the
    encoder can. Source: none.

    Args:
        agent: frozen agent; its encoder stays on its device.
        driver: a controller on pixels that acts in place of the agent's policy, while the agent watches: its barrier
            values and predictions are those of the actions taken.
        change: (latents ``(n, p)``, wanted actions ``(n, m)``) -> actions taken ``(n, m)``, such as a safety filter.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> decision = AgentController(load("pendulum")).step(torch.zeros(2, 6, 64, 64, dtype=torch.uint8))
        >>> decision.action.shape, decision.barrier.shape
        (torch.Size([2, 1]), torch.Size([2]))
    """

    reads = "pixels"

    def __init__(self, agent: Agent, driver: Any = None, change: Callable[[Tensor, Tensor], Tensor] | None = None) -> None:
        self._device = next(agent.barrier.parameters()).device
        self.agent, self.change = on_host(agent), change
        self.driver = None if driver is None else as_controller(driver)
        #: Whether ``step`` takes a camera, too.
        self.streams = self.driver is None or getattr(self.driver, "streams", False)
        self._split = hasattr(agent.encoder, "frames") and hasattr(agent.encoder, "head")
        self._memory = Memory(self.agent)
        self.reset()

    def reset(self, rows: Tensor | None = None) -> None:
        """Forget; see :class:`Controller`."""
        if rows is None:
            self._seen: Tensor | None = None
            self._features: Tensor | None = None
            self._action: Tensor | None = None
        self._memory.forget(rows)
        if self.driver is not None:
            self.driver.reset(rows)

    @torch.no_grad()
    def watch(self, observation: Tensor | Camera, rows: Tensor | None = None) -> Decision:
        """Latents and barrier values of observations; arguments as for :meth:`step`."""
        return self._judge(observation, rows).rows(rows)

    @torch.no_grad()
    def step(self, observation: Tensor | Camera, rows: Tensor | None = None) -> Decision:
        """Actions, barrier values and predictions for observations ``(k, 6, H, W)`` or a camera."""
        # All n at a time: a row's result does not depend on how many others are asked for.
        agent, decision = self.agent, self._judge(observation, rows)
        if self.driver is None:
            action = agent.policy(decision.latent)
        else:
            chosen = self.driver.step(observation, rows).action  # type: ignore[arg-type]
            action = chosen if rows is None or self._action is None else self._action.index_copy(0, rows, chosen)
            self._action = action
        action = action if self.change is None else self.change(decision.latent, action)
        predicted = agent.dynamics(decision.latent, action)
        self._memory.expect(predicted, rows)
        expected = {"predicted": predicted, "predicted_barrier": agent.barrier(predicted)[:, 0]}
        return replace(decision, action=action, **expected).rows(rows)

    def _judge(self, observation: Tensor | Camera, rows: Tensor | None) -> Decision:
        """What is thought of all n episodes after a look at some of them."""
        encoded, barrier = self._see(observation, rows), self.agent.barrier
        latent, innovation, cut, seen = self._memory.correct(encoded)
        outside = ~(encoded.abs() <= 1.0).all(1)  # the memory never does
        return Decision(barrier=barrier(latent)[:, 0], seen=barrier(seen)[:, 0], latent=latent, outside=outside, innovation=innovation, cut=cut)

    def _see(self, observation: Tensor | Camera, rows: Tensor | None) -> Tensor:
        """Encoded observations of all n episodes, after a look at some of them."""
        agent = self.agent
        if isinstance(observation, Tensor):
            latent = agent.encode(observation.to(self._device))
        elif self._split:
            encoder: Any = agent.encoder
            seen = torch.cat([encoder.frames(part) for part in observation.newest()])
            if self._features is None:
                self._features = torch.cat([encoder.frames(part) for part in observation.previous()])
            latent = encoder.head(self._features[observation.rows], seen)
            self._features[observation.rows] = seen
        else:
            latent = torch.cat([agent.encode(part) for part in observation.pixels()])
        if rows is not None and self._seen is not None:
            latent = self._seen.index_copy(0, rows, latent)
        self._seen = latent
        return latent


def covered(run: Any, agent: Agent) -> Tensor:
    """``(n,)`` bool, episodes from the first to the last observation of which the premise of an agent's proof is met; none where nothing
    is proved. The episodes are those of a simulation with the agent. Source: none."""
    error = torch.cat([torch.zeros_like(run.prediction_error[:1]), run.prediction_error])  # nothing was expected at first
    met = meets_premise(agent, run.barrier, run.seen, error)
    return (met | ~run.alive).all(0)


class _FunctionController:
    """A plain function of the present observation, to tensors, or arrays of actions."""

    def __init__(self, function: Callable[[Any], Any], reads: str = "pixels") -> None:
        self.function, self.reads = function, reads

    def reset(self, rows: Tensor | None = None) -> None:
        """It has no memory."""

    @torch.no_grad()
    def step(self, observation: Tensor, rows: Tensor | None = None) -> Decision:
        found, n = self.function(observation), len(observation)
        found, barrier = found if isinstance(found, tuple) and len(found) == 2 else (found, None)
        if not isinstance(found, (Tensor, np.ndarray)) or not (barrier is None or isinstance(barrier, Tensor)):
            raise ConfigError(
                "controller: expected a function observation -> action, or (action, barrier), received one that returns"
                f" {type(found).__name__} and {type(barrier).__name__}; one with memory has reset(rows) and "
                "step(observation, rows)"
            )
        action = torch.as_tensor(found, dtype=torch.float32).cpu()
        if action.ndim < 1 or len(action) != n or (barrier is not None and barrier.numel() != n):
            shapes = tuple(action.shape), None if barrier is None else tuple(barrier.shape)
            raise ShapeError(
                f"controller: expected one action (and barrier value) for each of {n} observations, received {shapes}"
            )
        return Decision(action.reshape(n, -1), _NONE if barrier is None else barrier.reshape(n).float().cpu())


class RandomController:
    """Uniform actions within bounds, whatever is seen.

    The sequence depends on the seed and the number of steps only: an episode that begins anew keeps the action that was
    drawn for its row. Source: none.

    Args:
        low, high: bounds ``(m,)`` of the action.
        seed: of the sequence, which no reset begins anew.

    Example:
        >>> random = RandomController(torch.tensor([-2.0]), torch.tensor([2.0]), seed=0)
        >>> random.step(torch.zeros(5, 6, 8, 8)).action.shape
        torch.Size([5, 1])
    """

    reads = "pixels"
    streams = True

    def __init__(self, low: Tensor, high: Tensor, seed: int) -> None:
        self.low, self.high = low.cpu(), high.cpu()
        self._generator = torch.Generator().manual_seed(seed)
        self._action, self._keep = torch.zeros(0, len(self.low)), False

    @classmethod
    def within(cls, env: Any, seed: int) -> RandomController:
        """Within the bounds of a TorchRL environment."""
        space = env.action_spec_unbatched.space
        return cls(space.low, space.high, seed)

    def reset(self, rows: Tensor | None = None) -> None:
        """What begins anew keeps the action drawn."""
        self._keep = rows is not None

    def watch(self, observation: Any, rows: Tensor | None = None) -> Decision:
        """Draws nothing."""
        return Decision()

    def step(self, observation: Any, rows: Tensor | None = None) -> Decision:
        """Actions ``(k, m)``; see :class:`Controller`."""
        if rows is not None and self._keep:
            self._keep = False
            return Decision(self._action[rows])
        unit = torch.rand(len(observation), len(self.low), generator=self._generator)
        self._action = self.low + unit * (self.high - self.low)
        return Decision(self._action)


def as_controller(acts: Any, reads: str | None = None) -> Controller:
    """A controller of anything that acts. Source: none.

    Args:
        acts: an agent, a controller, a policy of stable-baselines3 (with ``predict``, or that method), a policy of
            TorchRL (from its first in-key to ``"action"``), an object with ``act``, or a function observation ``(k,
            ...)`` -> action ``(k, m)`` or ``(k,)``, or -> (action, barrier ``(k,)`` or ``(k, 1)``).
        reads: what it sees, ``"pixels"`` by default; see :class:`Controller`.

    Raises:
        ConfigError: if it is none of these.

    Example:
        >>> as_controller(lambda state: -state[:, :1], reads="state").step(torch.ones(2, 2)).action.tolist()
        [[-1.0], [-1.0]]
    """
    owner = getattr(acts, "__self__", None)
    if getattr(acts, "__name__", "") == "predict" and hasattr(owner, "predict"):
        acts = owner
    if callable(getattr(acts, "step", None)) and callable(getattr(acts, "reset", None)):
        return acts
    reads = reads or str(getattr(acts, "reads", "pixels"))
    if isinstance(acts, Agent):
        return AgentController(acts)
    if callable(getattr(acts, "predict", None)):
        return _FunctionController(lambda seen: acts.predict(seen.cpu().numpy(), deterministic=True), reads)
    if hasattr(acts, "in_keys") and "action" in getattr(acts, "out_keys", ()):
        key = acts.in_keys[0]
        return _FunctionController(lambda seen: acts(TensorDict({key: seen}, [len(seen)]))["action"], key)
    function = acts.act if callable(getattr(acts, "act", None)) else acts
    if not callable(function):
        raise ConfigError(
            "controller: expected an agent, a controller (reset, step), a policy (predict, act) or a function "
            f"observation -> action, received an object of type {type(acts).__name__}"
        )
    return _FunctionController(function, reads)
