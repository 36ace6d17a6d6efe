"""The safety filter around a gymnasium environment, for policies that know nothing of this library."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from torch import Tensor

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.modules.controller import Memory
from torchrl_sspl.runtime.filter import Shield


class SafetyWrapper(gymnasium.Wrapper):
    r"""Changes actions where the agent's set would not surely be kept; see :class:`~torchrl_sspl.runtime.Shield`.

    The environment's observations are the agent's pictures, two RGB frames uint8: ``(6, H, W)``, ``(H, W, 6)``, or as
    ``gymnasium.wrappers.FrameStackObservation`` stacks them, ``(2, H, W, 3)``. Actions are those of the agent's system. ``info["safety"]``
    tells about the step that was taken: ``intervened``, ``wanted``, ``taken``, ``deviation``, ``margin``; and about what is
    seen now: ``barrier``, ``inside``, ``applies`` (every observation since the reset by itself lay in the set, premise of the proof).
    ``statistics`` counts steps and interventions. Source: none.

    Args:
        env: environment.
        agent: frozen agent.
        **options: of :class:`~torchrl_sspl.runtime.Shield`; errors too.

    Raises:
        ConfigError: if observations are no such pictures, or the range of actions is another than the agent's.
        ShapeError: if the pictures are of another size than those the agent was trained on.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> env = gymnasium.make("SSPL/QuadrupedObstacle-v0")  # doctest: +SKIP
        >>> env = SafetyWrapper(env, load("quadruped"), margin=0.02)  # doctest: +SKIP
    """

    def __init__(self, env: gymnasium.Env, agent: Agent, **options: Any) -> None:
        super().__init__(env)
        self.agent, self.shield = agent, Shield(agent, **options)
        self._layout = _layout(env.observation_space)
        scale, space = self.shield.scale.cpu().numpy(), env.action_space
        if not isinstance(space, Box) or space.shape != scale.shape or not (
            np.allclose(space.high, scale, rtol=1e-4) and np.allclose(space.low, -scale, rtol=1e-4)
        ):  # fmt: skip
            raise ConfigError(
                f"expected actions between -{scale} and {scale}, those that the agent was trained with, received {space}; rescale "
                "them (gymnasium.wrappers.RescaleAction) inside of this wrapper"
            )
        size = getattr(agent.encoder, "image_size", None)
        shown = tuple(_frames(np.zeros(env.observation_space.shape or (), np.uint8), self._layout).shape[-2:])
        if size is not None and tuple(size) != shown:
            raise ShapeError(f"expected pictures of {tuple(size)} pixels, received {shown}; resize them inside of this wrapper")
        self.statistics: dict[str, float] = {"steps": 0, "interventions": 0, "deviation": 0.0}
        self._memory = Memory(agent)
        self._latent: Tensor | None = None
        self._applies = True

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; the memory forgets."""
        observation, info = self.env.reset(**options)
        self._memory.forget()
        self._applies = True
        return observation, info | {"safety": self._look(observation)}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """A step under the action, or one in place of it; a ConfigError before the first reset."""
        if self._latent is None:
            raise ConfigError("expected reset() before the first step, received step()")
        wanted = torch.as_tensor(np.asarray(action), dtype=torch.float32, device=self._latent.device).reshape(1, -1)
        made = self.shield(self._latent, wanted)
        self._memory.expect(self.agent.dynamics(self._latent, made.action))
        taken: NDArray[np.floating] = made.action[0].cpu().numpy().astype(self.env.action_space.dtype)
        observation, reward, terminated, truncated, info = self.env.step(taken)
        told: dict[str, Any] = {
            "intervened": bool(made.intervened), "wanted": wanted[0].cpu().numpy(), "taken": taken,
            "deviation": float(made.deviation), "margin": float(made.margin),
        }  # fmt: skip
        self.statistics["steps"] += 1
        self.statistics["interventions"] += told["intervened"]
        self.statistics["deviation"] += told["deviation"]
        return observation, reward, terminated, truncated, info | {"safety": told | self._look(observation)}

    @torch.no_grad()
    def _look(self, observation: Any) -> dict[str, Any]:
        """What is thought of an observation."""
        agent = self.agent
        seen = agent.encode(_frames(np.asarray(observation), self._layout)[None].to(agent.gain.device))
        self._latent = self._memory.correct(seen)[0]
        barrier = float(agent.barrier(self._latent))
        self._applies &= agent.held_error > 0.0 and barrier <= 0.0 and float(agent.barrier(seen)) <= 0.0
        return {"barrier": barrier, "inside": barrier <= 0.0, "applies": self._applies}


def _layout(space: gymnasium.Space) -> str:
    """How two frames lie in an observation."""
    shape = space.shape or ()
    if isinstance(space, Box) and space.dtype == np.uint8:
        if len(shape) == 3 and 6 in (shape[0], shape[2]):
            return "channels first" if shape[0] == 6 else "channels last"
        if len(shape) == 4 and shape[0] == 2 and shape[3] == 3:
            return "stacked"
    raise ConfigError(
        f"expected observations of two RGB frames, uint8 (6, H, W), (H, W, 6) or (2, H, W, 3), received {space}; stack them with "
        "gymnasium.wrappers.FrameStackObservation(env, 2)"
    )


def _frames(observation: NDArray[np.uint8], layout: str) -> Tensor:
    """``(6, H, W)`` uint8."""
    pixels = torch.from_numpy(np.ascontiguousarray(observation))
    if layout == "channels last":
        return pixels.permute(2, 0, 1)
    return pixels if layout == "channels first" else pixels.permute(0, 3, 1, 2).flatten(0, 1)


__all__ = ["SafetyWrapper"]
