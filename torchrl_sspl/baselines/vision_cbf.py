r"""Vision-CBF: a conditional GAN draws where things are, geometry reads places and speed off it, a geometric barrier filters.

Faithful to Abdi, Raja, Ghabcheloo, *Safe control using vision-based control barrier function (V-CBF)*, ICRA 2023, as far as it is
described: pix2pix from the camera to geometry, a geometric barrier on it, known kinematics in the filter. The paper was not at
hand and no code is public. Stand-ins: heat-maps and an obstacle mask in place of 3-D geometry; a grid of actions and the
discrete condition in place of a quadratic program; barriers of second order (the collision cone for the car, a higher-order one
for the pendulum), because those of first order do not work on either task; the simulator's own step in place of kinematics. The pictures
of the geometry are drawn from true states, and the place of the obstacle is given to the barrier: the mask is drawn, and not
read. Pictures have 32 x 32 pixels, as all rivals' have. ``adversarial=false`` trains the same network by plain regression.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sspl.baselines.base import Budget, Needs, OneStepFilter
from torchrl_sspl.baselines.ceilings import collision_cone, higher_order
from torchrl_sspl.baselines.data import POOL, Recording, pooled
from torchrl_sspl.baselines.perception import fresh_error, train
from torchrl_sspl.envs.base import SafetyEnv, wrapped
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.envs.pendulum import PixelPendulumEnv
from torchrl_sspl.errors import ConfigError

_WIDTH = 1.5  # standard deviation of a blob, pixels
_ROD = 1.0 / 2.2  # length of gymnasium's rod, half pictures


class Geometry:
    """What the pictures are translated into, and the state that it tells.

    Pendulum: blobs at the tip of the rod at t-1 and t. Car: a mask of U, blobs at the robot at t-1 and t, and the blob at t
    times cosine and sine of the heading. Raises ConfigError for another system. Source: see the module.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> env = PendulumEnv()
        >>> of, state = Geometry(env), torch.tensor([[0.7, -1.0]])
        >>> bool((of.state(of.draw(state, env.previous_state(state))) - state).abs().max() < 0.05)
        True
    """

    def __init__(self, env: SafetyEnv) -> None:
        if not isinstance(env, PixelPendulumEnv | DubinsEnv) or env.state_dim > 3:
            raise ConfigError(f"expected a pendulum or a Dubins car without a yaw lag, received {type(env).__name__}")
        self.env: Any = env
        self.pendulum = isinstance(env, PixelPendulumEnv)
        self.channels = 2 if self.pendulum else 5
        self.axis = (torch.arange(POOL) + 0.5) / POOL * 2 - 1  # -1 to 1, to the right and down

    def place(self, state: Tensor) -> Tensor:
        """Places ``(n, 2)`` of tip or robot in the picture, to the right and down."""
        if self.pendulum:
            return _ROD * torch.stack([-state[:, 0].sin(), -state[:, 0].cos()], -1)
        return state[:, :2] * torch.tensor([1.0, -1.0]) / self.env.half_view

    def draw(self, state: Tensor, before: Tensor) -> Tensor:
        """The picture of the geometry, ``(n, channels, 32, 32)``."""

        def blob(place: Tensor) -> Tensor:
            wide = 2 * _WIDTH / POOL
            x = (-0.5 * ((self.axis - place[:, :1]) / wide).square()).exp()
            y = (-0.5 * ((self.axis - place[:, 1:]) / wide).square()).exp()
            return y[:, :, None] * x[:, None, :]

        old, new = blob(self.place(before)), blob(self.place(state))
        if self.pendulum:
            return torch.stack([old, new], 1)
        view = self.env.half_view
        x, y = torch.meshgrid(view * self.axis, -view * self.axis, indexing="xy")
        where = torch.stack([x, y, torch.zeros_like(x)], -1)
        mask = self.env.unsafe_set.contains(where.reshape(-1, 3)).reshape(1, POOL, POOL).float().expand(len(state), -1, -1)
        cos, sin = (t[:, None, None] for t in (state[:, 2].cos(), state[:, 2].sin()))
        return torch.stack([mask, old, new, new * cos, new * sin], 1)

    def centre(self, blob: Tensor) -> Tensor:
        """Centres ``(n, 2)`` of blobs ``(n, 32, 32)``: a soft argmax."""
        weight = blob.clamp_min(0).square() + 1e-9
        total = weight.sum((-2, -1))
        return torch.stack([(weight.sum(-2) @ self.axis) / total, (weight.sum(-1) @ self.axis) / total], -1)

    def state(self, picture: Tensor) -> Tensor:
        """States ``(n, s)`` that the geometry tells."""
        if self.pendulum:
            old, new = self.centre(picture[:, 0]), self.centre(picture[:, 1])
            before, now = torch.atan2(-old[:, 0], -old[:, 1]), torch.atan2(-new[:, 0], -new[:, 1])
            moved = wrapped(now - before)
            return torch.stack([now, moved / self.env.dt], -1)
        place = self.centre(picture[:, 2]) * torch.tensor([1.0, -1.0]) * self.env.half_view
        cos, sin = (picture[:, k] * picture[:, 2].clamp_min(0) for k in (3, 4))
        return torch.cat([place, torch.atan2(sin.sum((-2, -1)), cos.sum((-2, -1)))[:, None]], -1)


class UNet(nn.Module):
    """Generator: 32 x 32 pictures of two frames to the geometry. Source: Isola et al., pix2pix, CVPR 2017, three levels.

    Example:
        >>> UNet(5)(torch.zeros(2, 6, 32, 32)).shape
        torch.Size([2, 5, 32, 32])
    """

    def __init__(self, channels: int, width: int = 16) -> None:
        super().__init__()
        sizes = (6, width, 2 * width, 4 * width)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 4, 2, 1) for a, b in zip(sizes, sizes[1:], strict=False))
        self.up = nn.ModuleList([
            nn.ConvTranspose2d(4 * width, 2 * width, 4, 2, 1), nn.ConvTranspose2d(4 * width, width, 4, 2, 1),
            nn.ConvTranspose2d(2 * width, channels, 4, 2, 1),
        ])  # fmt: skip

    def forward(self, pixels: Tensor) -> Tensor:
        """``(n, 6, 32, 32)`` in [-1, 1] to ``(n, channels, 32, 32)``."""
        a = F.leaky_relu(self.down[0](pixels), 0.2)
        b = F.leaky_relu(self.down[1](a), 0.2)
        c = F.relu(self.up[0](F.leaky_relu(self.down[2](b), 0.2)))
        return self.up[2](torch.cat([F.relu(self.up[1](torch.cat([c, b], 1))), a], 1))


@dataclass
class VisionCBFConfig:
    """Options of the vision barrier."""

    steps: int = 1500  # of the optimiser
    batch: int = 64
    adversarial: bool = True  # a discriminator beside the plain loss
    plain: float = 100.0  # weight of the plain loss beside it
    k: float = 1.0  # of the pendulum's higher-order barrier, 1/s
    alpha: float = 0.5  # share of h that a step may leave
    offset: float = 0.0  # added to h


class VisionCBF(OneStepFilter):
    r"""Vision-CBF (Abdi, Raja, Ghabcheloo, ICRA 2023): pix2pix to geometry, a geometric barrier of second order, a filter.

    .. math:: L_G = \mathbb{E}\,\zeta(-D(o, G(o))) + 100 \lVert G(o) - y \rVert_1, \quad
        L_D = \mathbb{E}\,\zeta(-D(o, y)) + \mathbb{E}\,\zeta(D(o, G(o)))

    with the softplus :math:`\zeta`. Source: see the module.
    """

    name = "vision_cbf"
    Config: ClassVar[type | None] = VisionCBFConfig
    space: ClassVar[dict[str, tuple[Any, ...]]] = {
        "steps": (1500, 4500), "k": (0.5, 1.0, 2.0), "alpha": (0.5, 0.8, 0.95), "offset": (0.0, 0.1, 0.3),
    }  # fmt: skip

    @classmethod
    def idle(cls, env: SafetyEnv) -> tuple[str, ...]:
        """The car's barrier has no ``k``."""
        return () if isinstance(env, PixelPendulumEnv) else ("k",)

    def fit(self, data: Recording, env: SafetyEnv, budget: Budget, seed: int) -> None:
        """Learn to draw the geometry; see :meth:`SafetyMethod.fit`."""
        c = self.config
        self.env, self.alpha, self.offset, self.of = env, c.alpha, c.offset, Geometry(env)
        self.network, self.notes["loss"] = self.stage(("steps", "batch", "adversarial", "plain"), lambda: self._draw(data, seed))
        self.notes |= fresh_error(self.perceive, env)
        self.needs = Needs(
            transitions=len(data), masks=len(data), dynamics="exact",
            claimed="invariance of the geometric set, for exact geometry and without a bound on the action",
        )  # fmt: skip

    def _draw(self, data: Recording, seed: int) -> tuple[UNet, float]:
        """A network that draws the geometry, and its loss."""
        c = self.config
        network, judge = UNet(self.of.channels), nn.Sequential(
            nn.Conv2d(6 + self.of.channels, 16, 4, 2, 1), nn.LeakyReLU(0.2), nn.Conv2d(16, 32, 4, 2, 1), nn.LeakyReLU(0.2), nn.Conv2d(32, 1, 3, 1, 1)
        )  # fmt: skip
        before = self.env.previous_state(data.state)

        def loss(rows: Tensor) -> dict[str, Tensor]:
            seen = data.frames[rows, :2].flatten(1, 2).float() / 127.5 - 1.0
            wanted = self.of.draw(data.state[rows], before[rows])
            drawn = network(seen)
            terms = {"loss_plain": c.plain * (drawn - wanted).abs().mean()}
            if c.adversarial:
                # One optimiser for both: of the generator's term no gradient reaches the judge's weights, and the other way round.
                true, false = judge(torch.cat([seen, wanted], 1)), judge(torch.cat([seen, drawn.detach()], 1))
                terms["loss_judge"] = F.softplus(-true).mean() + F.softplus(false).mean()
                frozen = {k: v.detach() for k, v in judge.named_parameters()}
                fooled = torch.func.functional_call(judge, frozen, (torch.cat([seen, drawn], 1),))
                terms["loss_fool"] = F.softplus(-fooled).mean()
            return terms

        networks: dict[nn.Module, float] = {network: 2e-3}
        if c.adversarial:
            networks[judge] = 5e-4
        loop = train(seed, c.steps, networks, loss, len(data), c.batch)
        return network, float(loop.loss or 0.0)

    @torch.no_grad()
    def perceive(self, seen: Tensor) -> Tensor:
        """The state that the drawn geometry tells."""
        parts = [self.network(part.float() / 127.5 - 1.0) for part in pooled(seen).split(500)]
        return self.of.state(torch.cat(parts))

    def h(self, state: Tensor) -> Tensor:
        """The geometric barrier, at most zero where safe."""
        if self.of.pendulum:
            return higher_order(self.env, state, self.config.k)
        return collision_cone(self.env, state)

    def predict(self, state: Tensor, action: Tensor) -> Tensor:
        """One step of the known dynamics."""
        return self.env.wrap(self.env.dynamics(state, action))


__all__ = ["Geometry", "UNet", "VisionCBF"]
