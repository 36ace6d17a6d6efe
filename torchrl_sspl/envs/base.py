"""The part that all environments share: states, regions, frames, resets and specs."""

from __future__ import annotations

import functools
import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_sspl.devices import usable_device
from torchrl_sspl.envs.system import System
from torchrl_sspl.errors import ConfigError, DTypeError, NonFiniteError, ShapeError
from torchrl_sspl.sets import UNSAFE, Region, check_disjoint, label

LARGEST_ACTION = 1e30  # what calls itself bounded by more than that is not


def check_tensor(name: str, value: Tensor, dim: int) -> None:
    """Raise DTypeError, ShapeError or NonFiniteError unless ``value`` is a finite float tensor ``(*batch, dim)``."""
    if not isinstance(value, Tensor) or not value.is_floating_point():
        found = value.dtype if isinstance(value, Tensor) else type(value).__name__
        raise DTypeError(f"{name}: expected a floating-point tensor, received {found}; call .float().")
    if value.ndim < 1 or value.shape[-1] != dim:
        raise ShapeError(f"{name}: expected shape (*batch, {dim}), received {tuple(value.shape)}.")
    if not torch.isfinite(value).all():
        rows = int((~torch.isfinite(value)).reshape(-1, dim).any(-1).sum())
        raise NonFiniteError(
            f"{name}: expected finite values, received NaN or infinity in {rows} of "
            f"{value.numel() // dim} rows; remove them."
        )


def check_positive(**values: float) -> None:
    """Raise a ``ConfigError`` that names the first value that is not a positive finite number."""
    for name, value in values.items():
        if not isinstance(value, (int, float)) or not math.isfinite(value) or value <= 0:
            raise ConfigError(f"{name}: expected a positive finite number, received {value!r}.")


def numbers(values: Any) -> tuple[float, ...]:
    """Values as numbers; without any for what holds none, for whoever asks how many they are."""
    try:
        return tuple(float(v) for v in values)
    except (TypeError, ValueError):
        return ()


def wrapped(angle: Tensor) -> Tensor:
    """Angles in [-pi, pi), up to the rounding of their type, same shape."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def set_specs(env: EnvBase, image_size: int, state_dim: int, bound: Tensor) -> None:
    """Give an environment of stacked frames its specs; actions are within ``bound``, ``(action_dim,)``, of zero."""
    shape, device = env.batch_size, env.device
    entries: dict[str, Any] = {
        "pixels": Unbounded(shape=(*shape, 6, image_size, image_size), dtype=torch.uint8, device=device),
        "region": Categorical(3, shape=(*shape, 1), dtype=torch.int64, device=device),
    }
    if state_dim:
        entries["state"] = Unbounded(shape=(*shape, state_dim), dtype=torch.float32, device=device)
    env.observation_spec = Composite(entries, shape=shape, device=device)
    high = bound.expand(*shape, len(bound)).clone()
    env.action_spec = Bounded(-high, high, shape=high.shape, dtype=torch.float32, device=device)
    env.reward_spec = Unbounded(shape=(*shape, 1), dtype=torch.float32, device=device)
    flags = {
        name: Binary(shape=(*shape, 1), dtype=torch.bool, device=device) for name in ("done", "terminated", "truncated")
    }
    env.done_spec = Composite(flags, shape=shape, device=device)


class SafetyEnv(EnvBase):
    """A batched system with labelled regions that is seen through two consecutive frames.

    A subclass gives the physics and the picture: ``dynamics``, ``wrap``, ``previous_state`` and ``draw``.
    What else is particular to it (names, units, requirements, another renderer, a full physics) are ``system``,
    ``renderers``, ``known_twin`` and ``physics``, all with defaults; where ``sample_states`` does not draw from all states, ``among``
    names those in words, which certificates print. Output keys, for ``batch_size=[n]``:

    ========== ============================== ============================================================
    key        shape, dtype                   meaning
    ========== ============================== ============================================================
    pixels     ``(n, 6, H, W)`` uint8         RGB frame of step t-1, then RGB frame of step t
    state      ``(n, state_dim)`` float32     true state, wrapped; for evaluation, training does not need it
    region     ``(n, 1)`` int64               0 unlabelled, 1 safe, 2 unsafe
    reward     ``(n, 1)`` float32             -1 in the unsafe set, else 0
    terminated ``(n, 1)`` bool                the state has left the state space
    truncated  ``(n, 1)`` bool                ``horizon`` steps have passed since the reset
    ========== ============================== ============================================================

    ``reset()`` draws states uniformly from ``initial_set``; ``reset(TensorDict({"state": x}, [n]),
    set_state=True)`` starts at given states. Rollouts carry the previous frame, so nothing is drawn twice.

    Args:
        state_dim, action_dim: dimensions of the state and of the action.
        max_action: largest absolute value of an action component, in its physical unit.
        safe_set, unsafe_set, state_space: labelled sets and the set of all states, in state units.
        exit_region: region label of a state outside the state space.
        initial_set: where episodes start; None: the state space.
        batch_size: one entry ``[n]``, or ``[]`` for a single system.
        image_size: height and width H = W of the frames.
        horizon: steps after which an episode is truncated; None: never.
        device, seed: device and seed of the environment's own random generator.

    Raises ConfigError for a parameter that is not valid, OverlapError if the safe and the unsafe set share states.
    Source: paper Section II; deviation: none.
    """

    _supports_set_state = True

    def __init__(
        self,
        *,
        state_dim: int,
        action_dim: int,
        max_action: float,
        safe_set: Region,
        unsafe_set: Region,
        state_space: Region,
        exit_region: int = UNSAFE,
        initial_set: Region | None = None,
        batch_size: Sequence[int] = (1,),
        image_size: int = 64,
        horizon: int | None = None,
        device: torch.device | str | None = None,
        seed: int | None = None,
    ) -> None:
        try:
            size = torch.Size([batch_size] if isinstance(batch_size, int) else batch_size)
        except TypeError:
            size = torch.Size([0])
        if len(size) > 1 or any(n < 1 for n in size):
            raise ConfigError(f"batch_size: expected [n] with n >= 1, or [], received {batch_size!r}.")
        batch_size = size
        if seed is not None and not isinstance(seed, int):
            raise ConfigError(f"seed: expected an integer or None, received {seed!r}.")
        if not isinstance(image_size, int) or image_size < 1:
            raise ConfigError(f"image_size: expected an integer >= 1, received {image_size!r}.")
        if horizon is not None and (not isinstance(horizon, int) or horizon < 1):
            raise ConfigError(f"horizon: expected an integer >= 1 or None, received {horizon!r}.")
        check_positive(max_action=max_action)
        super().__init__(device=usable_device(device or "cpu"), batch_size=batch_size)
        self.state_dim, self.action_dim, self.max_action = state_dim, action_dim, float(max_action)
        self.safe_set, self.unsafe_set, self.state_space = safe_set, unsafe_set, state_space
        check_disjoint(safe_set, unsafe_set)
        self.exit_region, self.among = exit_region, ""
        self.initial_set = state_space if initial_set is None else initial_set
        self.image_size, self.horizon = image_size, horizon
        set_specs(self, image_size, state_dim, self.action_high)
        self._generator = torch.Generator(device=self.device)
        if seed is None:
            self._generator.seed()
        else:
            self.set_seed(seed)
        n = batch_size.numel()
        self._state = torch.zeros(n, state_dim, device=self.device)
        self._frame = torch.zeros(n, 3, image_size, image_size, dtype=torch.uint8, device=self.device)
        self._steps = torch.zeros(n, dtype=torch.int64, device=self.device)

    @abstractmethod
    def dynamics(self, state: Tensor, action: Tensor) -> Tensor:
        """Next state ``(*batch, state_dim)``, not wrapped; actions beyond the bounds are clamped to them."""

    @abstractmethod
    def wrap(self, state: Tensor) -> Tensor:
        """State with its periodic coordinates in [-pi, pi)."""

    @abstractmethod
    def previous_state(self, state: Tensor) -> Tensor:
        """State one step earlier, as far as the frame of that step depends on it."""

    @abstractmethod
    def draw(self, state: Tensor) -> Tensor:
        """One RGB frame per state, uint8 ``(n, 3, H, W)``."""

    @property
    def system(self) -> System:
        """Names and units of state and action, requirements, sizes of grids; by default without any of them."""
        names = tuple(f"x{k}" for k in range(self.state_dim))
        return System(f"{type(self).__name__.removesuffix('Env')} from pixels", names, "action")

    def renderers(self) -> dict[str, Callable[[Tensor], Tensor]]:
        """More renderers by name, ``(n, state_dim)`` -> uint8 ``(n, 3, H, W)``; agents are evaluated on them too."""
        return {}

    def portrait(self, state: Tensor) -> Tensor:
        """Pictures for people, larger than those of ``draw``: uint8 ``(n, 3, h, w)``; by default those of ``draw``."""
        return self.draw(state)

    def known_twin(self) -> SafetyEnv:
        """System of the same kind whose true kernel is computed, against which its agents are evaluated."""
        return self

    def physics(self) -> Callable[[], gymnasium.Env] | None:
        """Maker of the same system in full physics, with the same regions and actions; None where there is none."""
        return None

    def observe(self, state: Tensor, previous_state: Tensor | None = None) -> Tensor:
        """Two stacked frames of given states: uint8 ``(n, 6, H, W)``, frame t-1 (RGB), then frame t (RGB).

        Args:
            state: ``(n, state_dim)``, floating point, in physical units.
            previous_state: as ``state``, one step earlier; None: what ``previous_state(state)`` reconstructs.

        Raises ShapeError, DTypeError or NonFiniteError for other tensors. Source: paper Section V; deviation: none.
        """
        check_tensor("state", state, self.state_dim)
        if previous_state is None:
            previous_state = self.previous_state(state)
        else:
            check_tensor("previous_state", previous_state, self.state_dim)
            if previous_state.shape != state.shape:
                raise ShapeError(
                    f"previous_state: expected the shape of state {tuple(state.shape)}, "
                    f"received {tuple(previous_state.shape)}."
                )
        return torch.cat([self.draw(previous_state), self.draw(state)], dim=-3)

    def region(self, state: Tensor) -> Tensor:
        """Region label int64 ``(*batch, 1)`` of states ``(*batch, state_dim)``; see ``exit_region``."""
        check_tensor("state", state, self.state_dim)
        codes = label(state, self.safe_set, self.unsafe_set)
        outside = ~self.state_space.contains(state)
        return torch.where(outside.unsqueeze(-1), torch.full_like(codes, self.exit_region), codes)

    def sample_states(
        self, n: int, generator: torch.Generator | None = None, *, region: Region | None = None
    ) -> Tensor:
        """States ``(n, state_dim)``, as a region samples them (``initial_set``), uniformly but for unions and mixtures, by a generator (the environment's)."""
        chosen = self.initial_set if region is None else region
        generator = generator or self._generator
        return chosen.sample(n, generator=generator, device=generator.device).to(self.device)

    @property
    def action_low(self) -> Tensor:
        """Smallest action ``(action_dim,)``."""
        return torch.full((self.action_dim,), -self.max_action, device=self.device)

    @property
    def action_high(self) -> Tensor:
        """Largest action ``(action_dim,)``."""
        return torch.full((self.action_dim,), self.max_action, device=self.device)

    def to(self, device: torch.device | str) -> SafetyEnv:
        """The environment itself, moved to a device with its systems as they are; from there on resets are of another random stream.

        A system of your own that keeps tensors moves them here too, or draws from ``cached_property``, which are made anew.
        Raises ConfigError for a device that is not there.
        """
        before = self.device
        super().to(usable_device(device))
        if self.device == before:
            return self
        seed = int(torch.randint(2**62, (), generator=self._generator, device=before))
        self._generator = torch.Generator(device=self.device).manual_seed(seed)
        self._state, self._frame, self._steps = (x.to(self.device) for x in (self._state, self._frame, self._steps))
        for kind in type(self).__mro__:
            for name in [n for n, value in vars(kind).items() if isinstance(value, functools.cached_property)]:
                self.__dict__.pop(name, None)
        return self

    def clamp_action(self, action: Tensor) -> Tensor:
        """Check an action ``(*batch, action_dim)`` and clamp it to the bounds."""
        check_tensor("action", action, self.action_dim)
        return action.clamp(-self.max_action, self.max_action)

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            self._generator.seed()
        else:
            self._generator.manual_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None, *, set_state: bool = False, **_: Any) -> TensorDictBase:
        n = self._state.shape[0]
        rows = torch.arange(n, device=self.device)
        if tensordict is not None and "_reset" in tensordict:
            rows = rows[tensordict["_reset"].reshape(n)]
        if set_state:
            if tensordict is None or "state" not in tensordict:
                raise ConfigError("reset(set_state=True): expected key 'state' in the tensordict, found none.")
            given = tensordict["state"].to(self.device, torch.float32)
            check_tensor("state", given, self.state_dim)
            state = self.wrap(given.reshape(n, self.state_dim)[rows])
        else:
            state = self.wrap(self.sample_states(rows.shape[0]).to(torch.float32))
        previous = self._frame.clone()
        pixels = self.observe(state)
        self._state[rows] = state
        self._frame[rows] = pixels[:, 3:]
        self._steps[rows] = 0
        previous[rows] = pixels[:, :3]
        return _output(self, previous)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].reshape(-1, self.action_dim).to(torch.float32)  # as the state, whatever computes actions
        self._state = self.wrap(self.dynamics(self._state, action))
        previous, self._frame = self._frame, self.draw(self._state)
        self._steps = self._steps + 1
        out = _output(self, previous)
        shape = (*self.batch_size, 1)
        terminated = ~self.state_space.contains(self._state).reshape(shape)
        truncated = torch.zeros_like(terminated)
        if self.horizon is not None:
            truncated = (self._steps >= self.horizon).reshape(shape)
        out["reward"] = -(out["region"] == UNSAFE).float()
        out["terminated"], out["truncated"], out["done"] = terminated, truncated, terminated | truncated
        return out


def _output(env: SafetyEnv, previous_frame: Tensor) -> TensorDict:
    """What a step or a reset shows."""
    shape, size = env.batch_size, env.image_size
    return TensorDict(
        {
            "pixels": torch.cat([previous_frame, env._frame], dim=1).reshape(*shape, 6, size, size),
            "state": env._state.clone().reshape(*shape, env.state_dim),
            "region": env.region(env._state).reshape(*shape, 1),
        },
        batch_size=shape,
        device=env.device,
    )
