"""The walking robot of the paper's second case study as a Dubins car, seen from above."""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import torch
from torch import Tensor

from torchrl_sspl.envs.base import SafetyEnv, check_positive, check_tensor, numbers, wrapped
from torchrl_sspl.envs.quadruped.arena import check_arena, half_view
from torchrl_sspl.envs.quadruped.compositor import TopViewCompositor
from torchrl_sspl.envs.system import Opening, Requirement, System
from torchrl_sspl.errors import ConfigError, MissingDependencyError
from torchrl_sspl.sets import SAFE, Box, Region

YAW_LAG = (0.048, 0.063)
"""Turn of the walking robot in one step per yaw rate commanded now and one step before, in s."""
_REQUIREMENTS = (
    Requirement("walks_from_safe_hit", "walks from S that hit the obstacle or enter U", "<=", 0.0, 0.0),
    Requirement("walks_from_safe_fall", "walks from S that fall", "<=", 0.0, 0.0),
    Requirement("walks_from_set_enter", "walks from {B <= 0} that enter U", "<=", 0.01, 0.0),
    Requirement("safe_rollouts_touch_unsafe", "Dubins episodes from {B <= 0} that enter U", "<=", 0.001, 0.0),
    Requirement("volume_over_kernel", "volume of {B <= 0} over the true kernel", ">=", 0.7, 0.95),
    Requirement("false_safe_of_doomed", "doomed states outside U with B <= 0", "<=", 0.2, 0.01),
    Requirement("unsafe_called_safe", "grid of U with B <= 0", "<=", 0.0, 0.0),
    Requirement("training_minutes", "training time [min]", "<=", 60.0, 25.0),
    Requirement("latency_p99", "policy latency per frame, 99th percentile [ms]", "<=", 10.0, 5.0),
)
_LATE = (
    "Training and certificate are about a Dubins car that turns with the delay of the walking robot; the true kernel and the "
    "Dubins episodes in the table are those of a car that turns at once."
)
_PHYSICS = (
    "The walks measure what the robot does in full physics. There, position and heading alone do not determine the next step; "
    "the delay counts as an error that the set has to tolerate."
)


class Disc(Region):
    r"""States whose first two coordinates lie in a disc, :math:`\|(x, y) - c\| \le r`.

    Centre and radius are in m; ``rest`` are the values of the other coordinates when states are drawn, on which
    membership does not depend; None: the states are (x, y). Source: none.

    Example:
        >>> Disc([0.0, 0.0], 1.0).contains(torch.tensor([[0.6, 0.6], [0.8, 0.8]]))
        tensor([ True, False])
    """

    def __init__(self, centre: Sequence[float], radius: float, rest: Box | None = None) -> None:
        check_positive(radius=radius)
        self.centre, self.radius, self.rest = torch.tensor([float(v) for v in centre]), float(radius), rest
        self.dim = 2 if rest is None else 2 + rest.dim
        # Corners of the box around it.
        low, high = (torch.zeros(0), torch.zeros(0)) if rest is None else (rest.low, rest.high)
        self.low = torch.cat([self.centre - self.radius, low])
        self.high = torch.cat([self.centre + self.radius, high])

    def outside(self, state: Tensor) -> Tensor:
        """Distance in m to the disc, negative inside, ``(*batch, dim) -> (*batch,)``."""
        return (state[..., :2] - self.centre.to(state)).norm(dim=-1) - self.radius

    def contains(self, state: Tensor) -> Tensor:
        """Whether states belong to the set; arguments as for ``Region.contains``."""
        check_tensor("state", state, self.dim)
        return self.outside(state) <= 0

    def sample(
        self, n: int, generator: torch.Generator | None = None, device: torch.device | str | None = None
    ) -> Tensor:
        """Uniform states of the set; arguments as for ``Region.sample``."""
        u = torch.rand(n, 2, generator=generator, device=device)
        angle, distance = 2 * math.pi * u[:, :1], self.radius * u[:, 1:].sqrt()
        place = self.centre.to(u) + distance * torch.cat([angle.cos(), angle.sin()], -1)
        return place if self.rest is None else torch.cat([place, self.rest.sample(n, generator, device)], -1)


class ThereAndBack:
    """Heads straight for goals in turn, whatever stands between them: states ``(1, s)`` -> yaw rates ``(1, 1)`` in rad/s.

    Args:
        goals: places (x, y) in m.
        max_yaw_rate: in rad/s.
        near: m, from where a goal is reached.

    Source: none.

    Example:
        >>> ThereAndBack([(1.0, 0.0), (-1.0, 0.0)], 2.0)(torch.tensor([[0.0, 0.0, 0.0]]))
        tensor([[0.]])
    """

    def __init__(self, goals: Sequence[Sequence[float]], max_yaw_rate: float, near: float = 0.45) -> None:
        self.goals, self.max_yaw_rate, self.near, self._turn = torch.tensor(goals), max_yaw_rate, near, 0

    def __call__(self, state: Tensor) -> Tensor:
        """Yaw rate towards the present goal."""
        if float((state[0, :2] - self.goals[self._turn]).norm()) < self.near:
            self._turn = (self._turn + 1) % len(self.goals)
        x, y = self.goals[self._turn] - state[0, :2]
        off = math.remainder(float(torch.atan2(y, x) - state[0, 2]), 2 * math.pi)
        return torch.tensor([[3.0 * off]]).clamp(-self.max_yaw_rate, self.max_yaw_rate)


class DubinsEnv(SafetyEnv):
    r"""Batched robots that walk at constant speed past an obstacle, with two stacked top views as observation.

    With position (x, y), heading theta and the commanded yaw rate u, one step is

        x' = x + v cos(theta) dt,    y' = y + v sin(theta) dt,    theta' = theta + u dt

    Regions, in (m, m, rad), for the default sizes: X = [-2, 2]^2 x [-pi, pi], U = [-0.7, 0.7]^2 x [-pi, pi],
    S = X without (-1.5, 1.5)^2 x [-pi, pi]. A robot that leaves X ends the episode and counts as safe: at constant
    speed it has to leave. What stands on the ground is smaller than U, because the feet reach farther than the
    middle of the robot. Output keys: see ``SafetyEnv``.

    The walking robot turns later than it is told to. With ``yaw_lag=(a, b)`` the heading follows

        theta' = theta + a u_t + b u_{t-1}

    and (x, y, theta) alone does not determine what comes next: the state is then (x, y, theta, u_{t-1}), of
    dimension 4. Two frames show the turn of the last step, a mixture of the last two commands; they do not
    determine u_{t-1}.

    The pictures show a robot at some phase of its gait. The phase is not part of the state: it is a fixed,
    irregular function of the state that takes all values, so that whoever learns from the frames has to disregard it
    and the same state always gives the same frame.

    Args:
        batch_size: ``[n]`` robots, or ``[]`` for one.
        max_yaw_rate: bound of ``|u|`` in rad/s.
        speed: v in m/s.
        dt: time step in s.
        image_size: height and width of the frames.
        arena_half_size, safe_half_size, unsafe_half_size: in m; X is a square around the origin, S lies outside and U
            inside a square (U: a disc for ``obstacle_shape="disc"``) around the obstacle.
        obstacle_shape: ``"square"`` or ``"disc"``.
        obstacle_half_size: half of the edge, or the radius, of what stands on the ground, in m.
        obstacle_centre: (x, y) of the obstacle in m.
        yaw_lag: (a, b) in s, see above; ``YAW_LAG`` is what was measured on the walking robot. None: a = dt, b = 0.
        horizon: steps after which an episode is truncated; None: never.
        initial_set: where episodes start; None: all of X.
        device, seed: device, and seed of the environment's own random generator.

    Raises ConfigError for an unknown shape, a size or rate that is not positive, or sizes that are not in order.
    Source: paper, Section IV-B. Deviation: leaving the arena is defined (the paper's formula has no answer); the
    optional yaw lag.

    Example:
        >>> env = DubinsEnv(batch_size=[2], max_yaw_rate=2.0, seed=0)
        >>> env.dynamics(torch.tensor([[1.0, 1.0, 0.0]]), torch.tensor([[2.0]]))
        tensor([[1.1000, 1.0000, 0.2000]])
        >>> env.observe(torch.tensor([[1.0, 1.0, 0.0]])).shape
        torch.Size([1, 6, 128, 128])
    """

    def __init__(
        self,
        batch_size: Sequence[int] = (1,),
        max_yaw_rate: float = 2.0,
        *,
        speed: float = 1.0,
        dt: float = 0.1,
        image_size: int = 128,
        arena_half_size: float = 2.0,
        safe_half_size: float = 1.5,
        unsafe_half_size: float = 0.7,
        obstacle_shape: str = "square",
        obstacle_half_size: float = 0.3,
        obstacle_centre: Sequence[float] = (0.0, 0.0),
        yaw_lag: Sequence[float] | None = None,
        horizon: int | None = None,
        initial_set: Region | None = None,
        device: torch.device | str | None = None,
        seed: int | None = None,
    ) -> None:
        check_positive(max_yaw_rate=max_yaw_rate, speed=speed, dt=dt)
        centre = check_arena(
            arena_half_size=arena_half_size, safe_half_size=safe_half_size, unsafe_half_size=unsafe_half_size,
            obstacle_shape=obstacle_shape, obstacle_half_size=obstacle_half_size, obstacle_centre=obstacle_centre,
        )  # fmt: skip
        if yaw_lag is not None and (len(lag := numbers(yaw_lag)) != 2 or not all(map(math.isfinite, lag))):
            raise ConfigError(f"yaw_lag: expected two finite numbers (a, b) in s or None, received {yaw_lag!r}.")
        turn = 2 * math.pi
        # Coordinates other than the position: heading, and with a lag the last command.
        low, high, period = [-math.pi], [math.pi], [turn]
        if yaw_lag is not None:
            low, high, period = [*low, -max_yaw_rate], [*high, max_yaw_rate], [*period, 0.0]

        def square(half: float, middle: Sequence[float]) -> Box:
            x, y = middle
            return Box([x - half, y - half, *low], [x + half, y + half, *high], period=[0.0, 0.0, *period])

        space = square(arena_half_size, (0.0, 0.0))
        unsafe, obstacle = self._obstacle(obstacle_shape, centre, unsafe_half_size, obstacle_half_size, square)
        super().__init__(
            state_dim=len(low) + 2, action_dim=1, max_action=max_yaw_rate,
            safe_set=space - square(safe_half_size, centre), unsafe_set=unsafe, state_space=space,
            exit_region=SAFE, initial_set=initial_set,
            batch_size=batch_size, image_size=image_size, horizon=horizon, device=device, seed=seed,
        )  # fmt: skip
        self.max_yaw_rate, self.speed, self.dt = float(max_yaw_rate), float(speed), float(dt)
        self.yaw_lag = None if yaw_lag is None else (float(yaw_lag[0]), float(yaw_lag[1]))
        self.among = "" if yaw_lag is None else "of robots that were walking straight ahead before"
        self.obstacle_shape, self.obstacle_half_size = obstacle_shape, float(obstacle_half_size)
        self.obstacle_centre, self.arena_half_size = centre, float(arena_half_size)
        self.safe_half_size, self.unsafe_half_size = float(safe_half_size), float(unsafe_half_size)
        self.obstacle = obstacle  # what stands on the ground, a set of (x, y)
        self.half_view = half_view(self.arena_half_size)
        _ = self._compositor  # a size that is not valid is named at once

    @functools.cached_property
    def _compositor(self) -> TopViewCompositor:
        return TopViewCompositor(self.image_size, obstacle=self.obstacle, half_view=self.half_view, device=self.device)

    @property
    def system(self) -> System:
        """Place, heading, yaw rate, and what an agent has to reach; with a yaw lag the last command too."""
        late = self.yaw_lag is not None
        return System(
            title="Quadruped: an obstacle, from pixels",
            state_names=("x [m]", "y [m]", "heading [rad]", *(("last yaw rate [rad/s]",) if late else ())),
            action_name="yaw rate [rad/s]",
            requirements=_REQUIREMENTS,
            state_grid=(61, 61, 37, *((5,) if late else ())),
            kernel_grid=(101, 101, 72, *((9,) if late else ())),
            unsafe_grid=(61, 61, 36, *((5,) if late else ())),
            notes=(f"{_LATE} {_PHYSICS}" if late else _PHYSICS,),
            openings=self._openings() if not late else (),
        )

    def _openings(self) -> tuple[Opening, ...]:
        """Corner to corner, past the obstacle, from just inside the set, and there and back: each heads for goals that it hides."""
        (x, y), unsafe, half = self.obstacle_centre, self.unsafe_half_size, self.arena_half_size
        start, far, corner = x - 0.9 * half, 0.7 * half, 0.65 * half

        def between(*goals: tuple[float, float]) -> Callable[[], ThereAndBack]:
            return lambda: ThereAndBack([(x + a, y + b) for a, b in goals], self.max_yaw_rate)

        return (
            Opening(
                "Head on, from corner to corner", (x - 0.8 * half, y - 0.8 * half, math.pi / 4),
                between((corner, corner), (-corner, -corner)),
            ),
            Opening(
                "Grazing the unsafe set", (start, y + 0.85 * unsafe, 0.0),
                between((far, 0.85 * unsafe), (-far, 0.85 * unsafe)),
            ),
            Opening(
                "From the border of the safe set", (x - 0.69 * half, y - 0.93 * unsafe, 0.0),
                between((far, -0.93 * unsafe), (-far, -0.93 * unsafe)),
            ),
            Opening("A goal behind the obstacle, and back", (start, y, 0.0), between((far, 0.0), (-far, 0.0))),
        )  # fmt: skip

    def known_twin(self) -> DubinsEnv:
        """The same car without a yaw lag: its true kernel has three dimensions."""
        if self.yaw_lag is None:
            return self
        return DubinsEnv(self.batch_size, horizon=self.horizon, device=self.device, seed=0, **self._geometry())

    def physics(self) -> Callable[[], gymnasium.Env] | None:
        """Maker of the walking robot (paper, Section IV-B) with the same obstacle, regions, speed and actions; takes its other options.

        Raises MissingDependencyError without the simulator.
        """
        try:
            importlib.import_module("pybullet")
            from torchrl_sspl.envs.quadruped.env import QuadrupedEnv
        except ImportError as error:
            raise MissingDependencyError(
                f"full physics: expected the simulator, received {error}; pip install 'torchrl-sspl[quadruped]'."
            ) from error
        return functools.partial(QuadrupedEnv, **self._geometry())

    def _geometry(self) -> dict[str, Any]:
        """What this car, its twin and the robot in full physics have in common, as keyword arguments of theirs."""
        names = (
            "max_yaw_rate", "speed", "dt", "image_size", "arena_half_size", "safe_half_size", "unsafe_half_size",
            "obstacle_shape", "obstacle_half_size", "obstacle_centre",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names}

    @staticmethod
    def _obstacle(shape, centre, unsafe_half_size, half_size, square) -> tuple[Region, Region]:
        """The unsafe set in state space, and what stands on the ground in the plane."""
        box = square(unsafe_half_size, centre)
        x, y = centre
        if shape == "disc":
            rest = Box(box.low[2:], box.high[2:], period=box.period[2:].tolist())
            return Disc(centre, unsafe_half_size, rest), Disc(centre, half_size)
        return box, Box([x - half_size, y - half_size], [x + half_size, y + half_size])

    def dynamics(self, state: Tensor, action: Tensor) -> Tensor:
        """Next state ``(*batch, state_dim)`` by the formula in the class docstring; the heading is not wrapped.

        The yaw rate ``(*batch, 1)`` in rad/s is clamped to ``max_yaw_rate``. Source: paper, Section IV-B; deviation:
        the optional yaw lag.
        """
        check_tensor("state", state, self.state_dim)
        action = self.clamp_action(action)
        heading, step = state[..., 2:3], self.speed * self.dt
        moved = state[..., :2] + step * torch.cat([heading.cos(), heading.sin()], -1)
        if self.yaw_lag is None:
            return torch.cat([moved, heading + self.dt * action], -1)
        now, before = self.yaw_lag
        return torch.cat([moved, heading + now * action + before * state[..., 3:], action.expand_as(heading)], -1)

    def wrap(self, state: Tensor) -> Tensor:
        """State with its heading in [-pi, pi), same shape."""
        heading = wrapped(state[..., 2:3])
        return torch.cat([state[..., :2], heading, state[..., 3:]], -1)

    def previous_state(self, state: Tensor) -> Tensor:
        """State one step earlier of a robot that was walking straight ahead, same shape.

        The yaw rate of the last step cannot be told from the state: it moves the previous frame by at most
        ``v dt`` times the turn of one step, 2 cm for the default sizes.
        """
        check_tensor("state", state, self.state_dim)
        heading, step = state[..., 2:3], self.speed * self.dt
        before = state[..., :2] - step * torch.cat([heading.cos(), heading.sin()], -1)
        return torch.cat([before, heading, torch.zeros_like(state[..., 3:])], -1)

    def sample_states(
        self, n: int, generator: torch.Generator | None = None, *, region: Region | None = None
    ) -> Tensor:
        """States as in ``SafetyEnv``; with a yaw lag of robots that were walking straight ahead, as ``previous_state``
        shows them."""
        states = super().sample_states(n, generator, region=region)
        if self.yaw_lag is not None:
            states[..., 3] = 0.0
        return states

    def gait_phase(self, state: Tensor) -> Tensor:
        """Phase of the gait in which a state is drawn, ``(*batch, state_dim) -> (*batch,)`` in [0, 1)."""
        mixed = 43.7585 * state[..., 0] + 78.233 * state[..., 1] + 27.619 * state[..., 2].sin()
        return mixed.remainder(1.0)

    def draw(self, state: Tensor) -> Tensor:
        """RGB frames of states, ``(*batch, state_dim) -> uint8 (*batch, 3, H, W)``."""
        return self._compositor(state[..., :3], self.gait_phase(state))
