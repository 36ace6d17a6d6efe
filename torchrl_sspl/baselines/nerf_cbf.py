r"""NeRF-CBF: a radiance field of the scene, a depth rendered at the predicted pose, a barrier on the least depth.

Faithful to Tong, Dawson, Fan, *Enforcing safety for vision-based controllers via control barrier functions and neural radiance
fields*, ICRA 2023 (arXiv 2209.12266; code oscartong2001/nerf-cbf-controller): known pose, exact model, :math:`h = d - \text{least
depth} + \beta \lVert v \rVert`, accepted where :math:`h(x') \le \alpha h(x)`, with their constants d = 0.1, beta = 1, alpha = 0.5. Reduced: our camera
stands still and the robot moves, so the field is two-dimensional and has two parts, a scene and a robot in its own frame, in
plain torch. Stand-ins: depth is the distance to the nearest place where the learned density of the scene stops a ray (all
directions, tabulated once), of the pendulum the clearance of the angle, for which the field is learnt and not asked; a grid of bounded actions in place of their
sampling, which never ends where no action is admitted. On the car the speed is constant, and ``form="speed"`` is of relative
degree two; ``form="closing"`` takes the closing speed instead. ``pose="estimated"`` reads pictures in place of the true state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from torchrl_sspl.baselines.base import Budget, Needs, OneStepFilter
from torchrl_sspl.baselines.ceilings import box_of
from torchrl_sspl.baselines.data import POOL, Recording
from torchrl_sspl.baselines.perception import Perception, fresh_error, train
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.envs.pendulum import PixelPendulumEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.modules.networks import mlp

_TABLE = 97  # nodes of the table of distances, per side
_RAYS = 2048  # pixels per step
_EMPTY = 0.01  # price of what stops the light: a picture alone does not tell white from nothing
_OPAQUE = 0.5  # share of the light that a place has to stop to count as occupied


class Field(nn.Module):
    """A two-dimensional radiance field: places ``(n, 2)`` to colour ``(n, 3)`` and the share of the light that is stopped ``(n, 1)``.

    Source: Mildenhall et al., NeRF, ECCV 2020, in the plane, with one sample per ray of an orthographic camera.

    Example:
        >>> [t.shape for t in Field()(torch.zeros(5, 2))]
        [torch.Size([5, 3]), torch.Size([5, 1])]
    """

    def __init__(self, bands: int = 4) -> None:  # six, as published, wave between the pixels of 32 x 32
        super().__init__()
        self.bands = math.pi * 2.0 ** torch.arange(bands)
        self.net = mlp((2 + 4 * bands, 64, 64, 4), nn.SiLU)

    def forward(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Colour in [0, 1], and the share of the light that is stopped."""
        waves = (place[:, :, None] * self.bands).flatten(1)
        out = self.net(torch.cat([place, waves.sin(), waves.cos()], -1))
        return out[:, :3].sigmoid(), 1 - (-nn.functional.softplus(out[:, 3:] - 2.0)).exp()


class Scene(nn.Module):
    """Two fields before a background: what stands still, and the robot in its own frame. Source: see the module.

    Args:
        env: the system, of which pose and size of the picture are taken.
        ground: colour ``(3,)`` of the background in [0, 1]; what looks like it is taken for empty.
    """

    ground: Tensor

    def __init__(self, env: SafetyEnv, ground: Tensor) -> None:
        super().__init__()
        if not isinstance(env, PixelPendulumEnv | DubinsEnv) or env.state_dim > 3:
            raise ConfigError(f"expected a pendulum or a Dubins car without a yaw lag, received {type(env).__name__}")
        self.view = env.half_view if isinstance(env, DubinsEnv) else 2.2
        self.car = isinstance(env, DubinsEnv)
        self.still, self.robot = Field(), Field()
        self.register_buffer("ground", ground)

    def forward(self, place: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Colours ``(n, 3)`` at places ``(n, 2)`` in the picture, each with its state ``(n, s)``, and how much stops the light."""
        heading = state[:, 2] if self.car else state[:, 0]
        centre = state[:, :2] / self.view if self.car else torch.zeros_like(state)
        cos, sin = heading.cos(), heading.sin()
        x, y = (place - centre).unbind(-1)
        own = torch.stack([cos * x + sin * y, cos * y - sin * x], -1)
        (near, stops), (far, blocks) = self.robot(own), self.still(place)
        behind = blocks * far + (1 - blocks) * self.ground
        return stops * near + (1 - stops) * behind, stops + blocks


@dataclass
class NeRFCBFConfig:
    """Options; the defaults of margin, beta and alpha are the published constants."""

    steps: int = 1500  # of the optimiser
    margin: float = 0.1  # d: rad, or m
    beta: float = 1.0  # weight of the speed, s
    alpha: float = 0.5  # share of h that a step may leave
    actions: int = 41  # that are tried
    form: str = "speed"  # "speed" (as published) or "closing": the closing speed alone
    pose: str = "true"  # "true" (as published) or "estimated" from pictures
    perception_steps: int = 2000  # of the estimate


class NeRFCBF(OneStepFilter):
    r"""NeRF-CBF (Tong, Dawson, Fan, ICRA 2023): depth of a learned field at the predicted pose.

    .. math:: h(x) = d - \min_{rays} \text{depth}(x) + \beta \lVert v \rVert

    Source: see the module.
    """

    name = "nerf_cbf"
    Config: ClassVar[type | None] = NeRFCBFConfig
    space: ClassVar[dict[str, tuple[Any, ...]]] = {
        "margin": (0.0, 0.1, 0.2), "beta": (0.5, 0.7, 1.0), "alpha": (0.5, 0.8, 0.9), "form": ("speed", "closing"),
    }  # fmt: skip

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        if self.config.form not in ("speed", "closing") or self.config.pose not in ("true", "estimated"):
            raise ConfigError(f"nerf_cbf: expected form=speed|closing and pose=true|estimated, received {self.config.form}, {self.config.pose}")
        self.reads = "state" if self.config.pose == "true" else "pixels"  # type: ignore[misc]

    def fit(self, data: Recording, env: SafetyEnv, budget: Budget, seed: int) -> None:
        """Learn the field from posed pictures; see :meth:`SafetyMethod.fit`."""
        c = self.config
        self.env, self.alpha, self.grid = env, c.alpha, c.actions
        self.scene = Scene(env, data.frames[:200, 1].float().permute(1, 0, 2, 3).flatten(1).median(1).values / 255.0)
        self._learn(data, seed)
        if self.scene.car:
            self._tabulate()
        self.eyes = None
        if c.pose == "estimated":
            self.eyes = Perception(env, data, c.perception_steps, seed)
            self.notes |= fresh_error(self.eyes, env)
        self.needs = Needs(
            transitions=len(data), states=len(data), state_at_run_time=c.pose == "true", dynamics="exact",
            claimed="invariance of {h <= 0}, for an exact pose, where some action is admitted",
        )  # fmt: skip

    def _learn(self, data: Recording, seed: int) -> None:
        axis = (torch.arange(POOL) + 0.5) / POOL * 2 - 1
        frames = data.frames[:, 1]
        median = frames[:: max(1, len(data) // 500)].float().median(0).values
        generator = torch.Generator().manual_seed(seed)

        def loss(rows: Tensor) -> dict[str, Tensor]:
            row, column = torch.randint(POOL, (2, len(rows)), generator=generator)
            wanted = frames[rows, :, row, column].float()
            place = torch.stack([axis[column], -axis[row]], -1)
            heavy = 1.0 + 9.0 * ((wanted - median[:, row, column].T).abs().amax(-1, keepdim=True) > 8.0)
            told, stops = self.scene(place, data.state[rows])
            return {"loss": (heavy * (told - wanted / 255.0).square()).mean(), "loss_empty": _EMPTY * stops.mean()}

        loop = train(seed, self.config.steps, {self.scene: 5e-3}, loss, len(data), _RAYS)
        self.notes["field_loss"] = float(loop.loss or 0.0)

    @torch.no_grad()
    def _tabulate(self) -> None:
        """Distance in m from every place of a table to the nearest one at which the scene stops the light."""
        env: Any = self.env
        reach = env.arena_half_size
        axis = torch.linspace(-reach, reach, _TABLE)
        places = torch.cartesian_prod(axis, axis)
        stops = self.scene.still(places / self.scene.view)[1][:, 0] > _OPAQUE
        self.notes["occupied_m2"] = float(stops.float().mean()) * (2 * reach) ** 2
        occupied = places[stops]
        far = torch.full((len(places),), 2 * reach)
        if len(occupied):
            p = 2.0 if env.obstacle_shape == "disc" else torch.inf
            far = torch.cat([torch.cdist(part, occupied, p=p).amin(1) for part in places.split(1000)])
        # U is larger than what stands there, by the reach of the robot.
        self.table = (far - (env.unsafe_half_size - env.obstacle_half_size)).reshape(1, 1, _TABLE, _TABLE)

    def depth(self, state: Tensor) -> Tensor:
        """Least depth ``(n,)`` less the robot's reach; of the pendulum the clearance of its angle, rad."""
        if not self.scene.car:
            return box_of(self.env)[0] - state[:, 0].abs()
        at = (state[:, :2] / self.env.arena_half_size).flip(-1)[None, None]  # type: ignore[attr-defined]
        return nn.functional.grid_sample(self.table, at, align_corners=True, padding_mode="border")[0, 0, 0]

    def perceive(self, seen: Tensor) -> Tensor:
        """The true state, or what the pictures tell of it."""
        return seen if self.eyes is None else self.eyes(seen)

    def h(self, state: Tensor) -> Tensor:
        """The barrier; of the pendulum together with the bound on the speed that U asks for."""
        c, depth = self.config, self.depth(state)
        if not self.scene.car:
            speed = state[:, 1].abs()
            closing = (state[:, 1] * state[:, 0].sign()).clamp_min(0)
            h = c.margin - depth + c.beta * (speed if c.form == "speed" else closing)
            return torch.maximum(h, speed - box_of(self.env)[1])
        v, ahead = self.env.speed, state.clone()  # type: ignore[attr-defined]
        if c.form == "speed":
            return c.margin - depth + c.beta * v
        step = 0.05
        ahead[:, :2] += step * torch.stack([state[:, 2].cos(), state[:, 2].sin()], -1)
        return c.margin - depth + c.beta * v * ((depth - self.depth(ahead)) / step).clamp_min(0)

    def predict(self, state: Tensor, action: Tensor) -> Tensor:
        """One step of the exact model."""
        return self.env.wrap(self.env.dynamics(state, action))


__all__ = ["Field", "NeRFCBF", "Scene"]
