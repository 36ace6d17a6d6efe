"""Any gymnasium environment that can draw itself, as a TorchRL environment with two stacked frames and regions."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_sspl.devices import usable_device
from torchrl_sspl.envs.base import LARGEST_ACTION, set_specs
from torchrl_sspl.envs.games import Game, Games, Moment, Picture, Predicate, SpreadGames
from torchrl_sspl.errors import ConfigError, NonFiniteError

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
        batch_size: ``[n]`` environments, stepped one after the other in each of the ``workers``.
        image_size: height and width of the frames, in pixels; pictures are averaged down to it.
        horizon: steps after which an episode is truncated; ``None`` leaves that to gymnasium.
        reset_options: ``options`` of gymnasium's reset, or ``(numpy generator) -> options``.
        action_repeat: steps of gymnasium per step, all with the same action, of a discrete one with the mixture above;
            the two frames of an observation, and what the predicates judge, lie that far apart. Where a step moves less
            than the picture shows, it makes motion visible; of discrete actions it makes finer ones.
        settle: let one step pass after a reset.
        ignore_termination: let episodes go on where gymnasium ends them, up to ``horizon``: where it ends them in U, no
            transition would start there. The system has to bear it (those of gymnasium do, with a warning).
        workers: processes that step and draw the environments, at most n; one: this one. More show the same, sooner where
            drawing takes the time. They are forked, so a system without fork has one, and ``make`` is called in them.
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
        workers: int = 1,
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
        if not isinstance(workers, int) or workers < 1:
            raise ConfigError(f"workers: expected an integer >= 1, received {workers!r}.")
        if not callable(make):
            raise ConfigError(
                "make: expected a function that makes an environment of gymnasium, such as partial(gymnasium.make, "
                f"'CartPole-v1', render_mode='rgb_array'), received an object of type {type(make).__name__}."
            )
        super().__init__(device=usable_device(device or "cpu"), batch_size=size)
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        self.image_size, self.horizon = image_size, horizon
        self.reset_options, self.settle, self.action_repeat = reset_options, settle, action_repeat
        n, workers = size[0], min(workers, size[0])
        build = partial(
            Game, make, safe=safe, unsafe=unsafe, image_size=image_size, ignore_termination=ignore_termination
        )
        self._games = Games(build, n) if workers == 1 else SpreadGames(build, n, workers)
        observed, acted = self._games.ask("spaces", {0: ()})[0]
        try:
            self._read_action_space(acted)
        except ConfigError:
            self._games.close()
            raise
        shape: tuple[int, ...] = getattr(observed, "shape", None) or ()
        self.state_dim = shape[0] if len(shape) == 1 else 0
        set_specs(self, image_size, self.state_dim, torch.tensor(self._scale, device=self.device))
        self._random = np.random.default_rng(seed)
        self._frame = torch.zeros(n, 3, image_size, image_size, dtype=torch.uint8)
        self._steps = [0] * n
        self._last: dict[int, Moment] = {}

    def _read_action_space(self, space: Any) -> None:
        self._choices: int | None = None
        if hasattr(space, "n") and hasattr(space, "start"):
            self._choices, self._start = int(space.n), int(space.start)
            self.action_dim, self._scale, self._middle = 1, np.ones(1, np.float32), np.zeros(1, np.float32)
        elif hasattr(space, "low") and (np.abs([space.low, space.high]) < LARGEST_ACTION).all():
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
        native = (self._middle + bounded).reshape(self._action_shape)
        if np.issubdtype(self._action_dtype, np.integer):
            native = np.rint(native)
        return [native.astype(self._action_dtype)] * repeat

    def _options(self) -> dict[str, Any] | None:
        try:
            options = self.reset_options(self._random) if callable(self.reset_options) else self.reset_options
            return None if options is None else dict(options)
        except (TypeError, ValueError) as error:
            raise ConfigError(
                "reset_options: expected a mapping, or a function numpy generator -> mapping, received "
                f"{type(error).__name__}: {error}"
            ) from error

    def _restart(self, rows: list[int]) -> dict[int, Tensor]:
        """Resets some environments and, to settle them, lets one step pass; returns the frames of the reset."""
        before, waiting = dict[int, Tensor](), rows
        settling = self._native_actions(np.zeros(self.action_dim)) if self.settle else ()
        for _ in range(_ATTEMPTS):
            drawn = {k: (self._options(), int(self._random.integers(2**31 - 1))) for k in waiting}
            began = self._games.ask("reset", {k: (seed, options, settling) for k, (options, seed) in drawn.items()})
            for k, (picture, moment) in began.items():
                before[k], self._frame[k] = _frame(picture), _frame(moment.picture)
                self._steps[k], self._last[k] = 0, moment
            waiting = [k for k, (_, moment) in began.items() if moment.terminated or moment.truncated]
            if not waiting:
                return before
        raise ConfigError(
            f"reset: expected an episode that survives one step, received {_ATTEMPTS} that did not; change reset_options."
        )

    def _set_seed(self, seed: int | None) -> None:
        self._random = np.random.default_rng(seed)

    def _reset(self, tensordict: TensorDictBase | None, **_: Any) -> TensorDictBase:
        rows = list(range(self.batch_size[0]))
        if tensordict is not None and "_reset" in tensordict:
            chosen = tensordict["_reset"].reshape(-1).tolist()
            rows = [k for k in rows if chosen[k]]
        previous = self._frame.clone()
        for k, frame in self._restart(rows).items():
            previous[k] = frame
        return self._output(previous)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict["action"].detach().cpu().reshape(-1, self.action_dim).numpy()
        if np.isnan(actions).any():
            raise NonFiniteError("action: expected finite numbers, received NaN; a policy gives them whose weights are not finite")
        previous, self._frame = self._frame, torch.empty_like(self._frame)
        self._last = self._games.ask("step", {k: (self._native_actions(row),) for k, row in enumerate(actions)})
        for k, moment in self._last.items():
            self._frame[k] = _frame(moment.picture)
            self._steps[k] += 1
        moments = [self._last[k] for k in range(len(actions))]
        out = self._output(previous)
        late = [m.truncated or (self.horizon is not None and n >= self.horizon) for m, n in zip(moments, self._steps, strict=True)]
        over, cut = (torch.tensor(v, device=self.device)[:, None] for v in ([m.terminated for m in moments], late))
        out["reward"] = torch.tensor([m.reward for m in moments], device=self.device)[:, None]
        out["terminated"], out["truncated"], out["done"] = over, cut, over | cut
        return out

    def _output(self, previous: Tensor) -> TensorDict:
        moments = [self._last[k] for k in range(self.batch_size[0])]
        entries = {
            "pixels": torch.cat([previous, self._frame], dim=1),
            "region": torch.tensor([m.region for m in moments])[:, None],
        }
        if self.state_dim:
            entries["state"] = torch.from_numpy(np.stack([m.state for m in moments if m.state is not None]))
        return TensorDict(entries, batch_size=self.batch_size).to(self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the environments of gymnasium too, and the processes that step them."""
        self._games.close()
        super().close(raise_if_closed=raise_if_closed)


def _frame(picture: Picture) -> Tensor:
    return torch.from_numpy(picture).permute(2, 0, 1)
