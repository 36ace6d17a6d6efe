"""The inverted pendulum of the paper's first case study, seen through gymnasium's picture of it."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchrl_sspl.envs.base import SafetyEnv, check_positive, check_tensor, wrapped
from torchrl_sspl.envs.rendering import GymnasiumRenderer, PendulumRenderer
from torchrl_sspl.envs.system import Opening, Requirement, System
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.sets import Box, Region

_INTEGRATORS = ("semi_implicit", "explicit")
SYSTEM = System(
    title="Inverted pendulum from pixels",
    state_names=("angle [rad]", "angular velocity [rad/s]"),
    action_name="torque [N m]",
    action_direction=(0.0, 1.0),
    openings=(
        Opening("From the border of the safe set", (0.9, -0.9)),
        Opening("Pushed over with 10 N m", (0.1, 0.0), lambda: lambda state: 10.0 * torch.sign(state[:, :1] + 0.3 * state[:, 1:])),
        Opening("From the unsafe set, hanging", (math.pi - 0.3, 0.0)),
    ),
    requirements=(
        Requirement("unsafe_called_safe", "grid of U with B <= 0", "<=", 0.0, 0.0),
        Requirement("safe_called_unsafe", "S with B > 0", "<=", 0.0, 0.0),
        Requirement("volume_over_kernel", "volume of {B <= 0} over the true kernel", ">=", 0.5, 0.9),
        Requirement("false_safe", "{B <= 0} outside the true kernel", "<=", 0.01, 0.0),
        Requirement("safe_rollouts_touch_unsafe", "episodes from {B <= 0} that touch U", "<=", 0.0, 0.0),
        Requirement("safe_rollouts_leave", "episodes from {B <= 0} that leave it", "<=", 0.001, 0.0),
        Requirement("unsafe_rollouts_return", "recoverable starts in U that come back", ">=", 0.95, 1.0),
        Requirement("lipschitz_ratio", "sampled over certified Lipschitz constant", ">=", 0.5, 0.95),
    ),
)


class PixelPendulumEnv(SafetyEnv):
    r"""Batched torque-driven pendulum with two stacked RGB frames as observation.

    With the angle theta (0 upright, positive counter-clockwise) and the torque u, one step is

        thetadot' = thetadot + (g / l sin theta + u / (m l^2)) dt
        theta'    = theta + thetadot' dt        (``integrator="semi_implicit"``, as gymnasium integrates)
        theta'    = theta + thetadot dt         (``integrator="explicit"``, the paper's formula)

    With the semi-implicit step, theta_t - theta_{t-1} = thetadot_t dt: two frames determine the state. With
    the explicit one the two frames show thetadot_{t-1}; thetadot_t then differs by the unseen torque of the
    last step, +- max_torque dt / (m l^2) = +- 0.5 rad/s for the defaults, whatever the encoder.

    Regions, in (rad, rad/s): X = [-pi, pi] x [-3.5, 3.5] (theta is an angle: -pi and pi are the same
    state), S = [-pi/12, pi/12] x [-0.25, 0.25], U = X without [-pi/2, pi/2] x [-1.5, 1.5]. A state whose
    speed leaves X ends the episode and counts as unsafe. Output keys: see ``SafetyEnv``.

    Args:
        batch_size: ``[n]`` pendulums, or ``[]`` for one.
        image_size: height and width of the frames.
        integrator: ``"semi_implicit"`` or ``"explicit"``.
        max_torque: bound of ``|u|`` in N m.
        mass, length, gravity: in kg, m, m/s^2.
        dt: time step in s.
        horizon: steps after which an episode is truncated; None: never.
        snap: draw with gymnasium's whole-pixel corners, else continuously in the angle; see ``PendulumRenderer``.
        safe_set, unsafe_set, state_space: in place of S, U, X.
        initial_set: where episodes start; None: all of X.
        device, seed: device, and seed of the environment's own random generator.

    Raises ConfigError for an unknown integrator or a parameter that is not positive; OverlapError if the safe and the
    unsafe set share states. Source: paper, Section V-A. Deviation: the semi-implicit step is the default (see above).

    Example:
        >>> env = PixelPendulumEnv(batch_size=[2], seed=0)
        >>> env.dynamics(torch.tensor([[0.0, 1.0]]), torch.tensor([[10.0]]))
        tensor([[0.0750, 1.5000]])
        >>> rollout = env.rollout(3, break_when_any_done=False)
        >>> rollout["pixels"].shape, rollout["pixels"].dtype
        (torch.Size([2, 3, 6, 64, 64]), torch.uint8)
    """

    def __init__(
        self,
        batch_size: Sequence[int] = (1,),
        image_size: int = 64,
        integrator: str = "semi_implicit",
        max_torque: float = 10.0,
        *,
        mass: float = 1.0,
        length: float = 1.0,
        gravity: float = 10.0,
        dt: float = 0.05,
        horizon: int | None = None,
        snap: bool = True,
        safe_set: Region | None = None,
        unsafe_set: Region | None = None,
        state_space: Region | None = None,
        initial_set: Region | None = None,
        device: torch.device | str | None = None,
        seed: int | None = None,
    ) -> None:
        if integrator not in _INTEGRATORS:
            raise ConfigError(f"integrator: expected one of {list(_INTEGRATORS)}, received {integrator!r}.")
        check_positive(max_torque=max_torque, mass=mass, length=length, gravity=gravity, dt=dt)
        turn = [2 * math.pi, 0.0]
        if state_space is None:
            state_space = Box([-math.pi, -3.5], [math.pi, 3.5], period=turn)
        if safe_set is None:
            safe_set = Box([-math.pi / 12, -0.25], [math.pi / 12, 0.25], period=turn)
        if unsafe_set is None:
            unsafe_set = state_space - Box([-math.pi / 2, -1.5], [math.pi / 2, 1.5], period=turn)
        super().__init__(
            state_dim=2, action_dim=1, max_action=max_torque,
            safe_set=safe_set, unsafe_set=unsafe_set, state_space=state_space, initial_set=initial_set,
            batch_size=batch_size, image_size=image_size, horizon=horizon, device=device, seed=seed,
        )  # fmt: skip
        self.integrator, self.max_torque = integrator, float(max_torque)
        self.mass, self.length, self.gravity, self.dt = mass, length, gravity, dt
        self._snap = snap
        _ = self._renderer  # a size that is not valid is named at once

    @functools.cached_property
    def _renderer(self) -> PendulumRenderer:
        return PendulumRenderer(self.image_size, snap=self._snap, device=self.device)

    def dynamics(self, state: Tensor, action: Tensor) -> Tensor:
        """Next state ``(*batch, 2)`` (rad, rad/s) by the formula in the class docstring; the angle is not wrapped.

        The torque ``(*batch, 1)`` in N m is clamped to ``max_torque``, as gymnasium does. Source: paper, Section V-A
        (explicit); deviation: the semi-implicit default.
        """
        check_tensor("state", state, 2)
        action = self.clamp_action(action)
        angle, speed = state[..., :1], state[..., 1:]
        inertia = self.mass * self.length**2
        new_speed = speed + (self.gravity / self.length * angle.sin() + action / inertia) * self.dt
        moved_by = new_speed if self.integrator == "semi_implicit" else speed
        return torch.cat([angle + moved_by * self.dt, new_speed], dim=-1)

    def wrap(self, state: Tensor) -> Tensor:
        """State with its angle in [-pi, pi), ``(*batch, 2) -> (*batch, 2)``."""
        angle = wrapped(state[..., :1])
        return torch.cat([angle, state[..., 1:]], dim=-1)

    def previous_state(self, state: Tensor) -> Tensor:
        """State one step earlier under zero torque, ``(*batch, 2) -> (*batch, 2)``.

        For the semi-implicit step its angle is exact for every torque: theta - thetadot dt. For the explicit step it is
        one of the angles that the unseen torque allows, a range of +- max_torque dt^2 / (m l^2).
        """
        check_tensor("state", state, 2)
        angle, speed = state[..., :1], state[..., 1:]
        pull = self.gravity / self.length * self.dt
        if self.integrator == "semi_implicit":
            before = angle - speed * self.dt
            return torch.cat([before, speed - pull * before.sin()], dim=-1)
        before = angle
        for _ in range(8):  # fixed point of theta_t - (thetadot_t - pull sin theta) dt, a contraction
            before = angle - (speed - pull * before.sin()) * self.dt
        return torch.cat([before, speed - pull * before.sin()], dim=-1)

    def draw(self, state: Tensor) -> Tensor:
        """RGB frames of states, ``(*batch, 2) -> uint8 (*batch, 3, H, W)``."""
        return self._renderer(state[..., 0])

    def portrait(self, state: Tensor) -> Tensor:
        """Pictures for people: the same pendulum, large."""
        return _large_renderer()(state[..., 0].cpu())[..., 100:-100, 100:-100]

    @property
    def system(self) -> System:
        """Angle, angular velocity, torque, and what an agent has to reach."""
        return SYSTEM

    def renderers(self) -> dict[str, Callable[[Tensor], Tensor]]:
        """Gymnasium's own Pendulum-v1 pictures, see ``GymnasiumRenderer``; MissingDependencyError without pygame."""
        return {"gymnasium": lambda state: _gymnasium_renderer(self.image_size)(state[..., 0])}


@functools.lru_cache(maxsize=1)
def _large_renderer() -> PendulumRenderer:
    """One renderer for people, made when it is first asked for."""
    return PendulumRenderer(500, snap=False)


@functools.lru_cache(maxsize=4)
def _gymnasium_renderer(image_size: int) -> GymnasiumRenderer:
    """One table of gymnasium's pictures per frame size, shared by all environments of the process."""
    return GymnasiumRenderer(image_size)


PendulumEnv = PixelPendulumEnv
"""The same; TorchRL has a PendulumEnv of its own."""
