"""The safety filter around a gymnasium environment, for policies that know nothing of this library."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv, VectorWrapper
from numpy.typing import NDArray
from torch import Tensor

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.modules.controller import Controller
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
        ConfigError: if observations are no such pictures, the range of actions is another than the agent's, or the environment
            resets itself.
        ShapeError: if the pictures are of another size than those the agent was trained on.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> env = gymnasium.make("SSPL/QuadrupedObstacle-v0")  # doctest: +SKIP
        >>> env = SafetyWrapper(env, load("quadruped"))  # doctest: +SKIP
    """

    def __init__(self, env: gymnasium.Env, agent: Agent, **options: Any) -> None:
        if isinstance(env, VectorEnv):
            raise ConfigError("expected a single environment, received a vectorised one; use SafetyVectorWrapper(env, agent)")
        inner: Any = env
        while isinstance(inner, gymnasium.Wrapper):
            if isinstance(inner, gymnasium.wrappers.Autoreset):  # it begins an episode without a word
                raise ConfigError(
                    "expected an environment whose episodes begin with reset(), received one inside of Autoreset, after which the memory of an "
                    "episode would go on in the next; put Autoreset around this wrapper"
                )
            inner = inner.env
        super().__init__(env)
        self._guard = _Guard(agent, env.observation_space, env.action_space, 1, options)
        self.agent, self.shield, self.statistics = agent, self._guard.shield, self._guard.statistics

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; the memory forgets."""
        observation, info = self.env.reset(**options)
        return observation, info | {"safety": self._told(self._guard.begin(np.asarray(observation)[None]))}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """A step under the action, or one in place of it; a ConfigError before the first reset."""
        made = self._guard.protect(np.asarray(action)[None])
        observation, reward, terminated, truncated, info = self.env.step(made["taken"][0])
        return observation, reward, terminated, truncated, info | {"safety": self._told(made | self._guard.look(np.asarray(observation)[None]))}

    @staticmethod
    def _told(rows: dict[str, NDArray[Any]]) -> dict[str, Any]:
        """Of the one row; plain numbers where it has no size."""
        return {name: row[0].item() if row.ndim == 1 else row[0] for name, row in rows.items()}


class SafetyVectorWrapper(VectorWrapper):
    r"""Does what :class:`SafetyWrapper` does around a vectorised environment of gymnasium, with a memory of its own for every row.

    Entries of ``info["safety"]`` are arrays, first over the rows. Where an environment resets itself in the next step, the action of that step
    goes nowhere and is neither changed nor counted; where it does so in the same step, ``info["safety"]`` is about the first observation of
    the new episode. Source: none.

    Args:
        env: vectorised environment that resets its rows by itself (``AutoresetMode.NEXT_STEP`` or ``SAME_STEP``).
        agent: frozen agent.
        **options: of :class:`~torchrl_sspl.runtime.Shield`; errors too.

    Raises:
        ConfigError: as :class:`SafetyWrapper`, and if rows are not reset by themselves.
        ShapeError: if the pictures are of another size than those the agent was trained on.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> envs = gymnasium.make_vec("SSPL/QuadrupedObstacle-v0", num_envs=4)  # doctest: +SKIP
        >>> envs = SafetyVectorWrapper(envs, load("quadruped"))  # doctest: +SKIP
    """

    def __init__(self, env: VectorEnv, agent: Agent, **options: Any) -> None:
        super().__init__(env)
        mode = env.metadata.get("autoreset_mode", "NextStep")
        self._mode = str(getattr(mode, "value", mode))
        if self._mode not in ("NextStep", "SameStep"):
            raise ConfigError(f"expected an environment that resets its rows by itself, received autoreset_mode={self._mode}; choose another")
        self._guard = _Guard(agent, env.single_observation_space, env.single_action_space, env.num_envs, options)
        self.agent, self.shield, self.statistics = agent, self._guard.shield, self._guard.statistics
        self._ended = np.zeros(env.num_envs, dtype=bool)

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Begin episodes in all rows; the memory forgets. A ConfigError for ``options["reset_mask"]``: rows reset themselves."""
        if "reset_mask" in (options.get("options") or {}):
            raise ConfigError("expected a reset of all rows, received a reset_mask; rows whose episode ends are reset by themselves")
        observation, info = self.env.reset(**options)
        self._ended[:] = False
        return observation, info | {"safety": self._guard.begin(observation)}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """A step under the actions, or others in place of them; a ConfigError before the first reset."""
        resting = self._ended if self._mode == "NextStep" else np.zeros_like(self._ended)
        made = self._guard.protect(np.asarray(actions), resting)
        observation, reward, terminated, truncated, info = self.env.step(made["taken"])
        self._ended = np.asarray(terminated | truncated)
        begins = resting if self._mode == "NextStep" else self._ended
        return observation, reward, terminated, truncated, info | {"safety": made | self._guard.look(observation, begins)}


class _Guard:
    """What both wrappers share: the shield, the agent's memory, and what is counted."""

    def __init__(self, agent: Agent, observations: gymnasium.Space, actions: gymnasium.Space, n: int, options: dict[str, Any]) -> None:
        self.shield, self._layout = Shield(agent, **options), _layout(observations)
        scale = self.shield.scale.cpu().numpy()
        if not isinstance(actions, Box) or actions.shape != scale.shape or not (
            np.allclose(actions.high, scale, rtol=1e-4) and np.allclose(actions.low, -scale, rtol=1e-4)
        ):  # fmt: skip
            raise ConfigError(
                f"expected actions between -{scale} and {scale}, those that the agent was trained with, received {actions}; rescale "
                "them (gymnasium.wrappers.RescaleAction) inside of this wrapper"
            )
        size = getattr(agent.encoder, "image_size", None)
        shown = tuple(_frames(np.zeros(observations.shape or (), np.uint8), self._layout).shape[-2:])
        if size is not None and tuple(size) != shown:
            raise ShapeError(f"expected pictures of {tuple(size)} pixels, received {shown}; resize them inside of this wrapper")
        self.statistics: dict[str, float] = {"steps": 0, "interventions": 0, "deviation": 0.0}
        self._type, self._controller = actions.dtype, Controller(agent, n, compile=bool(options.get("compile", False)))
        self._held = agent.held_error > 0.0 and self.shield.proved
        self._latent: Tensor | None = None

    def begin(self, observation: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """What is thought of the first observations of n episodes."""
        self._controller.reset()
        return self.look(observation)

    def look(self, observation: NDArray[np.uint8], begins: NDArray[np.bool_] | None = None) -> dict[str, NDArray[Any]]:
        """What is thought of n observations, of which some begin an episode."""
        if begins is not None and begins.any():
            self._controller.reset(torch.from_numpy(begins.nonzero()[0]))
        step = self._controller.step(_frames(np.asarray(observation), self._layout))
        self._latent = step.latent
        applies = step.applies & self._held  # of a filter it is proved with held corrections alone, and with the proved margin
        told = {"barrier": step.barrier, "inside": step.inside, "applies": applies}
        return {name: value.cpu().numpy() for name, value in told.items()}

    def protect(self, wanted: NDArray[Any], resting: NDArray[np.bool_] | None = None) -> dict[str, NDArray[Any]]:
        """What is done in place of n actions, but of rows that only wait for their reset."""
        if self._latent is None:
            raise ConfigError("expected reset() before the first step, received step()")
        asked = torch.as_tensor(wanted, dtype=torch.float32, device=self._latent.device).reshape(len(self._latent), -1)
        made = self.shield(self._latent, asked)
        moves = torch.ones_like(made.intervened) if resting is None else ~torch.from_numpy(resting).to(made.intervened.device)
        action = torch.where(moves[:, None], made.action, asked)
        self._controller.took(action, made.predicted)  # of a row that waits it is forgotten
        told = {
            "intervened": made.intervened & moves, "wanted": asked, "taken": action, "deviation": made.deviation * moves,
            "margin": made.margin,
        }  # fmt: skip
        self.statistics["steps"] += int(moves.sum())
        self.statistics["interventions"] += int(told["intervened"].sum())
        self.statistics["deviation"] += float(told["deviation"].sum())
        rows = {name: value.cpu().numpy() for name, value in told.items()}
        return rows | {"taken": rows["taken"].astype(self._type)}


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
    """``(*batch, 6, H, W)`` uint8."""
    pixels = torch.from_numpy(np.ascontiguousarray(observation))
    if layout == "channels first":
        return pixels
    pixels = pixels.movedim(-1, -3)
    return pixels if layout == "channels last" else pixels.flatten(-4, -3)


__all__ = ["SafetyVectorWrapper", "SafetyWrapper"]
