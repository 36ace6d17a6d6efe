r"""What perfect perception would reach: model-based filters that read the true state and know the dynamics exactly.

They need no pictures. With ``noise`` they read the state with an error, fresh at every step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.linalg import solve_discrete_are
from torch import Tensor

from torchrl_sspl.baselines.base import Budget, Needs, OneStepFilter
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.envs.pendulum import PixelPendulumEnv
from torchrl_sspl.errors import ConfigError, SolverError
from torchrl_sspl.viability.grid import ViabilityKernel, _outside, viability_kernel


@dataclass
class CeilingConfig:
    """Options of a filter on the true state."""

    alpha: float = 0.5  # share of h that a step may leave
    actions: int = 21  # that are tried
    noise: list[float] = field(default_factory=list)  # standard deviation of the error per state coordinate; []: none


class Ceiling(OneStepFilter):
    """A filter with the true state and the true dynamics; a subclass gives ``h`` on states ``(n, s)``."""

    reads, learns = "state", False
    Config: ClassVar[type | None] = CeilingConfig
    system: ClassVar[Any] = SafetyEnv
    claimed: ClassVar[str] = "h <= 0, where h has no room for the bounded action"

    def fit(self, data: Any, env: SafetyEnv, budget: Budget, seed: int) -> None:
        """Nothing is learnt; raises ConfigError if the method does not know such a system."""
        if not isinstance(env, self.system):
            raise ConfigError(f"{self.name}: expected a {self.system.__name__}, received {type(env).__name__}; box_margin and kernel take any system")
        noise = torch.tensor([float(v) for v in self.config.noise] or [0.0] * env.state_dim)
        if len(noise) != env.state_dim or bool((noise < 0).any()) or not 0 <= self.config.alpha < 1 or self.config.actions < 2:
            raise ConfigError(
                f"{self.name}: expected noise of {env.state_dim} numbers >= 0, alpha in [0, 1) and actions >= 2, received "
                f"{self.config.noise}, {self.config.alpha} and {self.config.actions}"
            )
        self.env, self.noise = env, noise
        self.alpha, self.grid = self.config.alpha, self.config.actions
        self._generator = torch.Generator().manual_seed(seed)
        self.needs = Needs(state_at_run_time=True, dynamics="exact", claimed=self.claimed)
        self.prepare()

    def prepare(self) -> None:
        """Whatever is computed once."""

    def perceive(self, seen: Tensor) -> Tensor:
        """The true state, with the error that was asked for."""
        if not bool(self.noise.any()):
            return seen
        return self.env.wrap(seen + self.noise * torch.randn(seen.shape, generator=self._generator))

    def predict(self, state: Tensor, action: Tensor) -> Tensor:
        """One step of the true system."""
        return self.env.wrap(self.env.dynamics(state, action))


class BoxMargin(Ceiling):
    r"""How far the state is from U, largest-component norm, as if it were a barrier: :math:`h(x) = -\operatorname{dist}(x, U)`.

    The first thing that one writes down, and blind to what a bounded action can do. On the car it is the distance to U.
    Source: none.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> method = BoxMargin()
        >>> method.fit(None, PendulumEnv(), Budget("none", 0, 0, 0), 0)
        >>> method.claims(torch.tensor([[0.0, 0.0], [0.0, 2.0]]))
        tensor([ True, False])
    """

    name = "box_margin"

    def h(self, state: Tensor) -> Tensor:
        """Depth in U, negative outside."""
        h = -_outside(self.env.unsafe_set, state)
        return torch.where(self.env.unsafe_set.contains(state), h.clamp_min(1e-6), h)  # the outer border of X is U's, too


@dataclass
class DepthConfig(CeilingConfig):
    """Options of the depth barrier; the defaults are the published constants."""

    margin: float = 0.1  # d, rad
    beta: float = 1.0  # weight of the speed, s


class DepthBarrier(Ceiling):
    r"""NeRF-CBF's barrier of a double integrator, on the pendulum's true angle and speed.

    .. math:: h(x) = \max\bigl(d - (\pi/2 - |\theta|) + \beta |\dot\theta|,\; |\dot\theta| - 1.5\bigr)

    with the clearance of the angle in place of the least depth; the second part, the bound on the speed that U asks for,
    is ours. Source: Tong, Dawson, Fan, ICRA 2023 (arXiv 2209.12266), ``double_cbf.py`` of their code.
    """

    name = "depth"
    system = PixelPendulumEnv
    Config = DepthConfig

    def h(self, state: Tensor) -> Tensor:
        """The formula above."""
        angle, speed = box_of(self.env)
        clearance = angle - state[:, 0].abs()
        return torch.maximum(self.config.margin - clearance + self.config.beta * state[:, 1].abs(), state[:, 1].abs() - speed)


@dataclass
class HigherOrderConfig(CeilingConfig):
    """Options of the second-order barrier."""

    k: float = 1.0  # of psi_1 = psi_0' + k psi_0, 1/s


class HigherOrder(Ceiling):
    r"""Higher-order control barrier function of the pendulum's angle.

    .. math:: \psi_0 = (\pi/2)^2 - \theta^2, \quad \psi_1 = \dot\psi_0 + k \psi_0 = -2 \theta \dot\theta + k \psi_0, \quad
        h = \max(-\psi_0, -\psi_1, |\dot\theta| - 1.5)

    Source: Xiao and Belta, *High-order control barrier functions*, IEEE TAC 2022.
    """

    name = "hocbf"
    system = PixelPendulumEnv
    Config = HigherOrderConfig

    def h(self, state: Tensor) -> Tensor:
        """The formula above."""
        return higher_order(self.env, state, self.config.k)


def box_of(env: PixelPendulumEnv | SafetyEnv) -> tuple[float, float]:
    """Angle in rad and speed in rad/s that bound the pendulum's states outside U. Source: paper Section V-A.

    Example:
        >>> [round(v, 4) for v in box_of(PixelPendulumEnv())]
        [1.5708, 1.5]
    """
    inner = getattr(env.unsafe_set, "b", None)
    if inner is None:
        raise ConfigError(f"expected an unsafe set that is the space without a box, received {type(env.unsafe_set).__name__}")
    return float(inner.high[0]), float(inner.high[1])


def higher_order(env: SafetyEnv, state: Tensor, k: float) -> Tensor:
    """Largest of the three parts of :class:`HigherOrder`, ``(n, 2) -> (n,)``. Source: Xiao and Belta 2022.

    Example:
        >>> higher_order(PixelPendulumEnv(), torch.tensor([[0.0, 1.0]]), 1.0)
        tensor([-0.5000])
    """
    angle, speed = box_of(env)
    psi = angle**2 - state[:, 0].square()
    second = k * psi - 2 * state[:, 0] * state[:, 1]
    return torch.stack([-psi, -second, state[:, 1].abs() - speed]).amax(0)


@dataclass
class LQRConfig(CeilingConfig):
    """Options of the ellipsoid."""

    alpha: float = 0.0
    state_weight: list[float] = field(default_factory=lambda: [1.0, 1.0])  # diagonal of Q
    action_weight: float = 0.01  # R


class LQREllipsoid(Ceiling):
    r"""The largest sublevel set of the LQR cost inside the box that the saturated LQR keeps on the true system.

    .. math:: h(x) = x^\top P x - c, \qquad P = A^\top P A - A^\top P B (R + B^\top P B)^{-1} B^\top P A + Q

    The level c is the largest for which a fine grid of the border stays outside U and is led inwards by
    :math:`u = \operatorname{sat}(-K x)`. Raises SolverError if the Riccati equation has no positive definite solution. Source: textbook.
    """

    name = "lqr"
    system = PixelPendulumEnv
    Config = LQRConfig
    claimed = "invariance, checked on a grid of the border of every level"

    def prepare(self) -> None:
        """Solve for P and K, then find the level."""
        zero, unit = torch.zeros(1, 2, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
        a, b = torch.autograd.functional.jacobian(lambda x, u: self.env.dynamics(x, u)[0], (zero, unit))
        a, b = a[:, 0].numpy(), b[:, 0].numpy()
        q, r = np.diag(self.config.state_weight), np.array([[self.config.action_weight]])
        try:
            p = solve_discrete_are(a, b, q, r)
            np.linalg.cholesky(p)
        except (ValueError, np.linalg.LinAlgError) as error:
            raise SolverError(f"lqr: expected a positive definite solution of the Riccati equation, received {error}; choose other weights") from error
        self.p = torch.from_numpy(p).float()
        self.k = torch.from_numpy(np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)).float()
        self.level = self._level()

    def _level(self) -> float:
        """Largest level of which all smaller ones are kept."""
        turn = torch.linspace(0, 2 * math.pi, 721)[:-1]
        root = torch.linalg.inv(torch.linalg.cholesky(self.p).T)
        circle = torch.stack([turn.cos(), turn.sin()], -1) @ root.T
        best = 0.0
        for radius in torch.linspace(0.005, 4.0, 800):
            x = radius * circle
            after = self.env.dynamics(x, -x @ self.k.T)
            inside = ((after @ self.p) * after).sum(-1) <= radius**2
            if bool(self.env.unsafe_set.contains(x).any()) or not bool(inside.all()):
                break
            best = float(radius) ** 2
        return best

    def h(self, state: Tensor) -> Tensor:
        """The formula above."""
        return ((state @ self.p) * state).sum(-1) - self.level

    @torch.no_grad()
    def act(self, seen: Tensor, nominal: Tensor) -> tuple[Tensor, Tensor]:
        """The nearest action of the grid that keeps the ellipsoid; LQR's own where there is none."""
        action, none = super().act(seen, nominal)
        own = (-self.perceive(seen) @ self.k.T).clamp(-self.env.max_action, self.env.max_action)
        return torch.where(none[:, None], own, action), none & (self.h(seen) > 0)


@dataclass
class ConeConfig(CeilingConfig):
    """Options of the collision cone."""

    radius: float = 0.0  # of the circle around U, m; 0: the circumscribed one


class CollisionCone(Ceiling):
    r"""Collision-cone barrier (C3BF) of a car before a circle around U.

    .. math:: h(x) = -\langle p, v \rangle - \lVert p \rVert \lVert v \rVert \cos\phi, \qquad \cos\phi = \sqrt{\lVert p \rVert^2 - r^2} / \lVert p \rVert

    with p from the car to the middle of the circle and v its velocity relative to the car; at most zero where the car does
    not head into the cone. Source: the collision-cone barriers (C3BF) of Tayal and others, 2023.
    """

    name = "cone"
    system = DubinsEnv
    Config = ConeConfig

    def h(self, state: Tensor) -> Tensor:
        """The formula above; positive within the circle."""
        return collision_cone(self.env, state, self.config.radius)


def collision_cone(env: SafetyEnv, state: Tensor, radius: float = 0.0) -> Tensor:
    """h of :class:`CollisionCone`, ``(n, 3) -> (n,)`` in m^2/s; a radius of 0 is that of the circle around U.

    Source: as there.

    Example:
        >>> heading_at, heading_away = torch.tensor([[-1.5, 0.0, 0.0]]), torch.tensor([[-1.5, 0.0, 3.1]])
        >>> collision_cone(DubinsEnv(), heading_at) > 0, collision_cone(DubinsEnv(), heading_away) > 0
        (tensor([True]), tensor([False]))
    """
    assert isinstance(env, DubinsEnv)
    r = radius or env.unsafe_half_size * (math.sqrt(2) if env.obstacle_shape == "square" else 1.0)
    to = torch.tensor(env.obstacle_centre) - state[:, :2]
    velocity = -env.speed * torch.stack([state[:, 2].cos(), state[:, 2].sin()], -1)
    distance = to.norm(dim=-1)
    gap = (distance.square() - r**2).clamp_min(0).sqrt()
    h = -(to * velocity).sum(-1) - env.speed * gap
    return torch.where(distance > r, h, (r - distance) + h.clamp_min(0) + 1e-6)


class TurningCircle(Ceiling):
    r"""Backup barrier: turning with full rate to one side for ever keeps clear of U.

    .. math:: h(x) = -\max_{u = \pm u_{max}} \min_{t \le T} \operatorname{dist}(f^t(x, u), U)

    over two full turns of the true dynamics. Source: backup control barrier functions, Chen, Jankovic, Santillo, Ames, CDC
    2021.
    """

    name = "turning_circle"
    system = DubinsEnv
    claimed = "invariance: the backup manoeuvre is a periodic one"

    def prepare(self) -> None:
        """Places of two full turns to either side, seen from the car."""
        env: Any = self.env
        x = torch.zeros(2, env.state_dim)
        turn = torch.tensor([[-env.max_action], [env.max_action]])
        places = [x[:, :2]]
        for _ in range(math.ceil(4 * math.pi / (env.max_action * env.dt))):
            x = env.dynamics(x, turn)
            places.append(x[:, :2])
        self.places = torch.stack(places, 1)  # (2, T, 2); the car's motion is the same at every place and heading

    def h(self, state: Tensor) -> Tensor:
        """The formula above."""
        cos, sin = state[:, 2].cos()[:, None, None], state[:, 2].sin()[:, None, None]
        x, y = self.places.unbind(-1)
        centre = self.env.obstacle_centre  # type: ignore[attr-defined]
        dx, dy = (state[:, k, None, None] - centre[k] for k in (0, 1))
        px, py = dx + cos * x - sin * y, dy + sin * x + cos * y
        half = self.env.unsafe_half_size  # type: ignore[attr-defined]
        disc = self.env.obstacle_shape == "disc"  # type: ignore[attr-defined]
        distance = torch.hypot(px, py) - half if disc else torch.maximum(px.abs(), py.abs()) - half
        return -distance.amin(2).amax(1)


@dataclass
class KernelConfig(CeilingConfig):
    """Options of the true kernel."""

    depth: float = 0.5  # share of the largest value below which the value may not fall further
    nodes: int = 0  # per coordinate; 0: the system's own grid


class TrueKernel(Ceiling):
    r"""The viability kernel itself, with value V, and the nearest action that keeps it: nothing can be larger.

    .. math:: h = -V, \qquad V(f(x, u)) \ge \min(V(x), \rho \max V)

    Who rides along :math:`V = 0` exactly is thrown out by the interpolation between the nodes. Source: dynamic programming.
    """

    name = "kernel"
    Config = KernelConfig
    claimed = "the largest set, exact to a fraction of a cell"
    kernel: ViabilityKernel | None = None

    def prepare(self) -> None:
        """Compute the kernel, unless it is given already."""
        if self.kernel is None:
            self.kernel = viability_kernel(self.env, resolution=self.config.nodes or self.env.system.kernel_grid)

    def h(self, state: Tensor) -> Tensor:
        """Minus the kernel's value; its border does not belong to it."""
        assert self.kernel is not None
        value = self.kernel.interpolate(state).clamp(-1e3, 1e3)
        return torch.where(value > 0, -value, (-value).clamp_min(1e-9))

    def limit(self, state: Tensor) -> Tensor:
        """What is demanded of the successor."""
        assert self.kernel is not None
        return self.h(state).clamp_min(-self.config.depth * float(self.kernel.value.max())).clamp_max(0.0)


__all__ = [
    "BoxMargin", "Ceiling", "CollisionCone", "DepthBarrier", "HigherOrder", "LQREllipsoid", "TrueKernel", "TurningCircle",
]  # fmt: skip
