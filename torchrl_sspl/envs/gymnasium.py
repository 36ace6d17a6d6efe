"""Any gymnasium environment that can draw itself, as a TorchRL environment with two stacked frames and regions."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_sspl.devices import usable_device
from torchrl_sspl.envs.base import set_specs
from torchrl_sspl.errors import ConfigError, OverlapError
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE

Predicate = Callable[[Any, Mapping[str, Any]], Any]
_ATTEMPTS = 20


class GymnasiumPixels(EnvBase):
    r"""A gymnasium environment seen through its own pictures, labelled by two predicates.

    The networks see pixels only: gymnasium's observation where that is a uint8 picture (height, width, 3), else what it
    renders. The predicates are asked after every step; what neither of them claims is unlabelled. Output keys, for
    ``batch_size=[n]``:

    ========== ============================ ==============================================================
    key        shape, dtype                 meaning
    ========== ============================ ==============================================================
    pixels     ``(n, 6, H, W)`` uint8       RGB frame of step t-1, then RGB frame of step t
    region     ``(n, 1)`` int64             0 unlabelled, 1 safe, 2 unsafe
    state      ``(n, k)`` float32           gymnasium's observation, only where that is a vector
    reward     ``(n, 1)`` float32           gymnasium's reward
    terminated ``(n, 1)`` bool              gymnasium's, and ``truncated``: gymnasium's or ``horizon``
    ========== ============================ ==============================================================

    Actions lie in a box around zero. For a ``Box`` of gymnasium the action is the distance from its middle, in its
    own units: :math:`u_{gym} = (low + high) / 2 + u`. For ``Discrete(k)`` the interval [-1, 1] is cut into k equal
    parts, in the order of gymnasium's numbers; with r repetitions into :math:`(k - 1) r + 1`, so that neighbouring
    numbers mix: part j is the number :math:`\lfloor j / r \rfloor + 1` in the first :math:`j \bmod r` repetitions
    and :math:`\lfloor j / r \rfloor` in the others.

    A reset is followed by one step with the action zero, so that the two first frames show motion. Where systems start
    at rest, ``settle=False`` leaves the step out, and the two first frames are the same.

    Args:
        make: ``() -> gymnasium.Env``, with ``render_mode="rgb_array"`` unless it observes pictures; called n times.
        safe, unsafe: ``(observation, info) -> bool`` of what gymnasium returns, the sets S and U.
        batch_size: ``[n]`` environments, stepped one after the other.
        image_size: height and width of the frames, in pixels; pictures are averaged down to it.
        horizon: steps after which an episode is truncated; ``None`` leaves that to gymnasium.
        reset_options: ``options`` of gymnasium's reset, or ``(numpy generator) -> options``.
        action_repeat: steps of gymnasium per step, all with the same action, of a discrete one with the mixture above;
            the two frames of an observation, and what the predicates judge, lie that far apart. Where a step moves less
            than the picture shows, it makes motion visible; of discrete actions it makes finer ones.
        settle: let one step pass after a reset.
        ignore_termination: let episodes go on where gymnasium ends them, up to ``horizon``: where it ends them in U, no
            transition would start there. The system has to bear it (those of gymnasium do, with a warning).
        device, seed: device of the tensors, and seed of the resets.

    Raises ConfigError if the environment cannot draw itself, or its action space is neither a bounded ``Box`` nor
    ``Discrete``; OverlapError, during a run, if both predicates claim a state. Source: none; the paper has two systems
    of its own.

    Example:
        >>> import gymnasium
        >>> env = GymnasiumPixels(
        ...     lambda: gymnasium.make("CartPole-v1", render_mode="rgb_array"), batch_size=[2], image_size=32, seed=0,
        ...     safe=lambda state, info: abs(state[2]) < 0.05, unsafe=lambda state, info: abs(state[2]) > 0.15)
        >>> env.rollout(3)["pixels"].shape
        torch.Size([2, 3, 6, 32, 32])
        >>> env.max_action
        1.0
        >>> env.close()
    """

    def __init__(
        self,
        make: Callable[[], Any],
        *,
        safe: Predicate,
        unsafe: Predicate,
        batch_size: Sequence[int] = (1,),
        image_size: int = 64,
        horizon: int | None = None,
        reset_options: Mapping[str, Any] | Callable[[np.random.Generator], Mapping[str, Any]] | None = None,
        action_repeat: int = 1,
        settle: bool = True,
        ignore_termination: bool = False,
        device: torch.device | str | None = None,
        seed: int | None = None,
    ) -> None:
        size = torch.Size([batch_size]) if isinstance(batch_size, int) else torch.Size(batch_size)
        if len(size) != 1 or size[0] < 1:
            raise ConfigError(f"batch_size: expected [n] with n >= 1, received {list(size)}.")
        if horizon is not None and horizon < 1:
            raise ConfigError(f"horizon: expected an integer >= 1 or None, received {horizon!r}.")
        if not isinstance(action_repeat, int) or action_repeat < 1:
            raise ConfigError(f"action_repeat: expected an integer >= 1, received {action_repeat!r}.")
        if ignore_termination and horizon is None:
            raise ConfigError("horizon: expected an integer >= 1 with ignore_termination, received None.")
        if not isinstance(image_size, int) or image_size < 8:
            raise ConfigError(f"image_size: expected an integer >= 8, received {image_size!r}.")
        if not callable(make):
            raise ConfigError(
                "make: expected a function that makes an environment of gymnasium, such as partial(gymnasium.make, "
                f"'CartPole-v1', render_mode='rgb_array'), received an object of type {type(make).__name__}."
            )
        super().__init__(device=usable_device(device or "cpu"), batch_size=size)
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        self.image_size, self.horizon = image_size, horizon
        self.reset_options, self.settle, self.ignore_termination = reset_options, settle, ignore_termination
        self.action_repeat = action_repeat
        self._safe, self._unsafe = safe, unsafe
        self._envs = [make() for _ in range(size[0])]
        first = self._envs[0]
        space = first.observation_space
        shape: tuple[int, ...] = getattr(space, "shape", None) or ()
        self._observes_pictures = len(shape) == 3 and shape[2] == 3 and space.dtype == np.uint8
        if not self._observes_pictures and getattr(first, "render_mode", None) != "rgb_array":
            raise ConfigError(
                f"make: expected an environment with render_mode='rgb_array', received "
                f"{getattr(first, 'render_mode', None)!r}; give it to gymnasium.make."
            )
        self._read_action_space(first.action_space)
        self.state_dim = shape[0] if len(shape) == 1 else 0
        set_specs(self, image_size, self.state_dim, torch.tensor(self._scale, device=self.device))
        self._random = np.random.default_rng(seed)
        n = size[0]
        self._frame = torch.zeros(n, 3, image_size, image_size, dtype=torch.uint8)
        self._steps = [0] * n
        self._last: list[dict[str, Any]] = [{} for _ in range(n)]

    def _read_action_space(self, space: Any) -> None:
        self._choices: int | None = None
        if hasattr(space, "n") and hasattr(space, "start"):
            self._choices, self._start = int(space.n), int(space.start)
            self.action_dim, self._scale, self._middle = 1, np.ones(1, np.float32), np.zeros(1, np.float32)
        elif hasattr(space, "low") and np.isfinite(space.low).all() and np.isfinite(space.high).all():
            self._action_shape, self._action_dtype = space.shape, space.dtype
            low, high = space.low.reshape(-1).astype(np.float32), space.high.reshape(-1).astype(np.float32)
            self.action_dim, self._scale, self._middle = len(low), (high - low) / 2, (high + low) / 2
        else:
            raise ConfigError(
                f"action_space: expected Discrete or a Box with finite bounds, received {space}; wrap the environment, "
                "for example in gymnasium.wrappers.RescaleAction."
            )

    @property
    def max_action(self) -> float | list[float]:
        """Largest absolute action, a number where all components share it; what ``action_scale`` wants."""
        scale = self._scale.tolist()
        return scale[0] if len(set(scale)) == 1 else scale

    def _native_actions(self, action: np.ndarray) -> list[Any]:
        """Actions of gymnasium, one for each repetition, for an action ``(action_dim,)``; clamped to the bounds."""
        bounded = np.clip(action, -self._scale, self._scale)
        repeat = self.action_repeat
        if self._choices is not None:
            parts = (self._choices - 1) * repeat + 1
            lower, more = divmod(min(int((float(bounded[0]) + 1.0) / 2.0 * parts), parts - 1), repeat)
            return [self._start + lower + (step < more) for step in range(repeat)]
        return [(self._middle + bounded).reshape(self._action_shape).astype(self._action_dtype)] * repeat

    def _draw(self, index: int, observation: Any) -> Tensor:
        shown = observation if self._observes_pictures else self._envs[index].render()
        picture = np.asarray(shown)
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise ConfigError(
                f"render: expected a uint8 picture (height, width, 3), received {picture.dtype} {picture.shape}."
            )
        if picture.shape[:2] != (self.image_size, self.image_size):
            picture = _area_averaged(picture, self.image_size)
        else:
            picture = picture.copy()  # some renderers draw into the same memory again
        return torch.from_numpy(picture).permute(2, 0, 1)

    def _region(self, observation: Any, info: Mapping[str, Any]) -> int:
        judges = (("safe", self._safe), ("unsafe", self._unsafe))
        safe, unsafe = (self._judged(name, predicate, observation, info) for name, predicate in judges)
        if safe and unsafe:
            raise OverlapError(
                "safe and unsafe: expected predicates that exclude each other, received a state that both claim; "
                "make one of them smaller."
            )
        return SAFE if safe else UNSAFE if unsafe else UNLABELLED

    @staticmethod
    def _judged(name: str, predicate: Predicate, observation: Any, info: Mapping[str, Any]) -> bool:
        try:
            return bool(predicate(observation, info))
        except (TypeError, ValueError, LookupError) as error:
            raise ConfigError(
                f"{name}: expected a predicate (observation, info) -> bool of one state, received "
                f"{type(error).__name__}: {error}"
            ) from error

    def _options(self) -> dict[str, Any] | None:
        try:
            options = self.reset_options(self._random) if callable(self.reset_options) else self.reset_options
            return None if options is None else dict(options)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                "reset_options: expected a mapping, or a function numpy generator -> mapping, received "
                f"{type(error).__name__}: {error}"
            ) from error

    def _advance(self, env: Any, action: np.ndarray) -> tuple[Any, float, bool, bool, Mapping[str, Any]]:
        """``action_repeat`` steps of gymnasium; rewards add up, the end of an episode ends them too."""
        total = 0.0
        for native in self._native_actions(action):
            observation, reward, terminated, truncated, info = env.step(native)
            total += float(reward)
            terminated = bool(terminated) and not self.ignore_termination
            if terminated or truncated:
                break
        return observation, total, terminated, bool(truncated), info

    def _restart(self, index: int) -> Tensor:
        """Reset one environment and, to settle it, let one step pass; returns the frame of the reset."""
        env = self._envs[index]
        for _ in range(_ATTEMPTS):
            options = self._options()
            seed = int(self._random.integers(2**31 - 1))
            observation, info = env.reset(seed=seed, options=options)
            before = self._draw(index, observation)
            if not self.settle:
                break
            observation, _, terminated, truncated, info = self._advance(env, np.zeros(self.action_dim))
            if not (terminated or truncated):
                break
        else:
            raise ConfigError(
                f"reset: expected an episode that survives one step, received {_ATTEMPTS} that did not; "
                "change reset_options."
            )
        self._frame[index] = self._draw(index, observation)
        self._steps[index] = 0
        self._last[index] = self._row(observation, info)
        return before

    def _row(self, observation: Any, info: Mapping[str, Any]) -> dict[str, Any]:
        row: dict[str, Any] = {"region": self._region(observation, info)}
        if self.state_dim:
            row["state"] = np.asarray(observation, np.float32)
        return row

    def _set_seed(self, seed: int | None) -> None:
        self._random = np.random.default_rng(seed)

    def _reset(self, tensordict: TensorDictBase | None, **_: Any) -> TensorDictBase:
        rows = list(range(self.batch_size[0]))
        if tensordict is not None and "_reset" in tensordict:
            chosen = tensordict["_reset"].reshape(-1).tolist()
            rows = [k for k in rows if chosen[k]]
        previous = self._frame.clone()
        for k in rows:
            previous[k] = self._restart(k)
        return self._output(previous)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict["action"].detach().cpu().reshape(-1, self.action_dim).numpy()
        previous, self._frame = self._frame, torch.empty_like(self._frame)
        rewards, ended, cut = [], [], []
        for k, env in enumerate(self._envs):
            observation, reward, terminated, truncated, info = self._advance(env, actions[k])
            self._frame[k] = self._draw(k, observation)
            self._steps[k] += 1
            self._last[k] = self._row(observation, info)
            rewards.append(reward)
            ended.append(terminated)
            cut.append(truncated or (self.horizon is not None and self._steps[k] >= self.horizon))
        out = self._output(previous)
        over, late = (torch.tensor(v, device=self.device)[:, None] for v in (ended, cut))
        out["reward"] = torch.tensor(rewards, device=self.device)[:, None]
        out["terminated"], out["truncated"], out["done"] = over, late, over | late
        return out

    def _output(self, previous: Tensor) -> TensorDict:
        entries = {
            "pixels": torch.cat([previous, self._frame], dim=1),
            "region": torch.tensor([row["region"] for row in self._last])[:, None],
        }
        if self.state_dim:
            entries["state"] = torch.from_numpy(np.stack([row["state"] for row in self._last]))
        return TensorDict(entries, batch_size=self.batch_size).to(self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the environments of gymnasium too."""
        for env in self._envs:
            env.close()
        super().close(raise_if_closed=raise_if_closed)


def _area_averaged(picture: np.ndarray, size: int) -> np.ndarray:
    """A uint8 picture ``(h, w, 3)`` as ``(size, size, 3)``: bit for bit torch's mode "area", rounded, and faster."""
    turned = picture.strides[0] < picture.strides[1]  # pygame's pictures lie in memory column by column
    first, n = _summed(picture.transpose(1, 0, 2) if turned else picture, size)
    second, m = _summed(first.transpose(1, 0, 2), size)
    high, wide = (m, n) if turned else (n, m)
    mean = (second if turned else second.transpose(1, 0, 2)).astype(np.float32) / high[:, None, None] / wide[:, None]
    return (mean + np.float32(0.5)).astype(np.uint8)


def _summed(values: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Sums over ``size`` bins of the first axis, which may share a row, and how many rows each has (float32)."""
    n, bins = len(values), np.arange(size)
    first = bins * n // size
    counts = -(-(bins + 1) * n // size) - first
    sums = values[first].astype(np.uint32)
    for k in range(1, int(counts.max())):
        longer = counts > k
        sums[longer] += values[first[longer] + k]
    return sums, counts.astype(np.float32)
